"""How well visdom-prepare places cameras and cuts out the object, against the truth of drawn photographs.

    python benchmarks/prepare/board_and_masks.py [poses | masks | time] [--views 12] [--size 1600 1200]

poses: error of rotation (degrees), position (per cent of the distance) and focal length for each kind of picture.
masks: IoU with the true silhouette for each way of making them. time: seconds of one call on photographs of 12
megapixels, and the machine's load. Photographs are drawn into a temporary folder.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from datamodules import load
from visdom_plugin.prepare.demo import DemoConfig, Truth, true_mask, write_demo
from visdom_plugin.prepare.run import Plan, Prepared, prepare
from visdom_plugin.prepare.settings import MaskSettings

KINDS = {
    "clean": {"blur_px": 0.0, "noise": 0.0, "radial": (0.0, 0.0)},
    "usual": {},
    "strong distortion": {"radial": (-0.22, 0.08)},
    "blurred (2 px)": {"blur_px": 2.0},
    "noisy (12 of 255)": {"noise": 12.0},
    "a quarter covered": {"covered": 0.25},
    "no EXIF": {"exif": False},
}


def made(folder: Path, out: Path, masks: MaskSettings, **more) -> Prepared:
    """One call; the scene is at `out`."""
    return prepare(Plan(photographs=folder, out=out, masks=masks, **more))


def pose_errors(out: Path, truths: list[Truth]) -> dict[str, np.ndarray]:
    """Degrees, per cent of the distance, and per cent of the focal length, of each view placed."""
    views = load(out, views=999, train_list="all", test=False, allow_missing_masks=True).train
    by_name = {t.name.rpartition(".")[0]: t for t in truths}
    rows = []
    for i, name in enumerate(views.names):
        truth = by_name[Path(name).stem]
        found = views.cameras.world_from_camera[i].numpy()
        turn = found[:3, :3].T @ truth.world_from_camera[:3, :3]
        centre = truth.world_from_camera[:3, 3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        focal = truth.focal_px * int(views.cameras.width[i]) / truth.size[0]
        away = np.linalg.norm(found[:3, 3] - centre) / np.linalg.norm(centre)
        rows.append((angle, 100 * away, 100 * abs(float(views.cameras.intrinsics[i, 0, 0]) / focal - 1)))
    return dict(zip(("degrees", "position", "focal"), np.array(rows).T, strict=True))


def ious(out: Path, truths: list[Truth]) -> np.ndarray:
    """Of each view's mask with the true one."""
    views = load(out, views=999, train_list="all", test=False).train
    by_name = {t.name.rpartition(".")[0]: t for t in truths}
    found = []
    for name, mask in zip(views.names, views.masks, strict=True):
        mask = mask.numpy()
        true = true_mask(by_name[Path(name).stem], (mask.shape[1], mask.shape[0]))
        found.append((mask & true).sum() / (mask | true).sum())
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=("poses", "masks", "time"), default="poses")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1200))
    args = parser.parse_args()
    config = DemoConfig(views=args.views, size=tuple(args.size), samples=1 if args.what == "time" else 2)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        {"poses": measure_poses, "masks": measure_masks, "time": measure_time}[args.what](
            folder, config, args
        )


def measure_poses(folder: Path, config: DemoConfig, args: argparse.Namespace) -> None:
    """Prints one line per kind of photograph."""
    print(
        "| photographs | views | degrees, mean (most) | position %, mean (most) | focal % | corners' error px |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for kind, change in KINDS.items():
        taken = folder / kind.replace(" ", "_")
        truths = write_demo(taken, replace(config, **change))
        out = folder / f"{taken.name}_scene"
        record = made(taken, out, MaskSettings("none")).record
        e = pose_errors(out, truths)
        print(
            f"| {kind} | {len(record['views'])} of {len(truths)} | {e['degrees'].mean():.3f} "
            f"({e['degrees'].max():.3f}) | {e['position'].mean():.3f} ({e['position'].max():.3f}) | "
            f"{e['focal'].mean():.2f} | {record['poses']['reprojection_px']:.2f} |",
            flush=True,
        )


def measure_masks(folder: Path, config: DemoConfig, args: argparse.Namespace) -> None:
    """Prints one line per way."""
    print("| photographs | masks | IoU, mean | least |")
    print("| --- | --- | --- | --- |")
    for kind in ("usual", "a quarter covered"):
        taken = folder / kind.replace(" ", "_")
        truths = write_demo(taken, replace(config, **KINDS[kind]))
        box = (-0.09, -0.06, 0.0, 0.09, 0.06, 0.1)
        ways = {
            "grabcut, board": MaskSettings("grabcut"),
            "grabcut, board, without the hull's corrections": MaskSettings("grabcut", rounds=0),
            "grabcut, --box about the object": MaskSettings("grabcut", box=box),
        }
        for i, (way, masks) in enumerate(ways.items()):
            made(taken, folder / f"{taken.name}{i}", masks)
            found = ious(folder / f"{taken.name}{i}", truths)
            print(f"| {kind} | {way} | {found.mean():.3f} | {found.min():.3f} |", flush=True)


def measure_time(folder: Path, config: DemoConfig, args: argparse.Namespace) -> None:
    """Prints seconds of the whole and the load before it."""
    write_demo(folder / "taken", replace(config, size=(4000, 3000)))
    load_before, start, used = os.getloadavg()[0], time.perf_counter(), time.process_time()
    made(folder / "taken", folder / "scene", MaskSettings())
    print(
        json.dumps(
            {
                "photographs": config.views,
                "megapixels": 12,
                "seconds": round(time.perf_counter() - start, 1),
                "cpu_seconds": round(time.process_time() - used, 1),
                "cores": os.cpu_count(),
                "load_before": round(load_before, 1),
            }
        )
    )


if __name__ == "__main__":
    main()
