"""The companion in a trainer like gsplat's simple_trainer, on the CPU, beside both of gsplat's strategies."""

import copy
from functools import partial

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from visdom_plugin import Hull, VisDomGaussianRegularizer, VisibleDomain
from visdom_plugin.errors import CheckpointError, ConfigError
from visdom_plugin.integrations.gsplat import FADED_OPACITY, VisDomStrategy, draw_opacity, info_of
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise

SIZE, STEPS, N = 48, 40, 300
RATES = {"means": 1e-2, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 1e-2, "shN": 1e-3}


@pytest.fixture(scope="module")
def scene():
    views = make_scene(SyntheticConfig(size=SIZE, train_views=4, test_views=0)).train
    return views, VisibleDomain(k=3, resolution=64).carve(*views.silhouettes())


@pytest.fixture
def gsplat(monkeypatch):
    """The real gsplat, with torch twins of the two CUDA kernels that MCMCStrategy calls."""
    module = pytest.importorskip("gsplat", reason="gsplat is not installed")
    import gsplat.strategy.ops as ops
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", _quat_scale_to_covar_preci)
    monkeypatch.setattr(ops, "compute_relocation", relocation_twin)
    return module


def relocation_twin(opacities, scales, ratios, binoms):
    """Kheradmand et al. 2024, equation 9, term by term."""
    fresh, grown = opacities.clone(), scales.clone()
    for row, n in enumerate(ratios.clamp(1, len(binoms)).tolist()):
        fresh[row] = 1 - (1 - opacities[row]) ** (1 / n)
        total = sum(
            binoms[i - 1, k] * (-1) ** k / (k + 1) ** 0.5 * fresh[row] ** (k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        grown[row] = opacities[row] / total * scales[row]
    return fresh, grown


def draw(params, camera, background=None):
    gaussians = Gaussians(
        means=params["means"],
        log_scales=params["scales"],
        quaternions=params["quats"],
        opacity_logits=params["opacities"],
        sh=torch.cat([params["sh0"], params["shN"]], 1),
    )
    return rasterise(gaussians, camera, torch.ones(3) if background is None else background, near=0.01)


def initial(xyz):
    params = {
        "means": xyz,
        "scales": torch.full((len(xyz), 3), -2.5),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(len(xyz), 1),
        "opacities": torch.full((len(xyz),), 0.3).logit(),
        "sh0": torch.zeros(len(xyz), 1, 3),
        "shN": torch.zeros(len(xyz), 3, 3),
    }
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v.clone()) for k, v in params.items()})
    return params, {k: torch.optim.Adam([params[k]], lr=RATES[k], eps=1e-15) for k in params}


def in_a_box(hull):
    """gsplat's init_type="random": points all over a box around the object, most of them outside the hull."""
    low, high = torch.tensor(hull.bounds).float()
    return low + torch.rand(N, 3, generator=torch.Generator().manual_seed(0)) * (high - low)


class Trainer:
    """The order of gsplat's simple_trainer: render, pre, loss, backward, optimisers, post."""

    def __init__(self, gsplat, name, views, companion, xyz):
        self.views, self.companion, self.name = views, companion, name
        self.params, self.optimizers = initial(xyz)
        if name == "default":
            self.strategy = gsplat.DefaultStrategy(
                refine_start_iter=5, refine_every=8, grow_grad2d=1e-6, refine_scale2d_stop_iter=1000
            )
            self.state = self.strategy.initialize_state(scene_scale=1.0)
        else:
            self.strategy = gsplat.MCMCStrategy(
                cap_max=330, refine_start_iter=5, refine_every=8, noise_lr=100.0
            )
            self.state = self.strategy.initialize_state()
        self.strategy.check_sanity(self.params, self.optimizers)
        if companion is not None:
            self.state = companion.initialize_state(self.state)

    def run(self, begin, end):
        for step in range(begin, end):
            torch.manual_seed(step)  # gsplat draws from the global generator
            view = step % len(self.views)
            render = draw(self.params, self.views.cameras[view])
            info = info_of(render)
            arguments = (self.params, self.optimizers, self.state, step, info)
            self.strategy.step_pre_backward(*arguments)
            mask = self.views.masks[view][..., None]
            target = torch.where(mask, self.views.images[view].float() / 255, 1.0)
            loss = (render.rgb - target).abs().mean()
            if self.companion is not None:
                loss = loss + self.companion.step_pre_backward(*arguments)
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            rate = {"lr": RATES["means"]} if self.name == "mcmc" else {}
            self.strategy.step_post_backward(*arguments, **rate)
            if self.companion is not None:
                self.companion.step_post_backward(*arguments)
            self.check()
        return self

    def check(self):
        """What must hold between parameters, optimisers and running state after every step."""
        n = len(self.params["means"])
        for name, parameter in self.params.items():
            assert len(parameter) == n and parameter.requires_grad
            (group,) = self.optimizers[name].param_groups
            assert group["params"][0] is parameter and list(self.optimizers[name].state) == [parameter]
            moments = self.optimizers[name].state[parameter]
            assert moments["exp_avg"].shape == moments["exp_avg_sq"].shape == parameter.shape
        for key in ("grad2d", "count", "radii"):
            assert self.state.get(key) is None or self.state[key].shape == (n,)
        if self.name == "mcmc":
            assert self.state["binoms"].shape == (51, 51)

    def save(self):
        return copy.deepcopy(
            (
                {k: v.detach() for k, v in self.params.items()},
                {k: v.state_dict() for k, v in self.optimizers.items()},
                self.state,
                self.companion.state_dict(),
            )
        )

    def load(self, saved):
        params, optimizers, self.state, companion = copy.deepcopy(saved)
        self.params, self.optimizers = initial(params["means"])
        for name, value in params.items():
            self.params[name].data = value
            self.optimizers[name].load_state_dict(optimizers[name])
        self.companion.load_state_dict(companion)
        return self

    def outside(self, hull):
        """Opacity outside the hull as a share of all opacity."""
        opacity = self.params["opacities"].detach().sigmoid()
        return float(opacity[~hull.contains(self.params["means"], margin_voxels=2)].sum() / opacity.sum())


def companion_of(scene, **settings):
    views, hull = scene
    hook = VisDomGaussianRegularizer(
        hull, views.cameras, images=views.images, weight=settings.pop("weight", 0.3), prune_every=10, bank=16
    )
    return VisDomStrategy(hook, render=lambda params, camera: draw(params, camera).alpha, **settings)


@pytest.mark.parametrize("name", ["default", "mcmc"])
def test_less_opacity_outside_the_hull_with_the_companion(gsplat, scene, name):
    views, hull = scene
    make = partial(Trainer, gsplat, name, views)
    alone = make(None, in_a_box(hull))
    before = alone.outside(hull)
    without = alone.run(0, STEPS).outside(hull)
    ended = make(companion_of(scene), in_a_box(hull)).run(0, STEPS)
    loss_only = make(companion_of(scene, outside="keep", weight=1.0), in_a_box(hull)).run(0, STEPS)
    assert before > 0.7 and without > 0.2
    assert ended.outside(hull) < 0.1 * without and ended.companion.ended > 50
    assert loss_only.outside(hull) < 0.9 * without and loss_only.companion.ended == 0
    if name == "mcmc":  # dead ones were moved, none was lost
        assert len(ended.params["means"]) == len(alone.params["means"]) == 330


@pytest.mark.parametrize("name", ["default", "mcmc"])
@pytest.mark.parametrize("at", [10, 23])
def test_a_resumed_run_equals_an_uninterrupted_one(gsplat, scene, name, at):
    views, hull = scene
    start = in_a_box(hull)
    whole = Trainer(gsplat, name, views, companion_of(scene), start).run(0, 32)
    saved = Trainer(gsplat, name, views, companion_of(scene), start).run(0, at).save()
    resumed = Trainer(gsplat, name, views, companion_of(scene), start).load(saved).run(at, 32)
    for key, value in whole.params.items():
        assert torch.equal(value, resumed.params[key])
    assert whole.companion.ended == resumed.companion.ended > 0


def test_points_of_the_companion_lie_in_the_hull_and_none_is_ended(gsplat, scene):
    views, hull = scene
    companion = companion_of(scene)
    xyz, rgb = companion.initial_points(N)
    assert xyz.shape == rgb.shape == (N, 3) and hull.contains(xyz).all() and rgb.std() > 0.05
    trainer = Trainer(gsplat, "default", views, companion, xyz)
    assert companion.step_post_backward(trainer.params, trainer.optimizers, trainer.state, 0) == 0


def test_steps_without_loss_and_hulls_all_lie_outside_of(gsplat, scene, caplog):
    views, hull = scene
    companion = companion_of(scene, weight=0.0)
    trainer = Trainer(gsplat, "default", views, companion, in_a_box(hull) + 100)
    arguments = (trainer.params, trainer.optimizers, trainer.state)
    assert companion.step_pre_backward(*arguments, 0) == 0
    assert companion.step_post_backward(*arguments, 0) == 0 and len(trainer.params["means"]) == N
    assert "another frame" in caplog.text


def test_fading_keeps_what_is_inside_and_forgets_moments(gsplat, scene):
    views, hull = scene
    companion = companion_of(scene, outside="fade")
    trainer = Trainer(gsplat, "default", views, None, in_a_box(hull)).run(0, 5)
    out = ~hull.contains(trainer.params["means"], margin_voxels=2)
    before = trainer.params["opacities"].detach().clone()
    moments = trainer.optimizers["opacities"].state[trainer.params["opacities"]]
    kept = moments["exp_avg"][~out].clone()
    arguments = (trainer.params, trainer.optimizers, trainer.state)
    assert companion.step_post_backward(*arguments, 10) == int(out.sum()) > 0
    after = trainer.params["opacities"].detach()
    assert torch.equal(after[~out], before[~out]) and (after[out].sigmoid() < FADED_OPACITY + 1e-6).all()
    assert not moments["exp_avg"][out].any() and torch.equal(moments["exp_avg"][~out], kept) and kept.any()
    assert companion.step_post_backward(*arguments, 20) == 0


def test_another_hull_or_setting_is_refused(scene):
    views, hull = scene
    companion = companion_of(scene, seed=1)
    moved = Hull(hull.occupancy, hull.bounds + 0.1)
    for wrong in (companion_of(scene, seed=2), companion_of((views, moved), seed=1)):
        with pytest.raises(CheckpointError, match="seed"):
            companion.load_state_dict(wrong.state_dict())
    with pytest.raises(ConfigError, match="outside"):
        companion_of(scene, outside="drop")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_gsplats_own_rasteriser_draws_what_ours_does(scene):
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    views, hull = scene
    params, _ = initial(in_a_box(hull))
    ours = draw(params, views.cameras[0]).alpha.detach()
    theirs = draw_opacity({k: v.cuda() for k, v in params.items()}, views.cameras[0]).detach().cpu()
    assert (ours - theirs).abs().mean() < 1e-3
