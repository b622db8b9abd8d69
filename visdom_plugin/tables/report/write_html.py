"""A table as one page that needs nothing else: table, scenes, spread, curves, pictures. No script, no network."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from visdom_plugin.tables.measures import MEASURES
from visdom_plugin.tables.report.labels import (
    describe_numbers,
    describe_runs,
    has_paper,
    heading,
    list_failures,
    mark_of,
    spell_cell,
    spell_paper,
)
from visdom_plugin.tables.report.layout import MEAN, Block, Layout, arrange, list_views, spell_views
from visdom_plugin.tables.report.page_style import STYLE
from visdom_plugin.tables.report.strips import ERROR_FULL, Strip, data_uri, read_strip
from visdom_plugin.tables.report.summary import Cell, SceneValue, Summary
from visdom_plugin.tables.report.svg_figures import (
    Dots,
    average_curves,
    draw_curves,
    draw_spread,
    read_curve,
    swatch,
)
from visdom_plugin.tables.results import Job, Outcome
from visdom_plugin.tables.spec import TableSpec

HEIGHT_PX, MANY_HEIGHT_PX = 160, 96
"""Height of pictures, and where there are many of them."""
MANY = 30
OPEN = 4
"""More places (column and number of views) than this, and their details start closed."""


def to_html(spec: TableSpec, summary: Summary) -> str:
    """The page."""
    title = escape(heading(spec))
    body = [f"<h1>{title}</h1>"]
    body += [_table(spec, summary, block) for block in arrange(spec)]
    body.append(_footer(spec, summary))
    places = [(c, v) for c in range(len(spec.columns)) for v in list_views(spec, c) if v != MEAN]
    strips = len(places) * len(spec.rows)
    for c, views in places:
        body.append(_place(spec, summary, c, views, len(places) <= OPEN, strips > MANY))
    head = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n"
    )
    return head + "<body>\n" + "\n".join(body) + "\n</body>\n</html>\n"


def _table(spec: TableSpec, summary: Summary, block: Block) -> str:
    paper = any(has_paper(summary, h.column, h.views, h.measure) for h in block.heads)
    heads = "".join(f'<th scope="col">{escape(h.title)}</th>' for h in block.heads)
    lines = [
        f"<caption>{escape(block.title)}</caption>",
        f"<thead><tr><th></th>{heads}</tr></thead>",
        "<tbody>",
    ]
    for r, row in enumerate(spec.rows):
        if row.group and (r == 0 or spec.rows[r - 1].group != row.group):
            wide = 1 + len(block.heads)
            lines.append(
                f'<tr class="group"><th colspan="{wide}" scope="colgroup">{escape(row.group)}</th></tr>'
            )
        cells = [summary.cell(r, h.column, h.views, h.measure) for h in block.heads]
        words = "".join(_cell(cell, summary.layout, paper) for cell in cells)
        lines.append(f'<tr><th scope="row">{escape(row.label)}</th>{words}</tr>')
    return _scrolling([*lines, "</tbody>"])


def _cell(cell: Cell, layout: Layout, paper: bool) -> str:
    number, _, spread = spell_cell(cell).partition(" ± ")
    mark = mark_of(cell, layout)
    kind = mark or ("" if cell.whole else "partial" if cell.n else "absent")
    text = f"<strong>{escape(number)}</strong>" if mark == "best" else escape(number)
    if spread:
        text += f' <span class="spread">±&nbsp;{escape(spread)}</span>'
    if paper:
        text += f'<br><span class="beside">{escape(spell_paper(cell)) or "&nbsp;"}</span>'
    return f'<td class="{kind}">{text}</td>' if kind else f"<td>{text}</td>"


def _footer(spec: TableSpec, summary: Summary) -> str:
    lines = [f"<p>{escape(' '.join(describe_numbers(spec, summary)))}</p>"]
    lines.append(f"<p>{escape(describe_runs(spec, summary))}</p>")
    if spec.notes:
        notes = "".join(f"<li>{escape(note)}</li>" for note in spec.notes)
        lines.append(f"<h2>Notes</h2><ul>{notes}</ul>")
    failures = list_failures(spec, summary)
    if failures:
        lines.append("<h2>Failed</h2>")
        lines += [f"<p>{escape(place)}</p><pre>{escape(error)}</pre>" for place, error in failures]
    return "\n".join(lines)


def _place(spec: TableSpec, summary: Summary, c: int, views: int, unfolded: bool, many: bool) -> str:
    """Everything behind one column and number of views."""
    parts = [_side([_spread(spec, summary, c, views, m) for m in spec.metrics])]
    if summary.layout.pictures:
        jobs = [(j, o) for j, o in summary.outcomes if (j.column, j.views) == (c, views)]
        parts.append(_curves(spec, jobs))
        parts.append(_pictures(spec, c, jobs, MANY_HEIGHT_PX if many else HEIGHT_PX))
    if len(spec.columns[c].scenes) * len(spec.seeds) > 1:
        parts.append(_side([_scenes(spec, summary, c, views, m) for m in spec.metrics]))
    title = escape(f"{spec.columns[c].label}, {spell_views(views)}")
    inner = "\n".join(part for part in parts if part)
    if not inner:
        return ""
    state = " open" if unfolded else ""
    return f"<details{state}>\n<summary><h2>{title}</h2></summary>\n{inner}\n</details>"


def _spread(spec: TableSpec, summary: Summary, c: int, views: int, measure: str) -> str:
    rows = []
    for r, row in enumerate(spec.rows):
        cell = summary.cell(r, c, views, measure)
        if cell.mean is not None:
            rows.append(Dots(row.label, tuple(value for _, value in cell.seeds), cell.mean, cell.paper))
    if not rows:
        return ""
    paper = ", paper (diamond)" if any(dots.paper is not None for dots in rows) else ""
    title = f"{MEASURES[measure].title}: seeds (dots), mean (bar){paper}"
    return _figure(title, draw_spread(rows, MEASURES[measure]))


def _curves(spec: TableSpec, jobs: list[tuple[Job, Outcome]]) -> str:
    series, legend = [], []
    for r, row in enumerate(spec.rows):
        found = [read_curve(job.run_dir) for job, _ in _finished(jobs, r)]
        found = [curve for curve in found if curve is not None]
        if found:
            series.append((r, row.label, average_curves(found)))
            legend.append(f"<span>{swatch(r)} {escape(row.label)}</span>")
    if not series:
        return ""
    legend = f'<div class="legend">{"".join(legend)}</div>'
    title = "PSNR of training views over the share of each method's schedule; mean over scenes and seeds"
    return _figure(title, draw_curves(series) + legend)


def _pictures(spec: TableSpec, c: int, jobs: list[tuple[Job, Outcome]], height_px: int) -> str:
    """A strip per row, of the first scene and seed that any row has."""
    order = {scene: i for i, scene in enumerate(spec.columns[c].scenes)}
    lines = []
    for r, row in enumerate(spec.rows):
        done = sorted(
            _finished(jobs, r), key=lambda pair: (order.get(pair[0].scene, len(order)), pair[0].seed)
        )
        for job, outcome in done[:1]:
            strip = read_strip(job.run_dir, outcome.record or {}, height_px)
            if strip is not None:
                lines.append(_strip(row.label, job, strip))
    if not lines:
        return ""
    title = (
        f"A test view: truth, render, error (mean difference over channels, black 0, bright {ERROR_FULL:g})"
    )
    return _figure(title, '<div class="strips">' + "\n".join(lines) + "</div>")


def _strip(label: str, job: Job, strip: Strip) -> str:
    said = f"{job.scene}, seed {job.seed}, view {strip.view}"
    if strip.psnr is not None:
        said += f", {strip.psnr:.2f} dB"
    pictures = "".join(
        f'<img src="{data_uri(png)}" alt="{escape(what)} of {escape(strip.view)}, {escape(label)}">'
        for what, png in (("truth", strip.truth), ("render", strip.render), ("error", strip.error))
    )
    return f'<div class="strip">{pictures}<p><b>{escape(label)}</b> {escape(said)}</p></div>'


def _scenes(spec: TableSpec, summary: Summary, c: int, views: int, measure: str) -> str:
    """Rows by scenes: the mean over seeds, and each seed's value where there are several."""
    values: dict[tuple[int, str], list[SceneValue]] = {}
    for v in summary.scenes:
        if (v.column, v.views, v.measure) == (c, views, measure):
            values.setdefault((v.row, v.scene), []).append(v)
    if all(v.value is None for found in values.values() for v in found):
        return ""
    scenes = spec.columns[c].scenes
    heads = "".join(f'<th scope="col">{escape(scene)}</th>' for scene in scenes)
    lines = [
        f"<caption>{escape(MEASURES[measure].title)} per scene, every seed below its mean</caption>",
        f"<thead><tr><th></th>{heads}</tr></thead>",
        "<tbody>",
    ]
    for r, row in enumerate(spec.rows):
        words = "".join(f"<td>{_scene_cell(values.get((r, scene), []), measure)}</td>" for scene in scenes)
        lines.append(f'<tr><th scope="row">{escape(row.label)}</th>{words}</tr>')
    return _scrolling([*lines, "</tbody>"])


def _scene_cell(found: list[SceneValue], measure: str) -> str:
    spell = MEASURES[measure].spell
    numbers = [v.value for v in found if v.value is not None]
    if not numbers:
        return escape(found[0].status.replace("waiting", "not run")) if found else ""
    text = escape(spell(sum(numbers) / len(numbers)))
    if len(found) > 1:
        each = [spell(v.value) if v.value is not None else v.status for v in found]
        text += f'<br><span class="beside">{escape(", ".join(each))}</span>'
    return text


def _finished(jobs: list[tuple[Job, Outcome]], row: int) -> Iterator[tuple[Job, Outcome]]:
    for job, outcome in jobs:
        if job.row == row and outcome.status == "finished" and job.run_dir is not None:
            yield job, outcome


def _figure(title: str, content: str) -> str:
    return f"<figure>\n<figcaption>{escape(title)}</figcaption>\n{content}\n</figure>"


def _side(parts: list[str]) -> str:
    parts = [part for part in parts if part]
    return '<div class="side">\n' + "\n".join(parts) + "\n</div>" if parts else ""


def _scrolling(lines: list[str]) -> str:
    return '<div class="wide"><table>\n' + "\n".join(lines) + "\n</table></div>"
