"""The CUDA paths give what the CPU gives."""

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks, ring
from tests.hull.carving.test_votes import random_case
from visdom_plugin.hull.carving.octree import block_carve
from visdom_plugin.hull.carving.votes import dense_carve, gather_silhouettes
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.queries.raycast import cast, depth_and_silhouette

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]


@pytest.mark.parametrize("seed", range(20))
def test_votes(seed):
    _, cameras, masks, grid, rule = random_case(seed)
    silhouettes = gather_silhouettes(cameras, masks)
    there = dense_carve(silhouettes, grid, rule, "cuda").cpu().numpy()
    assert np.array_equal(there, block_carve(silhouettes, grid, rule))


def test_carve_and_rays():
    cameras = ring(5)
    masks = ball_masks(cameras, [((0.1, 0, 0), 0.5)])
    domain = VisibleDomain(resolution=64)
    hull = domain.carve(cameras, masks)
    assert domain.carve(cameras.to("cuda"), [m.cuda() for m in masks]) == hull
    depth, mask = depth_and_silhouette(hull, cameras[0])
    depth_there, mask_there = depth_and_silhouette(hull, cameras[0].to("cuda"))
    assert mask_there.is_cuda and (mask_there.cpu() != mask).float().mean() < 1e-3
    same = mask & mask_there.cpu()
    assert (depth_there.cpu() - depth)[same].abs().max() < 0.5 * hull.voxel_size
    points = torch.randn(1000, 3)
    assert torch.equal(hull.contains(points.cuda()).cpu(), hull.contains(points))
    crossing = cast(hull, (points * 4).cuda(), -points.cuda())
    assert crossing.t_first.is_cuda and crossing.hit.any()
