"""Lists of tiles and rows against every pixel looked at; no result depends on the number of threads."""

import numpy as np
import pytest
import torch

from tests.splat.twin import make_camera, make_gaussians
from visdom_plugin.splat.cpu import backend
from visdom_plugin.splat.cpu.tiles import TILE, Tiles
from visdom_plugin.splat.rasterise import rasterise

SCENES = {
    "plain": {"n": 300},
    "needles": {"n": 200, "scale": 0.02, "stretch": 2.5},
    "wider than the image": {"n": 40, "scale": 2.0},
}
CAMERAS = {
    "odd size": {"width": 53, "height": 37},
    "from the side": {"width": 70, "height": 90, "position": (2.5, 0.3, -1.0), "focal": 60.0},
}


def listed(scene, camera, monkeypatch, dtype=torch.float32):
    """Records (N, 16) as float64, and the tiles made of them."""
    seen = []

    class Watched(Tiles):
        def __init__(self, splats, *rest):
            super().__init__(splats, *rest)
            seen.append((splats.astype(np.float64), self))

    monkeypatch.setattr(backend, "Tiles", Watched)
    options = dict(SCENES[scene])
    stretch = options.pop("stretch", 0)
    gaussians = make_gaussians(**options, dtype=dtype).detach()
    gaussians.log_scales[:, 0] += stretch
    rasterise(gaussians, camera, torch.zeros(3), near=0.01)
    return seen[0]


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("scene", SCENES)
def test_every_visible_pixel_is_listed_and_few_rows_in_vain(scene, camera, monkeypatch):
    view = make_camera(**CAMERAS[camera])
    records, found = listed(scene, view, monkeypatch)
    width, height = view.size
    y, x = np.mgrid[:height, :width] + 0.5
    in_vain = total = 0
    for tile in range(found.count):
        rows = {
            int(g): (int(r) // 32, int(r) % 32)
            for g, r in zip(
                found.gaussians[found.starts[tile] : found.starts[tile + 1]],
                found.rows[found.starts[tile] : found.starts[tile + 1]],
                strict=True,
            )
        }
        top, left = tile // found.columns * TILE, tile % found.columns * TILE
        here = np.s_[top : top + TILE, left : left + TILE]
        for i, (a, b, c, opacity, *_, u, v, _, _, tau, _, _, _) in enumerate(records):
            dx, dy = u - x[here], v - y[here]
            alpha = opacity * np.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)
            needed = np.flatnonzero((alpha >= 1 / 255).any(1)) if tau > 0 else []
            first, end = rows.get(i, (0, 0))
            assert all(first <= row < end for row in needed), (tile, i)
            total += end - first
            in_vain += end - first - len(needed)
    assert total > 500 and in_vain < 0.15 * total


def test_both_orders_name_the_same_intersections(monkeypatch):
    records, found = listed("plain", make_camera(width=53, height=37), monkeypatch)
    assert len(found.slots) == found.offsets[-1] == found.starts[-1] > 300
    assert sorted(found.slots) == list(range(len(found.slots)))
    rank_of_slot = np.searchsorted(found.offsets, found.slots, side="right") - 1
    assert (found.order[rank_of_slot] == found.gaussians).all()
    for start, end in zip(found.starts[:-1], found.starts[1:], strict=True):
        assert (np.diff(records[found.gaussians[start:end], 7]) >= 0).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [0, 1, 40, 3000])
def test_order_by_depth_is_stable(n, dtype):
    generator = np.random.default_rng(0)
    some = generator.choice([0, 1e-3, 0.5, 0.5000001, 3, 1e20, np.inf], n)
    for depths in (
        some,
        np.zeros(n),
        np.full(n, 3.0),
        generator.random(n),
        np.where(some > 2, 0, generator.random(n)),
    ):
        splats = np.zeros((n, 16), dtype)  # none is drawn
        splats[:, 7] = depths
        found = Tiles(splats, np.zeros(n, np.int32), 40, 30)
        assert (found.order == np.argsort(splats[:, 7], kind="stable")).all()


@pytest.mark.parametrize("threads", [2, 3])
def test_results_do_not_depend_on_threads(threads):
    def run(count):
        before = torch.get_num_threads()
        torch.set_num_threads(count)
        try:
            gaussians = make_gaussians(n=3000, dtype=torch.float32)
            render = rasterise(gaussians, make_camera(width=150, height=131), torch.ones(3), near=0.01)
            (render.rgb.square().sum() + render.depth.sum()).backward()
        finally:
            torch.set_num_threads(before)
        return [render.rgb, render.depth, *(p.grad for p in gaussians.tensors().values())]

    for one, many in zip(run(1), run(threads), strict=True):
        assert torch.equal(one, many)
