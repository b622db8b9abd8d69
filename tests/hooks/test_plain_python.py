"""The public API inside a stranger's program: arrays, precisions, compilers, workers, copies, imports."""

import copy
import multiprocessing
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from visdom_plugin import Cameras, Render, VisDomGaussianRegularizer, VisDomSampler, VisibleDomain
from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.hooks.regularizer import outside_loss

from .test_regularizer import SIZE, capture

HALVES = [torch.float16, torch.bfloat16]
HEAVY = ("cv2", "scipy", "trimesh", "skimage", "tyro", "rich", "yaml", "gsplat", "nerfacc", "nerfstudio")


@pytest.fixture(scope="module")
def ball():
    cameras, masks = capture()
    hull = VisibleDomain(k=3, resolution=64).carve(cameras, masks)
    rays = rays_of(
        cameras, torch.rand(len(cameras), 40, 2, generator=torch.Generator().manual_seed(0)) * SIZE
    )
    return cameras, hull, rays.origins.float(), rays.directions.float()


def test_numpy_and_torch_opencv_and_opengl_give_one_hull():
    cameras, masks = capture()
    motion, K = cameras.world_from_camera, cameras.intrinsics
    flip = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=motion.dtype))
    size = {"width": SIZE, "height": SIZE}
    same = [
        Cameras.from_matrices(K, motion, **size),
        Cameras.from_matrices(K.numpy(), motion.numpy(), **size, convention="opencv"),
        Cameras.from_matrices(K, motion @ flip, **size, convention="opengl"),
        Cameras.from_matrices(list(K), list((motion @ flip).numpy()[:, :3]), **size, convention="opengl"),
    ]
    as_arrays = np.stack([m.numpy() for m in masks]).astype(np.uint8)
    hulls = [
        VisibleDomain(k=3, resolution=32).carve(c, m)
        for c, m in zip(same, (masks, as_arrays, torch.stack(masks), list(as_arrays)), strict=True)
    ]
    assert all(hull == hulls[0] for hull in hulls[1:])
    with pytest.raises(Exception, match="opencv"):
        Cameras.from_matrices(K, motion, **size, convention="blender")


def test_arrays_bound_like_tensors(ball):
    _, hull, origins, directions = ball
    sampler = VisDomSampler(hull)
    wanted = sampler(origins.double(), directions.double(), 0.1, 9.0)
    got = sampler(origins.double().numpy(), directions.double().numpy(), np.float64(0.1), np.full(40, 9.0))
    assert all(torch.equal(a, b) for a, b in zip(wanted, got, strict=True))
    whole = sampler(np.array([0, 0, 0]), np.array([2, -1, 0]), 0, 9)
    assert whole.near.dtype == torch.float64 and bool(whole.hit)
    with pytest.raises(ConfigError, match="rays have"):
        sampler(origins, directions, torch.zeros(5, 40, 1), 9.0)


@pytest.mark.parametrize("dtype", [*HALVES, torch.float64])
def test_bounds_come_in_the_rays_precision_and_never_cut_into_the_band(ball, dtype):
    _, hull, origins, directions = ball
    origins, directions = origins.to(dtype), directions.to(dtype)
    sampler = VisDomSampler(hull)
    exact = sampler(origins.double(), directions.double(), 0.5, 6.0)
    got = sampler(origins, directions, 0.5, torch.tensor(6.0, dtype=dtype))
    assert got.near.dtype == got.far.dtype == dtype and got.hit.dtype == torch.bool
    assert (got.hit == exact.hit).float().mean() > 0.99 and 0.2 < exact.hit.float().mean() < 0.8
    near, far, slack = got.near.double(), got.far.double(), 4 * torch.finfo(dtype).eps
    both = got.hit & exact.hit
    assert (near <= exact.near + 1e-6)[both].all() and (far >= exact.far - 1e-6)[both].all()
    assert (near >= exact.near * (1 - slack) - 1e-6)[both].all()
    assert (far <= exact.far * (1 + slack) + 1e-6)[both].all()
    assert (near >= 0.5).all() and (far <= 6).all() and (near <= far).all()


def test_no_grad_and_autocast_change_nothing(ball):
    cameras, hull, origins, directions = ball
    sampler, hook = VisDomSampler(hull), VisDomGaussianRegularizer(hull, cameras)
    alpha = torch.rand(SIZE, SIZE, requires_grad=True)

    def both():
        loss = hook.loss(lambda camera: alpha, generator=torch.Generator().manual_seed(3))
        return *sampler(origins, directions, 0.0, 9.0), loss["visdom_outside"]

    wanted = both()
    with torch.no_grad():
        assert all(torch.equal(a, b) for a, b in zip(wanted, both(), strict=True))
    with torch.inference_mode():
        assert all(torch.equal(a, b) for a, b in zip(wanted, both(), strict=True))
    with torch.autocast("cpu", torch.bfloat16):
        assert all(torch.equal(a, b) for a, b in zip(wanted, both(), strict=True))


@pytest.mark.parametrize("dtype", HALVES)
def test_loss_of_half_precision_is_that_of_single(dtype):
    g = torch.Generator().manual_seed(0)
    alpha = (torch.rand(9, 9, generator=g) > 0.5).to(dtype).requires_grad_()
    mask = torch.rand(9, 9, generator=g) > 0.5
    loss = outside_loss(alpha, mask)
    loss.backward()
    assert torch.equal(loss, outside_loss(alpha.float(), mask)) and loss > 1
    assert torch.isfinite(alpha.grad).all() and alpha.grad.dtype == dtype


def test_loss_takes_what_rasterisers_return_and_names_what_does_not_fit(ball):
    cameras, hull, _, _ = ball
    wide = cameras.resized(SIZE, SIZE // 2)
    hook = VisDomGaussianRegularizer(hull, wide)
    alpha = torch.rand(SIZE // 2, SIZE, requires_grad=True)
    seen = []

    def value(shape):
        def render(camera):
            seen.append(camera)
            return alpha.reshape(shape)

        return hook.loss(render, generator=torch.Generator().manual_seed(0))["visdom_outside"]

    wanted = hook.loss(
        lambda camera: Render(torch.zeros(1), alpha, alpha), generator=torch.Generator().manual_seed(0)
    )["visdom_outside"]
    for shape in [(SIZE // 2, SIZE), (SIZE // 2, SIZE, 1), (1, SIZE // 2, SIZE, 1)]:
        assert torch.equal(value(shape), wanted)
    assert seen[0].intrinsics.dtype == wide.intrinsics.dtype
    with pytest.raises(ConfigError, match="rendered opacity"):
        value((SIZE, SIZE // 2))
    assert list(hook.loss(lambda camera: alpha)) == ["visdom_outside"]


def test_compiled_code_around_the_hooks(ball):
    cameras, hull, origins, directions = ball
    sampler = VisDomSampler(hull, drop_outside=True)
    hook = VisDomGaussianRegularizer(hull, cameras)

    def sample(origins, directions, far):
        near, far, hit = sampler(origins * 1.0, directions, 0.1, far)
        middle = (near + far) / 2
        kept = sampler.keep(origins + middle[..., None] * directions)
        return near * 2, middle, hit, kept

    for whole in (False, True):
        compiled = torch.compile(sample, backend="eager", fullgraph=whole)
        for far in (9.0, torch.full((5, 40), 9.0, requires_grad=True)):
            got, wanted = compiled(origins, directions, far), sample(origins, directions, far)
            assert all(torch.equal(a, b) for a, b in zip(got, wanted, strict=True))
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(compiled(origins, directions, 9.0)[2], wanted[2])

    def step(logit):
        def render(camera):
            return torch.sigmoid(logit).expand(SIZE, SIZE)

        return sum(hook.loss(render, 0, torch.Generator().manual_seed(1)).values()) * 2

    logits = [torch.zeros(SIZE, requires_grad=True) for _ in range(2)]
    values = [f(logit) for f, logit in zip((step, torch.compile(step, backend="eager")), logits, strict=True)]
    for value in values:
        value.backward()
    assert torch.equal(*values) and torch.equal(logits[0].grad, logits[1].grad) and logits[0].grad.any()


class RayData(Dataset):
    """What a trainer's loader does: bounds in the worker, where the rays are made."""

    def __init__(self, sampler, hook, origins, directions):
        self.sampler, self.hook, self.origins, self.directions = sampler, hook, origins, directions

    def __len__(self):
        return len(self.origins)

    def __getitem__(self, index):
        draw = torch.Generator().manual_seed(index)
        bounds = self.sampler(self.origins[index], self.directions[index], 0.1, 9.0)
        with torch.no_grad():
            loss = self.hook.loss(lambda camera: torch.full((SIZE, SIZE), 0.5), index, draw)
        return *bounds, self.hook.initial_points(7, draw)[0], loss["visdom_outside"]


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_of_a_loader_compute_what_the_program_does(ball, method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system has no {method}")
    cameras, hull, origins, directions = ball
    data = RayData(VisDomSampler(hull), VisDomGaussianRegularizer(hull, cameras), origins, directions)
    wanted = [data[i] for i in range(len(data))]
    loader = DataLoader(data, batch_size=None, num_workers=1, multiprocessing_context=method)
    for got, expected in zip(loader, wanted, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(got, expected, strict=True))


def test_copies_give_equal_results(ball):
    cameras, hull, origins, directions = ball
    sampler = VisDomSampler(hull, interval="first_hit", missing="skip", drop_outside=True)
    hook = VisDomGaussianRegularizer(hull, cameras, prune_every=1, bank=4)
    alpha = torch.rand(SIZE, SIZE, requires_grad=True)
    points = torch.randn(50, 3) + 1

    def results(sampler, hook):
        loss = hook.loss(lambda camera: alpha, 0, torch.Generator().manual_seed(5))["visdom_outside"]
        xyz, rgb = hook.initial_points(9, torch.Generator().manual_seed(6))
        gone = hook.after_step(type("Cloud", (), {"means": points}), 0)
        return *sampler(origins, directions, 0.0, 9.0), sampler.keep(points), loss, xyz, rgb, gone

    wanted = results(sampler, hook)
    for duplicate in (copy.deepcopy, copy.copy, lambda x: pickle.loads(pickle.dumps(x))):
        pair = duplicate(sampler), duplicate(hook)
        assert all(torch.equal(a, b) for a, b in zip(wanted, results(*pair), strict=True))
        compiled = torch.compile(lambda o, d, s=pair[0]: s(o, d, 0.0, 9.0), backend="eager", fullgraph=True)
        assert torch.equal(compiled(origins, directions).far, wanted[1])


def test_all_that_another_trainer_imports_loads_torch_numpy_and_numba_alone():
    # The names of the workflow read scenes and train, which takes the rest.
    program = f"""
import sys, torch, numpy, numba
before = {{name.split(".")[0] for name in sys.modules}}
heavy = set({HEAVY!r}) - before
import visdom_plugin
for name in visdom_plugin.__all__:
    if not visdom_plugin._HOME.get(name, "").startswith("visdom_plugin.workflow"):
        getattr(visdom_plugin, name)
new = {{name.split(".")[0] for name in sys.modules}} - before - set(sys.stdlib_module_names)
assert new == {{"visdom_plugin"}}, new
assert not heavy & set(sys.modules)
assert "torch._dynamo" not in sys.modules, "the compiler costs seconds"
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_the_three_lines_run_where_nothing_else_is_installed():
    program = f"""
import sys
for name in {HEAVY!r}:
    sys.modules[name] = None  # importing it raises ImportError
import numpy as np
import torch
from visdom_plugin import Cameras, VisDomGaussianRegularizer, VisDomSampler, VisibleDomain
motion = np.tile(np.eye(4), (4, 1, 1))
for i, (c, s) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):  # on a circle, looking inwards, z up
    motion[i, :3] = np.array([[-s, c, 0], [0, 0, -1], [-c, -s, 0], [3 * c, 3 * s, 0]]).T
K = np.array([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]])
cameras = Cameras.from_matrices(K, motion, width=32, height=32, convention="opencv")
masks = np.zeros((4, 32, 32), bool)
masks[:, 10:22, 10:22] = True
hull = VisibleDomain(k=3, resolution=32).carve(cameras, masks)
near, far, hit = VisDomSampler(hull)(np.array([3.0, 0, 0]), np.array([-1.0, 0, 0]), 0.0, 9.0)
assert bool(hit) and 0 < float(near) < float(far) < 9
hook = VisDomGaussianRegularizer(hull, cameras, prune_every=1)
assert hook.loss(lambda camera: torch.full((32, 32), 0.5, requires_grad=True))["visdom_outside"] > 0
assert hook.after_step(type("Cloud", (), {{"means": torch.zeros(1, 3)}}), 0).tolist() == [False]
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_cuda_everything_stays_on_cuda(ball):
    cameras, hull, origins, directions = ball
    sampler, wanted = VisDomSampler(hull), VisDomSampler(hull)(origins, directions, 0.1, 9.0)
    for dtype in (torch.float32, torch.float16):
        got = sampler(origins.cuda().to(dtype), directions.cuda().to(dtype), 0.1, 9.0)
        assert {x.device.type for x in got} == {"cuda"} and got.near.dtype == dtype
        assert (got.hit.cpu() == wanted.hit).float().mean() > 0.99
    hook = VisDomGaussianRegularizer(hull, cameras.to("cuda"))
    assert hook.initial_points(5)[0].device.type == "cuda"
    alpha = torch.rand(SIZE, SIZE, device="cuda", requires_grad=True)
    with torch.autocast("cuda", torch.float16):
        value = hook.loss(lambda camera: alpha if camera.width.is_cuda else None)["visdom_outside"]
    value.backward()
    assert value.device.type == "cuda" and alpha.grad.any()
