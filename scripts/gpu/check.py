"""Runs the parts of the GPU check within a budget of seconds; what hangs or fails costs only itself.

Every part is a file in `parts/`, every case of it a row of the page. Called by `scripts/gpu_check.sh`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import machine
import page

HERE = Path(__file__).resolve().parent
# In order of worth.
PARTS = ("tests", "parity", "hooks", "train", "steps", "runs", "conformance")
LIMITS = {
    "tests": 120,
    "parity": 120,
    "hooks": 60,
    "train": 150,
    "steps": 150,
    "runs": 400,
    "conformance": 240,
}
"""Seconds a part may take; the whole budget goes before."""
WAITING = ("train", "steps", "runs")
STARTING = 90.0
"""Seconds a process may take to say which cases it has: torch is loaded for the first time, perhaps."""
RESERVE = 8
"""Seconds kept for the end: packing, and the last page."""


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/gpu_check.sh", description=__doc__.splitlines()[0])
    parser.add_argument(
        "out", type=Path, help="folder for page.md, results.json and what the next call may use"
    )
    parser.add_argument(
        "parts", nargs="*", metavar="part", help=f"some of {', '.join(PARTS)}; all by default"
    )
    parser.add_argument("--seconds", type=float, default=400, help="budget of the whole call")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="cpu is a dry run")
    parser.add_argument("--tiny", action="store_true", help="smallest sizes: shows that everything runs")
    parser.add_argument("--wheels", type=Path, help="folder of scripts/gpu_wheels.sh")
    parser.add_argument("--scene", type=Path, help="a capture; by default the one beside the wheels")
    parser.add_argument("--downscale", type=float, default=2.0, help="of the capture's photographs")
    parser.add_argument("--gsplat-cache", type=Path, help="compiled CUDA code; by default beside the wheels")
    parser.add_argument(
        "--reference", type=Path, help="results.json of `--device cpu train`, to compare with"
    )
    parser.add_argument("--resume", type=Path, help="OUT of an earlier call: results are kept, runs go on")
    scratch = Path(tempfile.gettempdir()) / "visdom-gpu"
    parser.add_argument("--work", type=Path, default=scratch, help="where all else is put")
    parser.add_argument("--only", help="cases whose name contains this word")
    args = parser.parse_intermixed_args(argv)
    for part in args.parts:
        if importlib.util.find_spec(f"parts.{part}") is None:
            parser.error(f"there is no part {part!r}; choose from {', '.join(PARTS)}")
    return args


class Check:
    """One call: what is known so far, and the time that is left."""

    def __init__(self, args: argparse.Namespace):
        self.args, self.began = args, time.monotonic()
        self.out, self.work = args.out.resolve(), args.work.resolve()
        for folder in (self.out, self.work):
            folder.mkdir(parents=True, exist_ok=True)
        for log in self.work.glob("*.log"):
            log.unlink()
        self.site = self.work / "site"
        wheels = args.wheels
        beside = None if wheels is None else wheels.resolve()
        self.scene = args.scene or (beside / "scene" if beside and (beside / "scene").is_dir() else None)
        self.reference = args.reference or (beside / "reference.json" if beside else None)
        self.cache = args.gsplat_cache or self.work / "compiled"
        if args.gsplat_cache is None and beside and (beside / "compiled").is_dir():
            self.cache = beside / "compiled"
        self.warming: subprocess.Popen | None = None
        self.results: dict = {"parts": {}, "device": args.device, "tiny": args.tiny}
        self.before: dict[str, dict] = {}
        if args.resume and (args.resume / "results.json").is_file():
            self.before = json.loads((args.resume / "results.json").read_text())["parts"]

    def left(self) -> float:
        return self.args.seconds - RESERVE - (time.monotonic() - self.began)

    def write(self) -> None:
        """results.json and page.md, each in one step."""
        self.results["seconds"] = round(time.monotonic() - self.began, 1)
        if hasattr(self, "compilation"):
            self.results["compiled"] = self.compilation.notes
        merged = self.results | {"parts": merge(self.before, self.results["parts"])}
        for name, text in (
            ("results.json", json.dumps(merged, indent=1)),
            ("page.md", page.render(merged)),
        ):
            part = self.out / f".{name}.part"
            part.write_text(text)
            part.replace(self.out / name)

    def prepare(self) -> None:
        args, notes = self.args, self.results.setdefault("notes", [])
        if args.wheels:
            trouble = machine.install_wheels(args.wheels / "wheels", self.site)
            notes += [trouble] if trouble else []
        machine.register_checkout(self.site)
        self.env = machine.environment(self.site)
        self.results["machine"] = machine.describe(args.device, self.env)
        self.write()
        self.compilation = machine.Compilation(self.cache, args.device, self.env)
        if args.device == "cuda":
            self._warm_up()
        self.results["ready_s"] = round(time.monotonic() - self.began, 1)
        self.write()

    def run(self) -> None:
        self.prepare()
        try:
            for part in self.args.parts or PARTS:
                if self.left() < 5:
                    self.results["parts"].setdefault(part, {})["note"] = "no time was left"
                    continue
                self.run_part(part)
                self.write()
        finally:
            self.compilation.stop()
            if self.warming is not None:
                self._kill(self.warming)
            self.keep()
            self.write()

    def run_part(self, part: str) -> None:
        """All cases of a part, in as many processes as it takes."""
        print(f"== {part}, {self.left():.0f} s left", flush=True)
        found = self.results["parts"][part] = {"cases": {}}
        limit = LIMITS.get(part, 60) * (1 if self.args.device == "cuda" else 8)
        end = time.monotonic() + min(limit, self.left())
        lines = self.work / f"{part}.jsonl"
        self._wait_for_code(part, end)
        for _ in range(12):
            lines.unlink(missing_ok=True)
            process = self._spawn(part, lines, self._settings(found, end - time.monotonic()), part)
            why = self._watch(process, lines, found, end)
            self._settle(found, why)
            left = [n for n in found.get("names", []) if n not in found["cases"]]
            if not found.get("names"):
                found["note"] = "the part does not start: " + self._tail(part)
                return
            if not left or time.monotonic() >= end:
                break
        if left:
            found["note"] = "out of time: " + ", ".join(left)

    def _warm_up(self) -> None:
        """Compiles the CPU kernels, which parity needs, in the background: the dry run of parity."""
        lines = self.work / "warm-up.jsonl"
        lines.unlink(missing_ok=True)
        settings = self._settings({"cases": {}}, 120) | {"device": "cpu", "tiny": True, "only": None}
        self.warming = self._spawn("parity", lines, settings, "warm-up")

    def _settings(self, found: dict, seconds: float) -> dict:
        args = self.args
        return {
            "device": args.device,
            "tiny": args.tiny,
            "downscale": args.downscale,
            "scene": None if self.scene is None else str(Path(self.scene).resolve()),
            "reference": str(self.reference) if self.reference and self.reference.is_file() else None,
            "work": str(self.work),
            "out": str(self.out),
            "resume": None if args.resume is None else str(args.resume.resolve()),
            "only": args.only,
            "done": list(found["cases"]),
            "seconds": seconds,
            "compiled": [p for p in machine.PACKAGES if self.compilation.ready(p)],
        }

    def _spawn(self, part: str, lines: Path, settings: dict, name: str) -> subprocess.Popen:
        log = (self.work / f"{name}.log").open("a")
        command = [sys.executable, str(HERE / "worker.py"), part, str(lines), json.dumps(settings)]
        return subprocess.Popen(
            command, env=self.env, stdout=log, stderr=log, start_new_session=True, cwd=machine.CHECKOUT
        )

    def _wait_for_code(self, part: str, end: float) -> None:
        """Parts whose cases mostly need compiled code wait for it, at most half of their time."""
        until = time.monotonic() + (end - time.monotonic()) / 2
        while part in WAITING and self.compilation.ready("gsplat") is None and time.monotonic() < until:
            time.sleep(0.5)

    def _watch(self, process: subprocess.Popen, lines: Path, found: dict, end: float) -> str:
        """Reads results until the process ends or must be ended; returns why it ended."""
        seen, running, limit, since = 0, None, STARTING, time.monotonic()
        limits: dict[str, float] = {}
        known = len(found["cases"])
        while True:
            over = process.poll() is not None
            text = lines.read_text() if lines.exists() else ""
            rows = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
            for row in rows[seen:]:
                seen += 1
                if "cases" in row:
                    limits = {name: seconds for name, seconds, _ in row["cases"]}
                    found["names"] = list(limits)
                elif row["status"] == "started":
                    running, since = row["case"], time.monotonic()
                    limit, found["running"] = limits.get(running, 60.0), running
                else:
                    found["cases"][row.pop("case")] = row
                    found.pop("running", None)
                    running, since, limit = None, time.monotonic(), 60.0
            if len(found["cases"]) != known:
                known = len(found["cases"])
                self.write()
            if over:
                return "" if running is None else f"the process died, exit status {process.returncode}"
            now = time.monotonic()
            if now >= end or now - since > limit:
                self._kill(process)
                why = "the part's time was over" if now >= end else f"took more than {limit:.0f} s"
                return why
            time.sleep(0.1)

    def _settle(self, found: dict, why: str) -> None:
        """Gives the case that was running when its process ended a result, too."""
        running = found.pop("running", None)
        if running is not None and running not in found["cases"]:
            found["cases"][running] = {"status": "ended", "error": why}

    @staticmethod
    def _kill(process: subprocess.Popen) -> None:
        for number in (signal.SIGTERM, signal.SIGKILL):
            try:
                os.killpg(process.pid, number)
                process.wait(timeout=4)
            except (ProcessLookupError, subprocess.TimeoutExpired):
                continue

    def _tail(self, part: str) -> str:
        log = self.work / f"{part}.log"
        return log.read_text(errors="replace").strip()[-600:] if log.exists() else "no output"

    def keep(self) -> None:
        """What the next call may use: compiled code, logs."""
        for built in self.cache.glob("*_csrc.so"):
            inside = self.out / built.name
            if not inside.exists() and "here" in self.compilation.notes.get(built.name.split("_")[0], ""):
                shutil.copyfile(built, inside)
        logs = [*self.work.glob("*.log"), *self.cache.glob("*.log")]
        text = [f"===== {log.name}\n{log.read_text(errors='replace')[-20_000:]}\n" for log in sorted(logs)]
        (self.out / "log.txt").write_text("".join(text))


def merge(before: dict[str, dict], now: dict[str, dict]) -> dict[str, dict]:
    """The results of two calls by part, case by case; the later one counts."""
    merged = dict(before)
    for part, found in now.items():
        cases = before.get(part, {}).get("cases", {}) | found.get("cases", {})
        merged[part] = {**found, "cases": cases}
    return {part: merged[part] for part in (*PARTS, *merged) if part in merged}


def main(argv: list[str] | None = None) -> int:
    args = parse(argv)
    check = Check(args)
    check.run()
    print((check.out / "page.md").read_text())
    bad = page.count_bad(check.results)
    print(f"{check.out}/page.md, {bad} cases failed or differ")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
