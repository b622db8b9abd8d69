"""Losses on step functions against their definitions."""

import pytest
import torch

from visdom_plugin.nerf.rendering import proposal_losses
from visdom_plugin.nerf.rendering.volume import weights_from_density
from visdom_plugin.nerf.sampling.step_functions import resample_blurred

ANTIALIASED = {
    "kernel": proposal_losses.antialiased_interlevel_loss,
    "torch": lambda *arguments: proposal_losses._antialiased_torch(*arguments, eps=1e-5),
}


def _histograms(rays: int, count: int, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(rays, count + 1, generator=generator, dtype=torch.float64).sort(-1).values
    density = torch.randn(rays, count, generator=generator, dtype=torch.float64).mul(2).exp()
    return edges, weights_from_density(density, edges)[0]


@pytest.mark.parametrize("kind", ANTIALIASED)
def test_antialiased_loss_is_zero_for_an_upper_envelope_only(kind):
    loss = ANTIALIASED[kind]
    t, w = _histograms(20, 8)
    t_prop, _ = _histograms(20, 12, seed=1)
    blurred = resample_blurred(t, w, 0.03, t_prop)
    assert torch.equal(loss(t, w, t_prop, blurred + 1e-9, 0.03), torch.zeros(20).double())
    assert torch.equal(loss(t, w, t_prop, 5 * blurred + 0.1, 0.03), torch.zeros(20).double())
    covered = blurred.clone()
    largest = blurred.argmax(-1, keepdim=True)
    covered.scatter_(-1, largest, 0.9 * blurred.gather(-1, largest))
    assert (loss(t, w, t_prop, covered, 0.03) > 0).all()


def test_antialiased_loss_by_its_definition():
    t, w = _histograms(20, 8)
    t_prop, w_prop = _histograms(20, 12, seed=1)
    excess = (resample_blurred(t, w, 0.01, t_prop) - w_prop).clamp_min(0)
    expected = (excess**2 / (w_prop + 1e-5)).sum(-1)
    for loss in ANTIALIASED.values():
        torch.testing.assert_close(loss(t, w, t_prop, w_prop, 0.01), expected)


def test_antialiased_loss_changes_smoothly_as_the_proposal_slides():
    """What blurring is for: the sharp loss jumps where a proposal edge passes a NeRF edge, this one does not."""
    t = torch.tensor([0.0, 0.5, 0.51, 1.0]).double()
    w = torch.tensor([0.0, 1.0, 0.0]).double()
    shift = torch.linspace(-0.05, 0.05, 2001).double()[:, None]
    t_prop = torch.tensor([0.3, 0.45, 0.55, 0.7]).double() + shift
    w_prop = torch.full((2001, 3), 0.1).double()
    smooth = proposal_losses.antialiased_interlevel_loss(t, w, t_prop, w_prop, 0.03)
    assert smooth.diff().abs().max() < 0.01 * smooth.max()


def test_distortion_is_the_mean_distance_of_two_points():
    t, w = _histograms(4, 6)
    fine = 60  # points per interval, at their middles
    step = t.diff(dim=-1)[..., None] / fine
    points = (t[:, :-1, None] + step * (torch.arange(fine) + 0.5)).flatten(1)
    mass = (w[..., None] / fine).expand(-1, -1, fine).flatten(1)
    double_integral = torch.einsum("ri,rj,rij->r", mass, mass, (points[:, :, None] - points[:, None]).abs())
    torch.testing.assert_close(proposal_losses.distortion_loss(t, w), double_integral, rtol=1e-3, atol=1e-6)


def test_distortion_equals_its_double_sum():
    t, w = _histograms(30, 32)
    middles = 0.5 * (t[:, 1:] + t[:, :-1])
    pairs = w[:, :, None] * w[:, None] * (middles[:, :, None] - middles[:, None]).abs()
    expected = pairs.sum((1, 2)) + (w**2 * t.diff(dim=-1)).sum(-1) / 3
    torch.testing.assert_close(proposal_losses.distortion_loss(t, w), expected)
    single = proposal_losses.distortion_loss((t + 100).float(), w.float())
    torch.testing.assert_close(single.double(), expected, rtol=0, atol=2e-5)


def test_distortion_scales_and_vanishes():
    t, w = _histograms(10, 6)
    loss = proposal_losses.distortion_loss(t, w)
    torch.testing.assert_close(proposal_losses.distortion_loss(5 * t - 3, 0.5 * w), 0.25 * 5 * loss)
    spike = torch.zeros(10, 6).double()
    spike[:, 3] = 1
    t[:, 4] = t[:, 3]
    torch.testing.assert_close(
        proposal_losses.distortion_loss(t, spike), torch.zeros(10).double(), atol=1e-15, rtol=0
    )


def test_distortion_is_the_same_on_other_devices_and_on_any_number_of_threads():
    t, w = _histograms(400, 20)
    slow = proposal_losses._Distortion.apply(t, w)
    torch.testing.assert_close(proposal_losses.distortion_loss(t, w), slow)
    results, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(proposal_losses.distortion_loss(t.float(), w.float()))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*results)


@pytest.mark.parametrize("name", ["antialiased", "distortion", "distortion elsewhere"])
def test_gradients_equal_finite_differences(name):
    t, w = _histograms(5, 6)
    t_prop, w_prop = _histograms(5, 7, seed=1)
    loss = {
        "antialiased": lambda x: proposal_losses.antialiased_interlevel_loss(t, w, t_prop, x, 0.02, eps=1e-2),
        "distortion": lambda x: proposal_losses.distortion_loss(t_prop, x),
        "distortion elsewhere": lambda x: proposal_losses._Distortion.apply(t_prop, x),
    }[name]
    assert torch.autograd.gradcheck(loss, [w_prop.requires_grad_()])


def test_the_nerf_learns_nothing_from_the_proposals():
    t, w = _histograms(5, 6)
    t_prop, w_prop = _histograms(5, 7, seed=1)
    w.requires_grad_()
    assert not proposal_losses.antialiased_interlevel_loss(t, w, t_prop, w_prop, 0.02).requires_grad
