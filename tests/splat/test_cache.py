"""The process that compiles the kernels computes what every later process, loading them from the cache, does."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib, torch
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
render = rasterise(Gaussians(*tensors), camera, torch.ones(3))
loss = 1 - ssim(render.rgb, torch.rand(40, 48, 3, generator=g)) + render.alpha.mean() + render.depth.mean()
loss.backward()
digest = hashlib.sha256()
for t in [render.rgb.detach(), render.depth.detach(), loss.detach(), *(t.grad for t in tensors)]:
    digest.update(t.contiguous().numpy().tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_first_and_later_processes_agree_to_the_bit(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    digests = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    ]
    assert any(tmp_path.rglob("*.nbc")), "nothing was cached, so nothing was tested"
    assert digests[0] == digests[1]
