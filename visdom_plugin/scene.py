"""Views and Scene: what a datamodule returns and everything else consumes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from visdom_plugin.errors import SceneError, count_of, list_some
from visdom_plugin.geometry.cameras import Cameras

MaskOrigin = Literal["given", "missing", "hull", "colour", "whole"]
"""given: the data has it. missing: it has none, `masks` is True everywhere and says nothing. hull: the outline
of the other views' hull stands in for it. colour: the same outline says where the view may be trusted for
colour, and says nothing about what is object within. whole: no view has a mask; the photograph counts as it is."""


NO_MASKS = (
    "cut the object out of each photograph (rembg, SAM or an image editor) and save masks/<photograph>.png, white "
    "on the object, or the photographs as PNG with an alpha channel; other views do not help. Variants without a "
    "hull and a mask loss, such as method:ingp, train on the photographs as they are: --data.missing-masks colour"
)
"""What to do where no view has a mask."""


@dataclass(frozen=True)
class Views:
    """Posed photographs with foreground masks. Sizes may differ from view to view."""

    cameras: Cameras
    """(N,) cameras, one per view."""
    images: Sequence[Tensor]
    """N tensors (H, W, 3) uint8, as photographed: the background is still there."""
    masks: Sequence[Tensor]
    """N tensors (H, W) bool, True on the object."""
    names: Sequence[str]
    """N names, unique, as in the data."""
    mono_depths: Sequence[Tensor | None] = ()
    """N tensors (H, W) float32 of monocular depth in its own arbitrary unit, or empty when there is none."""
    ignore: Sequence[Tensor | None] = ()
    """N tensors (H, W) bool, True where the photograph tells nothing (an occluder, a lens' dark corner), or None
    where it tells all; empty when there is none. Unlike a pixel outside the mask, which is known to be empty,
    such a pixel takes part in no loss and no metric, and cannot carve."""
    mask_origins: Sequence[MaskOrigin] = ()
    """Where each mask comes from; empty when all are given."""
    origin: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """(3,) float64: where the origin of the cameras' frame lies in the capture's own, which has the same axes.
    What is written for others is in the capture's own frame."""
    points: tuple[Tensor, Tensor] | None = None
    """The scene's points where training is to start from them: `Scene.points`, in the cameras' frame."""

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        width, height = self.cameras.width, self.cameras.height
        sizes = sorted(set(zip(width.tolist(), height.tolist(), strict=True)))
        shown = " and ".join(f"{w} x {h}" for w, h in sizes[:2]) + " and more" * (len(sizes) > 2)
        return f"Views({len(self)} of {shown or 'no'} pixels: {list_some(self.names)})"

    def ignored(self, index: int) -> Tensor | None:
        """(H, W) bool of one view, or None where nothing is ignored."""
        return self.ignore[index] if self.ignore else None

    def mask_origin(self, index: int) -> MaskOrigin:
        """Where one view's mask comes from."""
        return self.mask_origins[index] if self.mask_origins else "given"

    @property
    def has_masks(self) -> bool:
        """Whether the data gives a mask for any of the views."""
        return not self.mask_origins or "given" in self.mask_origins

    def take(self, indices: Sequence[int]) -> Views:
        """Some of the views, in the order given."""

        def chosen(items: Sequence[Any]) -> tuple[Any, ...]:
            return tuple(items[i] for i in indices) if items else ()

        return Views(
            self.cameras[list(indices)],
            chosen(self.images),
            chosen(self.masks),
            chosen(self.names),
            chosen(self.mono_depths),
            chosen(self.ignore),
            chosen(self.mask_origins),
            self.origin,
            self.points,
        )

    def relative_to(self, origin: Tensor) -> Views:
        """The same views in the frame that has its origin at `origin` (3,) float64; themselves for zero."""
        if not origin.any():
            return self
        points = None if self.points is None else (self.points[0] - origin, self.points[1])
        cameras = self.cameras.relative_to(origin)
        return replace(self, cameras=cameras, origin=self.origin + origin, points=points)

    def demanded(self, index: int) -> Tensor:
        """(H, W) bool of one view: the pixels that are known to show the object."""
        ignored = self.ignored(index)
        return self.masks[index] if ignored is None else self.masks[index] & ~ignored

    def with_masks(self) -> list[int]:
        """The views whose mask was given."""
        return [i for i in range(len(self)) if self.mask_origin(i) == "given"]

    def silhouettes(self) -> tuple[Cameras, Sequence[Tensor], Sequence[Tensor | None]]:
        """What may carve: the cameras, masks and ignored pixels of the views whose mask was given.

        An ignored pixel may be object for all one knows: it is True in the mask here and rules nothing out, and
        the third tells it apart, so that it asks for nothing.

        Raises:
            SceneError: no view has a mask.
        """
        if not self.mask_origins and not self.ignore:
            return self.cameras, self.masks, ()
        given = self.with_masks()
        if not given:
            raise SceneError(
                f"none of the {len(self)} training views has a foreground mask, and a hull is carved from masks",
                where=", ".join(self.names[:5]),
                cause="masks are neither in the folder masks nor in the photographs' alpha channels",
                todo=NO_MASKS,
                topic="mask-missing",
            )
        ignored = [self.ignored(i) for i in given]
        masks = [
            self.masks[i] if g is None else self.masks[i] | g for i, g in zip(given, ignored, strict=True)
        ]
        return self.cameras[given], masks, ignored if any(g is not None for g in ignored) else ()


@dataclass(frozen=True)
class Scene:
    """A capture split into what training may see and what only the evaluator may see."""

    name: str
    train: Views
    test: Views
    units: str = "unknown"
    """What one unit of the world frame is: "metres", "unknown", ..."""
    source: dict[str, Any] = field(default_factory=dict)
    """Where it came from, for run.json: root, layout, downscale, hashes of the files read."""
    notes: Sequence[str] = ()
    """What the reader has to say about how it understood the data, one line each."""
    all_train: bool = False
    """Whether so many views were asked for that those train, too, which are for testing otherwise."""
    grey_masks: Mapping[str, float] = field(default_factory=dict)
    """Training views whose mask may be none, as much of it is neither black nor white: that share, by name."""
    mesh: tuple[Tensor, Tensor] | None = None
    """Exact surface where it is known: vertices (V, 3) float64 and faces (F, 3) int64, outward."""
    read_points: Callable[[], tuple[Tensor, Tensor] | None] | None = field(default=None, compare=False)
    """Reads the points that structure from motion found; None where the data has none. Ask `points`."""

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, train={self.train!r}, test={self.test!r})"

    @cached_property
    def points(self) -> tuple[Tensor, Tensor] | None:
        """(P, 3) float64 world positions and (P, 3) float32 colours in [0, 1] of the points that structure from
        motion found, read when they are first asked for; None where the data has none.

        Raises:
            SceneError: their file is damaged.
        """
        return None if self.read_points is None else self.read_points()


def hold_out(scene: Scene, index: int) -> Scene:
    """The scene with one training view as its only test view, and without its own test views.

    Masks that were made of other views' hulls would tell of the held-out view: hold out first, fill masks then.

    Args:
        index: position among the training views.
    """
    rest = [i for i in range(len(scene.train)) if i != index]
    train, test = scene.train.take(rest), scene.train.take([index])
    source = {
        **scene.source,
        "views": len(train),
        "train": list(train.names),
        "test": list(test.names),
        "held_out": test.names[0],
    }
    return replace(scene, train=train, test=test, source=source)


def describe_masks(views: Views) -> list[str]:
    """What masks and ignored pixels mean in these views, one line each, for a command's summary.

    Reads no pixels where there is nothing but given masks.
    """
    known = {
        "given": ("foreground mask", "; the background is known to be empty"),
        "missing": ("view", " without a mask"),
        "hull": ("view", " with the outline of the other views' hull for a mask (not used to carve)"),
        "colour": (
            "view",
            " without a mask, for colour inside the other views' hull (no carving, no mask loss)",
        ),
        "whole": ("view", " without a mask, as photographed, background included"),
    }
    origins = [views.mask_origin(i) for i in range(len(views))]
    lines = [
        count_of(origins.count(kind), noun) + text for kind, (noun, text) in known.items() if kind in origins
    ]
    shares = [float(g.double().mean()) for g in views.ignore if g is not None]
    if shares:
        mean = sum(shares) / len(shares)
        lines.append(
            f"{count_of(len(shares), 'view')} with ignored pixels ({mean:.1%} of each on average): unknown, so "
            "in no loss and no metric, and they do not carve"
        )
    return lines
