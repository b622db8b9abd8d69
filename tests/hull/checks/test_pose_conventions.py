"""Wrong poses on disk are told in the terms of the file that holds them."""

from dataclasses import replace

import pytest
import torch

from datamodules import load
from tests.datamodules.layouts import layout_writers as w
from tests.hull.checks.faults import capture_of
from visdom_plugin.cli.commands.check import check_views
from visdom_plugin.cli.scenes import carving_views
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.checks.causes.pose_conventions import PoseFaults, pose_faults
from visdom_plugin.hull.checks.check import check

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
IN_FILE = {
    # What a file holds where it should hold C F (transforms.json) or inv(C) (COLMAP).
    "nerfstudio": PoseFaults(
        lambda C: C, lambda C: C.inverse(), lambda C: FLIP @ C.inverse(), lambda C: FLIP @ C @ FLIP
    ),
    "colmap": PoseFaults(
        lambda C: FLIP @ C.inverse(), lambda C: C, lambda C: C @ FLIP, lambda C: C.inverse() @ FLIP
    ),
}
MEND = {
    # What the advice says to do with the matrix in the file.
    "nerfstudio": PoseFaults(
        lambda M: M @ FLIP, lambda M: M.inverse() @ FLIP, torch.inverse, lambda M: FLIP @ M
    ),
    "colmap": PoseFaults(
        lambda M: FLIP @ M, torch.inverse, lambda M: (M @ FLIP).inverse(), lambda M: M @ FLIP
    ),
}


@pytest.fixture(scope="module")
def views():
    return load(None, views=5, downscale=4, test=False).train


def _written(views, layout, matrices, folder):
    """The scene whose file holds these matrices as they are."""
    motion = matrices @ FLIP if layout == "nerfstudio" else matrices.inverse()
    cameras = Cameras(views.cameras.intrinsics, motion, views.cameras.width, views.cameras.height)
    write = {"nerfstudio": w.write_nerfstudio, "colmap": w.write_colmap}[layout]
    return load(write(replace(views, cameras=cameras), folder), views=len(views), test=False)


@pytest.mark.parametrize("layout", IN_FILE)
@pytest.mark.parametrize("which", PoseFaults._fields[:3])
def test_the_files_fault_is_named_in_its_own_terms(layout, which, views, tmp_path):
    C = views.cameras.world_from_camera
    wrong = torch.stack([getattr(IN_FILE[layout], which)(m) for m in C])
    scene = _written(views, layout, wrong, tmp_path / "s")
    found = check_views(*carving_views(scene.train), layout=scene.source["layout"])
    (fault,) = (f for f in found.findings if f.kind == "axes")
    said = getattr(pose_faults(layout), which)
    assert fault.what.startswith(said.what) and fault.todo == said.todo


@pytest.mark.parametrize("layout", IN_FILE)
@pytest.mark.parametrize("which", PoseFaults._fields)
def test_what_is_advised_gives_what_the_format_wants(layout, which, views):
    for C in views.cameras.world_from_camera:
        wrong = getattr(IN_FILE[layout], which)(C)
        right = C @ FLIP if layout == "nerfstudio" else C.inverse()
        assert torch.allclose(getattr(MEND[layout], which)(wrong), right) and not torch.allclose(wrong, right)


def test_cameras_in_memory_and_other_layouts_are_spoken_of_as_what_they_are(views):
    capture = capture_of(views)
    motion = capture.cameras.world_from_camera @ FLIP
    (fault,) = check(replace(capture.cameras, world_from_camera=motion), capture.masks).findings
    assert "the poses have OpenGL axes" in fault.what and 'convention="opengl"' in fault.todo
    assert pose_faults("synthetic") == pose_faults(None) != pose_faults("llff")
