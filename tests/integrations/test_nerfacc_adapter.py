"""nerfacc's estimators with the hull: cells that stay closed, limits per ray."""

import inspect
from importlib.metadata import version
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from visdom_plugin import Hull, VisDomSampler
from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.integrations.nerfacc import confine, ray_limits, ray_planes

BOX, RESOLUTION, LEVELS = [-1.0, -1.2, -1.0, 1.0, 1.2, 1.0], [10, 12, 8], 2


@pytest.fixture(scope="module")
def hull():
    """Two blobs, off the estimator's grid, one of them partly outside its first level."""
    n = 30
    axis = (np.arange(n) + 0.5) / n * 3.1 - 1.55
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    grid = (x - 0.2) ** 2 + y**2 + (z + 0.1) ** 2 < 0.15
    grid |= (x + 1.1) ** 2 + (y - 0.8) ** 2 + z**2 < 0.05
    return Hull.from_grid(grid, [[-1.55] * 3, [1.55] * 3])


@pytest.fixture
def nerfacc():
    return pytest.importorskip("nerfacc", reason="nerfacc is not installed")


def estimator_like():
    """What `confine` reads and writes of nerfacc's estimator."""
    box = torch.tensor(BOX)
    centre, half = (box[:3] + box[3:]) / 2, (box[3:] - box[:3]) / 2
    cells = LEVELS * int(np.prod(RESOLUTION))
    return SimpleNamespace(
        aabbs=torch.stack([torch.cat([centre - half * 2**i, centre + half * 2**i]) for i in range(LEVELS)]),
        resolution=torch.tensor(RESOLUTION, dtype=torch.int32),
        occs=torch.zeros(cells),
        binaries=torch.ones([LEVELS, *RESOLUTION], dtype=torch.bool),
    )


def reached_twin(estimator, hull, margin):
    """(levels, X, Y, Z) bool: whether a voxel overlaps the cell, one voxel after the other."""
    reached = np.zeros(estimator.binaries.shape, bool)
    voxels = hull.bounds[0] + np.argwhere(hull.occupancy) * hull.voxel_edges
    for level, *cell in np.ndindex(*reached.shape):
        box = estimator.aabbs[level].double().numpy()
        size = (box[3:] - box[:3]) / RESOLUTION
        low = box[:3] + cell * size - margin
        high = box[:3] + (np.array(cell) + 1) * size + margin
        reached[(level, *cell)] = (
            ((voxels < high - 1e-9) & (voxels + hull.voxel_edges > low + 1e-9)).all(1).any()
        )
    return reached


@pytest.mark.parametrize("margin", [0.0, 0.13])
def test_cells_that_stay_open_are_those_the_hull_reaches(hull, margin):
    estimator = estimator_like()
    wanted = reached_twin(estimator, hull, margin)
    assert confine(estimator, hull, margin=margin) == wanted.sum() and 0.02 < wanted.mean() < 0.5
    assert np.array_equal(estimator.binaries.numpy(), wanted)
    assert np.array_equal(estimator.occs.numpy() >= 0, wanted.flatten())
    points = hull.sample_inside(2000, torch.Generator().manual_seed(0)).numpy()
    box = estimator.aabbs[1].double().numpy()
    index = np.floor((points - box[:3]) / (box[3:] - box[:3]) * RESOLUTION).astype(int)
    assert wanted[1][tuple(index.T)].all()


def test_a_hull_that_reaches_no_cell_is_refused_and_nothing_closed(hull):
    estimator = estimator_like()
    with pytest.raises(ConfigError, match="reaches no cell"):
        confine(estimator, Hull.from_grid(hull.occupancy, hull.bounds + 1000), margin=0.1)
    assert estimator.binaries.all() and not estimator.occs.any()


def test_cells_outside_never_revive(nerfacc, hull):
    torch.manual_seed(0)
    estimator = nerfacc.OccGridEstimator(BOX, RESOLUTION, LEVELS)
    if version("nerfacc") == "0.5.2":
        with pytest.raises(PluginError, match="open closed cells again"):
            confine(estimator, hull)
        return
    assert torch.equal(estimator.aabbs, estimator_like().aabbs)
    open_cells = confine(estimator, hull)
    closed = estimator.occs < 0
    seen = []

    def dense_everywhere(x):
        seen.append(x)
        return torch.ones(len(x), 1)

    for step in range(0, 400):
        estimator.update_every_n_steps(step, dense_everywhere, occ_thre=1e-2, warmup_steps=200, n=10)
    assert torch.equal(estimator.occs < 0, closed)
    assert not estimator.binaries.flatten()[closed].any()
    assert estimator.binaries.sum() > 0.3 * open_cells
    assert sum(len(x) for x in seen[:LEVELS]) == open_cells
    # The mark survives a checkpoint and a device move.
    fresh = nerfacc.OccGridEstimator(BOX, RESOLUTION, LEVELS)
    fresh.load_state_dict(estimator.state_dict())
    fresh.update_every_n_steps(0, dense_everywhere)
    assert torch.equal(fresh.occs < 0, closed) and not fresh.binaries.flatten()[closed].any()
    # Without the hull every cell would have come to life.
    free = nerfacc.OccGridEstimator(BOX, RESOLUTION, LEVELS)
    free.update_every_n_steps(0, lambda x: torch.rand(len(x), 1))
    assert free.binaries.flatten()[closed].any()


def rays(n=64):
    g = torch.Generator().manual_seed(0)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=-1) * 4
    return origins, torch.nn.functional.normalize(0.5 * torch.randn(n, 3, generator=g) - origins, dim=-1)


def test_limits_are_the_samplers_and_nerfacc_takes_them(nerfacc, hull):
    sampler, (origins, directions) = VisDomSampler(hull), rays()
    near, far, hit = sampler(origins, directions, 0.2, 7.0)
    limits = ray_limits(sampler, origins, directions, 0.2, 7.0)
    assert torch.equal(limits["t_min"], near) and torch.equal(limits["t_max"], far) and hit.any()
    assert set(limits) <= set(inspect.signature(nerfacc.OccGridEstimator.sampling).parameters)
    planes = ray_planes(sampler, origins, directions, 0.2, 7.0)
    assert set(planes) <= set(inspect.signature(nerfacc.PropNetEstimator.sampling).parameters)
    from nerfacc.estimators.prop_net import _transform_stot

    s = torch.linspace(0, 1, 9).expand(len(near), 9)
    for kind in ("uniform", "lindisp"):
        t = _transform_stot(kind, s, planes["near_plane"], planes["far_plane"])
        assert (
            t.shape == s.shape and torch.allclose(t[:, 0], near) and torch.allclose(t[:, -1], far, rtol=1e-4)
        )
        assert (t.diff(dim=-1) > 0).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_samples_on_cuda_lie_within_the_limits_and_open_cells(nerfacc, hull):
    estimator = nerfacc.OccGridEstimator(BOX, RESOLUTION, LEVELS).cuda()
    confine(estimator, hull)
    estimator.update_every_n_steps(0, lambda x: torch.rand(len(x), 1, device="cuda"))
    sampler, (origins, directions) = VisDomSampler(hull, missing="skip"), (x.cuda() for x in rays())
    near, far, hit = sampler(origins, directions, 0.2, 7.0)
    limits = ray_limits(sampler, origins, directions, 0.2, 7.0)
    index, begin, end = estimator.sampling(origins, directions, render_step_size=0.02, **limits)
    assert len(index) > 0 and hit[index].all()
    assert (begin >= near[index] - 1e-4).all() and (end <= far[index] + 1e-4 + 0.02).all()
