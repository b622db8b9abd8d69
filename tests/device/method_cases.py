"""Every method off the CPU: the same first steps, losses and pictures as on it, from other code."""

import sys
import types
from dataclasses import replace

import pytest
import torch

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.conformance import whole
from tests.device import second_device as second
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.nerf.encoding import hash_grid
from visdom_plugin.splat.cpu import backend
from visdom_plugin.splat.cpu.backend import _Blend, _Project
from visdom_plugin.training.batches import DataManager
from visdom_plugin.training.run import build, choose_batches

STEPS = 3
# Adam makes whole steps of gradients that are rounding alone, such as those of a bias before a normalisation.
SLOW = {
    "SmallZipNerf": {"lr": 1e-6, "lr_final": 1e-7},
    "SmallSplatFields": {"lr_field": 1e-6, "lr_field_final": 1e-7},
    "SmallZeroRf": {"lr": 1e-6},
}


def presets():
    for preset in whole.built_in():
        slow = replace(preset.quick, **SLOW.get(preset.name.split("+")[0], {}))
        yield pytest.param(replace(preset, quick=slow), id=preset.name)


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, sh_degree, backgrounds, **_
):  # fmt: skip
    """Stands in for gsplat's: the CPU's, with what goes in and comes out elsewhere."""
    motion = torch.linalg.inv(viewmats[0].cpu().double())
    camera = Cameras.from_matrices(Ks[0].cpu(), motion, width=width, height=height)
    parameters = (means, scales.log(), quats, opacities.logit(), colors)
    packed = backend.pack(camera, near_plane, "float32")
    means2d, splats, radii, _, tiles = _Project.apply(
        *(x.cpu() for x in parameters), sh_degree, packed, width, height
    )
    there = means2d.to(means.device)[None]
    rgb, alpha, depth = _Blend.apply(there[0].cpu(), splats, tiles, backgrounds[0].cpu(), width, height)
    image = torch.cat([rgb, depth[..., None]], -1)
    meta = {"means2d": there} | {
        name: x.to(means.device)[None]
        for name, x in {"radii": radii, "depths": splats[:, 7], "conics": splats[:, :3]}.items()
    }
    return image.to(means.device)[None], alpha[..., None].to(means.device)[None], meta


@pytest.fixture
def device(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))
    # Triton's kernels know CUDA alone.
    monkeypatch.setattr(
        hash_grid, "default_backend", lambda device: "cpu" if device.type == "cpu" else "torch"
    )
    with second.second_device() as device:
        yield device


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=40))


def start(preset, scene, device):
    method, _, _ = build(preset, preset.quick, scene.train, device=device, seed=0)
    return method, choose_batches(method, DataManager(scene.train, 0, device=device))


def walk(method, batch_of, steps):
    losses = []
    for step in steps:
        output = method.train_step(batch_of(step), step)
        output.total.backward()
        method.optimise(step, output)
        losses.append({name: float(value.detach()) for name, value in output.losses.items()})
    return losses


@pytest.mark.parametrize("preset", list(presets()))
def test_a_method_does_the_same_off_the_cpu(preset, device, scene, tmp_path):
    results = []
    for where in (torch.device("cpu"), device):
        method, batch_of = start(preset, scene, where)
        losses = walk(method, batch_of, range(STEPS))
        state = {key: value.cpu().clone() for key, value in method.state_dict().items()}
        again, batch_of = start(preset, scene, where)
        again.load_state_dict(state)
        losses += walk(again, batch_of, [STEPS])
        white = torch.ones(3, device=where)
        view = again.render(scene.test.cameras[0].to(where), white)
        assert view.rgb.device == where
        assert all(path.stat().st_size for path in again.export(tmp_path))
        results.append((losses, view.rgb.cpu(), view.alpha.cpu()))
    (here, *pictures), (there, *others) = results
    for a, b in zip(here, there, strict=True):
        assert a == pytest.approx(b, rel=1e-3, abs=1e-6)
    for a, b in zip(pictures, others, strict=True):
        torch.testing.assert_close(a, b, atol=5e-3, rtol=0)
