"""Views without a mask: the hull of the views that have one stands in.

The outline of that hull, seen by the view, holds the object wherever the other masks are right, and usually some
of the background beside it. With `hull` it is the view's mask. With `colour`, pixels outside the outline are
ignored; inside, only colour is supervised and opacity is free (`losses.composite_target`), without a mask loss.
In neither case does the view carve: its outline comes from the others and would count their votes twice.
Where no view has a mask, `colour` takes the photographs as a whole, background included.

Nothing stands in for the mask of a test view: a render measured against the hull's outline would be praised for
filling the hull. Such a view is rendered and not measured.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeVar, overload

import torch
from torch import Tensor

from visdom_plugin.errors import SceneError, count_of, list_some
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.hull.hull import Hull
from visdom_plugin.scene import NO_MASKS, MaskOrigin, Scene, Views

log = logging.getLogger(__name__)

Way = Literal["error", "colour", "hull"]
Item = TypeVar("Item")


def fill_masks(scene: Scene, way: Way, domain: VisibleDomain | None = None) -> Scene:
    """A scene in which every training view has a mask of some kind.

    Test views without one stay without, and a warning says that they are not measured.

    Args:
        scene: whose views without a mask have the mask origin "missing".
        way: what becomes of them.
        domain: how the hull is carved; by default the default visible domain, with K at most the number of
            training views that have a mask.

    Returns:
        The same scene when no mask is missing.

    Raises:
        SceneError: masks are missing and `way` is "error", or training views lack one and fewer than two have
            one.
        EmptyHullError: the masks that are there leave no hull.
    """
    missing, unmeasured = _missing(scene.train), _missing(scene.test)
    given = len(scene.train) - len(missing)
    if (missing or unmeasured) and way == "error":
        absent = [scene.train.names[i] for i in missing] + [scene.test.names[i] for i in unmeasured]
        raise SceneError(
            f"{count_of(len(absent), 'view has', 'views have')} no mask: {list_some(absent)}",
            where=scene.name,
            todo="make masks for them, or pass --data.missing-masks colour|hull",
            topic="mask-missing",
        )
    if unmeasured:
        log.warning(
            "test views without a mask, %d of %d: they are rendered, but not measured (%s)",
            len(unmeasured), len(scene.test), list_some([scene.test.names[i] for i in unmeasured]),
        )  # fmt: skip
    if not missing:
        return scene
    if not given and way == "colour":
        log.warning(
            "no training view has a mask: photographs are trained on as they are, background included"
        )
        whole: list[MaskOrigin] = ["whole"] * len(missing)
        return replace(scene, train=replace(scene.train, mask_origins=whole))
    if given < 2:
        raise SceneError(
            f"{count_of(len(missing), 'training view has', 'training views have')} no mask: "
            + list_some([scene.train.names[i] for i in missing]),
            where=scene.name,
            cause=f"and only {count_of(given, 'training view has', 'training views have')} one: a hull needs two",
            todo="make masks for them" if given else NO_MASKS,
            topic="mask-missing",
        )
    domain = VisibleDomain(k=min(3, given)) if domain is None else domain
    outlines = outline_views(domain.carve(*scene.train.silhouettes()), scene.train, missing)
    for i, outline in outlines.items():
        if not bool(outline.any()):
            log.warning("%s has no mask and does not see the hull of the other views", scene.train.names[i])
    return replace(scene, train=_filled(scene.train, outlines, "colour" if way == "colour" else "hull"))


def outline_views(hull: Hull, views: Views, indices: Sequence[int]) -> dict[int, Tensor]:
    """(H, W) bool by index: where the pixels' rays meet the hull."""
    from visdom_plugin.hull.queries.raycast import depth_and_silhouette

    return {i: depth_and_silhouette(hull, views.cameras[i].to("cpu"))[1] for i in indices}


def _missing(views: Views) -> list[int]:
    return [i for i in range(len(views)) if views.mask_origin(i) == "missing"]


def _filled(views: Views, outlines: dict[int, Tensor], way: MaskOrigin) -> Views:
    origins = tuple(way if i in outlines else views.mask_origin(i) for i in range(len(views)))
    filled = replace(views, masks=_Replaced(views.masks, outlines), mask_origins=origins)
    if way != "colour":
        return filled
    beside: dict[int, Tensor | None] = {
        i: _either(~outline, views.ignored(i)) for i, outline in outlines.items()
    }
    return replace(filled, ignore=_Replaced(views.ignore or (None,) * len(views), beside))


def _either(one: Tensor, other: Tensor | None) -> Tensor:
    return one if other is None else one | torch.as_tensor(other)


class _Replaced(Sequence[Item]):
    """A sequence with some items replaced, the others not looked at before they are asked for."""

    def __init__(self, base: Sequence[Item], changed: Mapping[int, Item]):
        self._base, self._changed = base, changed

    def __len__(self) -> int:
        return len(self._base)

    @overload
    def __getitem__(self, index: int) -> Item: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Item, ...]: ...

    def __getitem__(self, index: int | slice) -> Item | tuple[Item, ...]:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(len(self))))
        index = range(len(self))[index]
        return self._changed[index] if index in self._changed else self._base[index]
