"""Compiled functions, cached on disk under everything that they were compiled from.

numba's own cache looks at the file that a function stands in. It would go on running old machine code after a
change to another file, a function or a constant of which was compiled in. Here the cache is stamped with the code
of the function and of all that it reaches, and with the values that they read. What counts is the code that this
process has loaded, not files, which may have changed since; so any number of processes may share a cache. Of those
that want the same kernel at the same time one compiles it, and the others load what it made.
"""

from __future__ import annotations

import gc
import hashlib
import inspect
import logging
import operator
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar

import numpy as np
from numba import extending, njit
from numba.core import event as events
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher
from numba.core.typing import arraydecl, builtins
from numba.core.typing.templates import infer_global

from visdom_plugin.compute.claims import Claim
from visdom_plugin.compute.waiting import current

log = logging.getLogger(__name__)
Function = TypeVar("Function", bound=Callable[..., object])

# Sums may be regrouped into vector lanes (the compiled order is fixed, so results repeat to the bit), but NaN
# and infinity keep their meaning.
#
# A function with these flags is always inlined (`forceinline`). Otherwise the process that compiles it calls the
# copy compiled by itself, and every later process, which loads the caller from numba's cache, the copy optimised
# once more inside the caller: the last bits would differ between a machine's first run and all others.
_FAST: Any = {
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    "error_model": "numpy",
    "forceinline": True,
}

# numba tries what an operator may mean one after the other, strings and lists before arrays. What is made for the
# CPU alone comes first. Here these are what kernels mean, which saves a fifteenth of the time to compile them. A
# numba that names them otherwise does without.
for _operator, _module, _name in (
    (operator.getitem, arraydecl, "GetItemBuffer"),
    (operator.setitem, arraydecl, "SetItemBuffer"),
    (operator.add, builtins, "BinOpAdd"),
    (operator.sub, builtins, "BinOpSub"),
    (operator.mul, builtins, "BinOpMul"),
):
    if (_meaning := getattr(_module, _name, None)) is not None:
        infer_global(_operator)(type(_name, (_meaning,), {"metadata": {"target": "cpu"}}))


def kernel(
    *, fast: bool = False, error_model: str = "python", inline: str = "never", counted: bool = True
) -> Callable[[Function], Function]:
    """Compiles a function at its first call, to run without the GIL, and keeps the machine code on disk.

    Args:
        fast: for a function of floats that other kernels call: sums may be regrouped, division by zero gives
            infinity, and it is always inlined.
        error_model: "python", where division by zero raises, or "numpy".
        inline: "always" inlines before types are known.
        counted: False where a function makes no arrays, but takes rows or slices of them in a loop. numba counts
            who holds an array by an atomic operation for each slice, at which threads wait for one another.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": error_model, "inline": inline, "_nrt": counted}
    options["no_cfunc_wrapper"] = True  # C calls no kernel

    def compile_later(function: Function) -> Function:
        dispatcher: Any = njit(**options | (_FAST if fast else {}))(function)
        if hasattr(dispatcher, "enable_caching"):  # not where NUMBA_DISABLE_JIT is set
            with suppress(RuntimeError):  # no folder for a cache can be written to
                dispatcher._cache = _StampedCache(dispatcher)
        return dispatcher

    return compile_later


def fast_overload(stub: Callable[..., object]) -> Callable[[Function], Function]:
    """Makes kernels that call `stub` compile the function that the decorated one returns for its types."""

    def register(choose: Function) -> Function:
        # What stands behind the stub, for the stamp.
        stub.__dict__.update(__wrapped__=choose, targetoptions=_FAST)
        return extending.overload(stub, jit_options=_FAST)(choose)

    return register


class Busy(Exception):
    """Another process is compiling the kernel."""


POLL = 0.01
"""Seconds between two looks at what another process is compiling."""
PATIENCE = 60.0
"""Seconds of waiting for it, counted in looks (a machine may sleep); after them a kernel is compiled here, too."""

saving = threading.Lock()
"""Held while files of the cache are written."""


class _State(events.Listener):
    """What this process compiles: a kernel, and within it those that it calls."""

    def __init__(self) -> None:
        self.depth = 0
        self.waits = True
        self.collects = False

    @property
    def asked_for(self) -> bool:
        """The next kernel is one that somebody called."""
        return self.depth == 0 and self.waits

    def on_start(self, event: events.Event) -> None:
        if self.depth == 0:
            # numba makes much that lives until the kernel is done: looking through it takes a tenth of the time.
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: events.Event) -> None:
        self.depth -= 1
        cache = event.data["dispatcher"]._cache
        # numba's own `is_failed` is true where nothing failed.
        failed = getattr(event, "_exc_details", None) is not None
        if failed and isinstance(cache, _StampedCache):
            cache.claim.drop()
        if self.depth == 0:
            if self.collects:
                gc.enable()
            self.tell_ended()

    def tell_ended(self) -> None:
        watcher = current()
        if self.asked_for and watcher is not None:
            watcher.ended()


_state = _State()
events.register("numba:compile", _state)


def compile_if_free(dispatcher: Dispatcher, types: tuple[Any, ...]) -> bool:
    """Compiles a kernel for these types or loads it; False where another process is compiling it."""
    with global_compiler_lock:
        before, _state.waits = _state.waits, False
        try:
            dispatcher.compile(types)
        except Busy:
            return False
        finally:
            _state.waits = before
    return True


class _StampedCache(FunctionCache):
    def __init__(self, dispatcher: Dispatcher) -> None:
        super().__init__(dispatcher.py_func)
        self._dispatcher = dispatcher
        self._stamped = False
        self.claim = Claim(Path(self.cache_path), self._impl.filename_base)

    def load_overload(self, sig: object, target_context: object) -> object:
        # numba looks here before it compiles and saves. At decoration, names that the function reads may still be
        # missing from its module.
        if not self._stamped:
            stamp = fingerprint(self._dispatcher)
            self._cache_file = _StampedFile(self.cache_path, self._impl.filename_base, stamp)
            self._stamped = True
        found = self._load(sig, target_context)
        if found is not None:
            return found
        watcher = current() if _state.asked_for else None
        if watcher is not None:
            watcher.began()
        elif _state.asked_for:
            _tell_once()
        looks = 0
        while not self.claim.take() and looks * POLL < PATIENCE:
            looks += 1
            if _state.depth == 0 and not _state.waits:
                raise Busy
            if watcher is None or not watcher.help():
                time.sleep(POLL)
        # It may have been made since.
        found = self._load(sig, target_context)
        if found is not None:
            self.claim.drop()
            _state.tell_ended()
        return found

    def _load(self, sig: object, target_context: object) -> object:
        with suppress(OSError):  # as below
            return super().load_overload(sig, target_context)
        return None

    def save_overload(self, sig: object, data: object) -> None:
        try:
            with saving, suppress(OSError):  # a disk that is full or read-only costs time only
                super().save_overload(sig, data)
        finally:
            self.claim.drop()


@cache
def _tell_once() -> None:
    log.info("compiling kernels, once on this machine: up to half a minute")


class _StampedFile(IndexDataCacheFile):
    """Index and data files that both carry the stamp.

    A process with other code may write to the same files; between its index and its data this one's may come.
    """

    def save(self, key: object, data: object) -> None:
        super().save(key, (self._source_stamp, data))

    def load(self, key: object) -> object:
        stamp, data = super().load(key) or (None, None)
        return data if stamp == self._source_stamp else None


def fingerprint(function: Callable[..., object]) -> str:
    """Hash of what a compiled function is made from: its code, that of the functions of its package (and of this
    one) that it reaches, and the constants they read."""
    digest = hashlib.sha256()
    packages = {_package(inspect.unwrap(function)), _package(kernel)}
    for part in _parts(function, packages, set()):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def _package(value: object) -> str:
    name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
    return (name or "").split(".")[0]


def _parts(value: object, packages: set[str], seen: set[int]) -> Iterator[str]:
    if isinstance(value, (bool, int, float, complex, str, bytes, np.generic)) or value is None:
        yield f"{type(value).__name__} {value!r}"
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype.str} {value.shape} {value.tobytes().hex()}"
    elif isinstance(value, (tuple, list, set, frozenset)):
        yield f"{type(value).__name__} {len(value)}"
        for item in value if isinstance(value, (tuple, list)) else sorted(value, key=repr):
            yield from _parts(item, packages, seen)
    elif isinstance(value, Mapping):
        yield from _parts(list(value.items()), packages, seen)
    elif isinstance(value, CodeType):
        yield f"{value.co_code.hex()} {value.co_names} {value.co_varnames} {value.co_freevars}"
        yield from _parts(value.co_consts, packages, seen)
    else:
        function = inspect.unwrap(value) if callable(value) else value
        yield f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(value).__name__)}"
        if isinstance(function, FunctionType) and _package(function) in packages and id(function) not in seen:
            seen.add(id(function))
            yield from _parts(getattr(value, "targetoptions", {}), packages, seen)
            yield from _parts(function.__code__, packages, seen)
            for read in _reads(function, packages):
                yield from _parts(read, packages, seen)


def _reads(function: FunctionType, packages: set[str]) -> Iterator[object]:
    """What a function reads beside its arguments: defaults, closed-over values, globals, names of own modules."""
    yield function.__defaults__
    yield function.__kwdefaults__
    yield [cell.cell_contents for cell in function.__closure__ or ()]
    names = sorted(_names(function.__code__))
    for name in names:
        found = function.__globals__.get(name)
        if isinstance(found, ModuleType):
            if _package(found) in packages:
                yield [(n, getattr(found, n)) for n in names if hasattr(found, n)]
        elif name in function.__globals__:
            yield (name, found)


def _names(code: CodeType) -> set[str]:
    inner = (_names(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)
