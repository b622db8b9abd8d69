"""What methods cost: seconds and memory of one `visdom-train` command each, one after the other.

    python benchmarks/methods/cost.py ingp ingp+vd 3dgs-go 3dgs-go+vd
    python benchmarks/methods/cost.py 3dgs-go+vd -- --data $VISDOM_SCENES/blowtorch --downscale 4

Words after `--` go to every command. `train` and `test views` are those of run.json, `whole` is the command's wall
time, `processor` the time of all its threads, `memory` the most that the process held (resident, 10^6 bytes).
Kernels are compiled by the first run ever: run it twice.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> int:
    words = sys.argv[1:]
    at = words.index("--") if "--" in words else len(words)
    methods, extra = words[:at], words[at + 1 :]
    if not methods:
        print(__doc__)
        return 2
    train = str(Path(sys.executable).with_name("visdom-train"))
    print("| method | steps | train s | ms a step | test views s | whole s | processor s | memory MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    for method in methods:
        with tempfile.TemporaryDirectory() as folder:
            command = [train, f"method:{method}", "--quiet", "--no-report", "--out", f"{folder}/run", *extra]
            began = time.perf_counter()
            child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            _, status, used = os.wait4(child.pid, 0)
            whole = time.perf_counter() - began
            if status:
                print(f"{method}: visdom-train ended with status {os.waitstatus_to_exitcode(status)}")
                return 1
            run = json.loads(Path(folder, "run", "run.json").read_text(encoding="utf-8"))
        timing = run["timing"]
        seconds = (timing["eval_s"], whole, used.ru_utime + used.ru_stime)
        cells = [method, str(run["config"]["steps"]), f"{timing['train_s']:.1f}", f"{timing['step_ms']:.1f}"]
        cells += [f"{x:.1f}" for x in seconds] + [f"{used.ru_maxrss * 1024 / 1e6:.0f}"]
        print(f"| {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
