"""What the writers make of a table: numbers come back as they were, files are well-formed, words are escaped."""

import csv
import io
import json
import re
import shutil
import subprocess
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.tables.report.made_up import STATUSES, make_record, make_results, make_spec, tables
from visdom_plugin.figures.contact_sheet import SHEET_ROWS, SHEET_WIDTH_PX, cut_sheet, draw_sheet, write_png
from visdom_plugin.tables.measures import MEASURES
from visdom_plugin.tables.report import svg_figures
from visdom_plugin.tables.report.labels import spell_cell, spell_paper
from visdom_plugin.tables.report.layout import WIDE, arrange, list_views
from visdom_plugin.tables.report.strips import ERROR_FULL, read_strip
from visdom_plugin.tables.report.summary import summarise
from visdom_plugin.tables.report.write import write_all
from visdom_plugin.tables.report.write_html import HEIGHT_PX, to_html
from visdom_plugin.tables.report.write_text import _TEX, to_csv, to_latex, to_markdown, to_scene_csv
from visdom_plugin.tables.results import Job, Outcome, Results

HOSTILE = r"<script>alert('x')</script> & 50% of $5 _under_ #1 {a} \b ~ ^ | `c` *d* [e] " "q" " ü"
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Checks that tags are closed in order and gathers addresses, texts and tags."""

    def __init__(self, text):
        super().__init__()
        self.open, self.addresses, self.texts, self.tags = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self.addresses += [v for k, v in attributes if k in ("src", "href", "xlink:href", "action", "data")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"{tag} closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))


def both(results):
    return results.spec, summarise(results)


@settings(max_examples=20, deadline=None)
@given(tables())
def test_numbers_come_back_from_csv_with_every_digit(results):
    spec, summary = both(results)
    lines = list(csv.DictReader(io.StringIO(to_csv(spec, summary))))
    assert len(lines) == len(summary.cells)
    for line, cell in zip(lines, summary.cells, strict=True):
        for name in ("mean", "std", "paper", "difference"):
            assert (float(line[name]) if line[name] else None) == getattr(cell, name)
        assert (int(line["n"]), int(line["of"]), line["status"]) == (cell.n, cell.of, cell.status)
        assert line["rank"] == ("" if cell.rank is None else str(cell.rank))
        place = (spec.rows[cell.row].label, spec.columns[cell.column].label, str(cell.views), cell.measure)
        assert (line["row"], line["column"], line["views"], line["metric"]) == place


def test_scene_lines_say_what_each_job_gave(tmp_path):
    spec = make_spec()
    results = make_results(spec, statuses=STATUSES, folder=tmp_path / "runs")
    lines = list(csv.DictReader(io.StringIO(to_scene_csv(*both(results), tmp_path))))
    assert len(lines) == len(results.outcomes) * len(spec.metrics)
    by_place = {(x["row"], x["column"], x["scene"], x["views"], x["seed"], x["metric"]): x for x in lines}
    for job, outcome in results.outcomes.items():
        place = (spec.rows[job.row].label, spec.columns[job.column].label, job.scene, str(job.views))
        line = by_place[(*place, str(job.seed), "ssim")]
        expected = outcome.record["metrics"]["test"]["ssim"] if outcome.record else None
        assert (float(line["value"]) if line["value"] else None) == expected
        assert line["status"] == outcome.status and line["error"] == (outcome.error or "")
        assert line["run"] == f"runs/{job.run_dir.name}"


@settings(max_examples=15, deadline=None)
@given(tables(), st.text(max_size=12) | st.just("a\r\n\x00b"))
def test_files_do_not_break_on_what_users_type(results, typed):
    spec = results.spec
    rows = (replace(spec.rows[0], label=HOSTILE + typed, group=typed), *spec.rows[1:])
    columns = (replace(spec.columns[0], label=typed + HOSTILE), *spec.columns[1:])
    results = Results(
        replace(spec, rows=rows, columns=columns, title=HOSTILE, notes=(HOSTILE,)), results.outcomes
    )
    spec, summary = both(results)
    check_latex(to_latex(spec, summary))
    check_markdown(to_markdown(spec, summary))
    check_page(to_html(spec, summary))
    assert len(list(csv.reader(io.StringIO(to_csv(spec, summary))))) == 1 + len(summary.cells)


def check_latex(text):
    text = re.sub(r"^%.*\n", "", text)
    assert not re.search(r"(?<!\\)[#%^~]", text)
    plain = text.replace(r"\\", "\n")
    depth = 0
    for brace in re.findall(r"(?<!\\)[{}]", plain):
        depth += 1 if brace == "{" else -1
        assert depth >= 0
    assert depth == 0
    assert re.sub(r"\$(\\(pm|uparrow|downarrow)|-)\$", "", text).replace(r"\$", "").count("$") == 0
    stack = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+\*?)\}", text):
        if kind == "begin":
            stack.append(name)
        else:
            assert stack.pop() == name
    assert stack == []
    for columns, body in re.findall(r"\\begin\{tabular\}\{([lr]+)\}(.*?)\\end\{tabular\}", text, re.S):
        for line in body.split(r"\\")[1:-1]:
            width = sum(int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line))
            assert len(re.findall(r"(?<!\\)&", line)) + width == len(columns) - 1, line


def check_markdown(text):
    table = []
    for line in [*text.split("\n"), ""]:
        if line.startswith("|"):
            table.append(len(re.findall(r"(?<!\\)\|", line)))
        elif table:
            assert len(set(table)) == 1 and len(table) > 2
            table = []


def check_page(text):
    page = Page(text)
    assert all(address.startswith(("data:image/png;base64,", "#")) for address in page.addresses)
    assert "script" not in {tag for tag, _ in page.tags}
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    style = "".join(data for tag, data in page.texts if tag == "style")
    assert "url(" not in style and "@import" not in style
    return page


def test_hostile_words_arrive_as_they_were():
    spec = replace(make_spec(rows=[HOSTILE, "other"]), title=HOSTILE, notes=(HOSTILE,))
    spec, summary = both(make_results(spec))
    page = check_page(to_html(spec, summary))
    texts = [(tag, data) for tag, data in page.texts if data == HOSTILE]
    assert {"th", "h1", "title", "li"} <= {tag for tag, _ in texts}
    escaped = "".join(_TEX.get(c, c) for c in HOSTILE)
    assert escaped in to_latex(spec, summary)
    back = escaped
    for plain, tex in sorted(_TEX.items(), key=lambda pair: -len(pair[1])):
        back = back.replace(tex, f"\0{ord(plain)}\0")
    assert re.sub("\0(\\d+)\0", lambda m: chr(int(m[1])), back) == HOSTILE
    label = next(x for x in to_markdown(spec, summary).split("\n") if "script" in x and x.startswith("| "))
    assert re.sub(r"\\(.)", r"\1", label).startswith(f"| {HOSTILE.replace(chr(92), '')} |"[:20])


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles_it(tmp_path):
    rows = [HOSTILE, "\N{MINUS SIGN}0.5 or -0.5, not a-0", "third"]
    spec = replace(make_spec(rows=rows, columns=3), title=HOSTILE, notes=(HOSTILE,))
    table = to_latex(*both(make_results(spec, statuses=STATUSES)))
    assert "$-$0.5 or $-$0.5, not a-0" in table
    head = r"\documentclass{article}\usepackage[T1]{fontenc}\usepackage{booktabs}\begin{document}"
    (tmp_path / "page.tex").write_text(head + "\n" + table + r"\end{document}", encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "page.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stdout.decode(errors="replace")[-2000:]
    assert (tmp_path / "page.pdf").stat().st_size > 10_000


@settings(max_examples=15, deadline=None)
@given(tables())
def test_every_writer_prints_every_number(results):
    spec, summary = both(results)
    texts = [
        to_markdown(spec, summary),
        to_latex(spec, summary).replace(r"$\pm$", "±").replace("$-$", "-"),
        to_html(spec, summary),
    ]
    for cell in summary.cells:
        number = spell_cell(cell).partition(" ± ")[0]
        assert all(number in text for text in texts)
        assert all(spell_paper(cell) in text for text in texts)


@settings(max_examples=20, deadline=None)
@given(tables())
def test_blocks_hold_every_cell_once(results):
    spec, summary = both(results)
    heads = [(h.column, h.views, h.measure) for block in arrange(spec) for h in block.heads]
    assert len(heads) == len(set(heads))
    assert set(heads) == {(c.column, c.views, c.measure) for c in summary.cells}
    assert all(
        len(block.heads) <= max(WIDE, len(list_views(spec, block.heads[0].column))) for block in arrange(spec)
    )


def test_best_and_second_best_stand_out():
    spec = make_spec(rows=4, columns=1, scenes=1, views=(4,), seeds=(0,), metrics=("psnr",), paper=None)
    values = [20.0, 30.0, 25.0, 26.0]
    outcomes = {
        Job(r, 0, "scene00", 4, 0): Outcome("finished", make_record({"psnr": v}))
        for r, v in enumerate(values)
    }
    outcomes[Job(3, 0, "scene00", 4, 0)] = Outcome("failed", None, "broke")
    spec, summary = both(Results(spec, outcomes))
    assert re.findall(r"\*\*(.*?)\*\*", to_markdown(spec, summary)) == ["30.00"]
    assert re.findall(r"\b_([\d.]+)_\b", to_markdown(spec, summary)) == ["25.00"]
    assert re.findall(r"\\textbf\{(.*?)\}", to_latex(spec, summary)) == ["30.00"]
    assert re.findall(r"\\underline\{(.*?)\}", to_latex(spec, summary)) == ["25.00"]
    assert re.findall(r'<td class="(best|second)">(?:<strong>)?([\d.]+)', to_html(spec, summary)) == [
        ("best", "30.00"),
        ("second", "25.00"),
    ]


def test_cells_say_how_many_runs_they_lack_and_why():
    spec = make_spec(rows=3, columns=1, scenes=1, views=(4,), seeds=(0, 1), metrics=("psnr",))
    done = Outcome("finished", make_record({"psnr": 20.0}))
    fates = [
        [done, Outcome("failed", None, "no <hull>")],
        [Outcome("not available")] * 2,
        [Outcome("failed")] * 2,
    ]
    outcomes = {
        Job(r, 0, "scene00", 4, seed): fate for r, pair in enumerate(fates) for seed, fate in enumerate(pair)
    }
    spec, summary = both(Results(spec, outcomes))
    assert [spell_cell(c) for c in summary.cells] == ["20.00 (1 of 2)", "not available", "failed (0 of 2)"]
    assert spell_paper(summary.cells[1]) == "24.10"
    assert "no &lt;hull&gt;" in to_html(spec, summary) and r"no \<hull\>" in to_markdown(spec, summary)


def test_write_all_leaves_whole_files_or_none(tmp_path):
    results = make_results(make_spec(), statuses=STATUSES)
    written = write_all(results, tmp_path / "out")
    names = {"table.md", "table.csv", "table_scenes.csv", "table.tex", "table.html"}
    assert {p.name for p in written} == names == {p.name for p in (tmp_path / "out").iterdir()}
    first = {p.name: p.read_bytes() for p in written}
    shuffled = dict(reversed(list(results.outcomes.items())))
    again = write_all(replace(results, outcomes=shuffled), tmp_path / "out")
    assert {p.name: p.read_bytes() for p in again} == first
    with pytest.raises(Exception, match="psrn"):
        write_all(replace(results, spec=replace(results.spec, metrics=("psrn",))), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def make_run(folder, sizes, rng):
    """A run directory with pictures and a log; returns its record and the pictures' (truth, render) pairs."""
    names = [f"view{i}.png" for i in range(len(sizes))]
    pairs = [[rng.integers(0, 256, (h, w, 3), dtype=np.uint8) for _ in range(2)] for h, w in sizes]
    columns = [(name, [*pair, pair[0]]) for name, pair in zip(names, pairs, strict=True)]
    for name, (_, render) in zip(names, pairs, strict=True):
        write_png(folder / "renders" / "test" / name, render)
    write_png(folder / "renders" / "test_sheet.png", draw_sheet(columns, SHEET_ROWS))
    rows = [{"step": s, "psnr": 10 + s / 10 if s % 20 == 0 else None} for s in range(10, 101, 10)]
    (folder / "log.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows) + "{cut sho")
    per_view = {name: {"psnr": 20.0 + i} for i, name in enumerate(names)}
    record = make_record({"psnr": 20.0, "ssim": 0.9}, data={"test": names})
    record["metrics"]["per_view"] = per_view
    return record, pairs


@pytest.mark.parametrize(
    "sizes", [[(40, 60)], [(300, 520), (400, 260), (130, 260), (260, 260)], [(700, 500)] * 3]
)
def test_pictures_cut_from_a_sheet_are_those_put_there(sizes):
    import cv2

    rng = np.random.default_rng(0)
    pairs = [[rng.integers(0, 256, (h, w, 3), dtype=np.uint8) for _ in range(3)] for h, w in sizes]
    sheet = draw_sheet([(f"{i}", pair) for i, pair in enumerate(pairs)], SHEET_ROWS)
    for c, pair in enumerate(pairs):
        for r, picture in enumerate(pair):
            h, w = picture.shape[:2]
            small = (SHEET_WIDTH_PX, round(h * SHEET_WIDTH_PX / w))
            way = cv2.INTER_AREA if w > SHEET_WIDTH_PX else cv2.INTER_NEAREST
            expected = cv2.resize(picture, small, interpolation=way)
            assert np.array_equal(cut_sheet(sheet, c, r, SHEET_ROWS, (h, w)), expected)


def test_strips_show_truth_render_and_their_difference(tmp_path):
    import cv2

    record, pairs = make_run(tmp_path, [(8, 260), (10, 260), (9, 260)], np.random.default_rng(1))
    strip = read_strip(tmp_path, record, HEIGHT_PX)
    assert strip.view == "view1.png" and strip.psnr == 21.0
    truth, render, error = (
        cv2.imdecode(np.frombuffer(p, np.uint8), 1) for p in (strip.truth, strip.render, strip.error)
    )
    assert np.array_equal(truth[..., ::-1], pairs[1][0]) and np.array_equal(render[..., ::-1], pairs[1][1])
    grey = np.abs(truth.astype(int) - render).mean(axis=2) / ERROR_FULL
    lut = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_INFERNO)[0].astype(int)
    nearest = np.abs(error[:, :, None].astype(int) - lut).sum(-1).argmin(-1)
    assert np.abs(nearest - grey.clip(0, 255)).max() <= 1
    small = read_strip(tmp_path, record, 5)
    assert [cv2.imdecode(np.frombuffer(p, np.uint8), 1).shape[:2] for p in (small.truth, small.error)] == [
        (5, 130)
    ] * 2


def test_missing_or_broken_pictures_leave_the_strip_out(tmp_path):
    record, _ = make_run(tmp_path, [(40, 60)], np.random.default_rng(2))
    assert read_strip(tmp_path / "nowhere", record, 99) is None
    assert read_strip(tmp_path, {"metrics": {}}, 99) is None
    for content in (b"no picture", b""):
        (tmp_path / "renders" / "test_sheet.png").write_bytes(content)
        assert read_strip(tmp_path, record, 99) is None


def test_the_page_holds_its_pictures_and_curves(tmp_path):
    spec = make_spec(rows=2, columns=1, scenes=1, views=(4,), seeds=(0,), paper=None)
    rng, outcomes = np.random.default_rng(3), {}
    for r in range(2):
        record, _ = make_run(tmp_path / str(r), [(40, 60)], rng)
        outcomes[Job(r, 0, "scene00", 4, 0, tmp_path / str(r))] = Outcome("finished", record)
    page = check_page(to_html(*both(Results(spec, outcomes))))
    assert sum(tag == "img" for tag, _ in page.tags) == 6
    assert sum("stroke-width: 2;" in dict(a).get("style", "") for _, a in page.tags) == 2
    tips = [data for tag, data in page.texts if tag == "title"]
    assert tips[1:] == ["row 0: 20.00", "row 1: 20.00", "row 0: 0.9000", "row 1: 0.9000", "row 0", "row 1"]
    bare = check_page(to_html(*both(Results(replace(spec, layout={"pictures": False}), outcomes))))
    assert "img" not in {tag for tag, _ in bare.tags} and "row 0" not in [
        data for tag, data in bare.texts if tag == "title"
    ]


def test_curves_are_read_from_whole_lines(tmp_path):
    make_run(tmp_path, [(10, 10)], np.random.default_rng(4))
    curve = svg_figures.read_curve(tmp_path)
    assert np.allclose(curve[:, 0], [0.2, 0.4, 0.6, 0.8, 1.0]) and np.allclose(
        curve[:, 1], 10 + 10 * curve[:, 0]
    )
    assert np.allclose(
        svg_figures.average_curves([curve, curve + np.array([0, 2])])[:, 1], 11 + 10 * np.linspace(0.2, 1, 40)
    )
    assert svg_figures.read_curve(tmp_path / "nowhere") is None


@settings(max_examples=30, deadline=None)
@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
@example(5e-324, -7.0)
@example(1e5, 1e5)
def test_dots_stand_within_their_figure_in_order(a, b):
    svg = svg_figures.draw_spread((svg_figures.Dots("x", (a, b), (a + b) / 2, None),), MEASURES["psnr"])
    assert "nan" not in svg and "inf" not in svg
    width, left = svg_figures._WIDTH, 180
    at = [float(x) for x in re.findall(r'<use [^>]*?x="([-\d.]+)"[^>]*fill: #2c7fc9', svg)]
    assert len(at) == 2 and all(left <= x <= width - 24 for x in at)
    assert (at[0] <= at[1]) == (a <= b) or at[0] == at[1]


def test_tooltips_and_labels_are_the_users_words():
    rows = (svg_figures.Dots(f"{HOSTILE} Überall_写真 {'x' * 30}", (1.0,), 1.0, 2.0),)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        page = Page(svg_figures.draw_spread(rows, MEASURES["psnr"]))
    tips = [data for tag, data in page.texts if tag == "title"]
    assert tips == [f"{rows[0].label}: paper 2.00", f"{rows[0].label}: 1.00"]
    assert [data for tag, data in page.texts if tag == "text"][-1] == rows[0].label[:21] + "…"


def test_figures_are_the_same_whatever_the_user_set_and_leave_it_alone():
    row = svg_figures.Dots("Überall", (1.0, 2.0), 1.5, None)
    draw = svg_figures.draw_spread.__wrapped__
    plain, sheet = draw((row,), MEASURES["psnr"]), draw_sheet([("a", [np.zeros((4, 4, 3), np.uint8)])], "r")
    own = {"font.size": 30, "axes.grid": True, "svg.hashsalt": None, "lines.linewidth": 9, "figure.dpi": 300}
    with matplotlib.rc_context(own):
        before = dict(matplotlib.rcParams)
        assert draw((row,), MEASURES["psnr"]) == plain
        assert (draw_sheet([("a", [np.zeros((4, 4, 3), np.uint8)])], "r") == sheet).all()
        assert dict(matplotlib.rcParams) == before
