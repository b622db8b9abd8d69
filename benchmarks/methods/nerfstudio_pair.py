"""Nerfstudio's nerfacto beside nerfacto-vd: same photographs, same steps, same small size, measured by ns-eval.

    python benchmarks/methods/nerfstudio_pair.py --data SCENE --steps 300

runs in an environment of scripts/nerfstudio_env.sh, on the CPU. What runs is `ns-train` and `ns-eval` word for
word; the commands are printed. Bare nerfacto sees the photographs on white and draws on white; both take the
cameras as they are. Nerfstudio's PSNR: whole frame, white background, mean over the test views. "mask" is
nerfacto-vd with the mask loss alone, without the hull; "white" is a blank picture, which any method should beat.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
import time
from pathlib import Path

SMALL = {
    "--machine.device-type": "cpu",
    "--mixed-precision": "False",
    "--vis": "tensorboard",
    "--pipeline.model.implementation": "torch",
    "--pipeline.model.num-levels": "8",
    "--pipeline.model.max-res": "256",
    "--pipeline.model.log2-hashmap-size": "15",
    "--pipeline.model.hidden-dim": "32",
    "--pipeline.model.hidden-dim-color": "32",
    "--pipeline.model.num-proposal-samples-per-ray": "48 24",
    "--pipeline.model.num-nerf-samples-per-ray": "16",
    "--pipeline.model.eval-num-rays-per-chunk": "4096",
    "--pipeline.model.camera-optimizer.mode": "off",
    "--pipeline.datamanager.train-num-rays-per-batch": "512",
    "--steps-per-eval-batch": "1000000",
    "--steps-per-eval-image": "1000000",
    "--steps-per-eval-all-images": "1000000",
}
METHODS = {
    "nerfacto": ["nerfacto", "--pipeline.model.background-color", "white"],
    "nerfacto-vd": ["nerfacto-vd"],
    "mask": ["nerfacto-vd", "--pipeline.model.vd.enabled", "False"],
}


def call(entrypoint, words: list[str]) -> float:
    """Runs a command of nerfstudio in this process, which has imported it once; returns seconds."""
    print("+", shlex.join(words), flush=True)
    sys.argv, begin = words, time.monotonic()
    entrypoint()
    return time.monotonic() - begin


def main() -> None:
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--data", type=Path, help="folder of a scene; without it, the built-in scene")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--downscale", type=float, default=8)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--test-list", help="test views by position, with commas between; by default all")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--extra", default="", help="further words for ns-train, for every method")
    parser.add_argument("--out", type=Path, default=Path("runs/nerfstudio_pair"))
    options = parser.parse_args()

    import torch
    from nerfstudio.scripts import eval as evaluating
    from nerfstudio.scripts import train as training

    from datamodules import load
    from visdom_plugin.training.metrics import psnr, whiten

    name = options.data.name if options.data else "built-in"
    parsing = ["visdom", "--views", str(options.views), "--downscale", f"{options.downscale:g}"]
    parsing += ["--data", str(options.data)] if options.data else []
    parsing += ["--test-list", options.test_list] if options.test_list else []
    rows = []
    for method in options.methods:
        stamp = f"{method}-{options.seed}"
        words = ["ns-train", *METHODS[method]]
        words += [word for option, value in SMALL.items() for word in (option, *value.split())]
        words += ["--max-num-iterations", str(options.steps), "--machine.seed", str(options.seed)]
        where = ["--output-dir", str(options.out), "--experiment-name", name, "--timestamp", stamp]
        seconds = call(training.entrypoint, [*words, *shlex.split(options.extra), *where, *parsing])
        run = options.out / name / words[1] / stamp
        words = ["ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(run / "eval.json")]
        call(evaluating.entrypoint, [*words, "--render-output-path", str(run / "views")])
        results = json.loads((run / "eval.json").read_text())["results"]
        rows.append((method, results["psnr"], results["ssim"], seconds))
    views = load(
        options.data, views=options.views, downscale=options.downscale, test_list=options.test_list
    ).test
    pairs = zip(views.images, views.masks, strict=True)
    blank = [psnr(whiten(image, mask), torch.ones(())) for image, mask in pairs]
    rows.append(("white", sum(blank) / len(blank), math.nan, 0))
    print(f"\n{name}, {options.views} views, downscale {options.downscale:g}, {options.steps} steps\n")
    print("| method | test PSNR | test SSIM | seconds |\n| --- | --- | --- | --- |")
    for method, decibel, ssim, seconds in rows:
        print(f"| {method} | {decibel:.2f} | {ssim:.3f} | {seconds:.0f} |")
    for method, decibel, *_ in rows[1:]:
        print(f"\n{method} - {rows[0][0]}: {decibel - rows[0][1]:+.2f} dB")


if __name__ == "__main__":
    main()
