"""Protocols of the hooks: the places where a constraint enters a trainer.

Hooks never own an optimiser, never step, never know the method's name and never import a rasteriser: they
are handed callables. Several hooks are a list, applied in order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Generator, Tensor

from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render


class RayBounds(NamedTuple):
    """Where along each ray samples may be taken."""

    near: Tensor
    """(...) distance from the origin in units of the direction's length."""
    far: Tensor
    """(...) same unit, >= near."""
    hit: Tensor
    """(...) bool, True where the ray meets the hull."""


@runtime_checkable
class SamplerHook(Protocol):
    """What NeRF methods call where they would use near and far.

    In training, a method takes no samples outside the bounds, and none at all where near = far: what lies beyond
    has no part in colour, opacity and gradient. All levels of a hierarchical sampler are inside.
    """

    def bound(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> RayBounds:
        """Bounds inside [near, far], in the directions' dtype and on their device.

        Pure, without gradient, any leading shape: nothing handed in is changed, the same question has the same
        answer, no random numbers are drawn.

        Args:
            origins, directions: (..., 3) world frame.
            near, far: (...) the method's own bounds; where far < near there is nothing to sample.
        """
        ...


@runtime_checkable
class PixelSampler(Protocol):
    """What a sampler hook may offer besides: to be asked once about all training pixels, whose rays never change.

    A method may ask `bound` about them, keep the answers, and not ask again."""

    def follow_pixels(self, cameras: Cameras) -> None:
        """Names the training cameras (N,), on the device of the rays; called in `setup`, if at all."""
        ...

    def bound_pixels(
        self, pixels: Tensor, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
    ) -> RayBounds:
        """The same as `bound` on `geometry.pixel_rays.rays_of_pixels`, bit for bit on the CPU.

        Args:
            pixels: (n,) int64 numbers among the cameras' pixels, view by view and row by row.
        """
        ...


@runtime_checkable
class SampleFilter(Protocol):
    """What a sampler hook may offer besides: a say about each sample (VaxNeRF, Kondo et al. 2021).

    Bounds alone let a ray sample the gaps between the parts of a hull. A method that drops single samples asks
    `sample_filters(hooks)`; one that cannot refuses the setting `vd.drop_outside`.
    """

    @property
    def drop_outside(self) -> bool:
        """Whether `keep` has a say; where it has not, it need not be asked."""
        ...

    def keep(self, points: Tensor) -> Tensor:
        """(...) bool of sample points (..., 3), world frame: False where they shall count nothing."""
        ...


def sample_filters(hooks: Sequence[object]) -> list[SampleFilter]:
    """The hooks that have a say about single samples."""
    return [hook for hook in hooks if isinstance(hook, SampleFilter) and hook.drop_outside]


class EmptyRays(NamedTuple):
    """Rays along which there is nothing, because they miss the hull."""

    origins: Tensor
    """(n, 3) float32, in the frame of the training cameras."""
    directions: Tensor
    """(n, 3) float32, unit."""
    radii: Tensor
    """(n,) float32 radius of a pixel's cone at distance 1, of a training view's pixels."""


@runtime_checkable
class EmptySpace(Protocol):
    """What a sampler hook may offer besides: rays along which a method is to learn that there is nothing.

    A method adds `virtual_weight` times the mean cross entropy between their opacity and 0 (`losses.mask_loss`) to
    its loss. They are sampled within the method's own bounds, without any hook's.
    """

    @property
    def virtual_weight(self) -> float:
        """Weight of that loss; at 0 rays need not be asked for."""
        ...

    def empty_rays(
        self, photographed: int, generator: Generator | None = None, device: torch.device | None = None
    ) -> EmptyRays:
        """The rays of a step that has `photographed` rays of photographs; there may be none.

        Args:
            generator: CPU generator that draws them; the default is torch's global one.
            device: where they are wanted, the CPU by default.
        """
        ...


def empty_spaces(hooks: Sequence[object]) -> list[EmptySpace]:
    """The hooks that want rays of empty space trained."""
    return [hook for hook in hooks if isinstance(hook, EmptySpace) and hook.virtual_weight > 0]


class Placed(Protocol):
    """Gaussians, as far as hooks know them."""

    @property
    def means(self) -> Tensor:
        """(N, 3) centres, world frame."""
        ...


class Means(NamedTuple):
    """Gaussians of a trainer that has no object for them."""

    means: Tensor
    """(N, 3) centres, world frame."""


@runtime_checkable
class GaussianHook(Protocol):
    """What Gaussian splatting methods call at the start, for the loss, and after each step.

    Random numbers come from the generators handed in alone, so that the same question has the same answer.
    """

    def initial_points(self, n: int, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
        """At most `n` starting points: xyz (M, 3) world frame and rgb (M, 3) in [0, 1].

        The same ones each time without a `generator`.
        """
        ...

    def loss(self, render: Callable[[Cameras], Render], step: int, generator: Generator) -> dict[str, Tensor]:
        """Named, weighted scalars to add to the method's loss; empty when there is nothing to add.

        `render` draws the current Gaussians from one camera, with gradients.
        """
        ...

    def after_step(self, gaussians: Placed, step: int) -> Tensor | None:
        """Called after the optimiser's step with the method's Gaussians.

        Returns (N,) bool, True for Gaussians the method should remove, or None.
        """
        ...
