from __future__ import annotations

import io
import math
import re

import pytest

from tests.tables.matrix import make, table, write
from tests.tables.run.scripted import Scripted
from visdom_plugin.tables.results import Outcome
from visdom_plugin.tables.run import job_files, progress
from visdom_plugin.tables.run.driver import run_plan
from visdom_plugin.tables.run.executors import Ended, Here, Local
from visdom_plugin.tables.run.progress import Overview, spell_seconds


def _watch(made, folder, executor, **changes):
    """Everything that the overview says of a table."""
    said = io.StringIO()
    run_plan(made, executor, write(folder), overview=Overview(stream=said), **changes)
    return said.getvalue()


def _counts(said):
    """(done, of, running) of every line that says how far it is."""
    return [
        tuple(map(int, found))
        for found in re.findall(r"^(\d+)/(\d+) done, (\d+) running", said, re.MULTILINE)
    ]


@pytest.mark.parametrize("executor", [Here, lambda tick: Local(1, threads=1)])
def test_progress_counts_the_runs_asked_for(tmp_path, monkeypatch, executor):
    monkeypatch.setattr(progress, "EVERY", math.inf)
    rows = [
        {"label": "Good", "method": "one"},
        {"label": "Bad", "method": "two", "settings": {"crash": True}},
    ]
    rows.append({"label": "Later", "method": "three+vd"})
    made, shown = make(tmp_path, table(rows)), Overview(stream=io.StringIO())
    run_plan(made, executor(shown.tick), write(tmp_path), only=[0, 1], overview=shown)
    said = shown.stream.getvalue()
    assert "4 runs in all, 0 of them done before, 4 to do" in said
    assert said.count("finished: Good") == 2 and said.count("lava") == 2
    # After each end comes a line that knows what runs next; the last one says no time.
    assert _counts(said) == [(1, 4, 1), (2, 4, 1), (3, 4, 1), (4, 4, 0)]
    assert said.endswith("4/4 done, 0 running, 2 failed\n")
    assert "4 runs in all, 2 of them done before, 2 failed before, 0 to do" in _watch(
        made, tmp_path, Here(), only=[0, 1]
    )
    assert "2 runs in all, 0 of them done before, 2 to do" in _watch(made, tmp_path, Here(), only=[2])


def test_a_quiet_overview_is_silent(tmp_path):
    said = io.StringIO()
    run_plan(make(tmp_path), Here(), write(tmp_path), overview=Overview(quiet=True, stream=said))
    assert said.getvalue() == ""


def test_what_waits_in_a_queue_is_not_running(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.0)
    said = _watch(
        make(tmp_path, table(seeds=[0, 1, 2])), tmp_path, Scripted(lambda task: Ended(task, 1, "no"))
    )
    assert _counts(said) == [(0, 6, 2), (1, 6, 2), (2, 6, 2), (3, 6, 2), (4, 6, 2), (5, 6, 1), (6, 6, 0)]


def test_the_time_left_is_shared_by_what_runs(tmp_path):
    tasks = make(tmp_path, table(seeds=list(range(9)))).tasks
    for running in (1, 2, 4):
        said = io.StringIO()
        shown = Overview(stream=said)
        known = dict.fromkeys(tasks, Outcome("waiting"))
        known |= dict.fromkeys(list(tasks)[:running], Outcome("running"))
        shown.begin(tasks, known)
        known[list(tasks)[-1]] = Outcome(
            "finished", {"timing": {"hull_s": 1.0, "train_s": 6.0, "eval_s": 1.0}}
        )
        shown.report(tasks[list(tasks)[-1]], known[list(tasks)[-1]])
        shown.show(known)
        # 17 of 18 are left, of 8 seconds each.
        assert (
            f"1/18 done, {running} running, about {spell_seconds(17 * 8 / running)} left\n" in said.getvalue()
        )


def test_steps_of_an_earlier_time_say_nothing_of_the_time_left(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.0)
    tasks = make(tmp_path, table(settings={"steps": 100}, seeds=[0])).tasks
    run_dir = next(iter(tasks))
    said = io.StringIO()
    shown, known = Overview(stream=said), dict.fromkeys(tasks, Outcome("waiting"))
    for step in (50, 51):
        job_files.write_json(run_dir / f"checkpoints/step-{step}.json", {})
        if step == 50:
            shown.begin(tasks, known)
            known[run_dir] = Outcome("running")
        shown.show(known)
        assert ("left" in said.getvalue()) == (step > 50)
