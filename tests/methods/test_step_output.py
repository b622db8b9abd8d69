"""A step's output is all that passes from the forward pass to the optimiser and the log."""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from method_configs import corgs_lite, fsgs_lite, gs_go, ingp, splatfields_lite, zerorf_lite, zipnerf_lite
from tests.methods.short_runs import advance, copy_of, same, set_up
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.methods.fields.ingp import Ingp
from visdom_plugin.methods.fields.zerorf_lite import ZeroRfLite
from visdom_plugin.methods.fields.zipnerf_lite import ZipNerfLite
from visdom_plugin.methods.splats.corgs_lite import CorgsLite
from visdom_plugin.methods.splats.fsgs.method import FsgsLite
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.methods.splats.splatfields.method import SplatFieldsLite
from visdom_plugin.nerf.encoding.hash_layout import HashLayout
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import choose_batches

GRID = HashLayout(3, 1, base_resolution=8, max_resolution=32, log2_table_size=10)
SPLATS = {
    GsGo: replace(gs_go.SPEC.quick, steps=40, initial_points=300, depth_weight=0.0),
    CorgsLite: replace(corgs_lite.SPEC.quick, steps=40, initial_points=300),
    FsgsLite: replace(fsgs_lite.SPEC.quick, steps=40, initial_points=300),
    SplatFieldsLite: replace(
        splatfields_lite.SPEC.quick, steps=40, initial_points=300, noise_size=2, moran_weight=0.01
    ),
}
METHODS = SPLATS | {
    Ingp: replace(
        ingp.SPEC.quick, steps=40, max_rays=128, samples_per_step=1 << 10, grid=replace(GRID, features=2)
    ),
    ZeroRfLite: replace(zerorf_lite.SPEC.quick, steps=40, first_rays=64, noise_resolution=2, width=4),
    ZipNerfLite: replace(
        zipnerf_lite.SPEC.quick,
        steps=40,
        rays=64,
        coarse_grid=GRID,
        fine_grid=GRID,
        grid=replace(GRID, features=4),
    ),
}


class ReadNumbers(TorchDispatchMode):
    """Counts the floating-point tensors whose value is asked for, each of which makes the host wait for a GPU."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += func is torch.ops.aten._local_scalar_dense.default and args[0].is_floating_point()
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def scene():
    made = make_scene(SyntheticConfig(size=48))
    depths = tuple(1 + image.float().mean(-1) / 255 for image in made.train.images)
    return replace(made, train=replace(made.train, mono_depths=depths))


@pytest.fixture(scope="module")
def hull(scene):
    return VisibleDomain(resolution=32).carve(*scene.train.silhouettes())


@pytest.mark.parametrize("kind", METHODS, ids=lambda kind: kind.__name__)
def test_a_step_reads_no_number_and_gives_its_psnr_as_a_tensor(kind, scene, hull):
    method = set_up(kind, METHODS[kind], scene, hull, hooks=[])
    advance(method, scene, range(2))
    batches = choose_batches(method, DataManager(scene.train, 0))
    batch = batches(2)
    with ReadNumbers() as read:
        output = method.train_step(batch, 2)
    assert read.count == 0
    psnr = output.metrics["psnr"]
    assert psnr.shape == () and not psnr.requires_grad and 0 < float(psnr) < 60
    assert float(output.total.detach()) == pytest.approx(
        sum(float(v.detach()) for v in output.losses.values())
    )


@pytest.mark.parametrize("kind", SPLATS, ids=lambda kind: kind.__name__)
def test_the_optimiser_looks_at_the_output_it_is_handed_and_at_no_other_step(kind, scene, hull):
    """Between a step's forward pass and its optimiser another view is drawn, whose gradients are dropped."""
    states = []
    for distracted in (False, True):
        method = set_up(kind, METHODS[kind], scene, hull, hooks=[])
        data = DataManager(scene.train, 0)
        output = method.train_step(data.view(0), 0)
        if distracted:
            method.train_step(data.view(1), 0)
        output.total.backward()
        method.optimise(0, output)
        states.append(copy_of(method))
    assert same(*states)
