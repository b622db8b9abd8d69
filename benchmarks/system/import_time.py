"""Import time of the public API over `import torch, numpy, numba`, which it stands on.

    python benchmarks/system/import_time.py [runs]

Fresh interpreters, one after the other in turn; the fastest of each counts.
"""

from __future__ import annotations

import subprocess
import sys

BASE = "import torch, numpy, numba"
NAMES = "Cameras, VisibleDomain, Hull, VisDomSampler, VisDomGaussianRegularizer"
PROGRAMS = {
    BASE: BASE,
    "import visdom_plugin": "import visdom_plugin",
    f"from visdom_plugin import {NAMES}": f"from visdom_plugin import {NAMES}",
    f"{BASE}; from visdom_plugin import {NAMES}": f"{BASE}; from visdom_plugin import {NAMES}",
    "import torch, numpy, numba, cv2, scipy.ndimage": f"{BASE}, cv2, scipy.ndimage",
}


def seconds(program: str) -> float:
    """Processor time of the imports in one fresh interpreter: what else runs on the machine matters little."""
    code = f"import time; begin = time.process_time(); {program}; print(time.process_time() - begin)"
    return float(subprocess.run([sys.executable, "-c", code], check=True, capture_output=True).stdout)


def main() -> None:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    best = dict.fromkeys(PROGRAMS, float("inf"))
    for _ in range(runs):
        for name, program in PROGRAMS.items():
            best[name] = min(best[name], seconds(program))
    print(f"{'seconds':>8} {'ratio':>6}  program (processor time, fastest of {runs})")
    for name, value in best.items():
        print(f"{value:8.3f} {value / best[BASE]:6.2f}  {name}")


if __name__ == "__main__":
    main()
