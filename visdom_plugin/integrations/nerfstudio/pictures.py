"""Views as the image files nerfstudio wants to read: PNG with the foreground mask as alpha."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.integrations.nerfstudio.frame import Similarity
from visdom_plugin.scene import Views


class TrainingViews(NamedTuple):
    """What a model may know of the data: training views in the world frame, and the model's frame."""

    views: Views
    frame: Similarity


def default_cache() -> Path:
    """The user's cache folder for pictures."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "visdom-plugin" / "nerfstudio"


def write_pictures(views: Views, cache: Path) -> tuple[list[Path], list[Path] | None]:
    """Files of the views, named by their content, so that what is there already is right.

    Args:
        views: decoded here, one after the other.
        cache: a folder; made where there is none.

    Returns:
        One RGBA file per view, colours as photographed, alpha 255 on the object; and one file per view that is
        255 where the photograph counts, or None where all of it does in every view.
    """
    pictures, counted, ignoring = [], [], False
    for i, name in enumerate(views.names):
        rgb, mask, ignore = views.images[i].numpy(), views.masks[i].numpy(), views.ignored(i)
        counts = np.ones_like(mask) if ignore is None else ~ignore.numpy()
        ignoring |= not counts.all()
        bgra = np.dstack([rgb[..., ::-1], np.uint8(255) * mask])
        pictures.append(_write(bgra, cache, name))
        counted.append((np.uint8(255) * counts, name))
    if not ignoring:
        return pictures, None
    return pictures, [_write(pixels, cache, name) for pixels, name in counted]


def _write(pixels: np.ndarray, cache: Path, name: str) -> Path:
    content = hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()
    safe = re.sub(r"[^\w.+-]+", "_", Path(name).stem).strip(".") or "view"
    path = cache / content[:24] / f"{safe}.png"
    if not path.exists():
        write_bytes(path, cv2.imencode(".png", pixels)[1].tobytes())
    return path
