"""Masks by rembg's networks, from model files in a folder that the user names: nothing is downloaded."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from visdom_plugin.compute.waiting import counting, phase
from visdom_plugin.errors import ConfigError, SceneError, list_some


def cut_with_rembg(
    images: Sequence[np.ndarray], names: Sequence[str], models: str | None, model: str
) -> list[np.ndarray]:
    """Masks N x (H, W) bool of N x (H, W, 3) uint8 photographs.

    Raises:
        ConfigError: rembg is not installed, or the model's file is not in the folder or cannot be opened.
    """
    with phase(f"opening {model}"):
        session, remove = open_session(models, model)

    def cut(image: np.ndarray, name: str) -> np.ndarray:
        try:
            soft = np.asarray(remove(np.ascontiguousarray(image), session=session, only_mask=True))
        except Exception as error:  # the network's runtime raises whatever it comes across
            raise SceneError(f"rembg failed on {name}: {str(error)[:200]}", where=models) from error
        return soft.reshape(image.shape[:2]) > 127

    with counting("making masks", len(images)) as count:
        return [count(cut(image, name)) for image, name in zip(images, names, strict=True)]


def open_session(models: str | None, model: str) -> tuple[Any, Any]:
    """rembg's session and its function."""
    if models is None:
        raise ConfigError(
            "rembg needs the folder that its models are in",
            where="--mask-source rembg",
            todo=f"--rembg-models DIR, with {model}.onnx from rembg's release page in it",
            topic="weights",
        )
    folder = Path(models).expanduser()
    files = sorted(p.stem for p in folder.glob("*.onnx")) if folder.is_dir() else []
    if model not in files:
        raise ConfigError(
            f"there is no {model}.onnx in this folder" + (f"; there is {list_some(files)}" if files else ""),
            where=f"--rembg-models {models}",
            todo=f"--rembg-model {files[0]}" if files else "download the model from rembg's release page",
            topic="weights",
        )
    # Read by rembg when a session is opened: where models lie, and that one of another checksum than that of the
    # release is not to be downloaded in its place.
    os.environ |= {"U2NET_HOME": str(folder.resolve()), "MODEL_CHECKSUM_DISABLED": "1"}
    try:
        from rembg import new_session, remove
    except ImportError as error:
        raise ConfigError(
            "rembg is not installed",
            where="--mask-source rembg",
            todo="pip install 'visdom-plugin[rembg]', or take --mask-source grabcut",
            topic="not-installed",
        ) from error
    try:
        return new_session(model), remove
    except Exception as error:  # ValueError of rembg, and whatever the network's runtime raises
        raise ConfigError(
            f"rembg cannot open {model}.onnx: {str(error)[:200]}",
            where=f"--rembg-models {models}",
            cause="the file is no model or cut short, or rembg knows no model of this name",
            todo="download it again, and keep the name it has on rembg's release page",
        ) from error
