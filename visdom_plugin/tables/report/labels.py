"""Words of cells, heads and footers, in plain text that every writer escapes in its own way."""

from __future__ import annotations

from dataclasses import replace

from visdom_plugin.tables.measures import MEASURES
from visdom_plugin.tables.paper import find_number, load_numbers
from visdom_plugin.tables.report.summary import Cell, Summary
from visdom_plugin.tables.spec import TableSpec

_WORDS = {"waiting": "not run"}


def spell_cell(cell: Cell) -> str:
    """Our number: "24.05 ± 0.12"; "24.05 (4 of 6)" where jobs are missing; else why there is none."""
    if cell.mean is None:
        why = _WORDS.get(cell.status, cell.status)
        return f"{why} (0 of {cell.of})" if cell.of > 1 and cell.status in ("failed", "running") else why
    measure = MEASURES[cell.measure]
    text = measure.spell(cell.mean)
    if not cell.whole:
        return f"{text} ({cell.n} of {cell.of})"
    return text if cell.std is None else f"{text} ± {measure.spell(cell.std)}"


def spell_paper(cell: Cell) -> str:
    """The paper's number with the difference to it: "24.10 (-0.05)"; empty where there is none."""
    if cell.paper is None:
        return ""
    measure = MEASURES[cell.measure]
    text = measure.spell(cell.paper)
    return text if cell.difference is None else f"{text} ({measure.spell(cell.difference, signed=True)})"


def heading(spec: TableSpec) -> str:
    """The table's title, with its edition."""
    title = spec.title or spec.name
    return f"{title} ({spec.edition} edition)" if spec.edition else title


def describe_numbers(spec: TableSpec, summary: Summary) -> list[str]:
    """How the numbers are to be read, a sentence each."""
    layout = summary.layout
    lines = ["Views are averaged per scene, then scenes, then seeds."]
    if any(c.std is not None for c in summary.cells):
        lines.append(f"± is the sample standard deviation over {len(spec.seeds)} seeds.")
    if layout.best != "none" and any(c.rank for c in summary.cells):
        among = "the rows of a group" if layout.best == "group" else "all rows"
        marks = "best and the second best" if layout.second else "best"
        verb = "are" if layout.second else "is"
        lines.append(f"The {marks} of {among} {verb} marked, among cells whose every run gave its number.")
    if any(c.paper is not None for c in summary.cells):
        lines.append("Beside ours: the paper's number, and ours minus the paper's in brackets.")
        lines += _compare_with_page(spec, summary)
    if any(not c.whole and c.n for c in summary.cells):
        lines.append('"n of m": the mean of the n runs that gave a number, of m.')
    if any(c.status == "not available" for c in summary.cells):
        lines.append("Not available: a method of the paper that does not exist here.")
    return lines


def describe_runs(spec: TableSpec, summary: Summary) -> str:
    """How many runs stand behind the table, and on what they ran."""
    counts: dict[str, int] = {}
    for _, outcome in summary.outcomes:
        counts[outcome.status] = counts.get(outcome.status, 0) + 1
    parts = [f"{n} {_WORDS.get(status, status)}" for status, n in sorted(counts.items())]
    records = [outcome.record for _, outcome in summary.outcomes if outcome.record]
    facts = {
        "budget": {str(r["budget"]) for r in records if r.get("budget") and spec.kind == "train"},
        "seeds": [", ".join(map(str, spec.seeds))],
        "device": {str(r.get("device")) for r in records if r.get("device")},
        "threads": {str(r.get("threads")) for r in records if r.get("threads")},
        "downscale": {f"{c.downscale:g}" for c in spec.columns},
    }
    said = [f"{name} {' and '.join(sorted(values))}" for name, values in facts.items() if values]
    return "Runs: " + ", ".join(parts or ["none"]) + "; " + "; ".join(said) + "."


def list_failures(spec: TableSpec, summary: Summary) -> list[tuple[str, str]]:
    """Where a job failed, and what it said; jobs with the same run directory once."""
    found, seen = [], set()
    for job, outcome in summary.outcomes:
        key = job.run_dir or job
        if outcome.status == "failed" and key not in seen:
            seen.add(key)
            row, column = spec.rows[job.row].label, spec.columns[job.column].label
            place = f"{row}, {column}, {job.scene}, {job.views} views, seed {job.seed}"
            found.append((place, outcome.error or "no message"))
    return found


def _compare_with_page(spec: TableSpec, summary: Summary) -> list[str]:
    """One sentence on numbers that the paper's project page prints otherwise; none where it prints the same."""
    numbers = load_numbers(spec.paper or "")
    page = replace(numbers, values=numbers.page)
    told = []
    for cell in summary.cells:
        row, column, measure = spec.rows[cell.row], spec.columns[cell.column], MEASURES[cell.measure]
        number = find_number(page, row.paper, column.paper, cell.views, measure.paper)
        if number is not None:
            place = f"{row.label}, {column.label}, {cell.views if cell.views == 'mean' else f'{cell.views} views'}"
            told.append(f"{place}: {measure.spell(number)}")
    return [f"The paper's project page prints other numbers: {'; '.join(told)}."] if told else []
