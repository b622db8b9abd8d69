"""Nerfstudio's nerfacto beside nerfacto-vd: same photographs, same steps, same small size, measured by ns-eval.

    python benchmarks/nerfstudio_pair.py --data SCENE --steps 300

runs in an environment of scripts/nerfstudio_env.sh, on the CPU. What runs is `ns-train` and `ns-eval` word for word;
the commands are printed. Bare nerfacto sees the photographs on white and draws on white; both take the cameras as
they are. Nerfstudio's PSNR: whole frame, white background, mean over the test views.
"""

from __future__ import annotations

import argparse
import json
import logging
import shlex
import sys
import time
from pathlib import Path

SMALL = """--machine.device-type cpu --mixed-precision False --vis tensorboard --pipeline.model.implementation torch
--pipeline.model.num-levels 8 --pipeline.model.max-res 256 --pipeline.model.log2-hashmap-size 15
--pipeline.model.hidden-dim 32 --pipeline.model.hidden-dim-color 32
--pipeline.model.num-proposal-samples-per-ray 48 24 --pipeline.model.num-nerf-samples-per-ray 16
--pipeline.datamanager.train-num-rays-per-batch 512 --pipeline.model.eval-num-rays-per-chunk 4096
--steps-per-eval-batch 1000000 --steps-per-eval-image 1000000 --steps-per-eval-all-images 1000000
--pipeline.model.camera-optimizer.mode off""".split()
BARE = ["--pipeline.model.background-color", "white"]


def call(entrypoint, words: list[str]) -> float:
    """Runs a command of nerfstudio in this process, which has imported it once; returns seconds."""
    print("+", shlex.join(words), flush=True)
    sys.argv, begin = words, time.monotonic()
    entrypoint()
    return time.monotonic() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of a scene; without it, the built-in scene")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--downscale", type=float, default=8)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--test-list", help="test views by position, with commas between; by default all")
    parser.add_argument("--methods", nargs="+", default=["nerfacto", "nerfacto-vd"])
    parser.add_argument("--extra", default="", help="further words for ns-train, for every method")
    parser.add_argument("--out", type=Path, default=Path("runs/nerfstudio_pair"))
    options = parser.parse_args()

    from nerfstudio.scripts import eval as evaluating
    from nerfstudio.scripts import train as training

    logging.getLogger().setLevel(logging.WARNING)
    name = options.data.name if options.data else "built-in"
    parsing = ["visdom", "--views", str(options.views), "--downscale", f"{options.downscale:g}"]
    parsing += ["--data", str(options.data)] if options.data else []
    parsing += ["--test-list", options.test_list] if options.test_list else []
    rows = []
    for method in options.methods:
        words = ["ns-train", method, *SMALL, *([] if method.endswith("-vd") else BARE)]
        words += ["--max-num-iterations", str(options.steps), "--machine.seed", str(options.seed)]
        words += ["--output-dir", str(options.out), "--experiment-name", name, "--timestamp", str(options.seed)]
        words += shlex.split(options.extra)
        seconds = call(training.entrypoint, [*words, *parsing])
        run = options.out / name / method / str(options.seed)
        call(
            evaluating.entrypoint,
            ["ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(run / "eval.json")],
        )
        results = json.loads((run / "eval.json").read_text())["results"]
        rows.append((method, results["psnr"], results["ssim"], seconds))
    print(f"\n{name}, {options.views} views, downscale {options.downscale:g}, {options.steps} steps\n")
    print("| method | test PSNR | test SSIM | seconds |\n| --- | --- | --- | --- |")
    for method, psnr, ssim, seconds in rows:
        print(f"| {method} | {psnr:.2f} | {ssim:.3f} | {seconds:.0f} |")
    if len(rows) > 1:
        print(f"\n{rows[-1][0]} - {rows[0][0]}: {rows[-1][1] - rows[0][1]:+.2f} dB")


if __name__ == "__main__":
    main()
