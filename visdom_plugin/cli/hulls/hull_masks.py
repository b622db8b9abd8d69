"""Masks made of a hull: its outline seen by any camera, as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras

if TYPE_CHECKING:
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Scene


def mask_cameras(which: str, scene: Scene, hull: Hull, frames: int) -> tuple[Cameras, list[str]]:
    """Cameras to see the hull with, and a file name without ending for each.

    Args:
        which: "train", "test" or "orbit", a circle round the hull's centre with the first training camera's
            intrinsics.
        frames: cameras on the circle.
    """
    import torch

    from visdom_plugin.figures.contact_sheet import picture_names
    from visdom_plugin.geometry.camera_paths import orbit

    if which == "orbit":
        centre = torch.as_tensor(hull.centre)
        return orbit(scene.train.cameras, frames, centre), [f"orbit_{i:04d}" for i in range(frames)]
    views = getattr(scene, which)
    return views.cameras, picture_names(views.names)


def write_masks(
    hull: Hull, cameras: Cameras, names: list[str], folder: Path, *, poses: bool, overwrite: bool = False
) -> list[Path]:
    """`<folder>/<name>.png` for each camera, 8 bit, 255 on the hull and 0 beside it; each appears in one step.

    Args:
        cameras: (N,) cameras.
        poses: write `<folder>/transforms.json`, too, for cameras that no file of the scene has.
        overwrite: replace files that are there.

    Returns:
        The files written.

    Raises:
        ConfigError: a file is there already, which may be a mask made by hand; nothing is written then. Or the
            folder cannot be written.
    """
    import numpy as np

    from visdom_plugin.atomic_files import write_json
    from visdom_plugin.figures.contact_sheet import write_png
    from visdom_plugin.hull.queries.raycast import depth_and_silhouette

    files = [folder / f"{name}.png" for name in names]
    target = folder / "transforms.json"
    there = [path for path in [*files, *([target] if poses else [])] if path.exists()]
    if there and not overwrite:
        raise ConfigError(
            f"{there[0].name} is there already" + (f", and {len(there) - 1} more" if len(there) > 1 else ""),
            where=folder,
            cause="masks that were made by hand, or an earlier run of this command",
            todo="choose another folder with --masks-out, or pass --overwrite",
        )
    try:
        for i, path in enumerate(files):
            _, seen = depth_and_silhouette(hull, cameras[i].to("cpu"))
            write_png(path, seen.numpy().astype(np.uint8) * 255)
        if poses:
            write_json(target, describe_cameras(cameras, names))
    except OSError as error:
        raise ConfigError(
            f"the masks cannot be written: {error.strerror or error}",
            where=folder,
            todo="choose another folder with --masks-out",
        ) from error
    return [*files, *([target] if poses else [])]


def describe_cameras(cameras: Cameras, names: list[str]) -> dict[str, Any]:
    """Cameras as nerfstudio's transforms.json has them: OpenGL axes, camera to world, pixels.

    Its `mask_path` would mean pixels to leave out of training, so the masks stand as `file_path`.
    """
    frames = []
    for i, name in enumerate(names):
        camera = cameras[i].to("cpu")
        K, motion = camera.intrinsics.double(), camera.world_from_camera.double().clone()
        motion[:3, 1:3] *= -1
        frames.append(
            {
                "file_path": f"{name}.png",
                "w": int(camera.width),
                "h": int(camera.height),
                "fl_x": float(K[0, 0]),
                "fl_y": float(K[1, 1]),
                "cx": float(K[0, 2]),
                "cy": float(K[1, 2]),
                "transform_matrix": motion.tolist(),
            }
        )
    return {"camera_model": "PINHOLE", "frames": frames}
