"""Laws of the carved hull, and its bounds."""

import itertools
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, box_masks, moved, ring
from visdom_plugin.errors import ConfigError, EmptyHullError
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.hull.carving.carve import describe_pieces
from visdom_plugin.hull.carving.keep_rule import KeepRule, as_fraction, describe_rule
from visdom_plugin.hull.carving.votes import Grid, dense_carve, gather_silhouettes
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.raycast import cast

BALLS = [((0.1, -0.2, 0.1), 0.5), ((0.5, 0.3, -0.1), 0.3)]
BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
SMALL = VisibleDomain(resolution=48)


def grid_of(hull) -> Grid:
    return Grid(hull.bounds[0], hull.voxel_size, hull.shape)


def turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


@pytest.mark.parametrize("kind", ["visdom", "traditional", "unit-sphere", "released-go"])
def test_carve_is_the_dense_vote(kind):
    cameras = ring(5)
    masks = ball_masks(cameras, BALLS)
    domain = VisibleDomain(kind=kind, resolution=50, components="all")
    hull = domain.carve(cameras, masks)
    wanted = dense_carve(gather_silhouettes(cameras, masks), grid_of(hull), KeepRule.of(domain, 5)).numpy()
    if kind == "unit-sphere":
        centres = np.stack(np.meshgrid(*(grid_of(hull).centres(a) for a in range(3)), indexing="ij"), -1)
        wanted &= (
            np.linalg.norm(centres - hull.summary["sphere_centre"], axis=-1) <= hull.summary["sphere_radius"]
        )
    assert np.array_equal(hull.occupancy, wanted) and hull.voxels > 0


def test_hulls_of_growing_k_are_nested_before_culling():
    # Different fields of view, so that space near the object is seen by some views alone.
    cameras = ring(6)
    height = torch.tensor([30, 96, 40, 96, 30, 60])
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, 1, 2] = height / 2
    cameras = replace(cameras, intrinsics=intrinsics, height=height)
    masks = ball_masks(cameras, BALLS)
    box = ((-2.0,) * 3, (2.0,) * 3)
    grids = [
        VisibleDomain(k=k, resolution=60, bounds=box, components="all").carve(cameras, masks).occupancy
        for k in range(1, 7)
    ]
    assert all((b <= a).all() for a, b in itertools.pairwise(grids))
    assert grids[0].sum() > grids[2].sum() > grids[-1].sum() > 0
    misses = [
        VisibleDomain(max_misses=m, resolution=60, bounds=box, components="all")
        .carve(cameras, masks)
        .occupancy
        for m in range(3)
    ]
    assert all((a <= b).all() for a, b in itertools.pairwise(misses))


def test_order_of_the_cameras_does_not_matter():
    cameras = ring(6)
    masks = ball_masks(cameras, BALLS)
    order = torch.randperm(6, generator=torch.Generator().manual_seed(0))
    hull = SMALL.carve(cameras, masks)
    other = SMALL.carve(cameras[order], [masks[i] for i in order])
    assert np.allclose(hull.bounds, other.bounds) and np.array_equal(hull.occupancy, other.occupancy)


@pytest.mark.parametrize("scale", [1e-3, 0.05, 1.0, 40.0, 1e4])
def test_hull_moves_with_the_world(scale):
    cameras = ring(6)
    masks = ball_masks(cameras, BALLS)
    rotation, shift = turned(0.7), scale * np.array([3.0, -20.0, 7.0])
    domain = VisibleDomain(resolution=100)
    hull = domain.carve(cameras, masks)
    other = domain.carve(moved(cameras, rotation, scale, shift), masks)
    assert other.volume == pytest.approx(scale**3 * hull.volume, rel=0.02)
    points = hull.bounds.mean(0) + np.random.default_rng(0).uniform(-0.6, 0.6, (5000, 3))
    there = scale * points @ rotation.T + shift
    differ = hull.contains(points) != other.contains(there)
    # Only points within a voxel of the surface may change sides.
    assert differ.mean() < 0.05
    near = hull.contains(points, margin_voxels=2) & ~hull.contains(points)
    inner = hull.contains(points) & ~differ
    assert (
        (other.contains(there, margin_voxels=2) | ~hull.contains(points)).all() and near.any() and inner.any()
    )
    # The box is right at any scale: the object takes most of its longest side.
    assert (other.extent[1] - other.extent[0]).max() > 0.6 * (other.bounds[1] - other.bounds[0]).max()


@pytest.mark.parametrize("far", [1e5, 5e6])
def test_a_frame_far_from_the_origin_changes_nothing(far):
    cameras = ring(6)
    masks = ball_masks(cameras, BALLS)
    shift = far * np.array([1.0, -0.7, 0.3])
    there = moved(cameras, np.eye(3), 1.0, shift)
    domain = VisibleDomain(k="auto", resolution=100)
    hull, other = domain.carve(cameras, masks), domain.carve(there, masks)
    assert np.allclose(other.bounds - shift, hull.bounds, atol=0.01 * hull.voxel_size)
    # Centres on a mask's outline may change sides: the projection cancels numbers as large as the shift.
    assert (hull.occupancy != other.occupancy).sum() <= 1e-4 * hull.voxels
    for one, two in zip(
        measure_coverage(hull, cameras, masks), measure_coverage(other, there, masks), strict=True
    ):
        assert one == pytest.approx(two, abs=1e-3)
    rays = rays_of(cameras[0])
    one = cast(hull, rays.origins, rays.directions)
    two = cast(other, rays.origins + torch.from_numpy(shift), rays.directions)
    assert (one.hit != two.hit).sum() <= 2 and one.hit.any()
    gap = (one.t_first - two.t_first)[one.hit & two.hit].abs()
    assert gap.median() < 1e-4 * hull.voxel_size and (gap > hull.voxel_size).float().mean() < 1e-3
    found, again = check(cameras, masks), check(there, masks)
    assert [f.kind for f in found.findings] == [f.kind for f in again.findings]
    assert found.advice.k == again.advice.k


def test_hull_of_a_ball_approaches_the_ball():
    cameras = ring(40, size=300)
    hull = VisibleDomain(k="n-1", resolution=100).carve(cameras, ball_masks(cameras, [((0.2, 0.1, 0), 0.6)]))
    exact = 4 / 3 * np.pi * 0.6**3
    # Pixels sampled at their centres may cut half a pixel, 0.3 % of the radius here.
    assert exact * 0.98 < hull.volume < exact * 1.06
    assert np.allclose(hull.centre, [0.2, 0.1, 0], atol=0.02)


def test_hull_of_a_box_contains_it_and_fits():
    cameras = ring(40, distance=30, size=400, focal=9)
    hull = VisibleDomain(k="n-1", resolution=100).carve(
        cameras, box_masks(cameras, (-0.5, -0.7, -0.4), (0.6, 0.3, 0.5))
    )
    inner = np.random.default_rng(0).uniform((-0.48, -0.68, -0.38), (0.58, 0.28, 0.48), (5000, 3))
    assert hull.contains(inner).all()
    exact = 1.1 * 1.0 * 0.9
    assert 0.97 * exact < hull.volume < 1.15 * exact


def test_every_voxel_is_inside_the_masks_of_enough_views():
    from visdom_plugin.geometry.cameras import project

    cameras = ring(7)
    masks = ball_masks(cameras, BALLS)
    hull = SMALL.carve(cameras, masks)
    centres = hull.bounds[0] + (np.argwhere(hull.occupancy) + 0.5) * hull.voxel_size
    uv, depth = project(cameras, torch.from_numpy(centres))
    seen = (depth > 0) & (uv >= 0).all(-1) & (uv < 96).all(-1)
    index = torch.where(seen[..., None], uv, 0.0).long()
    inside = torch.stack([m[i[:, 1], i[:, 0]] for m, i in zip(masks, index, strict=True)]) & seen
    assert (seen.sum(0) >= 3).all() and (inside == seen).all()


def test_a_thin_rod_keeps_its_full_length():
    # Thinner than a cell of every coarse search level, and touching the body.
    cameras = ring(8, size=500)
    body = ball_masks(cameras, [((0, 0, 0), 0.35)])
    rod = box_masks(cameras, (0.3, -0.02, -0.02), (1.3, 0.02, 0.02))
    hull = VisibleDomain(resolution=160).carve(cameras, [a | b for a, b in zip(body, rod, strict=True)])
    assert hull.extent[1, 0] > 1.28 and hull.bounds[1, 0] > 1.3
    assert hull.bounds[1, 0] - hull.bounds[0, 0] < 2.2


def test_traditional_box_holds_the_cameras_and_the_ball_clips():
    cameras = ring(5)
    masks = ball_masks(cameras, BALLS)
    traditional = replace(SMALL, kind="traditional").carve(cameras, masks)
    centres = cameras.centres.numpy()
    assert (centres > traditional.bounds[0]).all() and (centres < traditional.bounds[1]).all()
    sphere = replace(SMALL, kind="unit-sphere", sphere_centre=(0.1, 0, 0), sphere_radius=0.9).carve(
        cameras, masks
    )
    vertices, _ = sphere.to_mesh()
    assert np.linalg.norm(vertices - [0.1, 0, 0], axis=1).max() < 0.9 + sphere.voxel_size
    visdom = SMALL.carve(cameras, masks)
    points = visdom.sample_inside(2000, torch.Generator().manual_seed(0))
    assert replace(SMALL, kind="unit-sphere").carve(cameras, masks).contains(points, margin_voxels=1).all()


def test_k_of_one_is_the_traditional_hull():
    cameras = ring(5)
    masks = ball_masks(cameras, BALLS)
    assert replace(SMALL, k=1).carve(cameras, masks) == replace(SMALL, kind="traditional").carve(
        cameras, masks
    )


def test_small_pieces_are_dropped():
    cameras = ring(8)
    masks = ball_masks(cameras, [((0, 0, 0), 0.5), ((0.9, 0, 0), 0.1)])
    for components, pieces in (("all", 2), ("drop-small", 1), ("largest", 1)):
        hull = VisibleDomain(components=components, resolution=80, bounds=BOX).carve(cameras, masks)
        assert hull.summary["components"] == pieces and hull.summary["components_found"] == 2
    kept = VisibleDomain(components="drop-small", min_component_fraction=0.001, resolution=80).carve(
        cameras, masks
    )
    assert kept.summary["components"] == 2 and kept.contains(np.array([0.9, 0, 0]))


def test_explicit_bounds_are_the_grid():
    cameras = ring(4)
    masks = ball_masks(cameras, BALLS)
    hull = VisibleDomain(bounds=((-1.0, -0.5, -1.0), (1.0, 0.5, 0.5)), resolution=40).carve(cameras, masks)
    assert hull.shape == (40, 20, 30) and np.allclose(hull.bounds, [[-1, -0.5, -1], [1, 0.5, 0.5]])


def test_bounds_may_count_from_the_cameras():
    cameras = ring(5)
    masks = ball_masks(cameras, BALLS)
    hull = VisibleDomain(bounds_capture_radii=0.5, resolution=40).carve(cameras, masks)
    centre = cameras.centres.mean(0).numpy()
    reach = 0.5 * np.linalg.norm(cameras.centres.numpy() - centre, axis=1).max()
    assert hull.shape == (40, 40, 40) and np.allclose(hull.bounds, [centre - reach, centre + reach])
    given = VisibleDomain(bounds=tuple(map(tuple, hull.bounds.tolist())), resolution=40)
    assert given.carve(cameras, masks) == hull


def test_found_bounds_may_be_made_longer():
    cameras = ring(5)
    masks = ball_masks(cameras, BALLS)
    tight, wide = (VisibleDomain(resolution=96, bounds_scale=s).carve(cameras, masks) for s in (1.0, 2.0))
    side = [float(np.ptp(h.bounds, axis=0)[0]) for h in (tight, wide)]
    assert np.allclose(tight.bounds.mean(0), wide.bounds.mean(0), atol=1e-6)
    assert side[1] == pytest.approx(2 * side[0]) and wide.volume == pytest.approx(tight.volume, rel=0.1)


def test_named_values_of_k(caplog):
    cameras = ring(5)
    masks = ball_masks(cameras, BALLS)
    assert replace(SMALL, k="n-1").carve(cameras, masks).summary["k"] == 4
    with caplog.at_level(logging.INFO, logger="visdom_plugin"):
        assert replace(SMALL, k="auto").carve(cameras, masks).summary["k"] == 3
    assert "K = 3" in caplog.text and "masks of all of the views" in caplog.text


def test_auto_k_gives_way_where_two_views_share_the_object():
    # Three views look at one ball, the two others at a second one, far to the side.
    cameras = ring(5, focal=2.5)
    shift = torch.zeros(5, 3).double()
    shift[3:] = torch.tensor([0.0, 1.2, 0.0])
    motion = cameras.world_from_camera.clone()
    motion[:, :3, 3] += shift
    cameras = replace(cameras, world_from_camera=motion)
    masks = ball_masks(cameras, [((0, 0, 0), 0.4), ((0, 1.2, 0), 0.4)])
    assert replace(SMALL, k="auto").carve(cameras, masks).summary["k"] < 3


def test_carving_twice_gives_the_same_bits():
    cameras = ring(9)
    masks = ball_masks(cameras, BALLS)
    one, two = (VisibleDomain(resolution=128).carve(cameras, masks) for _ in range(2))
    assert one == two and np.array_equal(one.to_mesh()[0], two.to_mesh()[0])


@pytest.mark.parametrize(
    "wrong",
    [
        {"k": 0}, {"k": "all"}, {"agreement": 0.0}, {"agreement": 1.5}, {"max_misses": -1}, {"kind": "cone"},
        {"resolution": 2}, {"bounds": ((0, 0, 0), (0, 1, 1))}, {"components": "some"}, {"dilate_px": -1},
        {"sphere_radius": -1.0}, {"min_component_fraction": 2.0}, {"bounds": ((0, 0), (1, 1))},
        {"bounds_capture_radii": 0.0}, {"bounds_capture_radii": 2.0, "bounds": BOX}, {"bounds_scale": 0.5},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError):
        VisibleDomain(**wrong)


def test_open_views_still_give_a_hull_and_say_so(caplog):
    # Two cameras side by side: nothing closes the hull along their view.
    cameras = ring(40)[torch.tensor([0, 1])]
    hull = VisibleDomain(k=2, resolution=64).carve(cameras, ball_masks(cameras, [((0, 0, 0), 0.5)]))
    assert hull.voxels > 0 and np.isfinite(hull.bounds).all()


def test_empty_hull_is_an_error():
    cameras = ring(4)
    with pytest.raises(EmptyHullError):
        SMALL.carve(cameras, [torch.zeros(96, 96, dtype=torch.bool)] * 4)


def test_pieces_and_the_rule_are_told_in_words():
    summary = {"components": 1, "components_found": 1, "components_dropped": ""}
    assert describe_pieces(summary) == "in one piece"
    more = {"components": 2, "components_found": 5, "components_dropped": "3 dropped"}
    assert describe_pieces(more) == "2 of 5 separate pieces kept (3 dropped)"
    rule = {"kind": "visdom", "k": 3, "agreement_means": KeepRule(4, 3, as_fraction(0.95)).meaning()}
    said = "inside the masks of all of the views that see it "
    said += "(the agreement: at least 0.95 of them; 4 views in all)"
    assert describe_rule(rule) == f"seen by at least 3 views (K = 3), {said}"
    assert describe_rule(rule | {"kind": "traditional"}) == said
