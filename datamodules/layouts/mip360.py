"""Raw MipNeRF360 scenes (360_v2), with masks added by the user.

images/, images_2/, images_4/, images_8/   photographs, smaller by these factors
sparse/0/                                  COLMAP model of pinhole cameras at the size of images/
masks/                                     foreground masks, which the published data does not have
poses_bounds.npy                           the same poses in LLFF's form, not used

The standard split: by name, positions 0, 8, 16, ... test. Sparse training views are spread evenly over the
others, or listed by hand or in index files.
"""

from __future__ import annotations

from pathlib import Path

from datamodules.capture import Capture
from datamodules.layouts import colmap
from datamodules.request import Request


def recognise(root: Path) -> str | None:
    """What makes the folder look like this layout, or None."""
    if not (root / "sparse/0").is_dir() or any(root.glob("sparse_*.txt")):
        return None
    smaller = [name for name in ("images_2", "images_4", "images_8") if (root / name).is_dir()]
    if smaller or (root / "poses_bounds.npy").is_file():
        return f"sparse/0 with {', '.join(smaller) or 'poses_bounds.npy'}"
    return None


def read(root: Path, request: Request) -> Capture:
    """Reads the model in sparse/0, or another of sparse/ that has more photographs."""
    return colmap.read_capture(root, request, "mip360")
