"""A table of two methods on two built-in scenes, as Markdown, CSV, LaTeX and one HTML page.

A table is a YAML file; `visdom-table two.yaml` makes the same one. Interrupted runs are resumed, and finished ones
are used again.

    python examples/06_table.py
    python examples/06_table.py --steps 20 --downscale 4     # a quick look, in another folder: --out quick
"""

import sys
from pathlib import Path

import tyro
import yaml

from visdom_plugin.cli.commands import table


def main(steps: int = 400, downscale: float = 1, out: Path = Path("two")) -> int:
    """Trains 2 methods x 2 scenes x 2 seeds.

    Args:
        steps: of each run.
        downscale: how much smaller than 200 x 200 the photographs are.
        out: folder of the table.
    """
    settings = {"steps": steps}
    spec = {
        "name": "two",
        "title": "What the visible domain gains",
        "rows": [
            {"label": "bare", "method": "ingp", "settings": settings},
            {"label": "in the visible domain", "method": "ingp+vd", "settings": settings},
        ],
        "columns": [{"label": "drawn", "scenes": ["duck", "chair"], "views": [4], "downscale": downscale}],
        "metrics": ["psnr", "silhouette_iou"],
        "seeds": [0, 1],
        "budget": "quick",
    }
    out.mkdir(parents=True, exist_ok=True)
    file = out / "two.yaml"
    file.write_text(yaml.safe_dump(spec, sort_keys=False), encoding="utf-8")
    status = table.main([str(file), "--out", str(out), "--device", "cpu", "--quiet"])
    print((out / "table.md").read_text(encoding="utf-8"))
    return status


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
