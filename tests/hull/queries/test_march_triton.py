"""The Triton march finds what its twin in torch finds, on the GPU or else in Triton's interpreter."""

import importlib.util
import os
import subprocess
import sys

import pytest
import torch

PROGRAM = """
import torch
from visdom_plugin.hull.queries.bricks import build_bricks
from visdom_plugin.hull.queries.raycast import march_with_torch
from visdom_plugin.hull.queries.march_triton import march

device = "cuda" if torch.cuda.is_available() else "cpu"
draw = torch.Generator().manual_seed(3)
for shape, share in (((21, 9, 14), 0.02), ((8, 8, 8), 0.3), ((5, 30, 7), 0.0)):
    occupancy = torch.rand(shape, generator=draw) < share
    distance = torch.from_numpy(build_bricks(occupancy.numpy()).ahead.min(0))
    size = torch.tensor(shape, dtype=torch.float64)
    count = 300
    target = torch.rand(count, 3, dtype=torch.float64, generator=draw) * size
    d = torch.randn(count, 3, dtype=torch.float64, generator=draw)
    d[:60, 0] = 0  # Rays along planes, which never leave by them.
    d[30:60, 1] = 0
    o = target - 40 * d
    planes = torch.stack([-o / d, (size - o) / d]).nan_to_num(posinf=1e9, neginf=-1e9)
    begin = torch.where(d == 0, -1e9, planes.amin(0)).amax(-1).clamp_min(0)
    end = torch.where(d == 0, 1e9, planes.amax(0)).amin(-1)
    alive = (begin < end) & (torch.arange(count) % 7 > 0)
    rays = [x.to(device) for x in (o, d, begin, end, alive, occupancy, distance)]
    one, other = march(*rays).cpu(), march_with_torch(*rays).cpu()
    assert ((one >= 0) == (other >= 0)).all(), (shape, ((one >= 0) != (other >= 0)).sum())
    assert torch.allclose(one, other, rtol=1e-12, atol=1e-9), (one - other).abs().max()
    assert (one[~alive] == -1).all()
    assert share == 0 or (one >= 0).sum() > 50
assert len(march(*[x[:0].to(device) for x in (o, d, begin, end, alive)], *rays[5:])) == 0
print("agrees")
"""


@pytest.mark.skipif(not importlib.util.find_spec("triton"), reason="triton is not installed")
def test_the_triton_march_agrees_with_its_twin():
    environment = os.environ | ({} if torch.cuda.is_available() else {"TRITON_INTERPRET": "1"})
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "agrees"
