"""What wrong poses leave must not pass for a hull, and sound captures must not be accused."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datamodules.synthetic.scene import SyntheticConfig, make_scene
from tests.hull.balls import ball_masks, moved, random_cameras, ring
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.checks.misfit import glance
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull

GL = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
SMALL = VisibleDomain(resolution=48)
INVERTED = [
    (torch.linalg.inv, "world-to-camera matrices;"),
    (lambda m: torch.linalg.inv(m @ GL), "world-to-camera matrices with OpenGL axes"),
]
"""Poses that leave some hull by chance; those that leave none are in test_diagnose."""
ROOT = os.environ.get("VISDOM_SCENES")


def with_poses(cameras: Cameras, motion) -> Cameras:
    return Cameras(cameras.intrinsics, motion, cameras.width, cameras.height)


@pytest.mark.parametrize("count", [4, 9])
@pytest.mark.parametrize(("spoil", "words"), INVERTED)
def test_poses_of_another_convention_are_an_error_that_names_it(count, spoil, words):
    views = make_scene(SyntheticConfig(size=48, train_views=count)).train
    wrong = with_poses(views.cameras, spoil(views.cameras.world_from_camera))
    with pytest.raises(SceneError, match=words) as caught:
        SMALL.carve(wrong, views.masks)
    assert "does not explain the masks" in caught.value.what
    assert caught.value.where == "camera poses" and "inverses" in caught.value.todo


@pytest.mark.scenes
@pytest.mark.skipif(not ROOT, reason="VISDOM_SCENES does not name the folder of real scenes")
def test_real_poses_taken_for_their_inverses():
    import datamodules

    views = datamodules.load(Path(ROOT) / "studio_human", views=4, downscale=8).train
    wrong = with_poses(views.cameras, torch.linalg.inv(views.cameras.world_from_camera.double()))
    with pytest.raises(SceneError, match="world-to-camera matrices;"):
        SMALL.carve(wrong, views.masks)


@pytest.mark.parametrize("count", [2, 3, 6, 9])
def test_sound_captures_are_not_accused(caplog, count):
    views = make_scene(SyntheticConfig(size=48, train_views=count)).train
    for change in ({}, {"k": count}, {"kind": "traditional"}, {"components": "largest"}, {"resolution": 16}):
        domain = replace(SMALL, **({"k": min(3, count)} | change))
        domain.carve(views.cameras, views.masks)
    assert "explain the masks" not in caplog.text


def test_a_misfit_of_another_cause_is_told_and_the_hull_kept(caplog):
    # Two views show the upper part of the object alone, two the lower: in common they see a band of it.
    cameras = ring(4)
    masks = ball_masks(cameras, [((0, 0, 0), 0.6)])
    masks = [*(m[:50] for m in masks[:2]), *(m[46:] for m in masks[2:])]
    K = cameras.intrinsics.clone()
    K[2:, 1, 2] -= 46
    cameras = Cameras.from_matrices(K, cameras.world_from_camera, width=96, height=50)
    hull = replace(SMALL, k=4).carve(cameras, masks)
    assert "does not explain the masks" in caplog.text and "seen by K = 4" in caplog.text
    assert "larger k" not in caplog.text and hull.contains(np.zeros(3))
    caplog.clear()
    replace(SMALL, k=2).carve(cameras, masks)
    assert "explain the masks" not in caplog.text


def test_bounds_and_balls_that_cut_the_object_are_obeyed(caplog):
    cameras = ring(6)
    masks = ball_masks(cameras, [((0, 0, 0), 0.6)])
    replace(SMALL, bounds=((0.0, 0.0, 0.0), (0.2, 0.2, 0.2))).carve(cameras, masks)
    ball = replace(SMALL, kind="unit-sphere", sphere_centre=(0, 0, 0), sphere_radius=0.2)
    ball.carve(cameras, masks)
    assert "explain the masks" not in caplog.text


@pytest.mark.parametrize("seed", range(6))
def test_the_quick_look_sees_nothing_that_is_not_there(seed):
    random = np.random.default_rng(seed)
    cameras = random_cameras(random, 5)
    sizes = zip(cameras.width.tolist(), cameras.height.tolist(), strict=True)
    masks = [random.random((height, width)) < 0.3 for width, height in sizes]
    grid = np.kron(random.random((6, 7, 5)) < 0.3, np.ones((4, 4, 4))) > 0
    hull = Hull.from_grid(grid, [[-0.8, -1, -0.7], [0.8, 0.9, 0.7]])
    exact = np.mean([c.covered for c in measure_coverage(hull, cameras, masks)])
    silhouettes = gather_silhouettes(cameras, masks)
    assert glance(hull, cameras, silhouettes) == pytest.approx(exact, abs=0.12)
    full = Hull.from_grid(np.ones((2, 2, 2)), [[-90] * 3, [90] * 3])
    nothing = Hull.from_grid(np.ones((2, 2, 2)), [[190] * 3, [191] * 3])
    assert glance(full, cameras, silhouettes) == 1
    assert glance(nothing, moved(cameras, np.eye(3), 1.0, [0.0, 0, -500]), silhouettes) == 0
