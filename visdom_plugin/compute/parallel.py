"""Numba kernels over both cores without a threading layer of numba's.

A kernel's first two arguments are a half-open range of items; plain Python threads hand out ranges. This costs
about 0.1 ms per launch, and in return several threads of a program may launch at once, a fork is harmless, nothing
spins between launches (numba's OpenMP pool next to torch's would), and kernels compile in a fraction of the time
that `parallel=True` takes.
"""

from __future__ import annotations

import itertools
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import torch


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="kernel")


# Threads do not survive a fork; the child makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def parallel_for(kernel, count: int, grain: int, *arguments) -> None:
    """Runs `kernel(begin, end, *arguments)` over [0, count) in pieces of `grain` items.

    Pieces go to whichever thread is free, so a kernel must write only what belongs to its own items; then the
    result does not depend on the number of threads, which is torch's (`torch.set_num_threads`).
    """
    pieces = -(-count // grain)
    workers = min(torch.get_num_threads(), pieces)
    if workers <= 1:
        if count:
            kernel(0, count, *arguments)
        return
    turn = itertools.count()  # next() is atomic in CPython

    def work() -> None:
        while (piece := next(turn)) < pieces:
            kernel(piece * grain, min((piece + 1) * grain, count), *arguments)

    others = [_pool(workers - 1).submit(work) for _ in range(workers - 1)]
    try:
        work()
    finally:
        for other in others:
            other.result()
