"""Report on a promise that is not kept, for the method's author."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import pytest


def require(holds: bool, what: str, promise: Callable[..., object] | type, todo: str) -> None:
    """Fails the check, without a traceback into this package, unless it holds.

    Args:
        what: what was seen, one sentence.
        promise: the class or function in whose documentation it is promised.
        todo: what to do.
    """
    if not holds:
        pytest.fail(
            f"{what}\n  promised in: {promise.__module__}.{promise.__qualname__} ({_place(promise)})\n"
            f"  what to do: {todo}",
            pytrace=False,
        )


def _place(promise: Callable[..., object] | type) -> str:
    return f"{inspect.getsourcefile(promise)}:{inspect.getsourcelines(promise)[1]}"
