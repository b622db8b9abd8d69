from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from tests.tables.matrix import ROOT, long_table, make, table_of, write
from visdom_plugin.tables.run.driver import run_plan
from visdom_plugin.tables.run.executors import Local
from visdom_plugin.tables.run.job_files import is_held


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The table of `long_table`, made in one go."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        run_plan(make(folder, long_table(0)), Local(2, threads=1), write(folder))
    assert table_of(folder).count(" finished ") == 4 and table_of(folder).count("no such thing") == 2
    return table_of(folder)


def _drive(folder):
    return subprocess.Popen([sys.executable, "-m", "tests.tables.matrix", str(folder)], cwd=ROOT)


def _wait_for_children(made):
    until = time.monotonic() + 120
    while any(is_held(d) for d in made.tasks):
        assert time.monotonic() < until, "a child outlives its driver"
        time.sleep(0.05)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_driver_stopped_at_any_moment_leaves_a_table_that_ends_the_same(tmp_path, undisturbed, number):
    made = make(tmp_path, long_table())
    draw = random.Random(time.time_ns())
    for _ in range(2):
        process = _drive(tmp_path)
        time.sleep(draw.uniform(0.3, 1.6))
        process.send_signal(number)
        process.wait(120)
        if number == signal.SIGKILL:
            _wait_for_children(made)
        else:
            # An orderly end waits for the children itself.
            assert not any(is_held(d) for d in made.tasks)
        if (tmp_path / "table.txt").exists():
            # An error goes on in lines of its own.
            assert sum(not line.startswith(" ") for line in table_of(tmp_path).splitlines()) == 6
    assert _drive(tmp_path).wait(300) == 0
    assert table_of(tmp_path) == undisturbed


def test_workers_killed_at_random_leave_no_trace(tmp_path, undisturbed):
    made = make(tmp_path, long_table())
    executor = Local(2, threads=1)
    draw, kills = random.Random(time.time_ns()), []
    started = executor.start

    def start_and_kill(tasks):
        started(tasks)
        for pid in executor.processes():
            if len(kills) < 3 and pid not in kills:
                kills.append(pid)
                threading.Timer(draw.uniform(0.05, 0.5), _kill, (pid,)).start()

    executor.start = start_and_kill
    results = run_plan(made, executor, write(tmp_path))
    assert results.complete and len(kills) == 3
    assert table_of(tmp_path) == undisturbed


def _kill(pid):
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def test_two_drivers_on_one_folder_make_the_table_of_one(tmp_path, undisturbed):
    both = [_drive(tmp_path) for _ in range(2)]
    assert [process.wait(300) for process in both] == [0, 0]
    assert table_of(tmp_path) == undisturbed
    left = {"".join(p.suffixes) for p in (tmp_path / "runs").iterdir() if p.is_file()}
    assert left == {".yaml", ".log", ".error.json"}
