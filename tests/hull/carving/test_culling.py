"""Which pieces the masks need: parts of the object however small, no strays however large."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from tests.hull.balls import ball_masks, box_masks, random_cameras, random_masks, ring
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.carving import culling
from visdom_plugin.hull.carving.areas import sum_areas
from visdom_plugin.hull.carving.votes import Grid, gather_silhouettes
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.grid.components import find_pieces


def turntable(count: int, size: int = 120, distance: float = 4.0) -> Cameras:
    """Cameras on a level ring: the epipolar planes of all pairs meet the objects at their own height."""
    angle = np.arange(count) * 2 * np.pi / count + 0.3
    centres = distance * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    up = torch.tensor([0.0, 0, 1]).double()
    motion = look_at_camera(torch.from_numpy(centres), torch.zeros(count, 3).double(), up)
    intrinsics = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]]).double()
    return Cameras.from_matrices(intrinsics.expand(count, 3, 3), motion, width=size, height=size)


NEAR = VisibleDomain(components="all", resolution=64, bounds=((-1.4,) * 3, (1.4,) * 3))


@pytest.mark.parametrize("views", [4, 6])
def test_separate_objects_all_stay(views):
    # On a level ring the cone of one ball in one view meets that of another ball in another view, in ghosts.
    balls = [((0.5, 0.0, 0.0), 0.22), ((-0.5, 0.1, 0.0), 0.22), ((0.0, 0.7, 0.0), 0.07)]
    cameras = turntable(views)
    masks = ball_masks(cameras, balls)
    everything, hull = (
        VisibleDomain(resolution=64, components=c).carve(cameras, masks) for c in ("all", "explain")
    )
    assert hull.contains(np.array([centre for centre, _ in balls])).all()
    assert hull.voxel_size <= everything.voxel_size
    small = VisibleDomain(resolution=64, components="drop-small").carve(cameras, masks)
    assert not small.contains(np.array(balls[2][0]))


def test_pieces_that_could_stand_for_each_other_stay():
    # Each of three cameras sees the middle behind a ball of its own: space there is inside all masks, and farther
    # out there are three ghosts that look just like the balls.
    azimuth = 0.3 + np.arange(3) * 2 * np.pi / 3
    balls = [((np.cos(a), np.sin(a), 0.0), 0.25) for a in azimuth]
    cameras = turntable(3, distance=6.0)
    masks = ball_masks(cameras, balls)
    ghost = replace(NEAR, components="largest").carve(cameras, masks)
    assert NEAR.carve(cameras, masks).summary["components"] > 3 and ghost.contains(np.zeros(3))
    hull = VisibleDomain(resolution=64).carve(cameras, masks)
    assert hull.contains(np.array([centre for centre, _ in balls])).all()


def test_a_ghost_inside_one_object_goes_however_large():
    # The same balls, joined by an arch above and one below: now the middle stands behind what is surely there.
    turn, share = np.meshgrid(np.arange(2), np.linspace(0, 1, 21), indexing="ij")
    azimuth = (0.3 + (turn + share) * 2 * np.pi / 3).ravel()
    height = (0.8 * np.sin(np.pi * share) * (1 - 2 * turn)).ravel()
    arches = np.stack([np.cos(azimuth), np.sin(azimuth), height], -1)
    balls = [((np.cos(a), np.sin(a), 0.0), 0.25) for a in 0.3 + np.arange(3) * 2 * np.pi / 3]
    cameras = turntable(3, distance=6.0)
    masks = ball_masks(cameras, balls + [(tuple(p), 0.09) for p in arches])
    pieces = find_pieces(NEAR.carve(cameras, masks).occupancy)
    assert (
        NEAR.carve(cameras, masks).contains(np.zeros(3))
        and (pieces.sizes > 0.05 * pieces.sizes.max()).sum() > 1
    )
    hull = VisibleDomain(resolution=64).carve(cameras, masks)
    assert (
        not hull.contains(np.zeros(3))
        and "cover the masks without them" in hull.summary["components_dropped"]
    )
    assert hull.contains(np.concatenate([[centre for centre, _ in balls], arches])).all()
    # No ghost is needed: each mask is covered as well without it.
    everything = VisibleDomain(resolution=64, components="all", bounds=hull.bounds.tolist()).carve(
        cameras, masks
    )
    for a, b in zip(
        measure_coverage(hull, cameras, masks), measure_coverage(everything, cameras, masks), strict=True
    ):
        assert a.covered > b.covered - 0.01


def test_a_part_that_broke_off_stays_however_small():
    # A rod in dashes of which each has less than 1 % of the body's volume.
    cameras = ring(7, size=200)
    masks = ball_masks(cameras, [((0, 0, 0), 0.5)])
    for x in (0.62, 0.82, 1.02):
        dash = box_masks(cameras, (x, -0.04, -0.04), (x + 0.1, 0.04, 0.04))
        masks = [a | b for a, b in zip(masks, dash, strict=True)]
    hull = VisibleDomain(resolution=100).carve(cameras, masks)
    assert hull.contains(np.array([[0.67, 0, 0], [0.87, 0, 0], [1.07, 0, 0]])).all()
    assert hull.bounds[1, 0] > 1.12 and hull.summary["components"] >= 4
    small = VisibleDomain(resolution=100, components="drop-small").carve(cameras, masks)
    assert small.summary["components"] == 1


def test_traditional_keeps_what_single_views_leave():
    cameras = turntable(4)
    masks = ball_masks(cameras, [((0.0, 0.0, 0.0), 0.3)])
    for domain in (VisibleDomain(kind="traditional", resolution=48), VisibleDomain(k=1, resolution=48)):
        assert domain.carve(cameras, masks) == replace(domain, components="drop-small").carve(cameras, masks)


def slow_pixels(occupied, labels, grid, silhouettes, canvas, piece, view) -> set:
    """Foreground working pixels that the voxels of one piece touch, all of them, one by one."""
    found = set()
    width, height = canvas.sizes[view]
    matrix, factor = silhouettes.projections[view], canvas.factors[view]
    edge = np.linalg.norm(matrix[:2, :3], axis=1).mean() * grid.voxel
    for index in occupied[labels == piece]:
        u, v, depth = matrix @ np.append(grid.lower + (index + 0.5) * grid.voxel, 1)
        if depth <= 0:
            continue
        u, v, half = u / depth / factor + 1, v / depth / factor + 1, min(0.5 * edge / depth / factor, 16)
        if u + half < 1 or v + half < 1 or u - half >= width - 1 or v - half >= height - 1:
            continue
        for row in range(max(int(v - half), 1), min(int(v + half), height - 2) + 1):
            for column in range(max(int(u - half), 1), min(int(u + half), width - 2) + 1):
                at = canvas.offsets[view] + row * width + column
                if canvas.foreground[at]:
                    found.add(int(at))
    return found


@given(st.integers(0, 10**9), st.floats(0.05, 0.5))
@settings(max_examples=25, deadline=None)
def test_drawn_silhouettes_are_those_of_every_voxel(seed, fill):
    random = np.random.default_rng(seed)
    cameras = random_cameras(random, 3)
    silhouettes = gather_silhouettes(cameras, random_masks(random, cameras))
    grid = Grid(random.normal(size=3) - 0.5, 0.12, tuple(random.integers(1, 10, 3)))
    occupancy = random.random(grid.shape) < fill
    occupancy[0, 0, 0] = True
    if random.random() < 0.5:
        occupancy = ndimage.binary_closing(np.pad(occupancy, 2), iterations=2)[2:-2, 2:-2, 2:-2] | occupancy
    pieces = find_pieces(occupancy)
    labels, count = ndimage.label(occupancy, np.ones((3, 3, 3)))
    once = np.ones(len(pieces.sizes), np.int64)
    runs, bounds = culling._shell(pieces, occupancy, once)
    focal = np.linalg.norm(silhouettes.projections[:, :2, :3], axis=-1).mean(-1)
    areas = sum_areas(silhouettes)
    canvas = culling._lay_out(silhouettes, areas, focal * grid.voxel, grid.lower + random.random(3))
    for view, (width, height) in enumerate(canvas.sizes):
        coarse = canvas.foreground[canvas.offsets[view] : canvas.offsets[view + 1]].reshape(height, width)
        factor, mask = canvas.factors[view], silhouettes.mask(view)
        padded = np.pad(mask, [(0, -n % factor) for n in mask.shape])
        blocks = padded.reshape(height - 2, factor, width - 2, factor).any((1, 3))
        assert np.array_equal(coarse, np.pad(blocks, 1))
    drawn = culling._draw(runs, bounds, once, grid, silhouettes, canvas, focal)
    occupied = np.argwhere(occupancy)
    first = {int(label): n for n, label in enumerate(dict.fromkeys(labels[occupancy].tolist()))}
    numbers = np.array([first[int(label)] for label in labels[occupancy]])
    assert len(pieces.sizes) == count
    for piece in range(count):
        for view, (width, _) in enumerate(canvas.sizes):
            listed = drawn.pixels[drawn.starts[piece, view] : drawn.starts[piece, view + 1]].tolist()
            wanted = slow_pixels(occupied, numbers, grid, silhouettes, canvas, piece, view)
            assert len(set(listed)) == len(listed) and set(listed) <= wanted
            # Voxels without a free face add at most pixels beside drawn ones.
            near = {p + a * width + b for p in listed for a in (-1, 0, 1) for b in (-1, 0, 1)}
            assert wanted <= near


@given(st.integers(0, 10**9))
@settings(max_examples=40, deadline=None)
def test_a_piece_stays_when_better_ones_leave_it_pixels(seed):
    """The choice against sets: pieces in order of what they explain, each judged by those twice as good."""
    random = np.random.default_rng(seed)
    views, side, count = random.integers(2, 5), 24, random.integers(2, 9)
    foreground = np.zeros((views, side, side), bool)
    foreground[:, 1:-1, 1:-1] = random.random((views, side - 2, side - 2)) < 0.9
    shown = np.zeros((count, *foreground.shape), bool)
    for piece, view in np.ndindex(count, views):
        r, c = random.integers(1, side - 6, 2)
        h, w = random.integers(0, 20, 2)
        shown[piece, view, r : r + h, c : c + w] = True
    shown &= foreground
    listed = [np.flatnonzero(view) + n * side * side for piece in shown for n, view in enumerate(piece)]
    ends = np.cumsum([len(x) for x in listed]).reshape(count, views)
    starts = np.concatenate([ends[:, :1] - [[len(x)] for x in listed[::views]], ends], 1)
    offsets = np.arange(views + 1) * side * side
    sizes = np.full((views, 2), side)
    canvas = culling._Canvas(np.ones(views, np.int64), sizes, offsets, foreground.reshape(-1))
    keep = culling._choose(culling._Drawn(starts, np.concatenate(listed).astype(np.int32)), canvas, 2)
    total = foreground.sum((1, 2))
    own = shown.sum((2, 3))
    share = (own / total).sum(1)
    wide = ndimage.binary_dilation(shown, np.ones((1, 1, 3, 3)))
    assert keep[share == share.max()].any()
    for piece in range(count):
        if share[piece] == share.max():
            continue
        better = wide[keep & (share >= 2 * share[piece])].any(0)
        fresh = (shown[piece] & ~better).sum((1, 2))
        says = (fresh >= 4) & (fresh >= 0.2 * own[piece])
        enough = says.sum() >= 2 or (says & (fresh >= 0.01 * total)).any()
        assert keep[piece] == (enough and (own[piece] > 0).sum() >= 2)


@pytest.mark.parametrize("stretch", [2, 4])
def test_a_sample_of_a_large_piece_draws_its_silhouette(stretch):
    cameras = ring(3, size=64)
    silhouettes = gather_silhouettes(cameras, [torch.ones(64, 64, dtype=torch.bool)] * 3)
    grid = Grid(np.full(3, -0.6), 1.2 / 120, (120, 120, 120))
    axis = np.arange(120) - 59.5
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    occupancy = (x**2 + y**2 + z**2 < 50**2) & (np.abs(x + y) > 12) & ((np.abs(z) < 20) | (x < 30))
    pieces = find_pieces(occupancy)
    focal = np.linalg.norm(silhouettes.projections[:, :2, :3], axis=-1).mean(-1)
    canvas = culling._lay_out(silhouettes, sum_areas(silhouettes), focal * grid.voxel, np.zeros(3))
    pictures, lengths = [], []
    for times in (1, stretch):
        factor = np.full(len(pieces.sizes), times)
        runs, bounds = culling._shell(pieces, occupancy, factor)
        drawn = culling._draw(runs, bounds, factor, grid, silhouettes, canvas, focal)
        picture = np.zeros(len(canvas.foreground), bool)
        picture[drawn.pixels] = True
        pictures.append(picture.reshape(3, 66, 66))
        lengths.append((runs[:, 3] - runs[:, 2]).sum())
    wide = [ndimage.binary_dilation(p, np.ones((1, 3, 3))) for p in pictures]
    assert lengths[1] < 1.3 * lengths[0] / stretch**2
    assert not (pictures[0] & ~wide[1]).any() and not (pictures[1] & ~wide[0]).any() and pictures[0].any()


def test_order_of_the_views_does_not_matter():
    balls = [((0.5, 0.0, 0.0), 0.22), ((-0.5, 0.1, 0.0), 0.1)]
    cameras = turntable(5)
    masks = ball_masks(cameras, balls)
    order = [3, 1, 4, 0, 2]
    one = VisibleDomain(resolution=48).carve(cameras, masks)
    other = VisibleDomain(resolution=48).carve(cameras[torch.tensor(order)], [masks[i] for i in order])
    assert one.summary["components"] == 2 and np.array_equal(one.occupancy, other.occupancy)
