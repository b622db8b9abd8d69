"""Seconds from `visdom-view` to the first picture in a headless Chromium that is already open.

    python benchmarks/system/first_picture.py [--repeats 2] [SUBJECT ...]

A subject is what `visdom-view` takes; without one, the built-in scene. A picture is there when what stands beside
the controls has many colours.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import threading
import time

import numpy as np

from tests.browser import Page

VIEW = "import sys; from visdom_plugin.cli.commands.view import main; sys.exit(main())"
WIDTH, HEIGHT, LONGEST = 900, 600, 90.0


def measure(subject: str | None) -> tuple[float, float]:
    """Seconds to the address in the terminal, and to the picture."""
    with Page() as page:
        page.size(WIDTH, HEIGHT)
        began = time.perf_counter()
        command = [sys.executable, "-u", "-c", VIEW, *([subject] if subject else [])]
        viewer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert viewer.stdout is not None
        try:
            address, said = None, ""
            while address is None:
                line = viewer.stdout.readline()
                said += line
                if not line:
                    raise SystemExit(said)
                address = re.search(r"http://\S+", line)
            ready = time.perf_counter() - began
            threading.Thread(target=viewer.stdout.read, daemon=True).start()
            page.open(address.group(0))
            while time.perf_counter() - began < LONGEST:
                middle = page.picture()[HEIGHT // 5 : 4 * HEIGHT // 5, 40:560].reshape(-1, 3).astype(int)
                if middle.std(0).max() > 4 and len(np.unique(middle[::7], axis=0)) > 40:
                    return ready, time.perf_counter() - began
                time.sleep(0.1)
            raise SystemExit(f"no picture of {subject or 'the built-in scene'} in {LONGEST:.0f} s")
        finally:
            viewer.kill()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT")
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    for subject in options.subjects or [None]:
        for _ in range(options.repeats):
            ready, picture = measure(subject)
            print(
                f"{subject or 'built-in'}: address {ready:.1f} s, first picture {picture:.1f} s", flush=True
            )


if __name__ == "__main__":
    main()
