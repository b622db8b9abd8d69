from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
import types
from dataclasses import replace
from pathlib import Path

import pytest

from tests.tables.matrix import ROOT, long_table, make, table, write
from tests.tables.run import slurm_cluster
from visdom_plugin.atomic_files import write_json
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.run import slurm, slurm_notes
from visdom_plugin.tables.run.driver import Interrupted, run_plan
from visdom_plugin.tables.run.executors import Here
from visdom_plugin.tables.run.job_files import beside, note_error
from visdom_plugin.tables.run.slurm import Slurm, SlurmConfig, SlurmError, read_config

CONFIG = SlurmConfig(partition="tests", cpus=1, memory_gb=None, time_min=5, poll_seconds=0.5)


def test_resources_come_from_the_table_and_from_a_file_which_wins(tmp_path):
    file = tmp_path / "site.yaml"
    file.write_text("partition: night\ngpus: 1\n")
    spec = table(slurm={"partition": "day", "time_min": 60})
    assert read_config(spec, file) == SlurmConfig(partition="night", gpus=1, time_min=60)
    assert read_config(spec, None) == SlurmConfig(partition="day", time_min=60)
    with pytest.raises(ConfigError, match="time_min"):
        read_config(table(slurm={"minutes": 60}), None)
    file.write_text("[")
    with pytest.raises(ConfigError, match=r"site\.yaml"):
        read_config(spec, file)


@pytest.fixture
def queue(monkeypatch):
    """A cluster made of a list: what was submitted as [(name, run_dirs, options)], and who is alive."""
    made = types.SimpleNamespace(submitted=[], alive=set(), dies=False, meanwhile=lambda: None)

    class AutoExecutor:
        def __init__(self, folder, cluster=None):
            assert cluster == "slurm"

        def update_parameters(self, **given):
            self.given = given

        def map_array(self, function, modules, argvs, run_dirs, names, cpus):
            made.meanwhile()
            made.submitted.append((names[0], run_dirs, self.given))
            made.alive |= {(names[0], i) for i in range(len(run_dirs))}
            if made.dies:
                raise KeyboardInterrupt
            return [types.SimpleNamespace(job_id=f"{len(made.submitted)}_{i}") for i in range(len(run_dirs))]

    monkeypatch.setitem(sys.modules, "submitit", types.SimpleNamespace(AutoExecutor=AutoExecutor))
    monkeypatch.setattr(slurm.shutil, "which", lambda name: name)
    monkeypatch.setattr(
        slurm_notes, "read_queue", lambda names: {x: "RUNNING" for x in made.alive if x[0] in names}
    )
    return made


@pytest.mark.parametrize("dies", [False, True])
def test_what_a_dead_driver_submitted_is_not_submitted_again(tmp_path, queue, dies):
    tasks = list(make(tmp_path).tasks.values())
    queue.dies = dies
    first = Slurm(CONFIG, tmp_path)
    if dies:
        # Dead between the submission and the note of its number.
        with pytest.raises(KeyboardInterrupt):
            first.start(tasks)
    else:
        first.start(tasks)
    (name, run_dirs, _), *_ = queue.submitted
    assert run_dirs == [str(t.run_dir) for t in tasks]
    queue.alive = {(name, 1), (name, 2)}
    write_json(beside(tasks[3].run_dir, ".exit.json"), {"batch": name, "code": 7})
    write_json(beside(tasks[0].run_dir, ".exit.json"), {"batch": "an older one", "code": 0})
    second = Slurm(CONFIG, tmp_path)
    assert second.adopt(tasks) == tasks[1:]
    assert [(e.task, e.code) for e in second.poll()] == [(tasks[3], 7)]


def test_drivers_that_submit_at_the_same_time_note_every_batch(tmp_path, queue):
    tasks = list(make(tmp_path, table(seeds=list(range(8)))).tasks.values())
    starts = [threading.Thread(target=Slurm(CONFIG, tmp_path).start, args=([task],)) for task in tasks]
    for start in starts:
        start.start()
    for start in starts:
        start.join()
    noted = json.loads((tmp_path / "slurm.json").read_text())["batches"].values()
    assert sorted(run for batch in noted for run in batch["runs"]) == sorted(t.run_dir.name for t in tasks)
    assert all(batch["id"] for batch in noted)


def test_what_another_driver_is_about_to_submit_is_neither_forgotten_nor_submitted_again(tmp_path, queue):
    tasks = list(make(tmp_path).tasks.values())
    first, second = Slurm(CONFIG, tmp_path), Slurm(replace(CONFIG, poll_seconds=0.0), tmp_path)
    assert first.adopt(tasks) == second.adopt(tasks) == []

    def meanwhile():
        # Between the first driver's note and its submission.
        queue.meanwhile = lambda: None
        assert Slurm(CONFIG, tmp_path).adopt([]) == []
        second.start(tasks)
        assert [second.poll() for _ in range(2 * slurm.ABSENT)] == [[]] * 2 * slurm.ABSENT
        assert second.queued() == {task.run_dir for task in tasks}

    queue.meanwhile = meanwhile
    first.start(tasks)
    ((name, run_dirs, _),) = queue.submitted
    assert run_dirs == [str(task.run_dir) for task in tasks]
    assert second.poll() == [] and not second.queued()
    assert Slurm(CONFIG, tmp_path).adopt(tasks) == tasks
    # Both hear the end; a task that was stopped is submitted again by one of them alone.
    word = {"batch": name, "code": 130, "said": "stopped"}
    write_json(beside(tasks[2].run_dir, ".exit.json"), word)
    for executor in (first, second):
        assert [(e.task, e.code, e.said) for e in executor.poll()] == [(tasks[2], 130, "stopped")]
        executor.start([tasks[2]])
    assert [run_dirs for _, run_dirs, _ in queue.submitted[1:]] == [[str(tasks[2].run_dir)]]


def test_a_failed_run_is_tried_again_though_its_batch_goes_on(tmp_path, queue):
    made = make(tmp_path)
    tasks = list(made.tasks.values())
    Slurm(CONFIG, tmp_path).start(tasks)
    name, _, _ = queue.submitted[0]
    queue.alive.remove((name, 0))
    write_json(beside(tasks[0].run_dir, ".exit.json"), {"batch": name, "code": 2, "said": "error: no"})
    note_error(tasks[0].run_dir, "no")
    with pytest.raises(Interrupted):
        run_plan(made, _Stops(CONFIG, tmp_path), write(tmp_path))
    assert len(queue.submitted) == 1
    with pytest.raises(Interrupted):
        run_plan(made, _Stops(CONFIG, tmp_path), write(tmp_path), retry=True)
    assert [run_dirs for _, run_dirs, _ in queue.submitted[1:]] == [[str(tasks[0].run_dir)]]


class _Stops(Slurm):
    """Interrupted at the first poll."""

    def poll(self):
        assert super().poll() == []
        raise KeyboardInterrupt


def test_a_task_that_vanishes_without_a_word_is_reported_lost(tmp_path, queue):
    tasks = list(make(tmp_path).tasks.values())[:2]
    executor = Slurm(replace(CONFIG, poll_seconds=0.0), tmp_path)
    executor.start(tasks)
    queue.alive = {x for x in queue.alive if x[1] == 1}
    ended = [e for _ in range(slurm.ABSENT) for e in executor.poll()]
    assert [(e.task, e.code) for e in ended] == [(tasks[0], None)]
    queue.alive = set()
    ended = [e for _ in range(slurm.ABSENT) for e in executor.poll()]
    assert [(e.task, e.code) for e in ended] == [(tasks[1], None)]
    assert json.loads((tmp_path / "slurm.json").read_text()) == {"batches": {}}


def test_every_resource_reaches_the_cluster_and_long_arrays_are_cut(tmp_path, queue, monkeypatch):
    monkeypatch.setattr(slurm, "ARRAY", 3)
    config = SlurmConfig("p", "a", "q", "c", 2, 6, 8.0, 30, 5, ("module load x",), {"reservation": "r"})
    tasks = list(make(tmp_path).tasks.values())
    Slurm(config, tmp_path).start(tasks)
    assert [len(run_dirs) for _, run_dirs, _ in queue.submitted] == [3, 1]
    given = queue.submitted[0][2]
    assert given == {
        "slurm_job_name": queue.submitted[0][0],
        "timeout_min": 30,
        "cpus_per_task": 6,
        "nodes": 1,
        "tasks_per_node": 1,
        "slurm_array_parallelism": 5,
        "mem_gb": 8.0,
        "gpus_per_node": 2,
        "slurm_partition": "p",
        "slurm_account": "a",
        "slurm_qos": "q",
        "slurm_constraint": "c",
        "slurm_setup": ["module load x"],
        "slurm_additional_parameters": {"reservation": "r"},
    }


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A running slurmctld and slurmd."""
    if importlib.util.find_spec("submitit") is None:
        pytest.skip("submitit is not installed: pip install 'visdom-plugin[slurm]'")
    if reason := slurm_cluster.why_not():
        pytest.skip(reason)
    with (
        slurm_cluster.running(tmp_path_factory.mktemp("slurm")) as conf,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("SLURM_CONF", str(conf))
        patch.chdir(ROOT)
        yield conf


@pytest.mark.slow
def test_a_real_cluster_makes_the_same_table_as_this_process(cluster, tmp_path):
    rows = [{"label": n, "method": n} for n in ("one", "two")]
    rows.append({"label": "Bad", "method": "three+vd", "settings": {"complaint": "no"}})
    tables = []
    for name in ("here", "there"):
        folder = tmp_path / name
        executor = Here() if name == "here" else Slurm(CONFIG, folder)
        run_plan(make(folder, table(rows)), executor, write(folder))
        tables.append((folder / "table.txt").read_text())
    assert tables[0] == tables[1] and tables[0].count(" finished ") == 4


@pytest.mark.slow
def test_on_a_real_cluster_a_killed_driver_and_a_killed_worker_lose_nothing(cluster, tmp_path):
    spec = long_table(0.1)
    here, there = tmp_path / "here", tmp_path / "there"
    run_plan(make(here, table_without_deaths(spec)), Here(), write(here))
    made = make(there, spec)
    driver = subprocess.Popen([sys.executable, "-m", "tests.tables.run.test_slurm", str(there)], cwd=ROOT)
    notes = there / "slurm.json"
    while not notes.exists() or None in [b["id"] for b in json.loads(notes.read_text())["batches"].values()]:
        assert driver.poll() is None
        time.sleep(0.05)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    results = run_plan(made, Slurm(CONFIG, there), write(there))
    assert results.complete
    assert (there / "table.txt").read_text() == (here / "table.txt").read_text()
    # Those that fail or finish were started once; those that are killed from within, once more.
    starts = [len((run_dir / "starts").read_text()) for run_dir in made.tasks]
    assert starts == [1, 1, 1, 1, 2, 2]


@pytest.mark.slow
def test_on_a_real_cluster_two_drivers_started_together_run_everything_once(cluster, tmp_path):
    spec = long_table(0.1)
    here, there = tmp_path / "here", tmp_path / "there"
    run_plan(make(here, table_without_deaths(spec)), Here(), write(here))
    command = [sys.executable, "-m", "tests.tables.run.test_slurm", str(there)]
    both = [subprocess.Popen(command, cwd=ROOT) for _ in range(2)]
    assert [process.wait(300) for process in both] == [0, 0]
    assert (there / "table.txt").read_text() == (here / "table.txt").read_text()
    starts = [len((run_dir / "starts").read_text()) for run_dir in make(there, spec).tasks]
    assert starts == [1, 1, 1, 1, 2, 2]


def table_without_deaths(spec):
    rows = tuple(replace(row, settings=row.settings | {"dies_at": -1}) for row in spec.rows)
    return replace(spec, rows=rows)


@pytest.mark.slow
def test_a_real_cluster_that_refuses_is_quoted_and_nothing_is_noted(cluster, tmp_path):
    with pytest.raises(SlurmError, match="partition") as caught:
        run_plan(make(tmp_path), Slurm(replace(CONFIG, partition="nowhere"), tmp_path), write(tmp_path))
    assert "--slurm FILE" in str(caught.value)
    assert json.loads((tmp_path / "slurm.json").read_text()) == {"batches": {}}


if __name__ == "__main__":
    target = Path(sys.argv[1])
    os.chdir(ROOT)
    run_plan(make(target, long_table(0.1)), Slurm(CONFIG, target), write(target))
