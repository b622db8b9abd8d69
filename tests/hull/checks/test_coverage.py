"""Planted faults, each to be named; and what a sound capture must not be accused of."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, box_masks, ring
from visdom_plugin.errors import EmptyHullError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.checks.coverage import border_share, diagnose, measure_coverage
from visdom_plugin.hull.domain import VisibleDomain

SMALL = VisibleDomain(resolution=64)
BOX = ((-0.4, -0.5, -0.3), (0.5, 0.3, 0.4))


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
    assert "all masks are empty" in cause_of(SMALL, cameras, [empty] * 6).cause
    one = cause_of(SMALL, cameras, [*masks[:4], empty, masks[5]])
    assert "empty" in one.cause and one.where == "view 4"


def test_k_above_the_number_of_views(capture):
    cameras, masks = capture
    assert "only 6 views" in cause_of(replace(SMALL, k=7), cameras, masks).cause


def test_k_above_co_visibility():
    # Two of six cameras look away from the object; a speck keeps their masks from being empty.
    cameras = ring(6)
    masks = ball_masks(cameras, [((0, 0, 0), 0.35)])
    motion = cameras.world_from_camera.clone()
    motion[:2] = motion[:2] @ torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()
    for i in range(2):
        masks[i] = torch.zeros_like(masks[i])
        masks[i][40:44, 40:44] = True
    error = cause_of(replace(SMALL, k=5), replace(cameras, world_from_camera=motion), masks)
    assert "co-visibility" in error.cause and all(
        said in error.todo for said in ("visdom-hull -k 4", "--method.hull.k 4", "VisibleDomain(k=4)")
    )


def test_inverted_masks(capture):
    cameras, masks = capture
    box = ((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))
    inside = replace(SMALL, bounds=box)
    error = cause_of(inside, cameras, [~masks[0], *masks[1:]])
    assert "inverted" in error.cause and error.where == "view 0"
    error = cause_of(inside, cameras, [~m for m in masks])
    assert "inverted" in error.cause and "True (white)" in error.todo


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
    except EmptyHullError as error:
        assert words in error.cause and "covers" in error.cause
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


def test_the_one_view_that_disagrees(capture):
    cameras, masks = capture
    wrong = torch.zeros_like(masks[2])
    wrong[:6, :6] = True
    error = cause_of(SMALL, cameras, [*masks[:2], wrong, *masks[3:]])
    assert error.where == "view 2" and "disagrees" in error.cause


def test_no_cause_is_invented():
    # Masks of noise: nothing explains an empty hull.
    cameras = ring(6)
    random = torch.Generator().manual_seed(0)
    masks = [torch.rand(96, 96, generator=random) < 0.002 for _ in range(6)]
    error = cause_of(SMALL, cameras, masks)
    assert error.cause is None and "--diagnose" in error.todo


def test_a_sound_capture_has_no_findings(capture):
    cameras, masks = capture
    hull = SMALL.carve(cameras, masks)
    found = diagnose(SMALL, hull, cameras, masks)
    assert found.findings == []
    assert all(v.covered > 0.97 and v.inside > 0.85 and v.border == 0 for v in found.views)
    assert list(found.voxels_per_k) == [1, 2, 3, 4, 5, 6]
    counts = list(found.voxels_per_k.values())
    assert counts == sorted(counts, reverse=True) and counts[2] > 0


def test_a_shrunken_mask_and_a_cut_object_are_found(capture):
    cameras, masks = capture
    small = masks[1].clone()
    rows = small.any(1).nonzero()
    small[int(rows.float().mean()) :] = False
    hull = SMALL.carve(cameras, [masks[0], small, *masks[2:]])
    found = diagnose(SMALL, hull, cameras, [masks[0], small, *masks[2:]], list("abcdef"))
    assert max(range(6), key=lambda i: found.views[i].removes) == 1
    assert any(text.startswith("b:") for text in found.findings) or any(
        "covers only" in t for t in found.findings
    )
    near = ring(6, distance=1.3, seed=3)
    cut = box_masks(near, *BOX)
    assert any(border_share(m.numpy()) > 0 for m in cut)
    assert any("border" in text for text in diagnose(SMALL, SMALL.carve(near, cut), near, cut).findings)


def test_coverage_counts_pixels():
    cameras = ring(3, size=64)
    masks = box_masks(cameras, *BOX)
    hull = SMALL.carve(cameras, masks)
    half = [m.clone() for m in masks]
    for m in half:
        m[:, 32:] = False
    for full, part, mask, cut in zip(
        measure_coverage(hull, cameras, masks),
        measure_coverage(hull, cameras, half),
        masks,
        half,
        strict=True,
    ):
        assert full.inside > 0.99 and full.covered > 0.9
        assert part.inside == pytest.approx(cut.sum().item() / mask.sum().item(), abs=0.05)
    assert measure_coverage(hull, cameras, [torch.zeros_like(m) for m in masks])[0].covered == 1.0


def test_border_share():
    mask = np.zeros((4, 5), bool)
    mask[0] = True
    assert border_share(mask) == 5 / 14 and border_share(~mask) == 9 / 14
