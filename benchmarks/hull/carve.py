"""Speed and memory of the hull: block carve against the dense torch votes, and its growth with resolution.

    python benchmarks/hull/carve.py [--resolutions 128 256 512 1024] [--repeats 5] [--masks consistent]

Nine views of 800 x 800 of an object with a hole, by default its silhouettes as cast from a solid; `--masks
made-up` has masks that no object has. The reference is measured in the same run. Each resolution is carved in a
process of its own, so that its peak memory is its own. Times are the least of several runs.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time

import numpy as np
import torch

from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, project
from visdom_plugin.hull.carving.keep_rule import KeepRule, as_fraction
from visdom_plugin.hull.carving.octree import block_carve
from visdom_plugin.hull.carving.votes import Grid, dense_carve, gather_silhouettes
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import depth_and_silhouette

VIEWS, SIZE = 9, 800


def cameras_around() -> Cameras:
    """Nine cameras on a wavy ring."""
    angle = torch.arange(VIEWS, dtype=torch.float64) * 2 * math.pi / VIEWS
    centres = 4 * torch.stack([angle.cos(), angle.sin(), 0.4 + 0.3 * (3 * angle).sin()], -1)
    motion = look_at_camera(centres, torch.zeros(VIEWS, 3).double(), torch.tensor([0.0, 0, 1]).double())
    intrinsics = torch.tensor([[1000.0, 0, SIZE / 2], [0, 1000, SIZE / 2], [0, 0, 1]]).double()
    return Cameras.from_matrices(intrinsics.expand(VIEWS, 3, 3), motion, width=SIZE, height=SIZE)


def capture() -> tuple[Cameras, list[torch.Tensor]]:
    """Cameras and the silhouettes of a thick ring with three arms, cast through its voxels."""
    axis = (torch.arange(256) + 0.5) / 128 - 1
    x, y, z = 1.2 * axis[:, None, None], 1.2 * axis[None, :, None], 1.2 * axis
    ring = ((x * x + y * y).sqrt() - 0.5).square() + z * z < 0.3**2
    for turn in (0, 1, 2):
        cos, sin = math.cos(2 * math.pi / 3 * turn), math.sin(2 * math.pi / 3 * turn)
        along, across = (x * cos + y * sin).clamp(0.5, 1.0), y * cos - x * sin
        ring = ring | ((x * cos + y * sin - along).square() + across * across + z * z < 0.18**2)
    solid = Hull(ring.numpy(), np.array([[-1.2] * 3, [1.2] * 3]), {})
    cameras = cameras_around()
    return cameras, [depth_and_silhouette(solid, camera)[1] for camera in cameras]


def made_up() -> tuple[Cameras, list[torch.Tensor]]:
    """The same cameras, all with one mask: no object has these silhouettes, so a carve also looks for causes."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    far = np.hypot(x, y)
    arms = np.cos(3 * np.arctan2(y, x)) > 0.8
    mask = (far < 190) & (far > 45) | arms & (far < 260)
    return cameras_around(), [torch.from_numpy(mask)] * VIEWS


CAPTURES = {"consistent": capture, "made-up": made_up}


def plain_votes(cameras: Cameras, masks, grid: Grid, rule: KeepRule) -> torch.Tensor:
    """The vote as a script would write it in torch: all voxel centres through `project`, chunk by chunk."""
    axes = [torch.from_numpy(grid.centres(a)).float() for a in range(3)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    cameras = cameras.to(dtype=torch.float32)
    kept = torch.empty(len(points), dtype=torch.bool)
    for rows in torch.arange(len(points)).split(1 << 20):
        visible = torch.zeros(len(rows), dtype=torch.int32)
        occupied = torch.zeros(len(rows), dtype=torch.int32)
        for view, mask in enumerate(masks):
            uv, depth = project(cameras[view], points[rows])
            height, width = mask.shape
            size = torch.tensor([width, height])
            seen = (depth > 0) & (uv >= 0).all(-1) & (uv < size).all(-1)
            index = torch.where(seen[:, None], uv, 0.0).long()
            visible += seen
            occupied += seen & mask[index[:, 1], index[:, 0]]
        kept[rows] = (occupied >= float(rule.agreement) * visible) & (visible >= rule.least_visible)
    return kept.reshape(grid.shape)


def least(call, repeats: int) -> float:
    """Seconds of the fastest of several runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def measure(resolution: int, repeats: int, masks_of: str) -> dict:
    """One resolution: seconds of votes to grid and of the whole call with bounds, bytes, occupied voxels."""
    cameras, masks = CAPTURES[masks_of]()
    VisibleDomain(resolution=32).carve(cameras, masks)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    hulls, whole = [], []
    for _ in range(repeats):
        hulls.clear()
        start = time.perf_counter()
        hulls.append(VisibleDomain(resolution=resolution).carve(cameras, masks))
        whole.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    hull = hulls[0]
    grid, rule = Grid(hull.bounds[0], hull.voxel_size, hull.shape), KeepRule(VIEWS, 3, as_fraction(0.95))
    voxels = hull.voxels
    hulls.clear()
    del hull
    silhouettes = gather_silhouettes(cameras, masks)
    return {
        "resolution": resolution,
        "votes_s": least(lambda: block_carve(silhouettes, grid, rule), repeats),
        "carve_s": min(whole),
        "peak_growth_mib": (peak - before) / 1024,
        "voxels": voxels,
    }


def compare(repeats: int, masks_of: str) -> None:
    """256^3: block carve against both dense votes."""
    cameras, masks = CAPTURES[masks_of]()
    hull = VisibleDomain(resolution=256, components="all").carve(cameras, masks)
    grid, rule = Grid(hull.bounds[0], hull.voxel_size, hull.shape), KeepRule(VIEWS, 3, as_fraction(0.95))
    silhouettes = gather_silhouettes(cameras, masks)
    fast = least(lambda: block_carve(silhouettes, grid, rule), max(repeats, 5))
    dense = least(lambda: dense_carve(silhouettes, grid, rule), 2)
    plain = least(lambda: plain_votes(cameras, masks, grid, rule), 1)
    same = np.array_equal(block_carve(silhouettes, grid, rule), dense_carve(silhouettes, grid, rule).numpy())
    print(f"256^3, {VIEWS} views of {SIZE} x {SIZE}, {torch.get_num_threads()} threads")
    print(f"block carve, summed-area tables included    {fast:8.4f} s")
    print(
        f"dense torch, projection split by axis       {dense:8.2f} s  {dense / fast:7.0f} times, equal: {same}"
    )
    print(f"dense torch, every centre through project   {plain:8.2f} s  {plain / fast:7.0f} times")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--resolutions", type=int, nargs="+", default=[128, 256, 512, 1024])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--masks", choices=CAPTURES, default="consistent")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one, options.repeats, options.masks)))
        return
    compare(options.repeats, options.masks)
    print("\nresolution  votes s  carve s (bounds, pieces)  peak growth MiB     voxels")
    rows = []
    for resolution in options.resolutions:
        command = [sys.executable, __file__, "--one", str(resolution), "--repeats", str(options.repeats)]
        command += ["--masks", options.masks]
        rows.append(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
        r = rows[-1]
        times = f"{r['votes_s']:8.3f} {r['carve_s']:8.3f}"
        print(f"{resolution:10d} {times} {r['peak_growth_mib']:34.0f} {r['voxels']:10d}")
    if len(rows) < 2:
        return
    sides = np.log([r["resolution"] for r in rows])
    for name in ("votes_s", "carve_s"):
        slope = np.polyfit(sides, np.log([r[name] for r in rows]), 1)[0]
        last = np.diff(np.log([r[name] for r in rows]))[-1] / np.diff(sides)[-1]
        print(f"{name} grows as resolution^{slope:.2f} over all, ^{last:.2f} over the last step (3 = volume)")


if __name__ == "__main__":
    main()
