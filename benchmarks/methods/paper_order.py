"""How far the methods of finished runs stand from the paper's order at 4 views.

    python benchmarks/methods/paper_order.py runs/*/

Runs are grouped by method; every method needs the same scenes and seeds. Prints the methods of the paper's main
table and of its general-purpose table from worst to best of ours, their mean PSNR beside the paper's on Omni3D and
Mip360, each with its rank, and Kendall's tau of the order with either: 1 for the same order, -1 for the reverse.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from scipy.stats import kendalltau

from visdom_plugin.tables.paper import load_numbers
from visdom_plugin.tables.spec import load_table

DATASETS = ("Omni3D", "MipNeRF360")


def read_runs(folders: list[Path]) -> dict[str, dict[tuple[str, int], float]]:
    """PSNR of the test views by method, then by scene and seed."""
    found: dict[str, dict[tuple[str, int], float]] = defaultdict(dict)
    for folder in folders:
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        if run["status"] == "finished":
            found[run["method"]][run["scene"], run["seed"]] = run["metrics"]["test"]["psnr"]
    return found


def ranks(values: list[float]) -> list[int]:
    """1 for the highest."""
    return [1 + sum(other > value for other in values) for value in values]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, help="folders with a run.json")
    found = read_runs([folder for folder in parser.parse_args().runs if (folder / "run.json").exists()])
    numbers = load_numbers("main_sota + general_purpose")
    rows = []
    for row in load_table("main", "smoke").rows:
        place = {"views": "4", "metric": "psnr_db", **(row.paper or {})}
        theirs = [numbers.find(dataset=dataset, **place) for dataset in DATASETS]
        if row.method in found and None not in theirs:
            rows.append((row.label, statistics.mean(found[row.method].values()), *theirs))
            if found[row.method].keys() != (first := next(iter(found.values()))).keys():
                lacking = sorted(found[row.method].keys() ^ first.keys())
                print(f"{row.method} was not run on the same scenes and seeds: {lacking}", file=sys.stderr)
                return 1
    rows.sort(key=lambda row: row[1])
    columns = list(zip(*rows, strict=True))[1:]
    print(f"| method | ours | {' | '.join(DATASETS)} |\n| --- | --- | --- | --- |")
    for (label, *values), places in zip(rows, zip(*map(ranks, columns), strict=True), strict=True):
        cells = [f"{value:.2f} ({place})" for value, place in zip(values, places, strict=True)]
        print(f"| {label} | {' | '.join(cells)} |")
    for i, j in ((0, 1), (0, 2), (1, 2)):
        names = ("ours", *DATASETS)
        print(f"Kendall's tau, {names[i]} and {names[j]}: {kendalltau(columns[i], columns[j]).statistic:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
