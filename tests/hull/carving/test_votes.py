"""The vote and its fast twin: equal voxel for voxel, whatever the cameras and masks."""

from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hull.balls import random_cameras, random_masks
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import project
from visdom_plugin.hull.carving.areas import sum_areas
from visdom_plugin.hull.carving.cells import DROPPED, KEPT, classify_cells, keep_centres
from visdom_plugin.hull.carving.keep_rule import KeepRule, as_fraction
from visdom_plugin.hull.carving.octree import block_carve
from visdom_plugin.hull.carving.votes import Grid, count_votes, dense_carve, gather_silhouettes


def random_rule(random: np.random.Generator, views: int) -> KeepRule:
    k = int(random.integers(1, views + 1))
    choice = random.integers(4)
    if choice == 0:
        return KeepRule(views, k, None, max_misses=int(random.integers(0, 3)))
    if choice == 1:
        return KeepRule(views, 0, None, least_occupied=max(views - 1, 1))
    return KeepRule(views, k, as_fraction(float(random.choice([0.5, 0.75, 0.95, 1.0]))))


def random_case(seed: int):
    random = np.random.default_rng(seed)
    views = int(random.integers(1, 9))
    cameras = random_cameras(random, views)
    masks = random_masks(random, cameras)
    shape = tuple(int(n) for n in random.integers(3, 60, 3))
    grid = Grid(random.normal(size=3) - 1, float(random.choice([0.01, 0.04, 0.3])), shape)
    return random, cameras, masks, grid, random_rule(random, views)


@given(st.integers(0, 10**9))
@settings(max_examples=80, deadline=None)
def test_blocks_equal_dense_vote(seed):
    _, cameras, masks, grid, rule = random_case(seed)
    silhouettes = gather_silhouettes(cameras, masks)
    assert np.array_equal(block_carve(silhouettes, grid, rule), dense_carve(silhouettes, grid, rule).numpy())


@given(st.integers(0, 10**9))
@settings(max_examples=40, deadline=None)
def test_unknown_pixels_count_alike_in_every_vote(seed):
    """Blocks, cells, centres and the dense vote: an unknown pixel is a hit, and two views must know better."""
    random, cameras, masks, grid, rule = random_case(seed)
    ignore = [None if random.random() < 0.3 else np.roll(m, 3, 1) ^ m for m in masks]
    silhouettes = gather_silhouettes(cameras, masks, ignore)
    hits = [m if g is None else m | g for m, g in zip(masks, ignore, strict=True)]
    surely = [m if g is None else m & ~g for m, g in zip(masks, ignore, strict=True)]
    occupied, visible = count_votes(gather_silhouettes(cameras, hits), grid)
    known, _ = count_votes(gather_silhouettes(cameras, surely), grid)
    table = rule.table().astype(bool)
    wanted = table[visible.numpy().astype(int), occupied.numpy().astype(int)]
    if any(g is not None for g in ignore):
        wanted &= known.numpy() >= min(2, rule.least_visible or rule.least_occupied)
    assert np.array_equal(block_carve(silhouettes, grid, rule), wanted)
    assert np.array_equal(dense_carve(silhouettes, grid, rule).numpy(), wanted)
    cells = np.stack(np.unravel_index(np.arange(wanted.size), wanted.shape), -1)
    assert np.array_equal(keep_centres(silhouettes, grid, rule, cells), wanted.reshape(-1))
    states = classify_cells(silhouettes, sum_areas(silhouettes), grid, rule, cells)
    assert not wanted.reshape(-1)[states == DROPPED].any() and wanted.reshape(-1)[states == KEPT].all()


@given(st.integers(0, 10**9))
@settings(max_examples=25, deadline=None)
def test_dense_vote_equals_projection_of_every_centre(seed):
    _, cameras, masks, grid, rule = random_case(seed)
    grid = grid._replace(shape=tuple(min(n, 20) for n in grid.shape))
    silhouettes = gather_silhouettes(cameras, masks)
    centres = np.stack(np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij"), -1).reshape(-1, 3)
    uv, depth = (x.numpy() for x in project(cameras, torch.from_numpy(centres)))
    visible, occupied = np.zeros(len(centres), int), np.zeros(len(centres), int)
    for view, mask in enumerate(masks):
        u, v = np.floor(uv[view]).T
        seen = (depth[view] > 0) & (u >= 0) & (u < mask.shape[1]) & (v >= 0) & (v < mask.shape[0])
        visible += seen
        occupied[seen] += mask[v[seen].astype(int), u[seen].astype(int)]
    counted = [x.numpy().reshape(-1) for x in count_votes(silhouettes, grid, chunk=500)]
    assert np.array_equal(counted[0], occupied) and np.array_equal(counted[1], visible)
    kept = np.array([rule.keeps(int(v), int(o)) for v, o in zip(visible, occupied, strict=True)])
    assert np.array_equal(block_carve(silhouettes, grid, rule).reshape(-1), kept)


@given(st.integers(0, 10**9))
@settings(max_examples=40, deadline=None)
def test_a_judged_cell_holds_for_every_point_in_it(seed):
    random, cameras, masks, grid, rule = random_case(seed)
    grid = grid._replace(shape=(6, 6, 6), voxel=grid.voxel * 5)
    silhouettes = gather_silhouettes(cameras, masks)
    cells = np.stack(np.unravel_index(np.arange(216), grid.shape), -1)
    states = classify_cells(silhouettes, sum_areas(silhouettes), grid, rule, cells)
    for _ in range(20):
        # Every cell's centre in a shifted grid is a random point of the cell; the corners are the hardest.
        shift = (random.choice([0.0, 1.0, random.random()], 3) - 0.5) * grid.voxel * (1 - 1e-9)
        kept = keep_centres(silhouettes, grid._replace(lower=grid.lower + shift), rule, cells)
        assert kept[states == KEPT].all() and not kept[states == DROPPED].any()


@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from([0.05, 0.3, 0.75, 0.9, 0.95, 1.0]))
def test_agreement_is_decided_in_integers(views, k, agreement):
    rule = KeepRule(views, k, as_fraction(agreement))
    table = rule.table()
    for visible in range(views + 1):
        for occupied in range(visible + 1):
            wanted = visible >= k and occupied * 100 >= round(agreement * 100) * visible
            assert table[visible, occupied] == wanted


def test_agreement_on_the_edge_keeps():
    # 0.95 * 20 = 19 and 0.3 * 10 = 3 in decimals; in binary 0.1 + 0.2 is not 0.3.
    assert as_fraction(0.95) == Fraction(19, 20)
    assert KeepRule(20, 3, as_fraction(0.95)).keeps(20, 19)
    assert not KeepRule(20, 3, as_fraction(0.95)).keeps(19, 18)
    assert KeepRule(10, 1, as_fraction(0.3)).keeps(10, 3)


@pytest.mark.parametrize(
    ("views", "agreement", "words"),
    [
        (4, 0.95, "masks of all of the views"),
        (9, 0.95, "masks of all of the views"),
        (20, 0.95, "all but one of"),
        (4, 0.74, "all but one of"),
        (40, 0.95, "all but 2 of"),
    ],
)
def test_rule_says_what_agreement_means(views, agreement, words):
    assert words in KeepRule(views, 3, as_fraction(agreement)).meaning()


def test_many_views_and_views_of_one_pixel():
    random = np.random.default_rng(5)
    cameras = random_cameras(random, 40)
    masks = random_masks(random, cameras)
    grid = Grid(np.full(3, -1.0), 0.05, (40, 40, 40))
    rule = KeepRule(40, 2, as_fraction(0.6))
    silhouettes = gather_silhouettes(cameras, masks)
    assert np.array_equal(block_carve(silhouettes, grid, rule), dense_carve(silhouettes, grid, rule).numpy())
    tiny = cameras.resized(1, 1)
    silhouettes = gather_silhouettes(tiny, [np.ones((1, 1), bool)] * 40)
    assert np.array_equal(block_carve(silhouettes, grid, rule), dense_carve(silhouettes, grid, rule).numpy())


def test_dilation_grows_by_a_square():
    cameras = random_cameras(np.random.default_rng(0), 1)
    width, height = int(cameras.width[0]), int(cameras.height[0])
    mask = np.zeros((height, width), bool)
    mask[8, 9] = True
    grown = gather_silhouettes(cameras, [mask], dilate_px=2).mask(0)
    wanted = np.zeros_like(mask)
    wanted[6:11, 7:12] = True
    assert np.array_equal(grown, wanted)


def test_masks_that_do_not_fit_are_refused():
    cameras = random_cameras(np.random.default_rng(0), 2)
    good = [
        np.ones((h, w), bool) for w, h in zip(cameras.width.tolist(), cameras.height.tolist(), strict=True)
    ]
    for bad in (good[:1], [good[0], good[1].T[:-1]], [good[0] * 255, good[1]]):
        with pytest.raises(SceneError):
            gather_silhouettes(cameras, bad)
