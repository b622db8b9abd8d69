"""`visdom-train` with the published schedule on the capture at 4 views. A run that does not end in its time is
stopped, measured as it is, and goes on with the next call on the same machine, or where its checkpoint was carried
along."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

from bench import Bench, Case

ORDER = {"3dgs-go+vd": 110, "ingp+vd": 150, "corgs-lite+vd": 150, "zipnerf-lite+vd": 200}
"""Most seconds for each."""
CALL = """
import sys
from importlib.metadata import entry_points
found = next(iter(entry_points(group="console_scripts", name=sys.argv.pop(1))))
sys.exit(found.load()())
"""
"""Runs one of the installed commands by its name."""
MEASURING = 25
"""Seconds kept for the test views of a run that was stopped."""
MOST_CARRIED = 14 << 20
"""Bytes of the runs that go into OUT, so that another machine can go on."""


def cases(bench: Bench) -> list[Case]:
    found = []
    for name, limit in ORDER.items():
        needs = () if name.startswith(("ingp", "zipnerf")) else ("gsplat",)
        found.append(Case(name, _run(name, limit), limit, needs))
    return bench.choose(found)


def _run(name: str, limit: float):
    def run(bench: Bench) -> dict:
        end = time.monotonic() + min(limit, bench.left()) - 3
        _unpack(bench)
        folder = _folder(bench) / name
        common = ["--device", str(bench.device), "--quiet"]
        command = [
            f"method:{name}",
            "--views",
            "4",
            "--out",
            str(folder),
            "--checkpoint-seconds",
            "60",
            *common,
        ]
        command += ["--budget", "quick" if bench.tiny else "full"]
        if bench.scene_path is not None:
            downscale = 8 if bench.tiny else bench.settings["downscale"]
            command += ["--data", str(bench.scene_path), "--downscale", str(downscale)]
        if bench.tiny:
            command += ["--method.steps", "6"]
            if (
                name == "zipnerf-lite+vd"
            ):  # begins so empty that nothing is drawn after so few steps, an error
                command += ["--method.density-bias", "-6"]
        # A stopped run is measured as it is, which takes a while, too.
        _call("visdom-train", command, end - MEASURING - time.monotonic())
        record = json.loads((folder / "run.json").read_text())
        if record["status"] != "finished" and any((folder / "checkpoints").glob("step-*.json")):
            _call("visdom-eval", [str(folder), *common], end - time.monotonic())
            record = json.loads((folder / "run.json").read_text())
        _pack(bench)
        last = _last_line(folder / "log.jsonl")
        steps, total = last.get("step", 0), record["config"]["steps"]
        test, timing = record.get("metrics", {}).get("test", {}), record.get("timing", {})
        spent = timing.get("train_s", last.get("train_s", 0))
        return {
            "status of the run": record["status"],
            "steps": steps,
            "of": total,
            "train s": spent,
            "ms a step": 1000 * spent / max(steps, 1),
            "whole schedule, min": spent / max(steps, 1) * total / 60,
            "hull s": timing.get("hull_s"),
            "eval s": timing.get("eval_s"),
            "PSNR": test.get("psnr"),
            "IoU": test.get("silhouette_iou"),
            "outside": test.get("outside_hull_mass"),
        }

    return run


def _folder(bench: Bench) -> Path:
    """Where the runs of this kind of call lie."""
    return bench.work / "runs" / f"{bench.device}{'-tiny' if bench.tiny else ''}"


def _call(command: str, words: list[str], seconds: float) -> None:
    """Runs one of the commands; after so many seconds it is asked to stop, which keeps its state.

    Raises:
        RuntimeError: when it fails, with the end of what it said.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", CALL, command, *words], stderr=subprocess.PIPE, text=True
    )
    try:
        said = process.communicate(timeout=max(seconds, 5))[1]
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        said = process.communicate()[1]
    print(said[-4000:], file=sys.stderr)
    # 130 is a run that was stopped and has kept its state; -15 something without one.
    if process.returncode not in (0, 130, -signal.SIGTERM):
        raise RuntimeError(f"{command} ended with {process.returncode}: {said.strip()[-500:]}")


def _last_line(log: Path) -> dict:
    lines = log.read_text().splitlines() if log.exists() else []
    return json.loads(lines[-1]) if lines else {}


def _unpack(bench: Bench) -> None:
    """Runs that an earlier call left in its OUT, unless they are here already."""
    resume = bench.settings["resume"]
    archive = None if resume is None else Path(resume) / "runs.tar"
    if archive is None or not archive.is_file():
        return
    with tarfile.open(archive) as tar:
        for member in tar.getmembers():
            if not (bench.work / member.name).exists():
                tar.extract(member, bench.work, filter="data")


def _pack(bench: Bench) -> None:
    """Records, logs and pictures of all runs, and newest checkpoints as far as they fit, into OUT/runs.tar."""
    files = []
    for folder in sorted(_folder(bench).iterdir()):
        small = [folder / "run.json", folder / "log.jsonl", folder / "renders" / "test_sheet.png"]
        states = sorted((folder / "checkpoints").glob("step-*.json"))[-1:]
        files += [small, [s.with_suffix(".safetensors") for s in states] + states]
    archive, size = bench.out / "runs.tar", 0
    part = archive.with_name(".runs.tar.part")
    with tarfile.open(part, "w") as tar:
        for group in sorted(files, key=_size):
            if size + _size(group) > MOST_CARRIED:
                continue
            size += _size(group)
            for file in group:
                if file.exists():
                    tar.add(file, file.relative_to(bench.work))
    part.replace(archive)


def _size(files: list[Path]) -> int:
    return sum(f.stat().st_size for f in files if f.exists())
