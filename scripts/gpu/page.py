"""The results as one Markdown page: `python scripts/gpu/page.py RESULTS.json [...] > docs/gpu.md`."""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path

GOOD = ("ok", "skipped")
PARTS = Path(__file__).with_name("parts")


def render(results: dict) -> str:
    """The page of one results.json."""
    machine = results.get("machine", {})
    where = machine.get("card") or (
        "a dry run on the CPU" if results["device"] == "cpu" else "no card was seen"
    )
    lines = [f"## {where}", ""]
    versions = ", ".join(f"{k} {v}" for k, v in machine.items() if k not in ("card", "error"))
    lines += [versions + ("; smallest sizes" if results.get("tiny") else ""), ""]
    lines += [f"- {note}" for note in [machine.get("error"), *results.get("notes", [])] if note]
    lines += [f"- {package}: {note}" for package, note in results.get("compiled", {}).items()]
    lines.append("")
    for part, found in results["parts"].items():
        lines += [f"### {part}", "", _about(part), ""]
        lines += _table(found.get("cases", {}))
        if "note" in found:
            lines += [found["note"], ""]
    return "\n".join(lines) + "\n"


def count_bad(results: dict) -> int:
    """Cases that failed, differ, died or were ended, and parts that did not start."""
    rows = [row for found in results["parts"].values() for row in found.get("cases", {}).values()]
    unstarted = [found for found in results["parts"].values() if "does not start" in found.get("note", "")]
    return sum(row["status"] not in GOOD for row in rows) + len(unstarted)


def _about(part: str) -> str:
    """The docstring of the part's file."""
    file = PARTS / f"{part}.py"
    return ast.get_docstring(ast.parse(file.read_text())) or "" if file.exists() else ""


def _table(cases: dict[str, dict]) -> list[str]:
    if not cases:
        return []
    columns = list(dict.fromkeys(key for row in cases.values() for key in row.get("values", {})))
    head = ["case", *columns, "s", "status"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    notes = []
    for name, row in cases.items():
        values = row.get("values", {})
        cells = [name, *(_show(values.get(c)) for c in columns), _show(row.get("seconds")), row["status"]]
        lines.append("| " + " | ".join(cells) + " |")
        if row.get("error"):
            notes.append(f"- {name}: {row['error']}".replace("\n", " "))
    return [*lines, "", *notes, *([""] if notes else [])]


def _show(value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value).replace("|", "\\|")


def main() -> None:
    texts = [render(json.loads(Path(name).read_text())) for name in sys.argv[1:]]
    frame = Path(__file__).with_name("page_frame.md").read_text()
    print(frame.replace("{cards}", "\n".join(texts).strip() or "No card has been seen yet."), end="")


if __name__ == "__main__":
    main()
