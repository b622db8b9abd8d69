"""A set of Gaussians in a unit of its own: what it shows, and states from before it had one."""

import pytest
import torch

from tests.splat.twin import make_camera
from visdom_plugin.splat.model import GaussianSet
from visdom_plugin.splat.rasterise import NEAR, rasterise
from visdom_plugin.splat.set_config import GaussianSetConfig

CONFIG = GaussianSetConfig(sh_degree=1)


def set_of(unit: float, n: int = 40) -> GaussianSet:
    draw = torch.Generator().manual_seed(0)
    xyz, rgb = 0.3 * torch.randn(n, 3, generator=draw), torch.rand(n, 3, generator=draw)
    return GaussianSet(CONFIG, xyz, rgb, extent=3.0, device=torch.device("cpu"), unit=unit)


def pull(one: GaussianSet, steps: int) -> None:
    for i in range(steps):
        one.draw(make_camera(), torch.ones(3)).rgb.square().mean().backward()
        one.optimise(i)


@pytest.mark.parametrize("unit", [0.004, 7.0])
def test_what_is_drawn_does_not_depend_on_the_unit(unit):
    one, plain = set_of(unit), set_of(1.0)
    shown, wanted = (each.draw(make_camera(), torch.ones(3)) for each in (one, plain))
    for name in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(getattr(shown, name), getattr(wanted, name), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(one.means, plain.means)
    scene = rasterise(one.in_scene(), make_camera(), torch.ones(3), near=NEAR * unit)
    torch.testing.assert_close(scene.rgb, shown.rgb.detach(), rtol=1e-3, atol=1e-4)


def test_the_harmonics_behind_the_constant_learn_at_a_twentieth():
    one = set_of(1.0)
    before = one.gaussians().sh.detach().clone()
    one.gaussians().sh.square().sum().backward()
    one.optimiser.parameters["sh"].grad = torch.ones_like(before)
    one.optimiser.step()
    moved = one.gaussians().sh.detach() - before
    torch.testing.assert_close(moved[:, 0], torch.full_like(moved[:, 0], -CONFIG.lr_sh), rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(20 * moved[:, 1:], moved[:, :1].expand(-1, 3, 3), rtol=1e-3, atol=1e-6)


def test_a_state_in_scene_units_goes_on_as_it_would_have():
    plain, one = set_of(1.0), set_of(0.25)
    pull(plain, 4)
    old = {name: value.clone() for name, value in plain.state_dict().items() if name != "unit"}
    one.load_state_dict(old)
    torch.testing.assert_close(one.means, plain.means)
    pull(plain, 4)
    pull(one, 4)
    torch.testing.assert_close(one.in_scene().log_scales, plain.in_scene().log_scales, rtol=1e-3, atol=1e-3)
    # Its learning rate is a fraction of the extent, whatever that is counted in.
    torch.testing.assert_close(one.means, plain.means, rtol=1e-3, atol=1e-4)
