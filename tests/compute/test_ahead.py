"""Kernels compiled ahead: the list names kernels that exist; a second process makes what a command then loads."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from visdom_plugin import registry
from visdom_plugin.compute import ahead, waiting
from visdom_plugin.compute.ahead import Kernel
from visdom_plugin.compute.claims import Claim

LISTED = json.loads(ahead.LIST.read_text())
PACK = "hull.queries.bricks._pack int64 int64 uint8[3Cr] uint64[3C]"
RUNS = "hull.grid.components._count_runs int64 int64 uint8[3C] int64[1C]"
COUNT_MISSES = """
from visdom_plugin.compute.ahead import Kernel
import json, sys
for text in json.loads(sys.argv[1]):
    function, types = Kernel(text).load()
    function.compile(types)
    print(sum(function.stats.cache_misses.values()), end=" ")
"""


@pytest.fixture
def lister():
    spec = importlib.util.spec_from_file_location(
        "list_kernels", Path(__file__).parents[2] / "scripts/list_kernels.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def compile_in_a_process(*texts):
    return subprocess.Popen(
        [sys.executable, "-c", COUNT_MISSES, json.dumps(texts)], stdout=subprocess.PIPE, text=True
    )


def wait_for(condition, seconds=120):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.parametrize("text", LISTED["kernels"])
def test_a_listed_kernel_is_there_and_takes_so_many_arguments(text):
    function, types = Kernel(text).load()
    assert function.py_func.__code__.co_argcount == len(types)
    assert Kernel.of(function.py_func, types).text == text


def test_each_kernel_is_compiled_once():
    """For one kind of arguments, on which its callers agree."""
    names = [text.split()[0] for text in LISTED["kernels"]]
    assert sorted(names) == sorted(set(names))


def test_every_method_has_a_job(lister):
    assert set(lister.jobs()) == set(LISTED["jobs"])
    methods = {ahead.training_job(name) for name in registry.installed().presets}
    assert methods - {"train gaussianobject"} <= set(LISTED["jobs"])


@pytest.mark.slow
@pytest.mark.parametrize("job", ["hull", "train ingp", "train 3dgs-go", "train zipnerf-lite"])
def test_the_list_is_what_the_command_calls(job, lister, tmp_path):
    """Where this fails, run scripts/list_kernels.py."""
    called = lister.run(lister.jobs()[job], str(tmp_path))
    assert called == [LISTED["kernels"][i] for i in LISTED["jobs"][job]]


def test_the_second_process_makes_what_the_first_loads_and_leaves_nothing(cache):
    kernels = [Kernel(PACK), Kernel("hull.no_such_module.kernel int64"), Kernel(RUNS)]
    assert not any(kernel.is_cached() for kernel in kernels)
    process = ahead.start_process(kernels)
    wait_for(lambda: kernels[0].is_cached() and kernels[2].is_cached())
    ahead.end_process(process)
    assert process.returncode == 0
    assert compile_in_a_process(PACK, RUNS).communicate()[0] == "0 0 "
    assert not list(cache.glob("**/*.tmp*"))


def test_the_second_process_ends_with_the_first_however_that_ends(cache):
    program = (
        "from visdom_plugin.compute.ahead import *; import time\n"
        "print(start_process(read_list('train zipnerf-lite')).pid, flush=True); time.sleep(100)"
    )
    first = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    second = int(first.stdout.readline())
    os.kill(second, 0)
    first.send_signal(signal.SIGKILL)
    first.wait()
    wait_for(lambda: not is_running(second))


def test_the_second_process_imports_nothing_from_the_users_folder(cache, tmp_path, monkeypatch):
    (tmp_path / "numba.py").write_text("open('imported', 'w').close()")
    monkeypatch.chdir(tmp_path)
    kernel = Kernel(PACK)
    process = ahead.start_process([kernel])
    wait_for(kernel.is_cached)
    ahead.end_process(process)
    assert not (tmp_path / "imported").exists()


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_of_processes_that_start_at_once_one_compiles(cache):
    processes = [compile_in_a_process(PACK, RUNS) for _ in range(3)]
    misses = [p.communicate()[0].split() for p in processes]
    assert [sum(int(row[i]) for row in misses) for i in range(2)] == [1, 1]


def test_a_claim_is_free_again_when_its_process_was_killed(tmp_path):
    program = (
        "from visdom_plugin.compute.claims import Claim; from pathlib import Path; import sys, time\n"
        "print(Claim(Path(sys.argv[1]), 'x').take(), flush=True); time.sleep(100)"
    )
    other = subprocess.Popen([sys.executable, "-c", program, tmp_path], stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "True\n"
    claim = Claim(tmp_path, "x")
    assert not claim.take()
    assert Claim(tmp_path, "y").take()
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert claim.take()


def test_a_kernel_that_does_not_compile_is_free_again(tmp_path, cache):
    (tmp_path / "wrong.py").write_text(
        "from visdom_plugin.compute.kernels import kernel\n@kernel()\ndef wrong(x):\n    return x.no_such\n"
    )
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from wrong import wrong; from numba import int64; from numba.core.errors import TypingError\n"
        "try: wrong.compile((int64,))\n"
        "except TypingError: print(wrong._cache.cache_path, flush=True); input()"
    )
    words = [sys.executable, "-c", program, tmp_path]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        folder = Path(other.stdout.readline().strip())
        assert Claim(folder, f"wrong.wrong-2.py{sys.version_info[0]}{sys.version_info[1]}").take()
        other.communicate("\n")


def test_where_there_are_no_locks_every_claim_is_granted(tmp_path):
    claim = Claim(tmp_path / "no such folder", "x")
    assert claim.take()
    claim.drop()


def test_a_kernel_that_another_process_holds_is_left_to_it(cache):
    program = (
        "from visdom_plugin.compute.ahead import Kernel; import sys, time\n"
        f"print(Kernel({PACK!r}).load()[0]._cache.claim.take(), flush=True); time.sleep(100)"
    )
    other = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "True\n"
    asking = (
        "from visdom_plugin.compute.ahead import Kernel\n"
        "from visdom_plugin.compute.kernels import compile_if_free\n"
        f"print(compile_if_free(*Kernel({PACK!r}).load()))"
    )
    asks = subprocess.run([sys.executable, "-c", asking], capture_output=True, text=True, check=True)
    other.kill()
    other.wait()
    assert asks.stdout == "False\n"


def test_a_cache_that_cannot_be_written_costs_time_only(cache):
    program = (
        "from visdom_plugin.compute.ahead import Kernel; import numpy as np, shutil, sys\n"
        f"function, types = Kernel({PACK!r}).load()\n"
        "shutil.rmtree(sys.argv[1]); open(sys.argv[1], 'w').close()\n"
        "grid, bits = np.ones((8, 8, 8), np.uint8), np.zeros((2, 2, 2), np.uint64); grid.flags.writeable = False\n"
        "function(0, 2, grid, bits); print(bits.any())"
    )
    done = subprocess.run([sys.executable, "-c", program, cache], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


@pytest.mark.parametrize(("told", "starts"), [("1", False), ("2", True)])
def test_there_is_no_second_process_on_one_core(told, starts, cache, monkeypatch):
    started = []
    monkeypatch.setenv("OMP_NUM_THREADS", told)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(ahead, "start_process", started.append)
    ahead.prepare("hull")
    monkeypatch.setattr(ahead, "_process", None)
    ahead.finish()
    assert bool(started) == starts
    assert waiting.current() is None


def test_nothing_is_started_where_all_is_cached(monkeypatch):
    monkeypatch.setattr(Kernel, "is_cached", lambda self: True)
    monkeypatch.setattr(ahead, "start_process", lambda kernels: pytest.fail("started"))
    ahead.prepare("train zipnerf-lite")
    ahead.finish()


def test_the_line_counts_kernels_and_seconds_left(monkeypatch):
    ready = set()
    monkeypatch.setattr(Kernel, "is_cached", lambda self: self.text in ready)
    helper = ahead.Helper([Kernel(text) for text in "abcdef"])
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    helper.began()
    assert helper.describe() == "compiling kernels, once on this machine: 0 s, 0 done, at most 6 to go"
    now, ready = 104.0, set("abcd")
    assert helper.describe() == "compiling kernels, once on this machine: 4 s, 4 done, at most 2 to go (2 s)"
    ready = set("abcdef")
    assert helper.describe() == "compiling kernels, once on this machine: 4 s"
    helper.ended()


def test_while_one_waits_the_next_free_kernel_is_compiled(monkeypatch):
    done = []
    monkeypatch.setattr(Kernel, "is_cached", lambda self: self.text == "cached")
    monkeypatch.setattr(Kernel, "compile", lambda self, _: self.text != "busy" and not done.append(self.text))
    helper = ahead.Helper([Kernel(text) for text in ("cached", "busy", "one", "two")])
    assert [helper.help() for _ in range(3)] == [True, True, False]
    assert done == ["one", "two"]


class Screen:
    def __init__(self, terminal):
        self.text, self.terminal = "", terminal

    def isatty(self):
        return self.terminal

    def write(self, text):
        self.text += text

    def flush(self):
        pass


@pytest.fixture
def quick_screen(monkeypatch):
    for name, seconds in (("FIRST", 0.05), ("EVERY", 0.1), ("TICK", 0.01)):
        monkeypatch.setattr(waiting.Screen, name, seconds)
    made = waiting.Screen()
    yield made
    made.turn(False)


@pytest.mark.parametrize("terminal", [True, False])
def test_the_line_moves_in_silence_and_is_gone_afterwards(terminal, quick_screen, monkeypatch):
    output, numbers = Screen(terminal), iter(range(10000))
    monkeypatch.setattr(sys, "stderr", output)

    def text():
        return f"{next(numbers)} of 9"

    quick_screen.begin(text)
    time.sleep(0.2)
    assert output.text == ""  # nobody turned it on
    quick_screen.turn(True)
    quick_screen.begin(text)
    wait_for(lambda: "1 of 9" in output.text)
    quick_screen.end(text)
    said = output.text
    time.sleep(0.3)
    assert output.text == said
    assert said.endswith("\r\x1b[K" if terminal else " of 9\n")
    assert ("\r" in said) == terminal


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_gets_the_line_at_once_where_it_is_asked_for(terminal, monkeypatch):
    output, screen = Screen(terminal), waiting.Screen()
    monkeypatch.setattr(sys, "stderr", output)
    monkeypatch.setattr(screen, "_thread", object())  # none writes later
    screen.show()
    screen.turn(True)
    screen.begin(lambda: "loading")
    screen.show()
    assert output.text == ("\r\x1b[Kloading" if terminal else "")


def test_what_is_said_stands_on_a_line_of_its_own(quick_screen, monkeypatch):
    output = Screen(terminal=True)
    monkeypatch.setattr(sys, "stderr", output)
    quick_screen.turn(True)
    quick_screen.begin(lambda: "carving")
    wait_for(lambda: "carving" in output.text)
    quick_screen.clear()
    assert output.text.endswith("\r\x1b[K")


def test_a_phase_ends_with_its_block_whatever_happens(monkeypatch):
    with pytest.raises(KeyError), waiting.phase("reading"):
        raise KeyError("x")
    assert waiting.screen._phases == []
