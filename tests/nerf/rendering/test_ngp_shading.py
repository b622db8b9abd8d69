"""Instant-NGP's field in one operation against the operations it is made of, bit for bit."""

import pytest
import torch

from visdom_plugin.nerf.activations import density_of, padded_sigmoid
from visdom_plugin.nerf.encoding.hash_grid import encode, initial_table
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.nerf.encoding.view_directions import encode_harmonics
from visdom_plugin.nerf.mlp import perceptron
from visdom_plugin.nerf.rendering.ngp_shading import NgpField, shade
from visdom_plugin.nerf.rendering.volume_packed import composite_packed
from visdom_plugin.nerf.sampling.occupancy_grid import PackedSamples, middles_of

LAYOUT = HashLayout(3, 2, base_resolution=4, max_resolution=32, log2_table_size=10)
HALF_SIDE, BIAS, VIEWS = 1.5, -0.5, 4


def _field() -> NgpField:
    draw = torch.Generator().manual_seed(0)
    table = torch.nn.Parameter(initial_table(LAYOUT, draw, 1.0))
    density_net = perceptron([LAYOUT.width, 16, 1 + 7], draw)
    colour_net = perceptron([VIEWS + 7, 16, 16, 3], draw)
    return NgpField(LAYOUT, table, density_net, colour_net, HALF_SIDE, BIAS)


def _rays(counts: list[int]):
    """Origins, directions, samples and background; ray r has counts[r] samples."""
    draw = torch.Generator().manual_seed(1)
    n, total = len(counts), sum(counts)
    origins = 0.1 * torch.randn(n, 3, generator=draw)
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=draw), dim=-1)
    of = torch.tensor(counts)
    ray = torch.arange(n).repeat_interleave(of)
    starts = torch.rand(total, generator=draw)
    samples = PackedSamples(torch.cat([of.new_zeros(1), of.cumsum(0)]), ray, starts, starts + 0.05)
    return origins, directions, samples, torch.rand(n, 3, generator=draw)


def _in_single_operations(field: NgpField, origins, directions, samples, background):
    unit = middles_of(origins, directions, samples) * (0.5 / HALF_SIDE) + 0.5
    density, out = density_of(field.density_net(encode(unit, field.table, LAYOUT)), BIAS)
    views = encode_harmonics(directions)[:, :VIEWS].index_select(0, samples.ray)
    colours = padded_sigmoid(field.colour_net(out, views, lead=1))
    intervals = samples.starts, samples.ends, samples.ray_offsets
    return composite_packed(density, colours, *intervals, background)[:3]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("counts", [[0, 0], [3, 0, 5], [40] * 70])
def test_values_and_gradients_are_those_of_the_single_operations(counts, threads):
    rays, found, before = _rays(counts), [], torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for run in (shade, _in_single_operations):
            field = _field()
            assert field.has_kernels()
            rgb, alpha, depth = run(field, *rays)
            (rgb.square().sum() + (2 * alpha + depth.square()).sum()).backward()
            parameters = field.table, *field.density_net.parameters(), *field.colour_net.parameters()
            found.append([rgb, alpha, depth, *(p.grad for p in parameters)])
    finally:
        torch.set_num_threads(before)
    assert all(map(torch.equal, *found))
    assert (sum(counts) > 0) == all(bool(g.any()) for g in found[0][3:])


def test_nets_too_wide_for_the_kernels_are_told_apart():
    field = _field()
    wide = perceptron([VIEWS + 7, 200, 3], torch.Generator().manual_seed(0))
    assert not field._replace(colour_net=wide).has_kernels()
