"""Collider, background, losses and whole models of radiance fields inside the real nerfstudio, on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: see scripts/nerfstudio_env.sh")

from nerfstudio.model_components.scene_colliders import NearFarCollider

from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks.configs import SamplerConfig
from visdom_plugin.hull.queries.raycast import cast
from visdom_plugin.integrations.nerfstudio import fields, methods
from visdom_plugin.integrations.nerfstudio.dataparser import METADATA
from visdom_plugin.integrations.nerfstudio.rays import bound_model_rays

from .host import HULL, build, pixel_rays


@pytest.fixture(scope="module")
def hook(train):
    views = train.metadata[METADATA].views
    hull = HULL.carve(views.cameras, views.masks)
    return SamplerConfig(enabled=True).build(hull, views)


@pytest.mark.parametrize("at_inference", [False, True])
def test_collider_confines_training_and_by_default_nothing_else(train, hook, at_inference):
    frame = train.metadata[METADATA].frame
    collider = fields.HullCollider(NearFarCollider(0.05, 1000.0), hook, frame, at_inference)
    bundle = pixel_rays(train)
    bounds = bound_model_rays(
        hook,
        frame,
        bundle.origins,
        bundle.directions,
        torch.full_like(bundle.origins[:, 0], 0.05),
        torch.full_like(bundle.origins[:, 0], 1000.0),
    )
    assert 0.05 < bounds.hit.float().mean() < 0.95
    seen = collider.train()(pixel_rays(train))
    assert torch.equal(seen.nears, bounds.near[:, None]) and torch.equal(seen.fars, bounds.far[:, None])
    seen = collider.eval()(pixel_rays(train))
    if at_inference:
        assert torch.equal(seen.fars, bounds.far[:, None])
    else:
        assert (seen.nears == 0).all() and (seen.fars == 1000).all()


def test_background_is_random_in_training_and_white_after():
    renderer = fields.RandomThenWhite()
    rgb, weights = torch.rand(6, 5, 3), torch.rand(6, 5, 1) / 5
    photograph = torch.rand(6, 4)
    opacity = weights.sum(-2)
    drawn = renderer.train()(rgb, weights)
    shown, target = renderer.blend_background_for_loss_computation(drawn, opacity, photograph)
    behind = (target - photograph[:, :3] * photograph[:, 3:]) / (1 - photograph[:, 3:])
    assert behind.std() > 0.1
    assert torch.allclose(shown, (weights * rgb).sum(-2) + behind * (1 - opacity), atol=1e-4)
    white = renderer.eval()(rgb.clone(), weights)
    assert torch.allclose(white, (weights * rgb).sum(-2) + 1 - opacity, atol=1e-6)
    assert torch.allclose(
        renderer.blend_background(photograph), photograph[:, :3] * photograph[:, 3:] + 1 - photograph[:, 3:]
    )


def test_rgba_mask_loss_is_the_cross_entropy():
    opacity, photograph = torch.rand(50, 1) * 0.9 + 0.05, torch.rand(50, 4).round()
    loss = fields.rgba_mask_loss(opacity, photograph)
    by_hand = [
        -np.log(a) if m else -np.log(1 - a)
        for a, m in zip(opacity[:, 0].tolist(), photograph[:, 3], strict=True)
    ]
    assert loss.item() == pytest.approx(np.mean(by_hand), rel=1e-5)
    with pytest.raises(ConfigError, match="without"):
        fields.rgba_mask_loss(opacity, photograph[:, :3])


def test_rgba_mask_loss_leaves_mixed_precision(monkeypatch):
    """On CUDA torch raises for a cross entropy of probabilities under autocast."""
    plain, seen = fields.mask_loss, []

    def watched(alpha, mask):
        seen.append((torch.is_autocast_enabled("cpu"), alpha.dtype, mask.dtype))
        return plain(alpha, mask)

    monkeypatch.setattr(fields, "mask_loss", watched)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        fields.rgba_mask_loss(torch.rand(5, 1).bfloat16(), torch.rand(5, 4).round())
    assert seen == [(False, torch.float32, torch.float32)]


# Whole models

TINY = {
    "implementation": "torch",
    "num_levels": 4,
    "max_res": 64,
    "log2_hashmap_size": 10,
    "num_proposal_samples_per_ray": (16, 8),
    "num_nerf_samples_per_ray": 8,
    "camera_optimizer": methods.CameraOptimizerConfig(mode="off"),
}


def step(model, train, batch):
    torch.manual_seed(1)
    bundle = pixel_rays(train)[batch["chosen"]]
    outputs = model(bundle)
    return outputs, model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))


@pytest.fixture(scope="module")
def batch(train):
    views = train.metadata[METADATA].views
    chosen = torch.randperm(views.masks[0].numel(), generator=torch.Generator().manual_seed(0))[:200]
    rgba = torch.cat([views.images[0].float() / 255, views.masks[0].float()[..., None]], -1)
    return {"chosen": chosen, "image": rgba.reshape(-1, 4)[chosen]}


def test_with_the_hooks_off_it_is_nerfacto(train, batch):
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    off = fields.NerfactoVdConfig(
        **TINY, vd=SamplerConfig(enabled=False), mask_weight=0, background_color="white"
    )
    results = []
    for config in (NerfactoModelConfig(**TINY, background_color="white"), off):
        model = build(config, train)
        outputs, losses = step(model, train, batch)
        sum(losses.values()).backward()
        results.append((outputs["rgb"], losses, [p.grad for p in model.field.parameters()]))
    (rgb, losses, gradients), (other_rgb, other_losses, other_gradients) = results
    assert torch.equal(rgb, other_rgb) and losses.keys() == other_losses.keys()
    assert all(torch.equal(losses[k], other_losses[k]) for k in losses)
    pairs = list(zip(gradients, other_gradients, strict=True))
    assert any(a is not None for a, _ in pairs)
    assert all((a is None and b is None) or torch.equal(a, b) for a, b in pairs)


def test_samples_of_training_rays_lie_in_the_hulls_band(train, batch):
    model = build(fields.NerfactoVdConfig(**TINY, hull=HULL), train).train()
    outputs, losses = step(model, train, batch)
    assert "mask_loss" in losses
    assert losses["mask_loss"].item() == pytest.approx(
        0.1 * fields.rgba_mask_loss(outputs["accumulation"], batch["image"]).item()
    )
    hook, frame = model.collider.hook, model.collider.frame
    bundle = model.collider(pixel_rays(train)[batch["chosen"]])
    hit = bound_model_rays(
        hook, frame, bundle.origins, bundle.directions, bundle.nears[:, 0] * 0, bundle.fars[:, 0] * 0 + 1e3
    ).hit
    samples = outputs["ray_samples_list"][-1].frustums
    middle = (samples.origins + samples.directions * (samples.starts + samples.ends) / 2)[hit]
    box = hook.hull.extent + np.array([[-1], [1]]) * (hook.epsilon_world + 1e-4)
    inside = frame.points_to_world(middle).numpy()
    assert 0.05 < hit.float().mean() < 0.95
    assert ((inside > box[0]) & (inside < box[1])).all()


def test_rays_of_virtual_views_are_trained_to_be_empty(train, batch, monkeypatch):
    on = SamplerConfig(enabled=True, virtual_views="midpoints", virtual_weight=0.5)
    model = build(fields.NerfactoVdConfig(**TINY, hull=HULL, vd=on), train).train()
    seen = []
    inner = model.get_outputs
    monkeypatch.setattr(
        model, "get_outputs", lambda bundle: seen.append((bundle, inner(bundle))) or seen[-1][1]
    )
    _, losses = step(model, train, batch)
    (photographs, _), (nothing, drawn) = seen
    assert len(photographs) == 200 and len(nothing) == 50
    hook, frame = model.collider.hook, model.collider.frame
    world = frame.points_to_world(nothing.origins), frame.directions_to_world(nothing.directions)
    assert not cast(hook.hull, *world).hit.any()
    # Between nerfacto's own bounds, which reach behind the hull.
    assert torch.equal(nothing.nears, torch.full((50, 1), 0.05)) and (nothing.fars > 100).all()
    by_hand = 0.5 * -(1 - drawn["accumulation"].detach().double()).log().mean()
    assert losses["empty_loss"].item() == pytest.approx(by_hand.item(), rel=1e-3)
    losses["empty_loss"].backward()
    assert any(p.grad is not None and bool(p.grad.any()) for p in model.field.parameters())
    seen.clear()
    model.eval()(pixel_rays(train)[:10])
    assert len(seen) == 1


def test_another_data_parser_is_told(train, capsys):
    with pytest.raises(SystemExit) as stop:
        build(fields.NerfactoVdConfig(**TINY), train, masks=False)
    assert stop.value.code == 2 and "ns-train nerfacto-vd visdom" in capsys.readouterr().err


def test_instant_ngp_takes_the_colliders_bounds(train):
    config = fields.InstantNgpVdConfig(
        hull=HULL, grid_resolution=8, grid_levels=1, log2_hashmap_size=10, max_res=64
    )
    model = build(config, train).train()
    seen = {}

    def sampling(**given):
        seen.update(given)
        n = len(given["rays_o"])
        return torch.arange(n), given["t_min"], given["t_max"]

    model.occupancy_grid.sampling = sampling
    bundle = model.collider(pixel_rays(train))
    model.sampler(
        ray_bundle=bundle,
        render_step_size=0.01,
        near_plane=0.05,
        far_plane=1e3,
        alpha_thre=0.0,
        cone_angle=0.0,
    )
    assert torch.equal(seen["t_min"], bundle.nears[:, 0]) and torch.equal(seen["t_max"], bundle.fars[:, 0])
    assert (seen["t_max"] < 100).any()
