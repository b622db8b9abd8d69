"""The process that compiles the kernels computes what every later process, loading them from the cache, does."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib, sys, torch
from numba.core.dispatcher import Dispatcher
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.ssim import ssim

g = torch.Generator().manual_seed(0)
draw = lambda *shape: torch.randn(*shape, generator=g)
camera = Cameras.from_matrices(
    torch.tensor([[40.0, 0, 24], [0, 40, 20], [0, 0, 1]]), torch.eye(4), width=48, height=40
)
tensors = [draw(300, 3) + torch.tensor([0.0, 0, 4]), draw(300, 3) - 2, draw(300, 4), draw(300), draw(300, 4, 3)]
tensors = [t.requires_grad_() for t in tensors]
render = rasterise(Gaussians(*tensors), camera, torch.ones(3), near=0.01)
loss = 1 - ssim(render.rgb, torch.rand(40, 48, 3, generator=g)) + render.alpha.mean() + render.depth.mean()
loss.backward()
digest = hashlib.sha256()
for t in [render.rgb.detach(), render.depth.detach(), loss.detach(), *(t.grad for t in tensors)]:
    digest.update(t.contiguous().numpy().tobytes())
modules = [module for name, module in sys.modules.items() if name.startswith("visdom_plugin.")]
kernels = {k for module in modules for k in vars(module).values() if isinstance(k, Dispatcher)}
print(digest.hexdigest(), sum(sum(k.stats.cache_misses.values()) for k in kernels))
"""


@pytest.mark.slow
def test_first_and_later_processes_agree_to_the_bit(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, check=True, capture_output=True, text=True
        ).stdout.split()
        for _ in range(2)
    ]
    (first, compiled), (second, compiled_again) = runs
    assert int(compiled) > 0, "nothing was compiled, so nothing was tested"
    assert compiled_again == "0"
    assert first == second
