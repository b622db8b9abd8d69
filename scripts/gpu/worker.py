"""One part of the check in a process of its own: runs its cases one by one, each result a line of JSON.

`check.py` starts it, reads the lines, ends it when a case takes too long, and starts it again for the rest.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
import traceback
from pathlib import Path

from bench import Bench, Disagrees


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part")
    parser.add_argument("lines", type=Path)
    parser.add_argument("settings", type=json.loads)
    args = parser.parse_args()
    settings = args.settings
    with args.lines.open("a") as file:

        def say(**row) -> None:
            file.write(json.dumps(row) + "\n")
            file.flush()

        bench = Bench(settings)
        cases = importlib.import_module(f"parts.{args.part}").cases(bench)
        say(cases=[[case.name, case.limit, list(case.needs)] for case in cases])
        for case in cases:
            if case.name in settings["done"]:
                continue
            say(case=case.name, status="started")
            began = time.monotonic()
            result = run(case, bench)
            say(case=case.name, seconds=round(time.monotonic() - began, 2), **result)
            if "CUDA error" in result.get("error", "") or "AcceleratorError" in result.get("error", ""):
                # After such an error nothing works in this process any more.
                return


def run(case, bench: Bench) -> dict:
    """Status, values and error of one case."""
    try:
        values = case.run(bench) or {}
        bench.synchronise()
        return {"status": "ok", "values": values}
    except Disagrees as error:
        return {"status": "differs", "values": error.values, "error": str(error)}
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        return {"status": "failed", "error": f"{type(error).__name__}: {str(error)[:600]} ({place})"}


if __name__ == "__main__":
    sys.exit(main())
