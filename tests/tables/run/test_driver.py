from __future__ import annotations

import fcntl
import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest

from tests.tables.matrix import ROOT, make, table, table_of, write
from tests.tables.run.scripted import Scripted
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.run import driver, executors, job_files
from visdom_plugin.tables.run.driver import run_plan
from visdom_plugin.tables.run.executors import Ended, Here, Local
from visdom_plugin.tables.run.job_files import is_held
from visdom_plugin.tables.run.jobs import Task


def _statuses(results):
    return [outcome.status for outcome in results.outcomes.values()]


def _starts(made):
    return [len((d / "starts").read_text()) if (d / "starts").exists() else 0 for d in made.tasks]


def test_this_process_and_others_make_the_same_table_and_a_second_time_runs_nothing(tmp_path):
    rows = [{"label": n, "method": n} for n in ("one", "two")]
    rows.append({"label": "Bad", "method": "three+vd", "settings": {"complaint": "no"}})
    rows.append({"label": "Crash", "method": "three+vd", "settings": {"crash": True}})
    rows.append({"label": "Missing", "method": "missing"})
    tables = []
    for name, executor in (("here", Here()), ("local", Local(2, threads=1))):
        folder = tmp_path / name
        made = make(folder, table(rows))
        results = run_plan(made, executor, write(folder))
        assert _statuses(results) == ["finished"] * 4 + ["failed"] * 4 + ["not available"] * 2
        assert results.complete
        errors = {o.error for o in results.outcomes.values() if o.status == "failed"}
        assert errors == {"no\n  what to do: mend it", "RuntimeError: the floor is lava"}
        again = run_plan(make(folder, table(rows)), executor, write(folder))
        assert _starts(made) == [1] * 8 and again.outcomes == results.outcomes
        tables.append(table_of(folder))
    assert tables[0] == tables[1]


def test_failed_runs_are_tried_again_only_when_asked(tmp_path, monkeypatch):
    spec = table([{"label": "Bad", "method": "one", "settings": {"crash": True}}])
    made = make(tmp_path, spec)
    run_plan(made, Here(), write(tmp_path))
    from tests.tables.run import fake_train

    def mended(argv):
        path = Path(argv[1])
        path.write_text(path.read_text().replace("crash: true", "crash: false"))
        return main(argv)

    main = fake_train.main
    monkeypatch.setattr(fake_train, "main", mended)
    assert _statuses(run_plan(made, Here(), write(tmp_path))) == ["failed"] * 2
    assert _starts(made) == [1, 1]
    assert _statuses(run_plan(made, Here(), write(tmp_path), retry=True)) == ["finished"] * 2
    assert _starts(made) == [2, 2] and " None None" not in table_of(tmp_path)


@pytest.mark.parametrize("retry", [False, True])
def test_only_the_rows_asked_for_are_run_and_the_others_show_what_there_is(tmp_path, retry):
    rows = [{"label": "Bad", "method": "one", "settings": {"complaint": "no"}}]
    rows += [{"label": n, "method": n} for n in ("two", "three+vd")]
    made = make(tmp_path, table(rows))
    before = run_plan(made, Here(), write(tmp_path), only=[0])
    assert _statuses(before) == ["failed"] * 2 + ["waiting"] * 4
    after = run_plan(made, Here(), write(tmp_path), only=[2], retry=retry)
    assert [o for j, o in after.outcomes.items() if j.row < 2] == list(before.outcomes.values())[:4]
    assert _statuses(after)[4:] == ["finished"] * 2 and _starts(made) == [1, 1, 0, 0, 1, 1]


@pytest.mark.parametrize(
    ("once", "status", "starts"), [(True, "finished", 2), (False, "failed", driver.CHANCES)]
)
def test_a_killed_worker_is_replaced_as_long_as_it_gets_further(tmp_path, once, status, starts):
    settings = {"steps": 6, "dies_at": 3, "dies_once": once}
    made = make(tmp_path, table([{"label": "A", "method": "one", "settings": settings}], seeds=[0]))
    results = run_plan(made, Local(1, threads=1), write(tmp_path))
    assert _statuses(results) == [status]
    # The first death is a step further than nothing; it counts as the first one all the same.
    assert _starts(made) == [starts]
    if not once:
        assert "SIGKILL" in next(iter(results.outcomes.values())).error


def test_the_table_is_written_before_the_end_and_tells_what_is_running(tmp_path):
    seen = []
    run_plan(make(tmp_path), Here(), lambda results: seen.append(_statuses(results)))
    assert seen[0] == ["waiting"] * 4 and seen[-1] == ["finished"] * 4
    assert any(s.count("finished") in (1, 2, 3) for s in seen)


def test_a_run_that_another_process_holds_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "BUSY_PAUSE", 0.05)
    made = make(tmp_path, table(seeds=[0]))
    held = next(iter(made.tasks))
    held.mkdir(parents=True)
    lock = (held / "run.lock").open("a+")
    fcntl.flock(lock, fcntl.LOCK_EX)
    assert is_held(held)
    threading.Timer(0.6, lock.close).start()
    seen = []
    results = run_plan(made, Local(2, threads=1), lambda r: seen.append(_statuses(r)))
    assert _statuses(results) == ["finished"] * 2 and ["running", "finished"] in seen
    assert _starts(made) == [1, 1]


def test_a_run_that_is_held_at_the_last_moment_is_not_a_failure(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "BUSY_PAUSE", 0.05)
    made = make(tmp_path, table(seeds=[0]))
    held = next(iter(made.tasks))
    held.mkdir(parents=True)
    lock = (held / "run.lock").open("a+")
    fcntl.flock(lock, fcntl.LOCK_EX)
    threading.Timer(0.6, lock.close).start()
    monkeypatch.setattr(driver.job_files, "is_held", lambda run_dir: False)
    assert _statuses(run_plan(made, Local(1, threads=1), write(tmp_path))) == ["finished"] * 2


def test_the_words_of_a_busy_run_directory_are_those_of_the_trainer(tmp_path):
    from visdom_plugin.errors import CheckpointError
    from visdom_plugin.tables.run.job_files import BUSY
    from visdom_plugin.training.runs.run_directory import RunDir

    with RunDir.open(tmp_path / "run", {}):
        assert is_held(tmp_path / "run")
        with pytest.raises(CheckpointError, match=BUSY):
            RunDir.open(tmp_path / "run", {})
    assert not is_held(tmp_path / "run")


def test_two_protocols_among_finished_runs_end_the_table(tmp_path):
    made = make(tmp_path)
    run_plan(made, Here(), write(tmp_path))
    path = list(made.tasks)[1] / "run.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"schema": 2}))
    with pytest.raises(ConfigError, match="schema is 1"):
        run_plan(made, Here(), write(tmp_path))


def test_every_driver_hears_its_own_process_and_leaves_no_file_of_it(tmp_path, monkeypatch):
    (tmp_path / "speaker.py").write_text(
        "import pathlib, sys, time\n"
        "def main(argv):\n"
        "    while not pathlib.Path('go').exists():\n"
        "        time.sleep(0.01)\n"
        "    print(argv[0], file=sys.stderr, flush=True)\n"
        "    pathlib.Path(argv[0]).touch()\n"
        "    return 2\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(ROOT)]))
    monkeypatch.chdir(tmp_path)
    Path("runs").mkdir()
    drivers = {word: Local(1, threads=1) for word in ("a short word", "a longer word")}
    for word, executor in drivers.items():
        executor.start([Task(tmp_path / "runs" / "same", "speaker", (word,))])
    Path("go").touch()
    until = time.monotonic() + 60
    while not all(Path(word).exists() for word in drivers) and time.monotonic() < until:
        time.sleep(0.01)
    for word, executor in drivers.items():
        while not (ended := executor.poll()):
            time.sleep(0.01)
        assert [(e.code, e.said) for e in ended] == [(2, word + "\n")]
    assert list((tmp_path / "runs").iterdir()) == []


def test_what_another_driver_noted_is_kept_and_a_busy_process_is_not_heard(tmp_path, monkeypatch):
    monkeypatch.setattr(driver, "BUSY_PAUSE", 0.0)
    made = make(tmp_path, table(seeds=[0]))
    one, two = made.tasks
    log = job_files.beside(one, ".log")
    seen = []

    def end(task):
        seen.append((task.run_dir, log.exists()))
        if task.run_dir == two:
            return Ended(task, 1, "Error: two")
        if len(seen) < 3:
            return Ended(task, 2, f"error: {job_files.BUSY}")
        job_files.note_error(one, "said to the other driver")
        return Ended(task, -signal.SIGKILL, "and not to this one")

    results = run_plan(made, Scripted(end), write(tmp_path))
    assert seen == [(two, False), (one, False), (one, False)]
    assert [o.error for o in results.outcomes.values()] == ["said to the other driver", "Error: two"]
    assert log.read_text() == "and not to this one"


def test_only_old_leftovers_are_removed(tmp_path):
    from visdom_plugin.tables.run.job_files import remove_old_parts

    old, new, whole = (tmp_path / name for name in (".part-1-table.md", ".part-2-table.md", "table.md"))
    for path in (old, new, whole):
        path.write_text("x")
    os.utime(old, (0, 0))
    os.utime(whole, (0, 0))
    remove_old_parts(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [new.name, whole.name]


def test_cores_are_divided_among_workers(monkeypatch):
    monkeypatch.setattr(executors, "count_cores", lambda: 8)
    assert [Local(n).threads for n in (1, 3, 16)] == [8, 2, 1]
    assert executors.environment(3)["OMP_NUM_THREADS"] == executors.environment(3)["NUMBA_NUM_THREADS"] == "3"
