"""Kernels, hooks and losses on the device against the CPU: relative error of values and of gradients (norm of the
difference over the norm), each against a bound. A first training step of every method, and one after a
checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import project
import subjects
import torch
from bench import Bench, Case, Disagrees, relative
from torch import Tensor

FLOAT32 = 1e-4
"""Bound for sums of float32 in another order."""


def cases(bench: Bench) -> list[Case]:
    found = [
        Case("votes", votes),
        Case("hull from data on the device", carve),
        Case("rays, float32", lambda b: crossings(b, torch.float32)),
        Case("rays, float64", lambda b: crossings(b, torch.float64)),
        Case("silhouette and depth", silhouette),
        Case("sampler bounds", bounds),
        Case("points inside", inside),
        Case("samples by occupancy", occupancy),
        Case("packed rendering", packed),
    ]
    found += [Case(f"loss: {name}", _loss_case(name)) for name in LOSSES]
    for name, layout, count in _layouts(bench):
        found.append(Case(f"hash grid, {name}", _grid_case(layout, count), 60))
    found += [Case(f"ray space: {name}", _step_piece(name)) for name in STEP_PIECES]
    for count, size in ((300, 61), (bench.size(20_000, 500), bench.size(200, 40))):
        found.append(Case(f"rasteriser, {count}", _raster_case(count, size), 60, ("gsplat",)))
    for name in subjects.METHODS:
        needs = () if name in ("ingp", "zipnerf-lite", "zerorf-lite") else ("gsplat",)
        found.append(Case(f"first step of {name}+vd", _first_step(f"{name}+vd"), 60, needs))
        found.append(Case(f"{name}+vd after a checkpoint", _resumed(f"{name}+vd"), 60, needs))
    return bench.choose(found)


def judge(values: dict, **errors: tuple[float, float]) -> dict:
    """The values with each error beside them; `Disagrees` where one is above its bound."""
    values = values | {name: error for name, (error, _) in errors.items()}
    over = [
        f"{name} {error:.2e} above {bound:g}" for name, (error, bound) in errors.items() if not error <= bound
    ]
    if over:
        raise Disagrees(", ".join(over), values)
    return values


def votes(bench: Bench) -> dict:
    views = subjects.built_in(bench.size(200, 40)).train
    n = bench.size(128, 24)
    grid = project.Grid(torch.tensor([-1.1] * 3, dtype=torch.float64).numpy(), 2.2 / n, (n, n - 1, n + 1))
    silhouettes = project.gather_silhouettes(*views.silhouettes())
    here = project.count_votes(silhouettes, grid, "cpu")
    there = project.count_votes(silhouettes, grid, bench.device)
    wrong = sum(int((a != b.cpu()).sum()) for a, b in zip(here, there, strict=True))
    return judge({"of": int(here[0].numel())}, wrong=(wrong, 0))


def carve(bench: Bench) -> dict:
    cameras, masks, _ = subjects.built_in(bench.size(200, 40)).train.silhouettes()
    domain = project.VisibleDomain(resolution=bench.size(128, 24))
    here = domain.carve(cameras, masks)
    there = domain.carve(cameras.to(bench.device), [torch.as_tensor(m).to(bench.device) for m in masks])
    wrong = float((here.occupancy != there.occupancy).sum())
    return judge({"of": here.occupancy.size}, wrong=(wrong, 0))


def crossings(bench: Bench, dtype: torch.dtype) -> dict:
    hull = subjects.hull_of_built_in(bench.size(256, 32))
    origins, directions = subjects.rays(subjects.built_in(100), bench.size(200_000, 500), dtype=dtype)
    here = project.cast(hull, origins, directions)
    there = project.cast(hull, origins.to(bench.device), directions.to(bench.device))
    flips = float((here.hit != there.hit.cpu()).double().mean())
    both = here.hit & there.hit.cpu()
    # A ray that grazes a corner may meet the next voxel; that is counted, not averaged.
    off = (
        torch.maximum((here.t_first - there.t_first.cpu()).abs(), (here.t_last - there.t_last.cpu()).abs())[
            both
        ]
        / hull.voxel_size
    )
    values = {"of": len(here.hit), "hit": float(here.hit.double().mean())}
    return judge(values, wrong=(flips, 1e-4), far=(float((off > 0.01).double().mean()), 1e-4))


def silhouette(bench: Bench) -> dict:
    hull = subjects.hull_of_built_in(bench.size(256, 32))
    one = subjects.built_in(100).train.cameras[0].resized(*[bench.size(400, 40)] * 2)
    depth, mask = project.depth_and_silhouette(hull, one)
    depth_there, mask_there = (x.cpu() for x in project.depth_and_silhouette(hull, one.to(bench.device)))
    both = mask & mask_there
    far = float(((depth - depth_there).abs()[both] > 0.01 * hull.voxel_size).double().mean())
    flips = float((mask != mask_there).double().mean())
    return judge({"of": mask.numel()}, wrong=(flips, 1e-4), far=(far, 1e-3))


def bounds(bench: Bench) -> dict:
    hull = subjects.hull_of_built_in(bench.size(256, 32))
    origins, directions = subjects.rays(subjects.built_in(100), bench.size(100_000, 500))
    worst, flips = 0.0, 0.0
    for interval in ("first_hit", "entry_exit"):
        for missing in ("full", "skip"):
            sampler = project.VisDomSampler(hull, interval=interval, missing=missing)
            here = sampler(origins, directions, 0.05, 6.0)
            there = [
                x.cpu() for x in sampler(origins.to(bench.device), directions.to(bench.device), 0.05, 6.0)
            ]
            flips = max(flips, float((here.hit != there[2]).double().mean()))
            same = here.hit == there[2]
            for a, b in zip(here[:2], there[:2], strict=True):
                off = (a - b).abs()[same] > 0.01 * hull.voxel_size
                worst = max(worst, float(off.double().mean()))
    return judge({"of": len(origins)}, wrong=(flips, 1e-4), far=(worst, 1e-4))


def inside(bench: Bench) -> dict:
    hull = subjects.hull_of_built_in(bench.size(256, 32))
    draw = torch.Generator().manual_seed(0)
    points = torch.randn(bench.size(200_000, 500), 3, generator=draw) * 0.5
    wrong = 0
    for margin in (0.0, 2.0):
        here = hull.contains(points, margin_voxels=margin)
        wrong += int((here != hull.contains(points.to(bench.device), margin_voxels=margin).cpu()).sum())
    return judge({"of": len(points)}, wrong=(wrong, 0))


def occupancy(bench: Bench) -> dict:
    draw = torch.Generator().manual_seed(0)
    n = bench.size(4096, 64)
    origins = torch.nn.functional.normalize(torch.randn(n, 3, generator=draw), dim=-1)
    directions = torch.nn.functional.normalize(torch.rand(n, 3, generator=draw) - 0.5 - origins, dim=-1)
    shift, near = torch.rand(n, generator=draw), torch.full((n,), 0.05)
    found = []
    for device in ("cpu", bench.device):
        grid = project.OccupancyGrid(64, 1.0, 0.5, device=device)
        occupied = torch.rand(64, 64, 64, generator=torch.Generator().manual_seed(1)) < 0.3
        grid.occupied = occupied.to(device)
        arguments = [x.to(device) for x in (origins, directions, near, near + 1.9, near * 0.2, shift)]
        samples = project.march_occupied(*arguments, grid)
        found.append((samples.ray_offsets.diff().cpu(), samples.starts.cpu()))
    other = float((found[0][0] != found[1][0]).double().mean())
    return judge({"of": len(found[0][1])}, wrong=(other, 0.01))


def compare(
    bench: Bench,
    function: Callable,
    arguments: Sequence,
    places: Sequence[int],
    bound: float = FLOAT32,
    reference: torch.dtype | None = None,
) -> dict:
    """A function on the device against the CPU, values and gradients by some of its arguments.

    Args:
        places: which arguments get a gradient.
        reference: dtype of the CPU's arithmetic; by default the arguments' own.
    """
    results = []
    for device, dtype in (("cpu", reference), (bench.device, None)):
        given = [_moved(x, device, dtype) for x in arguments]
        for i in places:
            given[i] = given[i].clone().requires_grad_()
        out = function(*given)
        out = out if isinstance(out, tuple) else (out,)
        draw = torch.Generator().manual_seed(1)
        weights = [torch.randn(x.shape, generator=draw).to(x) for x in out]
        total = sum((x * w).sum() for x, w in zip(out, weights, strict=True) if x.requires_grad)
        slopes = torch.autograd.grad(total, [given[i] for i in places]) if places else ()
        results.append((out, slopes))
    (out, slopes), (out_there, slopes_there) = results
    value = max(relative(b, a) for a, b in zip(out, out_there, strict=True))
    errors = {"value": (value, bound)}
    if places:
        worst = max(relative(b, a) for a, b in zip(slopes, slopes_there, strict=True))
        errors["gradient"] = (worst, 10 * bound)
    return judge({"of": sum(x.numel() for x in out)}, **errors)


def _moved(x, device, dtype):
    if not isinstance(x, Tensor):
        return x
    return x.to(device, dtype) if dtype is not None and x.is_floating_point() else x.to(device)


def packed(bench: Bench) -> dict:
    draw = torch.Generator().manual_seed(0)
    n, m = bench.size(4096, 40), bench.size(200_000, 800)
    ray = torch.randint(n, (m,), generator=draw).sort().values
    starts = torch.rand(m, generator=draw).sort().values
    density, rgb = torch.rand(m, generator=draw) * 60, torch.rand(m, 3, generator=draw)
    offsets, background = project.offsets_of(ray, n), torch.rand(n, 3, generator=draw)
    arguments = (density, rgb, starts, starts + 0.01, offsets, background)
    return compare(bench, lambda *x: project.composite_packed(*x)[:3], arguments, (0, 1, 5))


def _pictures(bench: Bench) -> dict[str, Tensor]:
    """Smooth pictures with a flat ground, as renders have it."""
    n = bench.size(400, 40)
    draw = torch.Generator().manual_seed(0)
    small = torch.rand(1, 3, n // 8, n // 8, generator=draw)
    image = (
        torch.nn.functional.interpolate(small, size=(n, n), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)
    )
    mask = (image.mean(-1) > 0.5).float()
    target = torch.where(mask[..., None] > 0, image, 1.0)
    rgb = (target + 0.02 * torch.randn(n, n, 3, generator=draw)).clamp(0, 1)
    alpha = (0.9 * mask + 0.1 * torch.rand(n, n, generator=draw)).clamp(0, 1)
    return {"rgb": rgb, "target": target, "mask": mask, "alpha": alpha, "depth": 1 + image[..., 0]}


def _ssim(p):
    return project.ssim, (p["rgb"], p["target"]), (0,)


def _photometric(p):
    return lambda x, y: project.photometric_loss(x, y, 0.2), (p["rgb"], p["target"]), (0,)


def _photometric_ignored(p):
    weight = (p["depth"] > 1.3).float()
    return lambda x, y, w: project.photometric_loss(x, y, 0.2, w), (p["rgb"], p["target"], weight), (0,)


def _mask(p):
    return project.mask_loss, (p["alpha"], p["mask"]), (0,)


def _outside(p):
    return project.outside_loss, (p["alpha"], p["mask"] > 0), (0,)


def _disparity(p):
    depth, ones = p["depth"], torch.ones_like(p["depth"])
    return lambda d, m: project.disparity_loss(d, ones.to(d), m, ones.to(d)), (depth, depth.sqrt() + 1), (0,)


LOSSES = {
    "ssim": _ssim,
    "photometric": _photometric,
    "photometric, ignored pixels": _photometric_ignored,
    "mask": _mask,
    "outside": _outside,
    "disparity": _disparity,
}


def _loss_case(name: str):
    def run(bench: Bench) -> dict:
        function, arguments, places = LOSSES[name](_pictures(bench))
        # Against float64: TF32 in a convolution would show here.
        return compare(bench, function, arguments, places, reference=torch.float64)

    return run


def _layouts(bench: Bench) -> list[tuple[str, object, int]]:
    layout = project.HashLayout
    if bench.tiny:
        return [("small", layout(3, 2, base_resolution=4, max_resolution=40, log2_table_size=9), 100)]
    return [
        ("8 x 2, 2^16", layout(8, 2, base_resolution=16, max_resolution=256, log2_table_size=16), 20_000),
        ("6 x 1, 2^21", layout(6, 1, base_resolution=16, max_resolution=512, log2_table_size=21), 20_000),
        ("16 x 2, 2^19", layout(16, 2, base_resolution=16, max_resolution=2048, log2_table_size=19), 20_000),
        ("10 x 4, 2^21", layout(10, 4, base_resolution=16, max_resolution=8192, log2_table_size=21), 20_000),
        ("3 x 3, 2^9", layout(3, 3, base_resolution=5, max_resolution=60, log2_table_size=9), 1000),
    ]


def _grid_case(layout, count: int):
    def run(bench: Bench) -> dict:
        draw = torch.Generator().manual_seed(0)
        table = project.initial_table(layout, draw, 1.0)
        points = torch.rand(count, 6, 3, generator=draw) * 1.2 - 0.1
        scales = torch.rand(count, 6, generator=draw) * 0.02
        scales[0] = 0
        weights = torch.randn(count, layout.width, generator=draw)
        backends = {"cpu": ("cpu", None), "torch": (bench.device, "torch")}
        if bench.on_cuda:
            backends["triton"] = (bench.device, "triton")
        found = {}
        for name, (device, backend) in backends.items():
            mine = table.to(device).requires_grad_()
            x, s = points.to(device), scales.to(device)
            plain = project.encode(x[:, 0], mine, layout, backend)
            mean, strengths = project.encode_mean(x, s, mine, layout, backend)
            loss = ((plain + mean) * weights.to(device)).sum()
            found[name] = (plain, mean, strengths, *torch.autograd.grad(loss, mine))
        errors = {}
        for name in list(found)[1:]:
            both = [relative(a, b) for a, b in zip(found[name], found["cpu"], strict=True)]
            errors[f"{name} value"] = (max(both[:3]), FLOAT32)
            errors[f"{name} gradient"] = (both[3], FLOAT32)
        return judge({"of": count * 6}, **errors)

    return run


STEP_PIECES = (
    "dense",
    "sample",
    "antialiased",
    "distortion",
    "hexagons",
    "random hexagons",
    "contract",
    "harmonics",
)
"""Cases of tests/nerf/sampling/test_rays_gpu.py, whose errors stand here as numbers."""


def _step_piece(name: str):
    def run(bench: Bench) -> dict:
        from tests.nerf.sampling import test_rays_gpu as tests

        case = tests._cases()[name]
        here, there = (tests._evaluate(*case, device) for device in ("cpu", bench.device))
        worst = max(relative(b, a) for a, b in zip(here, there, strict=True))
        return judge({"of": sum(x.numel() for x in here)}, value=(worst, FLOAT32))

    return run


def _raster_case(count: int, size: int):
    def run(bench: Bench) -> dict:
        camera, background = subjects.camera(size, size - 7), torch.tensor([0.2, 0.5, 0.9])
        results = []
        for device in ("cpu", bench.device):
            one = subjects.gaussians(count).to(device)
            parameters = [p.requires_grad_() for p in one.tensors().values()]
            render = project.rasterise(one, camera.to(device), background, near=0.01)
            (render.rgb.square().sum() + render.alpha.sum() + render.depth.sum()).backward()
            slopes = [p.grad for p in parameters] + [render.info["means2d"].grad]
            results.append(((render.rgb, render.alpha, render.depth), slopes))
        value, gradient = (
            max(relative(b, a) for a, b in zip(here, there, strict=True))
            for here, there in zip(*results, strict=True)
        )
        # gsplat compiles its kernels with fast arithmetic.
        return judge({"of": count}, value=(value, 2e-3), gradient=(gradient, 1e-2))

    return run


def _first_step(name: str):
    def run(bench: Bench) -> dict:
        from visdom_plugin import seeding

        seeding.EVERYWHERE_ALIKE = True
        scene, found = subjects.built_in(bench.size(100, 40)), []
        changes = {"steps": 20}
        for device in (torch.device("cpu"), bench.device):
            method, batches, _ = subjects.start(bench, name, scene, device, **changes)
            output = method.train_step(batches(0), 0)
            output.total.backward()
            found.append({k: float(v.detach()) for k, v in output.losses.items()})
        errors = {f"loss {k}": (abs(found[1][k] - v) / max(abs(v), 1e-6), 5e-3) for k, v in found[0].items()}
        worst = max(errors.values())
        return judge({"of": len(errors)}, value=worst)

    return run


def _resumed(name: str):
    def run(bench: Bench) -> dict:
        scene = subjects.built_in(bench.size(100, 40))
        method, batches, _ = subjects.start(bench, name, scene, bench.device, steps=20)
        for step in range(3):
            subjects.step_once(method, batches, step)
        state = {k: v.detach().cpu().clone() for k, v in method.state_dict().items()}
        again, batches_again, _ = subjects.start(bench, name, scene, bench.device, steps=20)
        again.load_state_dict(state)
        losses = []
        for one, draw in ((method, batches), (again, batches_again)):
            for step in (3, 4):
                subjects.step_once(one, draw, step)
            losses.append(float(one.train_step(draw(5), 5).total.detach()))
        # Sums by atomic additions are not repeatable, so neither is the step after them.
        return judge({}, value=(abs(losses[1] - losses[0]) / abs(losses[0]), 1e-2))

    return run
