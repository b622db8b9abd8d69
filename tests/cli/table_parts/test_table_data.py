"""What tables know of data before a run: each file that a job reads is in its name, and readings tell no lies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.layout_writers import join, write_colmap
from tests.datamodules.layouts.prepared_writer import write_prepared
from visdom_plugin.cli.commands import table
from visdom_plugin.cli.options import READING
from visdom_plugin.cli.table_parts.table_data import OWN, DataHasher, tidy_reading
from visdom_plugin.cli.table_parts.workshop import make_workshop
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.tables.run.jobs import plan
from visdom_plugin.tables.spec import parse_table


@pytest.fixture(scope="module")
def drawn():
    return make_scene(SyntheticConfig(size=(32, 24), test_views=2))


@pytest.fixture
def root(drawn, tmp_path, monkeypatch):
    """A folder of one scene; the working directory is beside it."""
    monkeypatch.chdir(tmp_path)
    write_prepared(drawn, tmp_path / "mine/thing")
    return tmp_path / "mine"


def _plan(root: Path, kind: str = "train", settings=None, **column):
    row = {"label": "A", "method": "hull" if kind == "hull" else "ingp+vd", "settings": settings or {}}
    column = {"label": "c", "root": "mine", "scenes": ["thing"], **column}
    spec = parse_table({"kind": kind, "rows": [row], "columns": [column], "budget": "quick"}, "t", "t.yaml")
    return plan(spec, Path("runs"), make_workshop("cpu"), {"mine": root})


def _run(*given, **column) -> str:
    (job,) = _plan(*given, **column).jobs
    return job.run_dir.name


def _touch(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\n")


def test_a_run_is_named_after_what_its_scenes_reader_opens(root):
    before = _run(root)
    for name in ("hull.ply", "mesh.ply", "table.md", "images/nobody.png", "runs/a/run.json", "runs/a/x.png"):
        (root / "thing" / name).parent.mkdir(parents=True, exist_ok=True)
        (root / "thing" / name).write_text("written later")
    assert _run(root) == before
    names = {before}
    read = ["images/train_000.png", "masks/test_001.png", "sparse_4.txt", "sparse/0/images.txt"]
    for count, name in enumerate(read, start=2):
        _touch(root / "thing" / name)
        names.add(_run(root))
        assert len(names) == count, name


def test_a_list_counts_by_what_it_holds_and_is_found_from_anywhere(root, tmp_path, monkeypatch):
    listed = tmp_path / "list.txt"
    listed.write_text("2 3 4 5")
    made = _plan(root, reading={"train_list": "list.txt"})
    ((run_dir, task),) = made.tasks.items()
    assert task.content["train_list"] == str(listed)
    monkeypatch.chdir(root)
    assert _run(root, reading={"train_list": str(listed)}) == run_dir.name
    listed.write_text("2 3 5 4")
    assert _run(root, reading={"train_list": str(listed)}) != run_dir.name


@pytest.mark.parametrize("train_list", ["2,3,4", "list.txt"])
def test_a_list_of_another_length_than_views_is_refused(root, tmp_path, train_list):
    (tmp_path / "list.txt").write_text("2 3 4")
    with pytest.raises(
        ConfigError, match=r"lists 3 training views, views says 4(.|\n)*column 'c'(.|\n)*views: 3"
    ):
        _plan(root, reading={"train_list": train_list})
    assert len(_plan(root, views=3, reading={"train_list": train_list}).jobs) == 1
    with pytest.raises(ConfigError, match="no view of this scene"):
        _plan(root, reading={"train_list": "2,3,4,nobody"})


def test_files_behind_links_count(drawn, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_colmap(join(drawn.train, drawn.test), tmp_path / "mine/thing")
    (tmp_path / "mine/thing/images").rename(tmp_path / "raw")
    (tmp_path / "mine/thing/images").symlink_to("../../raw", target_is_directory=True)
    before = _run(tmp_path / "mine", reading={"allow_outside": True})
    for path in (tmp_path / "raw").iterdir():
        _touch(path)
    assert _run(tmp_path / "mine", reading={"allow_outside": True}) != before


def test_the_true_surface_counts_where_it_is_measured_against(root, tmp_path):
    for place, settings in ((tmp_path, {"target": "mesh.ply"}), (root / "thing", {})):
        names = {_run(root, "hull", settings)}
        train = _run(root)
        for text in ("one", "two"):
            (place / "mesh.ply").write_text(text)
            names.add(_run(root, "hull", settings))
        assert len(names) == 3 and _run(root) == train


def test_a_scene_that_cannot_be_read_is_another_run_once_it_is_mended(root):
    (root / "thing/sparse").rename(root / "thing/parse")
    hasher = DataHasher()
    for _ in range(2):
        with pytest.raises(SceneError):
            hasher("train", root / "thing", {"views": 4, "downscale": 1.0}, None)
    broken = _run(root)
    (root / "thing/parse").rename(root / "thing/sparse")
    assert _run(root) != broken


@pytest.mark.parametrize(
    "name", [*OWN, "data", "show_config", "out", "overwrite", "quiet", "config", "mask_sorce"]
)
def test_a_reading_holds_only_how_a_scene_is_read(name, root):
    with pytest.raises(ConfigError, match=f"reading cannot hold '{name}'(.|\n)*column 'c' of t.yaml"):
        _plan(root, reading={name: True})


@pytest.mark.parametrize("views", [4, 5])
def test_a_dry_run_names_a_scene_that_cannot_be_read(root, capsys, views):
    Path("t.yaml").write_text(
        "rows: [{label: A, method: ingp+vd}]\n"
        f"columns: [{{label: c, root: mine, scenes: [thing], views: {views}}}]"
    )
    status = table.main(["t.yaml", "--root", "mine=mine", "--dry-run", "--device", "cpu"])
    listed, said = capsys.readouterr()
    assert status == (views == 5)
    assert listed.startswith("cannot run" if views == 5 else "run") and "1 job, 1 run, 1 of" in listed
    assert ("there is no sparse_5.txt" in said) == (views == 5)


def test_what_a_reading_may_hold_reaches_the_run():
    given = {
        "missing_masks": "hull",
        "mask_source": "alpha",
        "train_list": "0,1",
        "test_list": "2",
        "frame": 3,
        "masks": "outlines",
        "colmap_model": "sparse/1",
        "invert_masks": True,
        "mask_path": "foreground",
        "allow_outside": True,
        "split": "visdom",
    }
    assert tidy_reading(given, "here") == given and set(given) | set(OWN) == set(READING)
    with pytest.raises(ConfigError, match=r"reading\.frame cannot be 'first'"):
        tidy_reading({"frame": "first"}, "here")


def test_a_column_names_built_in_scenes(tmp_path, capsys):
    (tmp_path / "two.yaml").write_text(
        "name: two\nrows: [{label: a, method: ingp}]\ncolumns: [{label: drawn, scenes: [built-in, duck]}]\n"
    )
    words = [str(tmp_path / "two.yaml"), "--out", str(tmp_path / "out"), "--dry-run"]
    assert table.main(words) == 0
    said = capsys.readouterr().out
    assert "| built-in | 4 |" in said and "| duck | 4 |" in said and "2 runs" in said
    assert table.main([*words, "--data", "builtin:figure"]) == 0
    assert "| figure | 4 |" in capsys.readouterr().out
    (tmp_path / "two.yaml").write_text((tmp_path / "two.yaml").read_text().replace("duck", "kitchen"))
    assert table.main(words) == 2
    said = capsys.readouterr().err
    assert "there is no built-in scene 'builtin:kitchen'" in said and "without `root:`" in said
    assert "builtin:chair" in said and "two.yaml" in said


@pytest.mark.parametrize("kind", ["train", "hull"])
def test_a_k_above_the_number_of_views_is_refused_when_the_table_is_read(root, kind, monkeypatch):
    monkeypatch.setattr(DataHasher, "_look", lambda *_: pytest.fail("a scene was read"))
    with pytest.raises(ConfigError, match="K = 5 is more than the 4 views") as caught:
        _plan(root, kind, settings={"hull.k": 5}, views=[6, 4])
    assert str(caught.value.where) == "row 'A' and column 'c' of t.yaml"
    assert "hull.k" in caught.value.todo and "--only" in caught.value.todo
    monkeypatch.undo()
    for k in (4, "auto", "n-1"):
        (task,) = _plan(root, kind, settings={"hull.k": k}, views=[4]).tasks.values()
        assert not task.trouble


def test_rows_beside_one_with_too_large_a_k_run_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = [
        {"label": "all", "method": "ingp+vd", "settings": {"hull.k": 4}},
        {"label": "bare", "method": "ingp"},
    ]
    content = {"rows": rows, "columns": [{"label": "c", "views": [3]}], "budget": "quick"}
    Path("t.yaml").write_text(json.dumps(content))
    words = ["t.yaml", "--dry-run", "--device", "cpu"]
    assert table.main(words) == 2
    listed, said = capsys.readouterr()
    assert not listed and "row 'all' and column 'c' of t.yaml" in said and "K = 4 is more than the 3" in said
    assert table.main([*words, "--only", "bare"]) == 0
    assert not (tmp_path / "tables").exists()
