"""Views whose photographs are decoded when they are first looked at."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

from datamodules.capture import InspectedView, LoadedView


class LaterViews:
    """Views that are decoded on first use, each once, and then stay in memory.

    Args:
        read: decodes the view of a position.
        inspected: what is known of each.
    """

    def __init__(self, read: Callable[[int], LoadedView], inspected: Sequence[InspectedView]):
        self._read, self.inspected = read, inspected
        self._loaded: list[LoadedView | None] = [None] * len(inspected)
        self._locks = [threading.Lock() for _ in inspected]
        prints = "".join(view.fingerprint for view in inspected)
        self.fingerprint = hashlib.sha256(prints.encode()).hexdigest()

    def __getitem__(self, i: int) -> LoadedView:
        with self._locks[i]:
            view = self._loaded[i]
            if view is None:
                view = self._loaded[i] = self._read(i)
            return view

    def field(self, name: str) -> Sequence[Any]:
        """One field of `LoadedView` of all views."""
        return _Field(self, name, len(self._loaded))


class _Field(Sequence[Any]):
    def __init__(self, views: LaterViews, name: str, count: int):
        self._views, self._name, self._count = views, name, count
        self.fingerprint = views.fingerprint

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(self._count)))
        return getattr(self._views[range(self._count)[index]], self._name)
