"""GaussianObject's prepared scenes: photographs, masks and a COLMAP model of undistorted cameras.

images/ or images_<F>/   photographs, F times smaller in the latter
masks/<stem>.png         foreground masks at either size
sparse/0/                COLMAP model, text or binary, of all photographs
sparse_<N>.txt           the N training views, sparse_test.txt the test views: zero-based positions in the
                         list of all registered images, sorted by name without extension
zoe_depth/<stem>.png     optional monocular depth of the training views (16 bit, times 1000)
"""

from __future__ import annotations

from pathlib import Path

from datamodules.capture import Capture
from datamodules.layouts import colmap
from datamodules.request import Request
from visdom_plugin.errors import list_some


def recognise(root: Path) -> str | None:
    """What makes the folder look like this layout, or None."""
    found = sorted(path.name for path in root.glob("sparse_*.txt"))
    others = ("transforms.json", "transforms_train.json", "poses_bounds.npy", "calibration.csv")
    if found and ((root / "sparse").is_dir() or not any((root / name).exists() for name in others)):
        return f"index files {list_some(found, 3)}"
    return None


def read(root: Path, request: Request) -> Capture:
    """Reads the model in sparse/0. Index files are demanded unless both lists, or a split, are given by hand."""
    by_hand = request.split is not None or (
        request.train_list is not None and (request.test_list is not None or not request.test)
    )
    return colmap.read_capture(
        root, request, "prepared", folder="sparse/0", indexed=not by_hand, depths="zoe_depth"
    )
