"""A command like visdom-train, without torch: steps, states, a lock, run.json, and the faults a test asks for."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import sys
import time
from pathlib import Path

import yaml

from visdom_plugin.atomic_files import write_json
from visdom_plugin.tables.run.job_files import BUSY


def main(argv: list[str]) -> int:
    words = dict(zip(argv[::2], argv[1::2], strict=False))
    content = yaml.safe_load(Path(words["--config"]).read_text())
    settings, out = content["settings"], Path(words["--out"])
    out.mkdir(parents=True, exist_ok=True)
    lock = (out / "run.lock").open("a+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print(f"error: {BUSY}", file=sys.stderr)
        return 2
    with (out / "starts").open("a") as file:
        file.write("x")
    try:
        if json.loads((out / "run.json").read_text())["status"] == "finished":
            return 0
    except OSError:
        pass
    if settings["complaint"]:
        print(f"error: {settings['complaint']}\n  what to do: mend it", file=sys.stderr)
        return 2
    if settings["crash"]:
        raise RuntimeError("the floor is lava")
    record = {"schema": 1, "method": content["method"], "status": "running"}
    write_json(out / "run.json", record)
    stopped = []
    before = signal.signal(signal.SIGTERM, lambda *_: stopped.append(1))
    done = sorted(int(p.stem.partition("-")[2]) for p in (out / "checkpoints").glob("step-*.json"))
    value = json.loads((out / f"checkpoints/step-{done[-1]}.json").read_text())["value"] if done else 0.0
    for step in range(done[-1] if done else 0, settings["steps"]):
        if stopped:
            write_json(out / "run.json", record | {"status": "interrupted"})
            return 130
        time.sleep(settings["seconds"])
        if step == settings["dies_at"] and not (settings["dies_once"] and done):
            os.kill(os.getpid(), signal.SIGKILL)
        value = (value * 31 + step + content["seed"] + len(content["method"])) % 97
        write_json(out / f"checkpoints/step-{step + 1}.json", {"value": value})
    signal.signal(signal.SIGTERM, before)
    write_json(
        out / "run.json",
        record
        | {
            "status": "finished",
            "seed": content["seed"],
            "data": {"train": ["a"], "test": ["b"], "downscale": content["downscale"]},
            "metrics": {"test": {"psnr": value}, "per_view": {}, "protocol": {"background": "white"}},
        },
    )
    return 0
