"""VaxNeRF on Instant-NGP: what lies outside the hull has no part in training, nor, with the hull, in renders."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs import vaxnerf, zipnerf_lite
from method_configs.ingp import SPEC
from tests.methods.fields.test_nerf_methods import SMALL, advance, start
from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.sampler import VisDomSampler
from visdom_plugin.hull.hull import Hull
from visdom_plugin.methods.fields.ingp import Ingp
from visdom_plugin.nerf.sampling.occupancy_grid import PackedSamples, select
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.protocols import PixelBatch

CONFIG = replace(
    SMALL[Ingp],
    mask_weight=0.0,
    background="white",
    hull=replace(vaxnerf.HULL, resolution=48),
    vd=vaxnerf.SAMPLER,
)
WITH_HULL = replace(CONFIG, vd=replace(vaxnerf.SAMPLER, hull_at_inference=True))


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48))


@pytest.fixture(scope="module")
def shards(scene):
    """A hull in many pieces: the scene's own with most of its layers taken out, so that rays cross gaps."""
    hull = CONFIG.hull.carve(scene.train.cameras, scene.train.masks)
    grid = hull.occupancy.copy()
    grid[:, :, np.arange(grid.shape[2]) % 6 > 2] = False
    return Hull.from_grid(grid, hull.bounds)


def _poison(method: Ingp, hull: Hull, monkeypatch) -> None:
    """From here on the field has no value outside the hull."""
    features = method._features

    def poisoned(points):
        density, rest = features(points)
        inside = hull.contains(method.frame.to_world(points))
        return torch.where(inside, density, torch.nan), rest

    monkeypatch.setattr(method, "_features", poisoned)


@pytest.mark.parametrize("drop", [True, False])
def test_the_field_outside_the_hull_has_no_part_in_training(scene, shards, monkeypatch, drop):
    config = replace(CONFIG, vd=replace(CONFIG.vd, drop_outside=drop))
    method = start(Ingp, scene, shards, config)
    batch = DataManager(scene.train, seed=0).pixel_batch(1, 400)
    clean = method.train_step(batch, 1).losses["colour"]
    _poison(method, shards, monkeypatch)
    poisoned = method.train_step(batch, 1).losses["colour"]
    # Bounds without a band are not enough: they let rays sample the gaps between the shards.
    assert bool(poisoned.isfinite()) is drop
    assert torch.equal(clean, poisoned) is drop
    if drop:
        poisoned.backward()
        assert method.table.grad.isfinite().all() and method.table.grad.abs().max() > 0


def test_novel_views_look_outside_the_hull_only_without_it(scene, shards, monkeypatch):
    for config, clean in ((CONFIG, False), (WITH_HULL, True)):
        method = start(Ingp, scene, shards, config)
        before = method.render(scene.test.cameras[0], torch.ones(3))
        _poison(method, shards, monkeypatch)
        after = method.render(scene.test.cameras[0], torch.ones(3))
        assert torch.equal(before.rgb, after.rgb) is clean
        assert (before.alpha > 0).any()


def test_the_hull_at_inference_leaves_training_as_it_is(scene, shards):
    states = []
    for config in (CONFIG, WITH_HULL):
        method = start(Ingp, scene, shards, config)
        advance(method, scene, range(10))
        states.append(method.state_dict())
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


def test_a_batch_beside_the_hull_teaches_nothing_and_breaks_nothing(scene, shards):
    method = start(Ingp, scene, shards, CONFIG)
    batch = DataManager(scene.train, seed=0).pixel_batch(1, 400)
    hit = method.bound(batch.origins, batch.directions, method.hooks).hit
    fields = {f: getattr(batch, f) for f in PixelBatch.__dataclass_fields__}
    beside = PixelBatch(**{f: None if v is None else v[~hit] for f, v in fields.items()})
    assert int((~hit).sum()) > 20
    method.train_step(beside, 1).losses["colour"].backward()
    assert not method.table.grad.any()


def test_selected_samples_are_those_of_the_slow_twin():
    draw = torch.Generator().manual_seed(0)
    ray = torch.randint(7, (40,), generator=draw).sort().values
    starts = torch.rand(40, generator=draw)
    offsets = torch.tensor([int((ray < r).sum()) for r in range(8)])
    for share in (0.0, 0.4, 1.0):
        kept = torch.rand(40, generator=draw) < share
        found = select(PackedSamples(offsets, ray, starts, starts + 1), kept)
        for r in range(7):
            mine = slice(int(found.ray_offsets[r]), int(found.ray_offsets[r + 1]))
            expected = [float(starts[i]) for i in range(40) if kept[i] and ray[i] == r]
            assert found.starts[mine].tolist() == expected and (found.ray[mine] == r).all()
        assert found.ray_offsets[-1] == len(found.ends) == int(kept.sum())


def test_the_filter_is_the_hull(shards):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = torch.tensor(shards.bounds[0]) + points * torch.as_tensor(np.ptp(shards.bounds, axis=0))
    keep = VisDomSampler(shards, drop_outside=True).keep(points)
    assert torch.equal(keep, shards.contains(points)) and keep.any() and not keep.all()
    assert VisDomSampler(shards).keep(points).all()


def test_the_presets_are_ingp_with_a_hull_and_its_filter():
    star = list(vaxnerf.SPEC.presets().values())
    for preset in star:
        for config, base in ((preset.quick, SPEC.quick), (preset.full, SPEC.full)):
            assert replace(config, hull=None, vd=base.vd) == base
            assert (
                config.vd.drop_outside and config.vd.missing == "skip" and config.hull.kind == "unit-sphere"
            )
    assert [p.quick.vd.hull_at_inference for p in star] == [False, True]
    assert [p.name for p in star] == ["vaxnerf", "vaxnerf+hull"] and star[0].load() is Ingp


def test_other_methods_refuse_the_filter():
    with pytest.raises(ConfigError, match="drop_outside"):
        replace(zipnerf_lite.SPEC.quick, hull=vaxnerf.HULL, vd=vaxnerf.SAMPLER)
