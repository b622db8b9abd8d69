"""Rendering, step functions and ray space on CUDA give what the CPU gives."""

import pytest
import torch

from visdom_plugin.nerf.encoding import view_directions
from visdom_plugin.nerf.rendering import proposal_losses, volume
from visdom_plugin.nerf.rendering.volume_packed import composite_packed, offsets_of
from visdom_plugin.nerf.sampling import contraction, multisampling, step_functions

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


def _render_packed(density, rgb, starts, ends, ray, background):
    return composite_packed(density, rgb, starts, ends, offsets_of(ray, len(background)), background)


def _render_dense(density, rgb, distances, background):
    return volume.composite(volume.weights_from_density(density, distances)[0], rgb, distances, background)


def _sorted(*shape):
    return torch.rand(*shape).sort(-1).values


def _cases():
    torch.manual_seed(0)
    edges, weights = _sorted(50, 17), torch.rand(50, 16) / 16
    other, proposed = _sorted(50, 25), torch.rand(50, 24) / 24
    ray = torch.randint(0, 40, (3000,)).sort().values
    starts = torch.arange(3000) * 0.01
    packed = (torch.rand(3000) * 30, torch.rand(3000, 3), starts, starts + 0.01, ray, torch.rand(40, 3))
    unit = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    points = torch.randn(500, 3) * 3
    hexagons = (torch.randn(50, 3), unit, edges, torch.rand(50) * 0.1)
    # name: function, arguments, places of the differentiable ones
    return {
        "packed": (_render_packed, packed, (0, 1)),
        "dense": (_render_dense, (weights * 90, torch.rand(50, 16, 3), edges, torch.rand(50, 3)), (0, 1)),
        "sample": (step_functions.sample_edges, (edges, weights, 20, torch.rand(50, 1)), ()),
        "antialiased": (
            proposal_losses.antialiased_interlevel_loss,
            (edges, weights, other, proposed, 0.03, 1e-2),
            (3,),
        ),
        "distortion": (proposal_losses.distortion_loss, (edges, weights), (1,)),
        "hexagons": (multisampling.multisample, hexagons, ()),
        "random hexagons": (multisampling.multisample, (*hexagons, torch.rand(50, 16)), ()),
        "contract": (contraction.contract, (points, torch.rand(500)), ()),
        "harmonics": (view_directions.encode_harmonics, (unit,), ()),
    }


def _evaluate(function, arguments, places, device):
    arguments = [x.to(device) if isinstance(x, torch.Tensor) else x for x in arguments]
    for i in places:
        arguments[i] = arguments[i].clone().requires_grad_()
    out = function(*arguments)
    out = out if isinstance(out, tuple) else (out,)
    slopes = ()
    if places:
        total = sum(x.sum() for x in out if x.requires_grad)
        slopes = torch.autograd.grad(total, [arguments[i] for i in places])
    return [x.detach().cpu() for x in (*out, *slopes)]


@pytest.mark.parametrize("name", _cases())
def test_both_devices_agree(name):
    case = _cases()[name]
    for there, here in zip(_evaluate(*case, "cuda"), _evaluate(*case, "cpu"), strict=True):
        torch.testing.assert_close(there, here, rtol=1e-4, atol=1e-5)
