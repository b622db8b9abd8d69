"""The hook itself: it answers, and does nothing else. For a method with settings `vd` of its own."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from visdom_plugin.conformance.report import require
from visdom_plugin.conformance.subject import difference, global_luck, scene, seed_all
from visdom_plugin.hooks.protocols import GaussianHook, SamplerHook
from visdom_plugin.render import Render
from visdom_plugin.training.batches import DataManager


def rays(dtype: torch.dtype = torch.float32) -> dict[str, torch.Tensor]:
    """Two rows of three rays: origins, directions, near, far."""
    batch = DataManager(scene().train, 0).pixel_batch(0, 6)
    origins, directions = (x.reshape(2, 3, 3).to(dtype) for x in (batch.origins, batch.directions))
    return {
        "origins": origins,
        "directions": directions,
        "near": torch.full((2, 3), 0.1, dtype=dtype),
        "far": torch.full((2, 3), 20.0, dtype=dtype),
    }


def ask(hook, handed: dict[str, torch.Tensor], gaussians, step: int = 0) -> dict[str, torch.Tensor]:
    """Everything a hook answers, by name."""
    if isinstance(hook, SamplerHook):
        return hook.bound(**handed)._asdict()

    def render(camera):
        alpha = torch.full((int(camera.height), int(camera.width)), 0.5, requires_grad=True)
        return Render(alpha[..., None].expand(-1, -1, 3), alpha, alpha)

    xyz, rgb = hook.initial_points(50, torch.Generator().manual_seed(3))
    marks = hook.after_step(gaussians, step)
    return {
        "xyz": xyz,
        "rgb": rgb,
        **{
            f"loss {k}": v.detach()
            for k, v in hook.loss(render, step, torch.Generator().manual_seed(4)).items()
        },
        "marks": torch.zeros(0) if marks is None else marks,
    }


@pytest.fixture
def hook(hooked):
    return hooked.make_hook()


@pytest.fixture
def promise(hooked):
    return SamplerHook.bound if hooked.hook == "sampler" else GaussianHook


@pytest.fixture
def gaussians():
    draw = torch.Generator().manual_seed(1)
    return SimpleNamespace(means=2 * torch.rand(40, 3, generator=draw) + torch.tensor([0.7, -1.9, -0.4]))


def test_the_hook_leaves_what_it_is_handed(hook, gaussians, promise):
    handed = rays()
    before = {k: v.clone() for k, v in (handed | {"means": gaussians.means}).items()}
    ask(hook, handed, gaussians)
    changed = difference(before, handed | {"means": gaussians.means})
    require(not changed, f"the hook changed what it was handed: {changed}", promise, "clone before changing")


def test_the_hook_answers_alike_twice(hook, gaussians, promise):
    first, again = ({k: v.clone() for k, v in ask(hook, rays(), gaussians).items()} for _ in range(2))
    changed = difference(first, again)
    require(
        not changed,
        f"asked the same again, the hook answers otherwise: {changed}",
        promise,
        "let the answer depend on the question alone; keep nothing from call to call but what can be made again",
    )


def test_the_hook_draws_no_global_random_numbers(hook, gaussians, promise):
    seed_all(9)
    before = global_luck()
    ask(hook, rays(), gaussians)
    require(
        global_luck() == before,
        "the hook draws from a global random generator, or seeds one",
        promise,
        "draw from the generator that is handed in; a bound needs none",
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_hook_keeps_dtype_shape_and_order(sampler, hook, dtype):
    handed = rays(dtype)
    near, far, hit = hook.bound(**handed)
    require(
        near.dtype == far.dtype == dtype and hit.dtype == torch.bool,
        f"for rays of {dtype}, near is {near.dtype}, far {far.dtype}, hit {hit.dtype}",
        SamplerHook.bound,
        "answer in the directions' dtype, with hit as bool",
    )
    require(
        near.shape == far.shape == hit.shape == (2, 3) and not (near.requires_grad or far.requires_grad),
        f"for rays (2, 3), near has shape {tuple(near.shape)}, far {tuple(far.shape)}, hit {tuple(hit.shape)}",
        SamplerHook.bound,
        "answer in the rays' leading shape, without gradient",
    )
    require(
        bool(((handed["near"] <= near) & (near <= far) & (far <= handed["far"])).all()),
        "the bounds do not lie within [near, far] as handed in, or near lies behind far",
        SamplerHook.bound,
        "cut them to what was handed in; a ray that is skipped has near = far",
    )
