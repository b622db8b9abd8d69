"""Losses of rays in one operation against the same in plain torch."""

import pytest
import torch

from visdom_plugin.nerf.rendering.ray_losses import (
    Photographed,
    RayLosses,
    _ray_losses_torch,
    ray_losses,
)

DELTA = 0.1
N = 700


def _given(known: bool):
    draw = torch.Generator().manual_seed(0)
    rgb, seen, background = torch.rand(3, N, 3, generator=draw).unbind()
    rgb[: N // 3] = seen[: N // 3] + 0.1 * (rgb[: N // 3] - 0.5)  # within Huber's width, mostly
    alpha = torch.rand(N, generator=draw)
    alpha[:9] = torch.tensor([0, 1, 1e-7, 1 - 1e-7, 5e-4, 1 - 5e-4, 1.0000001, 1, 0])
    mask = (torch.rand(N, generator=draw) < 0.5).float()
    mask[:2] = torch.tensor([0.3, 1.0])
    which = torch.rand(N, generator=draw) < 0.7 if known else None
    return rgb, alpha, Photographed(seen, mask, which), background


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("clamp", [1e-6, 1e-3])
def test_losses_and_slopes_are_those_of_torch(known, clamp):
    found: list[list[torch.Tensor]] = []
    for run in (ray_losses, _ray_losses_torch):
        rgb, alpha, seen, background = _given(known)
        rgb, alpha = rgb.requires_grad_(), alpha.requires_grad_()
        losses = run(rgb, alpha, seen, background, DELTA, 0.3, clamp)
        (2 * losses.colour + 3 * losses.mask).backward()
        assert not losses.psnr.requires_grad
        found.append([*losses, rgb.grad, alpha.grad])
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=2e-6, atol=1e-9)


def test_no_error_is_100_db_and_no_known_mask_no_loss():
    rgb, alpha, seen, background = _given(False)
    seen = Photographed(rgb.clone(), torch.ones(N), torch.ones(N, dtype=torch.bool))
    assert float(ray_losses(rgb, alpha, seen, background, DELTA, 1.0).psnr) == pytest.approx(100)
    unknown = seen._replace(known=torch.zeros(N, dtype=torch.bool))
    losses: RayLosses = ray_losses(rgb, alpha.requires_grad_(), unknown, background, DELTA, 1.0)
    losses.mask.backward()
    assert float(losses.mask.detach()) == 0 and not alpha.grad.any()
