"""Raw OmniObject3D objects, rendered or filmed.

<object>/render/      blender_renders: transforms.json, images/r_<i>.png with alpha (depths/ and normals/ unused)
<object>/standard/    videos_processed: images/, matting/ with foreground masks, and poses as a COLMAP model in
                      sparse/ or as poses_bounds.npy (COLMAP's scale), poses_bounds_rescaled.npy (world scale)

Either folder, or the object's folder above it, is the scene. The render's file_path is a path of the machine
that rendered: only its last part counts. Of the filmed poses the COLMAP model is read where there is one; the
format omni3d-llff reads the LLFF file instead, the rescaled one first. Every 8th view is for testing: the data
names no split.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from datamodules.capture import Capture
from datamodules.files.find_model import find_model
from datamodules.files.paths import inside
from datamodules.layouts import colmap, llff, transforms
from datamodules.request import Request
from visdom_plugin.errors import SceneError

_LLFF = ("poses_bounds_rescaled.npy", llff.FILE)


def recognise(root: Path) -> str | None:
    """What makes the folder look like this layout, or None."""
    found = _find(root)
    return None if found is None else f"{found[0].name or root.name}/{found[1]}"


def _find(root: Path) -> tuple[Path, str] | None:
    """The folder below (or of) the object that holds the scene, and what it was known by."""
    for base in (root, root / "render"):
        if (base / "transforms.json").is_file():
            rendered = [name for name in ("depths", "normals") if (base / name).is_dir()]
            if base != root or rendered:
                return base, rendered[0] if rendered else "transforms.json"
    for base in (root, root / "standard"):
        if (base / "matting").is_dir():
            return base, "matting"
    return None


def read(root: Path, request: Request) -> Capture:
    """Reads the rendered or the filmed layout, whichever the folder has.

    Raises:
        SceneError: neither, or both below one object's folder.
    """
    if (root / "render").is_dir() and (root / "standard").is_dir():
        raise SceneError(
            "this object has a rendered and a filmed capture",
            where=root,
            todo=f"name one: {root / 'render'} or {root / 'standard'}",
            topic="layout",
        )
    base = _base(root, request)
    if (base / "matting").is_dir() or not (base / "transforms.json").is_file():
        return _filmed(root, base, request, prefer_llff=False)
    file = transforms.read_transforms(base, "transforms.json", request)
    return replace(
        transforms.make_capture(base, request, "omni3d", [file], rename=_last_part), name=_name(root)
    )


def read_llff(root: Path, request: Request) -> Capture:
    """The filmed layout with its LLFF poses."""
    return _filmed(root, _base(root, request), request, prefer_llff=True)


def _base(root: Path, request: Request) -> Path:
    found = _find(root)
    if found is None:
        return root
    if found[0] != root:
        inside(root, found[0].name, outside=request.allow_outside)
    return found[0]


def _last_part(file_path: str) -> str:
    last = file_path.rstrip("/").rpartition("/")[2]
    return f"images/{last}" if last.lower().endswith(".png") else f"images/{last}.png"


def _filmed(root: Path, base: Path, request: Request, *, prefer_llff: bool) -> Capture:
    tables: Sequence[str] = [name for name in _LLFF if (base / name).is_file()]
    folder = find_model(base)
    if tables and (prefer_llff or folder is None):
        capture = llff.read_capture(base, request, "omni3d", file=tables[0], mask_folder="matting")
    elif folder is not None and not prefer_llff:
        note = (
            f"poses of the COLMAP model in {folder}; --data-format omni3d-llff takes {tables[0]}"
            if tables
            else None
        )
        capture = colmap.read_capture(
            base,
            request,
            "omni3d",
            folder=folder,
            mask_folder="matting",
            notes=[note] if note else [],
        )
    else:
        raise SceneError(
            f"there are no poses: neither a COLMAP model in sparse/ nor {' or '.join(_LLFF)}",
            where=base,
            cause="the scene was copied only in part",
            topic="no-scene",
        )
    return replace(capture, name=_name(root))


def _name(root: Path) -> str:
    """The object's: the folders render and standard are the same for all."""
    real = root.resolve()
    return real.parent.name if real.name in ("render", "standard") else real.name
