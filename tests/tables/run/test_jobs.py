from __future__ import annotations

import shutil

import pytest

from tests.tables.matrix import make, table, workshop
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.tables.run.jobs import plan


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
    assert _run_dir(tmp_path) != _run_dir(tmp_path, hash_data=lambda *given: "redrawn")
    (scenes / "kitchen/stray.txt").write_text("x")
    assert before == _run_dir(tmp_path, _real(), {"mip": scenes})
    (scenes / "kitchen/poses.json").write_text("Kitchen")
    assert before != _run_dir(tmp_path, _real(), {"mip": scenes})


def test_data_are_hashed_as_the_job_reads_them(tmp_path, scenes):
    asked = []
    spec = _real(scenes=["kitchen"], views=[4, 6], downscale=2, data_format="llff", reading={"frame": 3})
    hash_data = lambda *given: str(asked.append(given))  # noqa: E731
    made = plan(spec, tmp_path, workshop(hash_data=hash_data), {"mip": scenes})
    for job, (kind, folder, reading, config) in zip(made.jobs, asked, strict=True):
        content = made.tasks[job.run_dir].content
        assert (kind, folder, config.steps) == ("train", (scenes / "kitchen").resolve(), 3)
        assert reading == {"views": job.views, "downscale": 2, "data_format": "llff", "frame": 3}
        assert reading.items() <= content.items()


def test_a_scene_that_cannot_be_read_fails_in_its_run_and_one_read_wrongly_before(tmp_path, scenes):
    def broken(kind, folder, reading, config):
        if folder.name == "kitchen":
            raise SceneError("the kitchen is closed", where=folder)
        return "open"

    made = plan(_real(), tmp_path, workshop(hash_data=broken), {"mip": scenes})
    assert {o.status for o in made.jobs.values()} == {"waiting"}
    mended = plan(_real(), tmp_path, workshop(hash_data=lambda *given: "open"), {"mip": scenes})
    pairs = list(zip(made.jobs, mended.jobs, strict=True))
    assert all((a.run_dir == b.run_dir) == (a.scene == "bonsai") for a, b in pairs)

    def misread(*given):
        raise ConfigError("no such view", where="--train-list 99", todo="look")

    with pytest.raises(ConfigError, match=r"column 'real' of small\.yaml \(--train-list 99\)"):
        plan(_real(), tmp_path, workshop(hash_data=misread), {"mip": scenes})


def test_rows_that_come_to_the_same_settings_share_a_run(tmp_path):
    rows = [{"label": "A", "method": "one"}, {"label": "B", "method": "one", "settings": {"hull": {"k": 3}}}]
    made = make(tmp_path, table(rows))
    assert len(made.jobs) == 4 and len(made.tasks) == 2


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"hull.kk": 3}, "unknown setting 'hull.kk'"),
        ({"hull": {"k": "many"}}, "hull.k cannot be 'many'"),
        ({"stps": 3}, "unknown setting 'stps'; did you mean 'steps'?"),
        ({"step": 60}, "unknown setting 'step'; did you mean 'steps'?"),
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
