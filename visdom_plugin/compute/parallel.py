"""Numba kernels over both cores without a threading layer of numba's.

A kernel's first two arguments are a half-open range of items; plain Python threads hand out ranges. This costs
some 20 us per launch, and in return several threads of a program may launch at once, a fork is harmless, nothing
spins between launches (numba's OpenMP pool next to torch's would), and kernels compile in a fraction of the time
that `parallel=True` takes.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from queue import SimpleQueue

import torch

Done = SimpleQueue[BaseException | None]
"""Where a thread says that it has no more to do of a launch, or what it raised."""


def _serve(jobs: SimpleQueue[tuple[Callable[[], None], Done]]) -> None:
    while True:
        work, done = jobs.get()
        try:
            work()
        except BaseException as error:
            done.put(error)
        else:
            done.put(None)
        del work, done  # they hold the kernel's arrays


@cache
def _jobs(threads: int) -> SimpleQueue[tuple[Callable[[], None], Done]]:
    """Where so many threads wait for work."""
    jobs: SimpleQueue[tuple[Callable[[], None], Done]] = SimpleQueue()
    for i in range(threads):
        threading.Thread(target=_serve, args=(jobs,), daemon=True, name=f"kernel_{i}").start()
    return jobs


# Threads do not survive a fork; the child makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_jobs.cache_clear)


def _starts(count: int, grain: int, workers: int) -> Iterator[int]:
    """Where pieces begin, and the end: of what is left every piece takes a share, in whole grains.

    Each piece costs a call of Python's, during which other threads wait; the last ones are small so that all
    threads end at about the same time.
    """
    begin = 0
    while begin < count:
        yield begin
        begin += max(-(-(count - begin) // (2 * workers * grain)), 1) * grain
    yield count


def parallel_for(kernel, count: int, grain: int, *arguments) -> None:
    """Runs `kernel(begin, end, *arguments)` over [0, count) in pieces of at least `grain` items.

    Pieces go to whichever thread is free, so a kernel must write only what belongs to its own items; then the
    result does not depend on the number of threads, which is torch's (`torch.set_num_threads`).
    """
    parallel_for_each(kernel, grain, [(count, arguments)])


def parallel_for_each(kernel, grain: int, runs: Sequence[tuple[int, tuple]]) -> None:
    """The same for several runs, each a count and arguments, in one launch; they, too, write apart."""
    workers = min(torch.get_num_threads(), sum(-(-count // grain) for count, _ in runs))
    if workers <= 1:
        for count, arguments in runs:
            if count:
                kernel(0, count, *arguments)
        return
    listed = [
        (begin, end, *arguments)
        for count, arguments in runs
        for begin, end in pairwise(_starts(count, grain, workers))
    ]
    pieces = iter(listed)  # its next() is atomic in CPython

    def work() -> None:
        for piece in pieces:
            kernel(*piece)

    jobs, done = _jobs(workers - 1), Done()
    for _ in range(workers - 1):
        jobs.put((work, done))
    try:
        work()
    finally:
        errors = [done.get() for _ in range(workers - 1)]
    for error in errors:
        if error is not None:
            raise error
