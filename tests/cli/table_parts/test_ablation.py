"""visdom-table ablation: variants that differ in what they name, one figure, and scenes without test views."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.datamodules.layouts.prepared_writer import write_prepared
from tests.training import fake
from visdom_plugin import registry
from visdom_plugin.cli.commands import table
from visdom_plugin.cli.table_parts.ablation import NAMED, VARIANTS, AblationOptions, make_spec
from visdom_plugin.cli.table_parts.ablation_figure import draw_figure
from visdom_plugin.cli.table_parts.workshop import make_workshop
from visdom_plugin.errors import ConfigError
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.tables.results import Job, Outcome, Results
from visdom_plugin.tables.run.jobs import plan
from visdom_plugin.training.runs.config_io import as_plain, differences

LABELS = [label for label, *_ in VARIANTS]
WORDS = ["ablation", "method:fake", "--out", "t", "--set", "steps=3"]


@dataclass(frozen=True)
class HullConfig(fake.FakeConfig):
    """The fake method's settings with a hull."""

    hull: VisibleDomain = field(default_factory=lambda: VisibleDomain(resolution=16, k=2))


@pytest.fixture
def variants(fakes, monkeypatch):
    """A registry of the fake method with variants."""
    known = registry.Registry()
    presets = [fake.PRESET, replace(fake.PRESET, name="fake+mask", quick=fake.FakeConfig(lr=0.1))]
    presets.append(replace(fake.PRESET, name="fake+vd", quick=HullConfig(lr=0.2)))
    known.add([*presets, replace(fake.PRESET, name="lonely")], "tests")
    monkeypatch.setattr(registry, "installed", lambda: known)
    # The default hull is as fine for a fake as for anybody.
    monkeypatch.setattr("visdom_plugin.training.run.carve_reference", lambda views: None)
    return fakes


def _resolved(method: str, **options):
    given = AblationOptions(table="ablation", budget="quick", device="cpu", **options)
    spec = make_spec(method, given)
    made = plan(spec, Path("runs"), make_workshop(given.device))
    settings = {}
    for job in made.jobs:
        settings[spec.rows[job.row].label] = made.tasks[job.run_dir].content
    return spec, settings


@pytest.mark.parametrize("method", ["ingp", "3dgs-go", "zipnerf", "corgs"])
def test_variants_differ_in_what_they_name_and_in_nothing_else(method):
    spec, content = _resolved(method, seeds=(7,), views=(6,))
    assert [row.label for row in spec.rows] == LABELS == list(content)
    for label in LABELS:
        same = {k: v for k, v in content[label].items() if k not in ("method", "settings")}
        assert same == {k: v for k, v in content["+vd"].items() if k not in ("method", "settings")}
        assert (same["seed"], same["views"], same["budget"]) == (7, 6, "quick")
    domain = as_plain(content["+vd"]["settings"])
    assert domain["hull"]["kind"] == "visdom" and domain["vd"]["enabled"]
    for label, kind in (("+unit sphere", "unit-sphere"), ("+traditional hull", "traditional")):
        found = differences(domain, content[label]["settings"])
        assert found == [f"hull.kind: visdom -> {kind}"], found
    for label in ("vanilla", "+mask"):
        assert not content[label]["settings"]["vd"]["enabled"]
    assert content["vanilla"]["settings"]["mask_weight"] < content["+mask"]["settings"]["mask_weight"]
    assert len({s["settings"]["steps"] for s in content.values()}) == 1
    # What --set cannot give is what the labels speak of: the kind of hull, the hook and the mask loss.
    for name in NAMED:
        assert len({value for c in content.values() for value in _values(c["settings"], name)}) > 1, name
    hooks = [c["settings"]["vd"] for c in content.values()]
    assert {line.partition(":")[0] for h in hooks for line in differences(h, hooks[-1])} == {"enabled"}


def _values(settings, path):
    for name in path.split("."):
        settings = None if settings is None else settings[name]
    return [] if settings is None else [settings]


def test_settings_given_once_hold_for_all_variants():
    spec, content = _resolved("ingp", set=("steps=9", "hull.resolution=40"))
    assert {s["settings"]["steps"] for s in content.values()} == {9}
    assert content["vanilla"]["settings"]["hull"] is None
    assert all(content[label]["settings"]["hull"]["resolution"] == 40 for label in LABELS[2:])
    for wrong in ("steps", "=3", "steps="):
        with pytest.raises(ConfigError, match="PATH=VALUE"):
            make_spec("ingp", AblationOptions(set=(wrong,)))
    assert spec.name == "ablation-ingp"


@pytest.mark.parametrize(
    "word",
    [
        "hull.kind=visdom",
        "vd.enabled=false",
        "mask_weight=0.2",
        "hull=null",
        "hull={k: 2, kind: traditional}",
    ],
)
def test_what_a_variants_label_says_cannot_be_set(word):
    with pytest.raises(ConfigError, match="the variants differ in") as caught:
        make_spec("ingp", AblationOptions(set=("steps=9", word)))
    assert word in str(caught.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["k_ablation", "method:fake", "--views", "4"], "not with 'k_ablation'"),
        (["ablation:smoke", "method:fake"], "not with 'ablation:smoke'"),
        (["--quiet", "t.yaml", "method:fake"], "not with 't.yaml'"),
        (["ablation", "--edition", "smoke"], "no editions"),
        (["ablation", "method:fake", "--only", "vd"], "rows: vanilla, +mask"),
        (["ablation", "method:fake", "--only", "vd", "--leave-one-out"], "rows: vanilla, +mask"),
        (["ablation", "method:fake", "--downscale", "0"], "1 or more"),
        (["ablation", "method:fake", "--views", "0"], "1 or more"),
        (["ablation", "method:fake", "--runs", "t.yaml", "--leave-one-out"], "t.yaml"),
    ],
)
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_other_tables_editions_rows_and_scales_are_refused(variants, words, said, dry, capsys):
    Path("t.yaml").write_text("a file")
    assert table.main([*words, *(dry if "--leave-one-out" not in words else [])]) == 2
    assert said in capsys.readouterr().err
    assert [p.name for p in Path().iterdir()] == ["t.yaml"]


def test_the_figure_is_of_the_runs_that_were_made(variants, monkeypatch):
    """Another look at the scene could name other runs, where something has changed in its folder meanwhile."""
    from visdom_plugin.tables.run import jobs

    def plan_once(*given, **named):
        monkeypatch.setattr(jobs, "plan", None)
        return plan(*given, **named)

    monkeypatch.setattr(jobs, "plan", plan_once)
    assert table.main([*WORDS, "--views", "4", "--downscale", "2", "--quiet", "--only", "vanilla"]) == 0
    figure = cv2.imread("t/ablation.png")
    height = (figure.shape[0] - 24) // 6
    left = figure[24 + height + 40 : 24 + 2 * height - 40, 200:380].reshape(-1, 3)
    assert (left == 200).all(1).mean() < 0.5
    assert {keywords["downscale"] for _, keywords in variants} == {2.0}


def test_a_method_without_variants_is_refused_with_those_that_have_them(variants, capsys):
    assert table.main(["ablation", "method:lonely"]) == 2
    said = capsys.readouterr().err
    assert "no variant lonely+mask and lonely+vd" in said and "choose one of: method:fake" in said
    assert table.main(["ablation", "method:fake", "method:lonely"]) == 2


def test_one_command_makes_table_and_figure_and_the_next_reuses_them(variants, capsys):
    assert table.main([*WORDS, "--views", "4"]) == 0
    said = capsys.readouterr()
    assert "Paired ablation of fake" in said.out and "figure: t/ablation.png" in said.err
    for name in ("table.md", "table.csv", "table.tex", "table.html"):
        assert Path("t", name).stat().st_size > 100
    runs = [json.loads(p.read_text()) for p in Path("t/runs").glob("*/run.json")]
    assert len(runs) == 5 and {r["seed"] for r in runs} == {0}
    assert len({r["data"]["hashes"]["train_views"] for r in runs}) == 1
    figure = cv2.imread("t/ablation.png")
    assert figure.shape[0] > 6 * 200 and figure.shape[1] > 4 * 250
    before = {p: p.stat().st_mtime_ns for p in Path("t/runs").glob("*/run.json")}
    assert table.main(["--out", "t", "--quiet", "method:fake", "ablation", "--set", "steps=3"]) == 0
    assert capsys.readouterr() == ("", "")
    assert before == {p: p.stat().st_mtime_ns for p in before}
    assert np.array_equal(figure, cv2.imread("t/ablation.png"))


def test_a_table_in_the_scenes_own_folder_finds_its_runs_again(variants, tmp_path, monkeypatch, capsys):
    write_prepared(fake.tiny_scene(), tmp_path / "mine")
    monkeypatch.chdir(tmp_path / "mine")
    words = ["ablation", "method:fake", "--data", ".", "--views", "4", "--set", "steps=3"]
    shown = []
    monkeypatch.setattr(
        "visdom_plugin.cli.table_parts.ablation_figure.draw_figure",
        lambda results, *others: (shown.append(results), draw_figure(results, *others))[1],
    )
    assert table.main(words) == 0
    assert [o.status for o in shown[0].outcomes.values()] == ["finished"] * 5
    made = sorted(Path().glob("tables/*/runs/*/run.json"))
    assert len(made) == 5
    capsys.readouterr()
    assert table.main([*words, "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:5]] == ["reuse"] * 5 and "0 of them" in lines[-1]


def _without_tests(monkeypatch):
    import datamodules

    scene = fake.tiny_scene()
    bare = replace(scene, test=scene.test.take([]))
    monkeypatch.setattr(datamodules, "load", lambda path, **keywords: bare, raising=False)
    return bare


def test_without_test_views_leave_one_out_is_pointed_at_and_works(variants, monkeypatch, capsys):
    scene = _without_tests(monkeypatch)
    assert table.main(WORDS) == 2
    assert "--leave-one-out" in capsys.readouterr().err and not Path("t").exists()
    assert table.main([*WORDS, "--leave-one-out", "--budget", "quick"]) == 0
    out = capsys.readouterr().out
    runs = [json.loads(p.read_text()) for p in Path("t/runs").glob("*/*/run.json")]
    assert len(runs) == 5 * len(scene.train)
    for label, method in (("vanilla", "fake"), ("+mask", "fake+mask")):
        psnr = [r["metrics"]["test"]["psnr"] for r in runs if r["method"] == method]
        assert len(psnr) == 4 and f"{sum(psnr) / 4:.2f}" in next(
            line for line in out.splitlines() if line.strip("| ").startswith(label)
        )
    assert {r["data"]["test"][0] for r in runs} == set(scene.train.names)
    assert cv2.imread("t/ablation.png").shape[0] > 6 * 200
    assert table.main([*WORDS, "--leave-one-out", "--workers", "2"]) == 2
    assert table.main([*WORDS, "--leave-one-out", "--quiet", "--budget", "quick", "--set", "steps=4"]) == 0
    assert len([*Path("t/runs").glob("*/*/run.json")]) == 10 * len(scene.train)


def test_the_figure_shows_renders_and_bars_of_the_numbers_and_grey_for_what_is_missing(tmp_path):
    spec, _ = _resolved("ingp")
    scene = fake.tiny_scene()
    renders = tmp_path / "renders" / "test"
    renders.mkdir(parents=True)
    colour = np.full((20, 24, 3), (0, 0, 250), np.uint8)
    for name in scene.test.names:
        cv2.imwrite(str(renders / name), colour)
    record = {"data": {"test": list(scene.test.names)}, "metrics": {"test": {"psnr": 20.0}}}
    outcomes = {}
    for i in range(len(LABELS)):
        done = Outcome("finished", record={**record, "metrics": {"test": {"psnr": 20.0 / (1 + i)}}})
        outcomes[Job(i, 0, "s", 4, 0, tmp_path)] = done if i < 2 else Outcome("failed", error="x")
    figure = draw_figure(Results(spec, outcomes), 4, scene.test, 2)
    rows = (figure.shape[0] - 24) // 6
    cell = [figure[24 + i * rows + 40 : 24 + i * rows + 180] for i in range(6)]
    red, grey = (250, 0, 0), (200, 200, 200)
    for i, seen in enumerate((None, red, red, grey, grey, grey)):
        left = cell[i][:, 200:380].reshape(-1, 3)
        assert seen is None or (left == seen).all(1).mean() > 0.9, i
    blue = [(c[:, -265:] == (76, 120, 168)).all(-1).any(0).sum() for c in cell]
    assert blue[1] > 200 and blue[2] == pytest.approx(blue[1] / 2, abs=3) and sum(blue[3:]) == 0
