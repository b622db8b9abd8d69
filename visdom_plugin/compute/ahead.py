"""Kernels compiled ahead: a second process compiles what a command that has just started is going to call.

numba compiles one function at a time, in Python, while the command waits. On a machine's first run the second
process starts with the command, while that imports torch and reads the scene. Both take kernels from the same
list, in the order of their need, and find what the other has made in numba's cache on disk. Nothing depends on
the list but time: a kernel that it lacks is compiled when it is called.
"""

from __future__ import annotations

import gc
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from visdom_plugin.compute.waiting import screen, seconds_left, watch

LIST = Path(__file__).with_name("ahead.json")
"""What commands call: kernels with types as `Kernel.spell` writes them, and their numbers by job."""
WORTH_A_PROCESS = 3
"""Kernels to compile from which on a second process is started."""
PACKAGE = __name__.split(".")[0]
PROGRAM = f"import sys; sys.path[:] = [p for p in sys.path if p]; from {__name__} import main; main()"
"""The second process. Like the command itself it does not import what lies in the user's folder."""

_ARRAY = re.compile(r"(\w+)\[(\d)([CFA])(r?)\]")


@dataclass(frozen=True)
class Kernel:
    """A compiled function with the types of its arguments, as text."""

    text: str
    """Such as `nerf.mlp_kernels.run int64 float32[2C]`: arrays with dimensions and order, r where read-only."""

    @property
    def module(self) -> str:
        """Within the package."""
        return self.text.split()[0].rpartition(".")[0]

    @property
    def name(self) -> str:
        """Of the function."""
        return self.text.split()[0].rpartition(".")[2]

    @classmethod
    def of(cls, function: Any, types: Iterable[Any]) -> Kernel:
        """Of a function of this package and numba's types."""
        return cls(
            " ".join(
                [f"{function.__module__}.{function.__qualname__}".partition(".")[2], *map(_spell, types)]
            )
        )

    def load(self) -> tuple[Any, tuple[Any, ...]]:
        """The compiled function and numba's types."""
        from importlib import import_module

        module = import_module(f"{PACKAGE}.{self.module}")
        return getattr(module, self.name), tuple(map(_read, self.text.split()[1:]))

    def compile(self, compile_if_free: Callable[[Any, tuple[Any, ...]], bool]) -> bool:
        """False where another process compiles it, or where there is no such kernel any more."""
        from numba.core.errors import NumbaError

        try:
            return compile_if_free(*self.load())
        except (ImportError, AttributeError, NumbaError):
            return False

    @cached_property
    def _source(self) -> Path:
        return Path(__file__).parents[1].joinpath(*self.module.split(".")).with_suffix(".py")

    def is_cached(self) -> bool:
        """numba has a file on it that is newer than its module."""
        try:
            newest = max((f.stat().st_mtime for f in self._files()), default=0.0)
            return newest >= self._source.stat().st_mtime
        except OSError:
            return False

    def _files(self) -> Iterable[Path]:
        pattern = f"{self._source.stem}.{self.name}-*.py{sys.version_info[0]}{sys.version_info[1]}*.nbi"
        folder = self._source.parent
        named = os.environ.get("NUMBA_CACHE_DIR")
        if named and (os.access(named, os.W_OK) or not Path(named).exists()):
            return Path(named).glob(f"{folder.name}_*/{pattern}")
        own = folder / "__pycache__"
        if os.access(own if own.exists() else folder, os.W_OK):
            return own.glob(pattern)
        return _user_cache().glob(f"{folder.name}_*/{pattern}")


def _user_cache() -> Path:
    """numba's folder where the package's own is read-only."""
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/numba"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"


def _spell(kind: Any) -> str:
    if not hasattr(kind, "layout"):
        return str(kind)
    return f"{kind.dtype}[{kind.ndim}{kind.layout}{'' if kind.mutable else 'r'}]"


def _read(text: str) -> Any:
    from numba import types

    found = _ARRAY.fullmatch(text)
    if found is None:
        return getattr(types, {"bool": "boolean"}.get(text, text))
    order: Any
    dtype, dimensions, order, fixed = found.groups()
    return types.Array(_read(dtype), int(dimensions), order, readonly=bool(fixed))


def read_list(job: str) -> list[Kernel]:
    """The kernels of a job in the order of their need; none for a job that is not listed."""
    listed = json.loads(LIST.read_text())
    return [Kernel(listed["kernels"][i]) for i in listed["jobs"].get(job, ())]


def training_job(method: str) -> str:
    """The job that trains a method, in whatever variant."""
    return f"train {method.partition('+')[0]}"


def count_cores() -> int:
    """Cores that this process may use, or was told to."""
    free = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    told = os.environ.get("OMP_NUM_THREADS", "")
    return min(free, int(told)) if told.isdecimal() else free


class Helper:
    """What a command knows of the kernels that it is going to call; told when it waits for one."""

    def __init__(self, kernels: Sequence[Kernel]) -> None:
        """
        Args:
            kernels: those not in the cache, in the order of their need.
        """
        self._kernels, self._left = tuple(kernels), list(kernels)
        self._began: float | None = None

    def began(self) -> None:
        if self._began is None:
            self._began = time.monotonic()
        screen.begin(self.describe)

    def help(self) -> bool:
        from visdom_plugin.compute.kernels import compile_if_free

        for kernel in tuple(self._left):
            if kernel.is_cached():
                self._left.remove(kernel)
            elif kernel.compile(compile_if_free):
                self._left.remove(kernel)
                return True
        return False

    def ended(self) -> None:
        screen.end(self.describe)

    def describe(self) -> str:
        """How many are there, and how many may follow: work goes on as soon as the one that it waits for is there,
        and a run need not call all of the list."""
        took = time.monotonic() - (self._began or time.monotonic())
        done, total = sum(k.is_cached() for k in self._kernels), len(self._kernels)
        text = f"compiling kernels, once on this machine: {took:.0f} s"
        if done == total:
            return text
        seconds = seconds_left(done, total, took)
        return f"{text}, {done} done, at most {total - done} to go" + f" ({seconds} s)" * (
            seconds is not None
        )


_process: subprocess.Popen[bytes] | None = None


def prepare(job: str | None = None) -> None:
    """Starts to compile what a job is going to call, where that is not in the cache; returns at once.

    Args:
        job: as in the list; of another one, kernels are compiled when they are called.
    """
    global _process
    missing = [kernel for kernel in read_list(job) if not kernel.is_cached()] if job else []
    watch(Helper(missing))
    may_start = count_cores() > 1 and not os.environ.get("NUMBA_DISABLE_JIT")
    if len(missing) >= WORTH_A_PROCESS and may_start and _process is None:
        _process = start_process(missing)


def finish() -> None:
    """Ends what `prepare` began, whether or not all is compiled."""
    global _process
    watch(None)
    if _process is not None:
        end_process(_process)
        _process = None


def start_process(kernels: Sequence[Kernel]) -> subprocess.Popen[bytes] | None:
    """A second process that compiles kernels; it ends with this one at the latest."""
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C goes to the command, which ends this one
        )
        assert process.stdin is not None
        process.stdin.write(json.dumps([kernel.text for kernel in kernels]).encode() + b"\n")
        process.stdin.flush()
    except OSError:
        return None
    return process


def end_process(process: subprocess.Popen[bytes]) -> None:
    """Ends what `start_process` began, in the middle of a kernel but not of a file."""
    assert process.stdin is not None
    with suppress(OSError):
        process.stdin.close()
    process.wait()


def main() -> None:
    """The second process: kernels as a line of JSON on stdin, which stays open as long as they are wanted."""
    kernels = [Kernel(text) for text in json.loads(sys.stdin.readline())]
    threading.Thread(target=_leave_with_input, daemon=True).start()
    gc.disable()
    from visdom_plugin.compute.kernels import compile_if_free

    for kernel in kernels:
        kernel.compile(compile_if_free)


def _leave_with_input() -> None:
    sys.stdin.read()
    from visdom_plugin.compute.kernels import saving

    with saving:  # no half-written file is left in the cache
        os._exit(0)
