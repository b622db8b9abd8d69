"""Failed carves are explained: planted faults are named, and sound captures are not accused."""

import logging
import os
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.hull.balls import ball_masks, box_masks, moved, random_cameras, ring
from visdom_plugin.errors import EmptyHullError, SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.checks import explain_failure
from visdom_plugin.hull.checks.coverage import estimate_coverage, measure_coverage
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.wording import for_commands

GL = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
SMALL = VisibleDomain(resolution=48)
BOX = ((-0.4, -0.5, -0.3), (0.5, 0.3, 0.4))
INVERTED = [
    (torch.linalg.inv, "world-to-camera matrices:"),
    (lambda m: torch.linalg.inv(m @ GL), "world-to-camera matrices with OpenGL axes"),
]
"""Poses that leave some hull by chance."""
ROOT = os.environ.get("VISDOM_SCENES")


# Empty hulls


@pytest.fixture(scope="module")
def capture():
    cameras = ring(6, seed=3)
    return cameras, box_masks(cameras, *BOX)


def cause_of(domain, cameras, masks) -> EmptyHullError:
    with pytest.raises(EmptyHullError) as caught:
        domain.carve(cameras, masks)
    assert caught.value.todo
    return caught.value


def test_empty_masks_are_named(capture):
    cameras, masks = capture
    empty = torch.zeros_like(masks[0])
    every = cause_of(SMALL, cameras, [empty] * 6)
    assert every.cause.startswith("the masks of view 0, view 1, ") and "no foreground pixel" in every.cause
    assert every.where == "view 0, view 1, view 2, view 3, view 4 and view 5"
    one = cause_of(SMALL, cameras, [*masks[:4], empty, masks[5]])
    assert "no foreground pixel" in one.cause and one.where == "view 4"


def test_k_above_the_number_of_views(capture):
    cameras, masks = capture
    assert "only 6 views" in cause_of(replace(SMALL, k=7), cameras, masks).cause


def test_k_above_co_visibility(capture):
    # Three views show the upper part of the object alone, three the lower.
    cameras, masks = capture
    masks = [*(m[:46] for m in masks[:3]), *(m[50:] for m in masks[3:])]
    K = cameras.intrinsics.clone()
    K[3:, 1, 2] -= 50
    cameras = Cameras.from_matrices(K, cameras.world_from_camera, width=96, height=46)
    error = cause_of(replace(SMALL, k=6), cameras, masks)
    assert "too little is seen in common for K = 6" in error.cause and error.where == "k"
    assert re.search(r"K = \d would lose \d+\.\d% of the mask of view \d", error.cause)
    assert "VisibleDomain(k=2)" in error.todo and "visdom-" not in error.todo
    assert replace(SMALL, k=2).carve(cameras, masks).voxels


def test_one_view_has_no_hull_and_no_k_is_advised_that_would_give_it_one(capture):
    cameras, masks = capture
    for k in (3, "auto"):
        error = cause_of(replace(SMALL, k=k), cameras[:1], masks[:1])
        assert "only 1 view" in error.cause and error.todo == "use more views"
    assert replace(SMALL, k=1).carve(cameras[:1], masks[:1]).voxels


def test_inverted_masks(capture):
    cameras, masks = capture
    box = ((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))
    inside = replace(SMALL, bounds=box)
    error = cause_of(inside, cameras, [~masks[0], *masks[1:]])
    assert "background is marked" in error.cause and error.where == "view 0"
    error = cause_of(inside, cameras, [~m for m in masks])
    assert "all masks are foreground along" in error.cause and "white (True)" in error.todo


def test_inverted_masks_that_leave_a_hull_are_warned_about(capture, caplog):
    cameras, masks = capture
    SMALL.carve(cameras, [~m for m in masks])
    assert "mark the background" in caplog.text


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: m @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double(), "OpenGL"),
        (torch.linalg.inv, "world-to-camera"),
        (lambda m: torch.linalg.inv(m @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()), "OpenGL"),
    ],
)
def test_poses_of_another_convention(capture, spoil, words):
    cameras, masks = capture
    wrong = Cameras(cameras.intrinsics, spoil(cameras.world_from_camera), cameras.width, cameras.height)
    try:
        hull = SMALL.carve(wrong, masks)
    except (EmptyHullError, SceneError) as error:
        assert words in error.cause and "0.00% of the object's length in the mean in place of" in error.cause
        assert error.where == "camera poses" and "visdom-" not in error.todo
    else:
        # Wrong poses may agree somewhere by chance; then coverage shows it.
        assert min(c.covered for c in measure_coverage(hull, wrong, masks)) < 0.9


def test_bounds_beside_the_object(capture):
    cameras, masks = capture
    error = cause_of(replace(SMALL, bounds=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))), cameras, masks)
    assert "bounds miss" in error.cause and error.where == "bounds"
    error = cause_of(
        replace(SMALL, kind="unit-sphere", sphere_centre=(9.0, 9.0, 9.0), sphere_radius=0.5), cameras, masks
    )
    assert "ball misses" in error.cause
    # Voxels far larger than the object, none with its centre in it.
    error = cause_of(replace(SMALL, bounds=((-9.0,) * 3, (9.0,) * 3), resolution=8), cameras, masks)
    assert "no voxel's centre" in error.cause and error.where == "bounds"


def test_the_one_view_that_disagrees(capture):
    cameras, masks = capture
    wrong = torch.zeros_like(masks[2])
    wrong[:6, :6] = True
    error = cause_of(SMALL, cameras, [*masks[:2], wrong, *masks[3:]])
    assert error.where == "view 2" and error.cause.startswith("view 2 does not fit the others: without it")


def test_no_cause_is_invented():
    cameras = ring(6)
    random = torch.Generator().manual_seed(0)
    specks = [torch.rand(96, 96, generator=random) < 0.002 for _ in range(6)]
    error = cause_of(SMALL, cameras, specks)
    assert "speckled" in error.cause and error.where.endswith("view 5")
    # Blobs anywhere: nothing explains an empty hull.
    blobs = [torch.zeros(96, 96, dtype=torch.bool) for _ in range(6)]
    for mask in blobs:
        row, column = torch.randint(5, 80, (2,), generator=random).tolist()
        mask[row : row + 9, column : column + 9] = True
    error = cause_of(SMALL, cameras, blobs)
    assert error.cause is None or "no single cause explains it" in error.cause


# Hulls that leave the masks uncovered


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
    with pytest.raises(SceneError, match="world-to-camera matrices:"):
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
    assert "does not explain the masks" in caplog.text and "seen in common for K = 4" in caplog.text
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
    assert estimate_coverage(hull, cameras, silhouettes) == pytest.approx(exact, abs=0.12)
    full = Hull.from_grid(np.ones((2, 2, 2)), [[-90] * 3, [90] * 3])
    nothing = Hull.from_grid(np.ones((2, 2, 2)), [[190] * 3, [191] * 3])
    assert estimate_coverage(full, cameras, silhouettes) == 1
    assert estimate_coverage(nothing, moved(cameras, np.eye(3), 1.0, [0.0, 0, -500]), silhouettes) == 0


@pytest.mark.parametrize(
    "who, mine, other", [(nullcontext, "VisibleDomain(k=3)", "--"), (for_commands, "-k 3", "VisibleD")]
)
def test_errors_speak_to_who_asked(who, mine, other):
    cameras = ring(4, size=48)
    with who(), pytest.raises(EmptyHullError) as error:
        VisibleDomain(k=9, resolution=32).carve(cameras, ball_masks(cameras, [((0, 0, 0), 0.5)]))
    assert mine in str(error.value) and other not in str(error.value)


@pytest.mark.parametrize("who, other", [(nullcontext, ("visdom-", "--")), (for_commands, ("VisibleDomain",))])
def test_what_may_miss_is_said_to_who_asked(who, other, monkeypatch):
    monkeypatch.setattr(explain_failure, "_faults", lambda *_: [])
    cameras = ring(4, size=48)
    masks = [torch.zeros(48, 48, dtype=torch.bool) for _ in range(4)]
    for i, mask in enumerate(masks):
        mask[12 * i : 12 * i + 3, :4] = True
    with who(), pytest.raises(EmptyHullError, match="misses") as error:
        VisibleDomain(k=3, resolution=32, bounds=((-1, -1, -1), (1, 1, 1))).carve(cameras, masks)
    assert not any(word in str(error.value) for word in other)


@pytest.mark.parametrize("spoilt", [False, True])
def test_who_looks_for_a_cause_tells_what_came_of_it(capture, caplog, spoilt):
    cameras, masks = capture
    hull = SMALL.carve(cameras, masks)
    seen = [*masks[:5], torch.roll(masks[5], 8, 1)] if spoilt else masks
    caplog.set_level(logging.INFO)
    assert explain_failure.find_misfit(SMALL, cameras, gather_silhouettes(cameras, seen), hull) is None
    looked, told = caplog.messages[-2:]
    assert "looking for a cause" in looked
    assert told.startswith("cause: ") and told.endswith("the hull is used as it is")
    assert ("none was found" in told) != spoilt
