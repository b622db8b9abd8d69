"""Pixels at which nothing is known: they neither carve nor ask for anything."""

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, ring
from visdom_plugin.geometry.cameras import project
from visdom_plugin.hull.carving.votes import gather_silhouettes
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.checks.mask_checks import look_inverted
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.scene import Views

DOMAIN = VisibleDomain(resolution=48)
BALLS = [((0.1, 0, 0), 0.5), ((0.3, 0.4, 0.1), 0.25)]


@pytest.fixture(scope="module")
def capture():
    cameras = ring(6, size=64)
    return cameras, ball_masks(cameras, BALLS)


def _rim(mask, width=6):
    """What an undistorted photograph leaves open along its border."""
    unknown = torch.ones_like(mask)
    unknown[width:-width, width:-width] = False
    return unknown


def _corner(mask):
    unknown = torch.zeros_like(mask)
    unknown[:18, :18] = True
    return unknown


@pytest.mark.parametrize("shape", [_rim, _corner])
def test_unknown_rims_change_neither_hull_nor_findings(shape, capture):
    cameras, masks = capture
    unknown = [shape(m) & ~m for m in masks]
    hull = DOMAIN.carve(cameras, masks)
    found = DOMAIN.carve(cameras, [m | g for m, g in zip(masks, unknown, strict=True)], unknown)
    assert found.summary["components"] == hull.summary["components"] == 1
    assert np.abs(found.extent - hull.extent).max() < 2.5 * hull.voxel_size
    assert found.volume == pytest.approx(hull.volume, rel=0.05)
    assert not check(cameras, masks, ignore=unknown).findings
    for seen in measure_coverage(
        found, cameras, [m | g for m, g in zip(masks, unknown, strict=True)], unknown
    ):
        assert seen.covered > 0.97 and seen.inside > 0.97


@pytest.mark.parametrize("components", ["all", "drop-small", "largest"])
@pytest.mark.parametrize("k", [1, 2, 3])
def test_what_only_unknown_rims_would_hold_is_not_kept(components, k, capture):
    """Rims of several views meet in places where nothing was ever seen, and no culling takes these away."""
    cameras, masks = capture
    domain = VisibleDomain(resolution=48, components=components, k=k, bounds=((-2,) * 3, (2,) * 3))
    unknown = [_rim(m) & ~m for m in masks]
    hull, found = domain.carve(cameras, masks), domain.carve(cameras, masks, unknown)
    assert found.volume < 1.05 * hull.volume or k == 1
    centres = found.bounds[0] + (np.argwhere(found.occupancy) + 0.5) * found.voxel_size
    known = torch.zeros(len(centres))
    for uv, depth, mask in zip(*project(cameras, torch.from_numpy(centres)), masks, strict=True):
        inside = (depth > 0) & (uv >= 0).all(-1) & (uv < 64).all(-1)
        column, row = uv.clamp(0, 63).long().unbind(-1)
        known += inside & mask[row, column]
    assert (known >= min(k, 2)).all()


def test_taken_for_object_they_would_be_faults(capture):
    """What the tests above guard against."""
    cameras, masks = capture
    found = check(cameras, [m | _rim(m) for m in masks])
    assert {"border", "inverted"} & {f.kind for f in found.findings}


def test_what_is_unknown_on_the_object_is_not_asked_for_and_not_carved(capture):
    cameras, masks = capture
    unknown = [torch.zeros_like(m) for m in masks]
    unknown[0][:, 20:40] = True
    seen = [m & ~g for m, g in zip(masks, unknown, strict=True)]
    hull, found = DOMAIN.carve(cameras, masks), DOMAIN.carve(cameras, seen, unknown)
    assert found.volume >= 0.97 * hull.volume
    assert DOMAIN.carve(cameras, seen, ()).volume < 0.9 * hull.volume
    assert not check(cameras, seen, ignore=unknown).findings


def test_real_faults_show_beside_unknown_rims(capture):
    cameras, masks = capture
    unknown = [_rim(m) for m in masks]
    turned = check(cameras, [~m for m in masks], ignore=unknown).findings
    assert [f.kind for f in turned] == ["inverted"] and len(turned[0].views) == 6
    moved = [m.roll(14, 1) if i == 2 else m for i, m in enumerate(masks)]
    assert any(2 in f.views for f in check(cameras, moved, ignore=unknown).findings)


def test_border_of_what_is_known_tells_inverted_masks():
    unknown = np.ones((20, 30), bool)
    unknown[4:-4, 4:-4] = False
    ball = np.zeros((20, 30), bool)
    ball[8:12, 10:20] = True
    assert not look_inverted(ball, unknown) and look_inverted(~ball & ~unknown, unknown)
    assert not look_inverted(ball & ~unknown, np.ones_like(unknown))


def test_silhouettes_hold_them_apart(capture):
    cameras, masks = capture
    images = [m[..., None].expand(*m.shape, 3) for m in masks]
    views = Views(cameras, images, masks, [str(i) for i in range(6)], ignore=[_corner(masks[0]), *[None] * 5])
    packed = gather_silhouettes(*views.silhouettes())
    assert packed.mask(0)[0, 0] == 1 and packed.demanding().mask(0)[0, 0] == 0
    assert np.array_equal(packed.unknown_in(0), _corner(masks[0]).numpy())
    assert not packed.unknown_in(1).any() and np.array_equal(packed.demanding().mask(1), masks[1].numpy())
    grown = gather_silhouettes(*views.silhouettes(), dilate_px=1)
    assert not grown.mask(0)[18, 18] or masks[0][17:20, 17:20].any()


def test_pieces_that_explain_nothing_are_told_where_all_are_kept(caplog):
    """Two views of two balls leave phantoms, which the other views rule out unless they know nothing there."""
    cameras = ring(6, size=64)
    masks = ball_masks(cameras, [((-0.6, 0.1, 0), 0.2), ((0.6, 0, 0), 0.2)])
    unknown = [torch.zeros_like(m) if i < 2 else ~m for i, m in enumerate(masks)]
    domain = VisibleDomain(resolution=48, components="all", k=2, bounds=((-2,) * 3, (2,) * 3))
    strays = domain.carve(cameras, masks, unknown).summary["components_strays"]
    assert strays == domain.carve(cameras, masks, unknown).summary["components"] - 2 > 0
    assert f"{strays} of {strays + 2} pieces explain no mask" in caplog.text
    assert "components=explain" in caplog.text
    caplog.clear()
    assert "components_strays" not in domain.carve(cameras, masks).summary
    assert "explain no mask" not in caplog.text
