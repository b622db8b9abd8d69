"""splatfields-lite: what its field gives to Gaussians, and what its losses ask for."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs.splatfields_lite import SPEC
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin.hooks.configs import RegularizerConfig
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.splats.splatfields.field import TriplaneField
from visdom_plugin.methods.splats.splatfields.method import SplatFieldsLite
from visdom_plugin.methods.splats.splatfields.moran import moran, moran_loss
from visdom_plugin.seeding import generator
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.ply import read_ply
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.training.batches import DataManager

SMALL = replace(
    SPEC.quick,
    steps=40,
    initial_points=300,
    max_gaussians=600,
    densify_from=8,
    densify_until=30,
    densify_every=6,
    densify_gradient=1e-4,
    noise_size=2,
    plane_channels=4,
    decoder_width=4,
    mlp_depth=2,
    mlp_width=16,
    moran_weight=0.01,
    hull=VisibleDomain(resolution=48),
    vd=RegularizerConfig(enabled=True, prune_every=7),
)


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=48))


@pytest.fixture(scope="module")
def hull(scene):
    return SMALL.hull.carve(scene.train.cameras, scene.train.masks)


def start(scene, hull, config=SMALL, hooks=None, seed=0):
    return set_up(SplatFieldsLite, config, scene, hull, hooks, seed)


def some(n, seed=0, degree=1):
    draw = generator(seed, "some")
    shapes = ((n, 3), (n, 3), (n, 4), (n,), (n, (degree + 1) ** 2, 3))
    return Gaussians(*(torch.randn(shape, generator=draw) for shape in shapes))


def stirred(field, seed=0):
    """The field with a head that says something."""
    with torch.no_grad():
        field.head.weight.copy_(torch.randn(field.head.weight.shape, generator=generator(seed, "head")))
    return field


def test_at_the_start_the_field_adds_nothing():
    own = some(50)
    field = TriplaneField(SMALL, own.means, 4, 1.0, generator(0))
    assert field.planes().shape == (3, 4, 32, 32)
    shown = field(own, field.planes())
    assert all(
        torch.equal(a, b) for a, b in zip(shown.tensors().values(), own.tensors().values(), strict=True)
    )


def test_what_the_field_adds_depends_on_the_place_alone():
    own, other = some(40), some(40, seed=1)
    other.means = own.means.flip(0)
    field = stirred(TriplaneField(SMALL, own.means, 4, 1.0, generator(0)))
    planes = field.planes()

    def added(gaussians):
        shown = field(gaussians, planes).tensors()
        return {name: shown[name] - value for name, value in gaussians.tensors().items()}

    first, second = added(own), added(other)
    for name, value in first.items():
        assert value.flatten(1 if value.ndim > 1 else 0).std(0).max() > 1e-4, name
        torch.testing.assert_close(second[name].flip(0), value, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**12])
def test_the_field_has_no_unit(factor):
    own = some(30)
    fields = [stirred(TriplaneField(SMALL, s * own.means, 4, s * 1.3, generator(0))) for s in (1.0, factor)]
    scaled = replace(own, means=factor * own.means)
    a, b = (f(g, f.planes()) for f, g in zip(fields, (own, scaled), strict=True))
    assert torch.equal(factor * a.means, b.means)
    assert all(torch.equal(a.tensors()[n], b.tensors()[n]) for n in ("log_scales", "quaternions", "sh"))


def test_only_the_field_learns(scene, hull):
    method = start(scene, hull, replace(SMALL, densify_from=100, densify_until=0), hooks=[])
    before = copy_of(method)
    advance(method, scene, range(6))
    after = method.state_dict()
    own = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")
    assert all(torch.equal(before[name], after[name]) for name in own)
    learned = [name for name, value in after.items() if name.startswith("field.") and ".adam." not in name]
    moved = [name for name in learned if name in before and not torch.equal(before[name], after[name])]
    assert any("decoders" in name for name in moved) and "field.head.weight" in moved
    assert not any("noise" in name for name in learned)  # it is frozen
    assert float((method.splats.means - before["means"] * method.unit).abs().max()) > 0


def test_it_learns(scene, hull):
    method = start(scene, hull, replace(SMALL, lr_field=2e-2, mlp_width=64, norm_weight=0.0))

    def error():
        batches = (DataManager(scene.train, seed=0).view(i) for i in range(len(scene.train)))
        total = 0.0
        for batch in batches:
            truth = torch.where(batch.mask[..., None] > 0, batch.image, 1.0)
            total += float((method.render(batch.camera, torch.ones(3)).rgb - truth).square().mean())
        return total

    before = error()
    advance(method, scene, range(40))
    assert error() < 0.93 * before


def test_a_resumed_run_equals_the_uninterrupted_one(scene, hull):
    straight = start(scene, hull)
    advance(straight, scene, range(19))
    saved = copy_of(straight)
    straight.render(scene.test.cameras[0], torch.ones(3))  # which leaves no trace
    advance(straight, scene, range(19, 36))
    resumed = start(scene, hull)
    resumed.load_state_dict(saved)
    advance(resumed, scene, range(19, 36))
    assert same(straight.state_dict(), resumed.state_dict())
    assert len(straight.splats) != SMALL.initial_points


def test_what_is_exported_looks_like_what_is_drawn(scene, hull, tmp_path):
    method = start(scene, hull)
    advance(method, scene, range(12))
    (path,) = method.export(tmp_path)
    camera, white = scene.test.cameras[0], torch.ones(3)
    drawn = rasterise(read_ply(path), camera, white)
    torch.testing.assert_close(drawn.rgb, method.render(camera, white).rgb, rtol=1e-3, atol=1e-3)


def test_what_the_field_makes_faint_is_removed(scene, hull):
    method = start(scene, hull, replace(SMALL, densify_gradient=1.0), hooks=[])
    with torch.no_grad():
        method.splats.field.head.bias[10] -= 12.0  # the opacity's
    advance(method, scene, range(11))
    assert len(method.splats) == 300
    advance(method, scene, range(11, 12))
    # All are faint, and not all may go.
    assert len(method.splats) == 300
    with torch.no_grad():
        method.splats.field.head.bias[10] += 12.0
        method.splats.field.head.weight[10] = 30 * torch.randn(16, generator=generator(0))
    method.splats._planes = None
    advance(method, scene, range(12, 18))
    assert len(method.splats) < 300


def test_each_loss_is_what_it_says(scene, hull):
    config = replace(SMALL, mask_l1_weight=0.3, norm_weight=0.2, moran_weight=0.1)
    method = start(scene, hull, config, hooks=[])
    batch = DataManager(scene.train, seed=0).view(1)
    output = method.train_step(batch, 0)
    alpha = output.renders[0].alpha.detach()
    assert float(output.losses["mask_l1"].detach()) == pytest.approx(
        0.3 * float((alpha - batch.mask).abs().mean())
    )
    apart = (method.splats.means / method.unit - method.look_at).norm(dim=-1).mean()
    assert float(output.losses["norm"].detach()) == pytest.approx(0.2 * float(apart))
    assert 0 < float(output.losses["moran"].detach()) < 0.4
    off = start(scene, hull, replace(config, mask_l1_weight=0, norm_weight=0, moran_weight=0), hooks=[])
    assert not {"mask_l1", "norm", "moran"} & off.train_step(batch, 0).losses.keys()


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 6), st.integers(1, 4), st.floats(0.1, 50.0), st.integers(0, 10**6))
def test_morans_index_is_at_most_one_and_one_where_all_are_alike(n, f, scale, seed):
    draw = generator(seed)
    features = torch.randn(7, n, f, generator=draw, dtype=torch.float64)
    weights = torch.rand(7, n, n, generator=draw, dtype=torch.float64)
    weights = (weights + weights.mT) * (1 - torch.eye(n, dtype=torch.float64))
    torch.testing.assert_close(moran(features, scale * weights), moran(features, weights))
    alike = features[:, :1].expand(-1, n, -1).abs() + 1
    assert float(moran(alike, weights)) == pytest.approx(1, abs=1e-3)
    # A slow twin.
    total = 0.0
    for b in range(7):
        for k in range(f):
            x, w = features[b, :, k], weights[b]
            cross = sum(float(w[i, j] * x[i] * x[j]) for i in range(n) for j in range(n))
            total += n / float(w.sum()) * cross / (float((x * x).sum()) + 1e-4)
    assert float(moran(features, weights)) == pytest.approx(total / (7 * f), abs=1e-9)


def test_smooth_attributes_have_less_of_the_moran_loss_than_shuffled_ones():
    smooth = some(400)
    wave = smooth.means @ torch.randn(3, 1, generator=generator(1))
    smooth.sh = wave[:, None].expand(-1, 4, 3).contiguous()
    shuffled = replace(smooth, sh=smooth.sh[torch.randperm(400, generator=generator(2))])
    a, b = (float(moran_loss(g, generator(3))) for g in (smooth, shuffled))
    assert 0 <= a < b - 0.1 and b <= 4


def test_presets_differ_only_in_what_they_name():
    bare, mask, vd = (SPEC.presets()[f"splatfields{suffix}"] for suffix in ("", "+mask", "+vd"))
    assert SPEC.presets()["splatfields-lite+vd"] == vd
    for budget in ("quick", "full"):
        base = getattr(bare, budget)
        assert replace(getattr(mask, budget), mask_weight=base.mask_weight) == base
        kept = {name: getattr(base, name) for name in ("mask_weight", "hull", "vd")}
        assert replace(getattr(vd, budget), **kept) == base and getattr(vd, budget).vd.enabled
