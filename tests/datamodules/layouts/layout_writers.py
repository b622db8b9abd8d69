"""Writes one and the same scene in each layout on disk, as plainly as the formats are described.

Every writer takes views with their names, and puts the pictures, masks and cameras of all of them into a folder.
Units, axes and orders are the format's own: what a reader must undo is done here by hand.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import torch

from tests.datamodules.layouts.prepared_writer import write, write_model
from visdom_plugin.geometry.rotations import quaternion_from_matrix
from visdom_plugin.scene import Views

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def join(*parts: Views) -> Views:
    """Train and test views in one list."""
    from visdom_plugin.geometry.cameras import Cameras

    cameras = Cameras(
        *(
            torch.cat([getattr(p.cameras, name) for p in parts])
            for name in ("intrinsics", "world_from_camera", "width", "height")
        )
    )
    return Views(
        cameras,
        tuple(i for p in parts for i in p.images),
        tuple(m for p in parts for m in p.masks),
        tuple(n for p in parts for n in p.names),
    )


def lens(views: Views, i: int) -> tuple[float, float, float, float, int, int]:
    """fx, fy, cx, cy, width, height."""
    K = views.cameras.intrinsics[i]
    numbers = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return (*numbers, int(views.cameras.width[i]), int(views.cameras.height[i]))


def write_photograph(path: Path, views: Views, i: int, *, alpha: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = views.images[i].numpy()[..., ::-1]
    if alpha:
        picture = np.concatenate([picture, views.masks[i].numpy()[..., None].astype(np.uint8) * 255], -1)
    write(path, picture)


def write_mask(path: Path, views: Views, i: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, views.masks[i].numpy().astype(np.uint8) * 255)


def colmap_rows(views: Views) -> list[tuple]:
    rows = []
    for i, name in enumerate(views.names):
        fx, fy, cx, cy, width, height = lens(views, i)
        world = views.cameras[i].camera_from_world
        pose = [*quaternion_from_matrix(world[:3, :3]).tolist(), *world[:3, 3].tolist()]
        rows.append((f"{name}.png", pose, [fx, fy, cx, cy], width, height))
    return rows


def write_colmap(views: Views, folder: Path, *, binary=True, model="sparse/0", masks="masks") -> Path:
    """images/, a mask folder and a model; further names by the caller."""
    (folder / model).mkdir(parents=True)
    for i, name in enumerate(views.names):
        write_photograph(folder / f"images/{name}.png", views, i)
        write_mask(folder / f"{masks}/{name}.png", views, i)
    write_model(folder / model, colmap_rows(views)[::-1], binary, "PINHOLE")
    return folder


def write_mip360(views: Views, folder: Path) -> Path:
    """With a half-size copy of the photographs and the poses in LLFF's form beside the model."""
    write_colmap(views, folder)
    (folder / "images_2").mkdir()
    for path in (folder / "images").iterdir():
        picture = cv2.imread(str(path))
        size = picture.shape[1] // 2, picture.shape[0] // 2
        write(folder / "images_2" / path.name, cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    write_poses_bounds(views, folder / "poses_bounds.npy")
    return folder


def write_poses_bounds(views: Views, path: Path, scale: float = 1.0) -> None:
    """Down, right, backward, position | height, width, focal; near, far; rows in the order of the names."""
    rows = []
    for i in sorted(range(len(views.names)), key=lambda i: views.names[i]):
        fx, _, _, _, width, height = lens(views, i)
        motion = views.cameras.world_from_camera[i].numpy()
        right, down, forward, centre = motion[:3].T
        table = np.stack([down, right, -forward, scale * centre, [height, width, fx]], -1)
        rows.append([*table.reshape(-1), 0.5, 9.0])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(rows))


def write_llff(views: Views, folder: Path) -> Path:
    for i, name in enumerate(views.names):
        write_photograph(folder / f"images/{name}.png", views, i)
        write_mask(folder / f"masks/{name}.png", views, i)
    write_poses_bounds(views, folder / "poses_bounds.npy")
    return folder


def opengl(views: Views, i: int) -> list[list[float]]:
    return (views.cameras.world_from_camera[i].numpy() @ OPENGL).tolist()


def angle(pixels: int, focal: float) -> float:
    return 2 * math.atan(0.5 * pixels / focal)


def write_json(path: Path, content) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))


def write_blender(parts: dict[str, Views], folder: Path) -> Path:
    """transforms_<part>.json, file paths without extension, alpha as mask, one field of view for all."""
    for part, views in parts.items():
        frames = []
        for i, name in enumerate(views.names):
            write_photograph(folder / f"{part}/{name}.png", views, i, alpha=True)
            frames.append(
                {"file_path": f"./{part}/{name}", "rotation": 0.1, "transform_matrix": opengl(views, i)}
            )
        fx, *_, width, _ = lens(views, 0)
        write_json(folder / f"transforms_{part}.json", {"camera_angle_x": angle(width, fx), "frames": frames})
    return folder


def write_nerfstudio(views: Views, folder: Path, *, alpha: bool = False) -> Path:
    """Focal lengths, principal points and sizes per frame; frames in no order."""
    frames = []
    for i, name in enumerate(views.names):
        write_photograph(folder / f"images/{name}.png", views, i, alpha=alpha)
        if not alpha:
            write_mask(folder / f"masks/{name}.png", views, i)
        keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
        row = dict(zip(keys, lens(views, i), strict=True))
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": opengl(views, i), **row})
    content = {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "frames": frames[::-1]}
    write_json(folder / "transforms.json", content)
    return folder


def write_instant_ngp(views: Views, folder: Path) -> Path:
    """Angles in degrees, no sizes, its own scale and offset, extensions left out, alpha in side files."""
    frames = []
    for i, name in enumerate(views.names):
        fx, fy, cx, cy, width, height = lens(views, i)
        write_photograph(folder / f"images/{name}.png", views, i)
        write_mask(folder / f"images/{name}.alpha.png", views, i)
        frames.append(
            {
                "file_path": f"./images/{name}",
                "transform_matrix": opengl(views, i),
                "x_fov": math.degrees(angle(width, fx)),
                "y_fov": math.degrees(angle(height, fy)),
                "cx": cx,
                "cy": cy,
            }
        )
    write_json(
        folder / "transforms.json",
        {"aabb_scale": 16, "scale": 0.5, "offset": [0.1, 0.2, 0.3], "up": [0, 0, 1], "frames": frames},
    )
    return folder


def write_omni3d_render(views: Views, folder: Path) -> Path:
    """<object>/render with paths of the machine that rendered."""
    frames = []
    for i, name in enumerate(views.names):
        write_photograph(folder / f"render/images/{name}.png", views, i, alpha=True)
        where = f"/mnt/machine/omni/out/{folder.name}/render/{name}"
        frames.append(
            {"file_path": where, "rotation": 0.01, "transform_matrix": opengl(views, i), "scale": 0.7}
        )
    (folder / "render/depths").mkdir()
    (folder / "render/normals").mkdir()
    fx, *_, width, _ = lens(views, 0)
    write_json(folder / "render/transforms.json", {"camera_angle_x": angle(width, fx), "frames": frames})
    return folder


def write_omni3d_video(views: Views, folder: Path, *, poses: str = "colmap") -> Path:
    """<object>/standard with mattes, and poses as a model, an LLFF file or both at two scales."""
    base = folder / "standard"
    if poses == "llff":
        for i, name in enumerate(views.names):
            write_photograph(base / f"images/{name}.png", views, i)
            write_mask(base / f"matting/{name}.png", views, i)
    else:
        write_colmap(views, base, model="sparse/0", masks="matting")
    write_poses_bounds(views, base / "poses_bounds.npy", scale=0.25 if poses == "llff" else 1)
    if poses == "llff":
        write_poses_bounds(views, base / "poses_bounds_rescaled.npy")
    return folder


def write_actorshq(views: Views, folder: Path, *, frame: int = 15, scales=(1,), rig=None) -> Path:
    """Cameras Cam001..., or of these numbers, in the order of the views; frame `frame` and a later one's box."""
    for scale in scales:
        lines = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
        for i in range(len(views.names)):
            fx, fy, cx, cy, width, height = lens(views, i)
            motion = views.cameras.world_from_camera[i].numpy()
            axis, _ = cv2.Rodrigues(motion[:3, :3])
            name = f"Cam{i + 1 if rig is None else rig[i]:03d}"
            numbers = [*axis[:, 0], *motion[:3, 3], fx / width, fy / height, cx / width, cy / height]
            small = width // scale, height // scale
            lines.append(",".join([name, *map(str, small), *(repr(float(v)) for v in numbers)]))
            picture, mask = views.images[i].numpy()[..., ::-1], views.masks[i].numpy().astype(np.uint8) * 255
            base = folder / f"{scale}x"
            for kind in ("rgbs", "masks"):
                (base / kind / name).mkdir(parents=True, exist_ok=True)
            shrink = [cv2.resize(a, small, interpolation=cv2.INTER_AREA) for a in (picture, mask)]
            # Lossless behind the name of a JPEG, so that pixels can be compared.
            data = cv2.imencode(".png", np.ascontiguousarray(shrink[0]))[1].tobytes()
            (base / f"rgbs/{name}/{name}_rgb{frame:06d}.jpg").write_bytes(data)
            write(base / f"masks/{name}/{name}_mask{frame:06d}.png", np.repeat(shrink[1][..., None], 3, -1))
        (folder / f"{scale}x/calibration.csv").write_text("\n".join(lines) + "\n")
    corners = "aabb_min_x,aabb_min_y,aabb_min_z,aabb_max_x,aabb_max_y,aabb_max_z"
    (folder / "aabbs.csv").write_text(
        f"frame_number,{corners}\n{frame},-1,-2,-3,1,2,3\n{frame + 1},0,0,0,1,1,1\n"
    )
    return folder
