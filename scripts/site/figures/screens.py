"""Pictures of docs/guide/outputs.md: the viewer and the report of a finished run, in a headless Chromium.

python scripts/site/figures/screens.py [--runs DIR] [--out DIR]

Trains visdom-gs on the first built-in scene where DIR has no such run yet.
"""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from before_after import PICTURES, write_webp
from trained import read_options, train

from tests.browser import Page

MAKES = REPORT, VIEWER = "report.webp", "viewer.webp"
DRAWN_S, SETTLED_S = 2, 40
"""Time for the report to draw itself, and for the viewer to draw the run at full size beside other work."""

CLOSE_NOTICES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
"""The viewer warns that this browser draws without a GPU."""


def main() -> None:
    """Draws both pictures."""
    args = read_options(__doc__, PICTURES)
    run = train(args.runs, "visdom-gs")
    command(run, "report").wait()
    viewer = command(run, "view")
    try:
        with Page() as page:
            page.size(1100, 900)
            page.open((run / "report.html").resolve().as_uri())
            time.sleep(DRAWN_S)
            write_webp(page.picture(), args.out / REPORT)
            assert viewer.stdout is not None
            address = next(found for line in viewer.stdout if (found := re.search(r"http://\S+", line)))
            threading.Thread(target=viewer.stdout.read, daemon=True).start()
            page.size(1100, 640)
            page.open(address[0])
            time.sleep(SETTLED_S)
            page.run(CLOSE_NOTICES)
            time.sleep(DRAWN_S)
            write_webp(page.picture(), args.out / VIEWER)
    finally:
        viewer.kill()


def command(run: Path, name: str) -> subprocess.Popen[str]:
    """visdom-report or visdom-view of a run, as a process of which the output can be read."""
    words = [sys.executable, "-u", "-m", f"visdom_plugin.cli.commands.{name}", str(run)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


if __name__ == "__main__":
    main()
