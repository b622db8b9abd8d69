from __future__ import annotations

import shutil

import pytest

from tests.tables.matrix import make, table, workshop
from visdom_plugin.cli.options import Common
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.jobs import WHOLE, hash_folder, plan


@pytest.fixture
def scenes(tmp_path):
    for scene in ("kitchen", "bonsai"):
        (tmp_path / "mip" / scene).mkdir(parents=True)
        (tmp_path / "mip" / scene / "poses.json").write_text(scene)
    return tmp_path / "mip"


def _real(**changes):
    column = {"label": "real", "root": "mip", "scenes": ["kitchen", "bonsai"], "views": [4, 6]} | changes
    return table(columns=[column])


def _run_dir(tmp_path, spec=None, roots=None, **changes):
    made = plan(spec or table(), tmp_path / "runs", workshop(**changes), roots)
    return next(iter(made.jobs)).run_dir


def test_jobs_are_rows_by_scenes_by_views_by_seeds_in_order(tmp_path, scenes):
    made = plan(_real(), tmp_path, workshop(), {"mip": scenes})
    found = [(j.row, j.column, j.scene, j.views, j.seed) for j in made.jobs]
    assert found == [
        (r, 0, s, v, n) for r in (0, 1) for s in ("kitchen", "bonsai") for v in (4, 6) for n in (0, 1)
    ]
    assert len(made.tasks) == len(made.jobs) and {o.status for o in made.jobs.values()} == {"waiting"}


def test_a_run_is_found_again_whatever_the_table_is_called_and_wherever_the_data_lie(tmp_path, scenes):
    first = _run_dir(tmp_path, _real(), {"mip": scenes})
    shutil.move(scenes, tmp_path / "elsewhere")
    renamed = _real(label="another")
    assert first == _run_dir(tmp_path, renamed, {"mip": tmp_path / "elsewhere"})
    assert _run_dir(tmp_path) == _run_dir(tmp_path, table(title="T", metrics=["ssim"], notes=["n"]))
    spelt_out = table([{"label": "A", "method": "one", "settings": {"steps": 3}}])
    assert _run_dir(tmp_path) == _run_dir(tmp_path, spelt_out)


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": {"rate": 0.2}},
        {"seeds": [1]},
        {"budget": "full"},
        {"columns": [{"label": "c", "views": 6}]},
        {"columns": [{"label": "c", "downscale": 2}]},
        {"columns": [{"label": "c", "reading": {"mask_source": "alpha"}}]},
        {"rows": [{"label": "One", "method": "two"}]},
    ],
)
def test_every_fact_of_a_run_is_in_its_name(tmp_path, changes):
    assert _run_dir(tmp_path) != _run_dir(tmp_path, table(**changes))


def test_changed_data_make_another_run(tmp_path, scenes):
    before = _run_dir(tmp_path, _real(), {"mip": scenes})
    assert _run_dir(tmp_path) != _run_dir(tmp_path, built_in_hash=lambda: "redrawn")
    (scenes / "kitchen/.DS_Store").write_text("x")
    assert before == _run_dir(tmp_path, _real(), {"mip": scenes})
    (scenes / "kitchen/poses.json").write_text("Kitchen")
    assert before != _run_dir(tmp_path, _real(), {"mip": scenes})


def test_the_hash_sees_names_sizes_and_the_ends_of_large_files(tmp_path):
    large = tmp_path / "a.bin"
    large.write_bytes(bytes(WHOLE + 10))
    hashes = {hash_folder(tmp_path)}
    for content in (bytes(WHOLE + 11), b"x" + bytes(WHOLE + 10), bytes(WHOLE + 10) + b"x"):
        large.write_bytes(content)
        hashes.add(hash_folder(tmp_path))
    large.rename(tmp_path / "b.bin")
    hashes.add(hash_folder(tmp_path))
    assert len(hashes) == 5


def test_rows_that_come_to_the_same_settings_share_a_run(tmp_path):
    rows = [{"label": "A", "method": "one"}, {"label": "B", "method": "one", "settings": {"hull": {"k": 3}}}]
    made = make(tmp_path, table(rows))
    assert len(made.jobs) == 4 and len(made.tasks) == 2


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"hull.kk": 3}, "unknown setting 'hull.kk'"),
        ({"hull": {"k": "many"}}, "hull.k cannot be 'many'"),
        ({"stps": 3}, "unknown setting 'stps'"),
        ({"rate": -1.0}, "rate is -1.0"),
        ({"steps": 3, "steps.more": 1}, "steps"),
    ],
)
def test_a_wrong_setting_names_its_row_before_anything_runs(tmp_path, settings, said):
    rows = [{"label": "Good", "method": "one"}, {"label": "Bad row", "method": "two", "settings": settings}]
    with pytest.raises(ConfigError, match=r"row 'Bad row' of small\.yaml") as caught:
        make(tmp_path, table(rows))
    assert said in str(caught.value) and not list(tmp_path.iterdir())


def test_methods_and_roots_that_are_not_here_leave_their_cells(tmp_path, scenes, caplog, monkeypatch):
    rows = [{"label": "One", "method": "one"}, {"label": "Later", "method": "later"}]
    columns = [{"label": "drawn"}, {"label": "real", "root": "mip-nerf", "scenes": ["kitchen"]}]
    spec = table(rows, columns=columns, seeds=[0])
    made = plan(spec, tmp_path, workshop())
    assert [o.status for o in made.jobs.values()] == ["waiting", "no data", "not available", "not available"]
    assert [j.run_dir is None for j in made.jobs] == [False, True, True, True]
    assert len(caplog.records) == 1 and "--root mip-nerf=DIR" in caplog.text
    monkeypatch.setenv("VISDOM_ROOT_MIP_NERF", str(scenes))
    assert [o.status for o in plan(spec, tmp_path, workshop()).jobs.values()][1] == "waiting"
    with pytest.raises(ConfigError, match="--root mip-nerf=DIR"):
        plan(spec, tmp_path, workshop(), {"mip-nerf": tmp_path / "nowhere"})
    with pytest.raises(ConfigError, match="scenes there: bonsai, kitchen"):
        plan(_real(scenes=["garden"]), tmp_path, workshop(), {"mip": scenes})


def test_options_on_reading_are_those_of_visdom_train(tmp_path):
    spec = table(columns=[{"label": "c", "reading": {"mask_sorce": "alpha"}}])
    with pytest.raises(ConfigError, match="column 'c'"):
        make(tmp_path, spec, reading=Common())
