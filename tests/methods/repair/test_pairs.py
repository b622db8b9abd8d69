"""Pairs of a corrupted render and a photograph: which views a run lacks, the noise, and what is shown when."""

from dataclasses import replace

import pytest
import torch

from tests.methods.short_runs import set_up
from visdom_plugin import seeding
from visdom_plugin.methods.repair.configs import GaussianObjectConfig, LoraConfig
from visdom_plugin.methods.repair.finetuning import FineTuning
from visdom_plugin.methods.repair.gaussian_object import GaussianObject
from visdom_plugin.methods.repair.leave_one_out import NOISED, RemovesUntil, add_noise
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import choose_batches


def test_a_run_lacks_its_view_until_it_returns_and_the_twin_for_good(scene, hull, small):
    method = set_up(GaussianObject, small, scene, hull, hooks=[])
    method.done = method.lengths[0]
    method.number = 1
    stage = method._begin()
    for view in range(4):
        seen = [stage.view_at(18 * view + i) for i in range(18)]
        assert view not in seen[:6] and view not in seen[12:]
        assert sorted(seen[:3]) == sorted(seen[3:6]) == sorted(seen[12:15]) == sorted({0, 1, 2, 3} - {view})
        assert sorted(seen[6:10]) == [0, 1, 2, 3]
    method.stage = stage
    batches = choose_batches(method, DataManager(scene.train, 0))
    assert [batches(12 + i).index for i in range(18)] == [stage.view_at(i) for i in range(18)]


def test_a_hook_removes_nothing_while_run_and_twin_are_compared():
    class Hook:
        def after_step(self, gaussians, step):
            return torch.ones(3, dtype=torch.bool)

    hook = RemovesUntil(Hook(), 6)
    assert hook.after_step(None, 5).all() and hook.after_step(None, 6) is None


@pytest.fixture
def gaussians():
    shapes = {
        "means": (5_000, 3),
        "log_scales": (5_000, 3),
        "quaternions": (5_000, 4),
        "opacity_logits": (5_000,),
    }
    return Gaussians(**{k: torch.zeros(v) for k, v in shapes.items()}, sh=torch.ones(5_000, 4, 3))


def noise_of(gaussians, mean, deviation):
    """What two views left, of means 0 and twice the mean."""
    kept = {}
    for name in NOISED:
        one = torch.ones(getattr(gaussians, name).shape[1:])
        for view, factor in ((0, 0.0), (1, 2.0)):
            kept[f"noise.{view}.{name}.mean"] = factor * mean * one
            kept[f"noise.{view}.{name}.std"] = factor * deviation * one
    return kept


@pytest.mark.parametrize("dropout", [0.0, 0.7, 1.0])
def test_noise_has_the_views_mean_statistics_and_spares_the_share_it_is_told(gaussians, dropout):
    config = GaussianObjectConfig(lora=LoraConfig(noise_dropout=(dropout, dropout), noise_scale=(0.25, 0.25)))
    found = add_noise(gaussians, noise_of(gaussians, 1.0, 2.0), config, seeding.generator(0, "noise"))
    assert torch.equal(found.sh, gaussians.sh)
    for name in NOISED:
        value = getattr(found, name)
        moved = value != 0
        assert float(moved.float().mean()) == pytest.approx(1 - dropout, abs=0.02)
        if dropout == 1:
            continue
        assert float(value[moved].mean()) == pytest.approx(1.0, abs=0.1)
        cut = value[moved].abs().max()
        # Positions have the whole of it, the others a quarter of a deviation to each side of the mean.
        assert (cut > 5) if name == "means" else (cut <= 1.5)


def test_noisy_renders_come_first_then_those_of_views_left_out(scene, hull, small, monkeypatch):
    from visdom_plugin.methods.repair import finetuning

    method = set_up(GaussianObject, small, scene, hull, hooks=[])
    stage = FineTuning.__new__(FineTuning)
    config = replace(small, lora=replace(small.lora, noise_steps=10, noise_decay=0.9))
    kept = {f"renders.{i}.0001": torch.full((64, 64, 3), 51, dtype=torch.uint8) for i in range(4)}
    stage.config, stage.coarse, stage.kept = config, method.coarse, kept
    monkeypatch.setattr(finetuning, "add_noise", lambda gaussians, *_: gaussians)
    batch = DataManager(scene.train, 0).view(1)

    def cached(step):
        hints = [stage.corrupted(batch, step, seeding.generator(i, "draw")) for i in range(200)]
        return sum(bool((hint == 0.2).all()) for hint in hints) / len(hints)

    assert cached(0) == cached(9) == 0
    assert cached(16) == pytest.approx(1 - 0.9**7, abs=0.1) and cached(200) == 1


def test_ignored_pixels_stay_as_rendered_and_unknown_masks_are_those_of_the_coarse_stage(scene, hull, small):
    method = set_up(GaussianObject, small, scene, hull, hooks=[])
    stage = FineTuning.__new__(FineTuning)
    stage.config, stage.coarse = small, method.coarse
    batch, hint = DataManager(scene.train, 0).view(0), torch.zeros(64, 64, 3)
    target = stage.photograph(batch, hint)
    assert bool((target[batch.mask == 0] == 1).all())
    on_object = batch.mask == 1
    assert torch.equal(target[on_object], batch.image[on_object])
    weight = torch.ones(64, 64)
    weight[:10] = 0
    spared = stage.photograph(replace(batch, weight=weight), hint)
    assert bool((spared[:10] == 0).all()) and torch.equal(spared[10:], target[10:])
    unknown = stage.photograph(replace(batch, mask_known=False, mask=torch.ones(64, 64)), hint)
    alpha = method.coarse.splats.draw(batch.camera, torch.ones(3)).alpha.detach()[..., None]
    assert torch.allclose(unknown, batch.image * alpha + 1 - alpha, atol=1e-6)
