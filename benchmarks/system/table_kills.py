"""Kills visdom-table's driver, or one of its workers, at random moments; the table must be as if it had not.

python benchmarks/system/table_kills.py --kills 10 [--steps 20] [--seed S]

One table is made in one go. Then the same table is made again, while after random times the driver and one of its
workers get SIGKILL in turn; a killed driver is started again at once. table.csv and table.md must be the same byte
for byte. When a table is finished before all kills are spent, another one begins.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TABLE = """
title: Kills
budget: quick
seeds: [0, 1]
metrics: [psnr, ssim, psnr_foreground, silhouette_iou, outside_hull_mass]
settings: {{steps: {steps}}}
rows:
  - {{label: Instant-NGP, method: ingp}}
  - {{label: + VisDom, method: ingp+vd, settings: {{hull.resolution: 64}}}}
columns:
  - {{label: built-in, views: 4, downscale: 4}}
"""
FILES = ("table.csv", "table.md")


def start(table: Path, out: Path) -> subprocess.Popen:
    """The command under test."""
    words = [
        sys.executable,
        "-m",
        "visdom_plugin.cli.commands.table",
        table,
        "--out",
        out,
        "--workers=2",
        "--quiet",
    ]
    return subprocess.Popen([str(word) for word in words], stdout=subprocess.DEVNULL)


def list_workers(driver: int) -> list[int]:
    """Process ids of the driver's children that run a job."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            words = (folder / "cmdline").read_bytes()
        except (OSError, IndexError):
            continue
        if folder.name.isdecimal() and int(parent) == driver and b"visdom_plugin.tables.run.worker" in words:
            found.append(int(folder.name))
    return found


def read_table(out: Path) -> dict[str, bytes]:
    """The files to compare."""
    return {name: (out / name).read_bytes() for name in FILES if (out / name).exists()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument(
        "--seed", type=int, default=time.time_ns() % 10**6, help="of the moments; by default the clock"
    )
    parser.add_argument("--out", type=Path, help="keep everything here")
    options = parser.parse_args()
    draw = random.Random(options.seed)
    folder = options.out or Path(tempfile.mkdtemp(prefix="table-kills-"))
    folder.mkdir(parents=True, exist_ok=True)
    table = folder / "kills.yaml"
    table.write_text(TABLE.format(steps=options.steps))
    began = time.monotonic()
    if start(table, folder / "whole").wait() != 0:
        sys.exit("the undisturbed table failed")
    whole_s = time.monotonic() - began
    whole = read_table(folder / "whole")
    print(f"undisturbed: {whole_s:.1f} s; moments drawn with --seed {options.seed}", flush=True)
    print("| kill | table | killed | after s | runs finished then | files then |")
    print("| ---: | ---: | --- | ---: | ---: | --- |", flush=True)
    differing = rounds = number = 0
    while number < options.kills:
        rounds += 1
        out = folder / f"cut-{rounds}"
        driver = start(table, out)
        while driver.poll() is None:
            if number == options.kills:
                driver.wait()
                break
            # Starting, carving, training, evaluation and writing may all be hit.
            moment = draw.uniform(0.02, 0.6) * whole_s
            until = time.monotonic() + moment
            while time.monotonic() < until and driver.poll() is None:
                time.sleep(0.005)
            workers = list_workers(driver.pid)
            victim = "worker" if workers and number % 2 else "driver"
            if driver.poll() is not None:
                break
            done = sum('"status": "finished"' in p.read_text() for p in out.glob("runs/*/run.json"))
            try:
                os.kill(driver.pid if victim == "driver" else draw.choice(workers), signal.SIGKILL)
            except ProcessLookupError:
                continue
            number += 1
            there = ", ".join(read_table(out)) or "none yet"
            print(f"| {number} | {rounds} | {victim} | {moment:.1f} | {done}/4 | {there} |", flush=True)
            if victim == "driver":
                driver.wait()
                driver = start(table, out)
        same = driver.returncode == 0 and read_table(out) == whole
        differing += not same
        digests = " ".join(f"{n} {hashlib.sha256(c).hexdigest()[:12]}" for n, c in read_table(out).items())
        print(f"table {rounds}: {'identical' if same else 'DIFFERENT'} ({digests})", flush=True)
    print(f"{number} kills, {rounds} tables, {differing} of them different from the undisturbed one")
    if options.out is None:
        shutil.rmtree(folder)
    sys.exit(1 if differing else 0)


if __name__ == "__main__":
    main()
