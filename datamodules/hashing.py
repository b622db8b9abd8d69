"""Hashes of what a scene's views hold."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable

from torch import Tensor

from visdom_plugin.scene import Views


def hash_parts(views: Views) -> dict[str, str]:
    """SHA-256 of the cameras, images, masks and depths as decoded, so that other data is told apart."""

    def digest(tensors: Iterable[Tensor | None]) -> str:
        state = hashlib.sha256()
        for tensor in tensors:
            if tensor is None:
                state.update(b"none")
                continue
            state.update(json.dumps([str(tensor.dtype), list(tensor.shape)]).encode())
            state.update(tensor.contiguous().numpy().data)
        return state.hexdigest()

    cameras = views.cameras
    hashes = {
        "cameras": digest([cameras.intrinsics, cameras.world_from_camera, cameras.width, cameras.height]),
        "images": digest(views.images),
        "masks": digest(views.masks),
    }
    if views.ignore:
        hashes["ignore"] = digest(views.ignore)
    return hashes | ({"mono_depths": digest(views.mono_depths)} if views.mono_depths else {})
