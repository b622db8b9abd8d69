"""The visible domain as a soft constraint on Gaussians (the paper's section 4.3, equation for L_i)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.camera_paths import draw_between
from visdom_plugin.geometry.cameras import Cameras, project, require_batch
from visdom_plugin.geometry.local_frame import is_near
from visdom_plugin.hooks.protocols import Placed
from visdom_plugin.hooks.settings import RegularizerSettings
from visdom_plugin.hooks.virtual_views import midpoint_views
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.point_colours import check_images, colour_points
from visdom_plugin.hull.queries.raycast import depth_and_silhouette
from visdom_plugin.hull.queries.shell_points import sample_shell, voxel_centres
from visdom_plugin.losses import outside_sum

log = logging.getLogger(__name__)


def outside_loss(alpha: Tensor, hull_mask: Tensor) -> Tensor:
    """L_i = -(1 - M_i) log(1 - Mhat_i), averaged over the image: opacity beside the hull is penalised.

    Pixels on the hull add nothing, whatever their opacity: the hull is an upper bound of the object.

    Args:
        alpha: (..., H, W) rendered opacity in [0, 1].
        hull_mask: (..., H, W) bool, True where the hull is seen.

    Returns:
        Scalar.
    """
    if alpha.dtype in (torch.float16, torch.bfloat16):
        alpha = alpha.float()  # 1 - 1e-6 would round to 1
    return _Outside.apply(*torch.broadcast_tensors(alpha, hull_mask))


class _Outside(torch.autograd.Function):
    """The loss in fewer kernels than autograd makes of it; `losses.below_one` says what happens at 1."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, hull_mask: Tensor) -> Tensor:
        total, room = outside_sum(alpha, hull_mask)
        ctx.save_for_backward(room)
        return total / room.numel()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor, None]:
        (room,) = ctx.saved_tensors
        return slope / room.numel() / room, None


class Opacity(Protocol):
    """What the loss reads of a render."""

    @property
    def alpha(self) -> Tensor:
        """Opacity (H, W), (H, W, 1) or (1, H, W, 1)."""
        ...


def _opacity(drawn: Opacity | Tensor, shape: torch.Size) -> Tensor:
    """Opacity of what a renderer returned, without the dimensions of size one that rasterisers add."""
    alpha = getattr(drawn, "alpha", drawn)
    if not isinstance(alpha, Tensor):
        raise ConfigError(
            f"render(camera) returned {type(drawn).__name__}, which is no opacity",
            where="VisDomGaussianRegularizer.loss",
            cause="a renderer that returns several things: gsplat's returns colours, opacity, info",
            todo="return the opacity tensor alone, or an object that has it as .alpha",
            topic="render",
        )
    # An empty picture may be a constant.
    if torch.is_grad_enabled() and not alpha.requires_grad and bool((alpha > 0).any()):
        raise ConfigError(
            "the rendered opacity has no gradient, so the loss would change nothing",
            where="VisDomGaussianRegularizer.loss",
            cause="a render under torch.no_grad(), a detached opacity, or Gaussians that are not trained",
            todo="render with gradients; to look at the loss alone, call it under torch.no_grad(), too",
            topic="render",
        )
    kept = [d for d in alpha.shape if d != 1]
    if kept != [d for d in shape if d != 1]:
        raise ConfigError(
            f"the rendered opacity has shape {tuple(alpha.shape)}, the camera's image is {tuple(shape)}",
            where="VisDomGaussianRegularizer.loss",
            cause="a renderer that ignores the camera's width and height, or returns colours",
            todo="return opacity (H, W) of the size that camera.height and camera.width say",
            topic="render",
        )
    return alpha if alpha.shape == shape else alpha.reshape(shape)


def _check_frame(hull: Hull, cameras: Cameras) -> None:
    """Whether points in the hull fall into a picture at all."""
    points = hull.sample_inside(4096, torch.Generator().manual_seed(0))
    uv, depth = project(cameras, points)
    size = torch.stack([cameras.width, cameras.height], -1)[:, None]
    if not ((depth > 0) & (uv >= 0).all(-1) & (uv < size).all(-1)).any():
        low, high = np.round(hull.extent, 3).tolist()
        raise ConfigError(
            f"no training camera sees the hull, which reaches from {low} to {high}",
            where="VisDomGaussianRegularizer",
            cause="a hull in another frame than the cameras': one of the two was moved, scaled or turned",
            todo="carve from the poses that the trainer trains with",
            topic="render",
        )


# As torch.compiler.disable, but the compiler is imported at the first call, not with this module.
_outside_graphs = getattr(torch, "_disable_dynamo", torch.compiler.disable)


class VisDomGaussianRegularizer:
    """Initial points from a hull, and L_i on views interpolated between training cameras.

    Three lines in any trainer of Gaussians:

        hook = VisDomGaussianRegularizer(hull, cameras)
        xyz, rgb = hook.initial_points(20_000)
        loss = loss + sum(hook.loss(render).values())   # render(camera) -> object with .alpha (H, W)

    Args:
        hull: the visible domain; fixed from here on.
        cameras: (N,) training cameras, N >= 2; their interpolation gives the views of L_i. The bank of views is
            the same for every hook with the same hull and cameras, so that runs can resume.
        config: its settings, RegularizerSettings's own by default.
        images: N tensors or arrays (H, W, 3) of the cameras' sizes, integers in 0..255 or floats in [0, 1], that
            colour the initial points; grey without.
        loss_hull: the hull that L_i goes by, by default the same.
        settings: single fields of the config to change: `VisDomGaussianRegularizer(hull, cameras, weight=0.1)`.

    Raises:
        ConfigError: for fewer than two cameras, a setting out of range, images that do not fit the cameras, or a
            hull that no camera sees.
    """

    def __init__(
        self,
        hull: Hull,
        cameras: Cameras,
        config: RegularizerSettings | None = None,
        *,
        images: Sequence[Tensor | np.ndarray] | None = None,
        loss_hull: Hull | None = None,
        **settings: Any,
    ):
        require_batch(cameras, "VisDomGaussianRegularizer")
        if len(cameras) < 2:
            raise ConfigError(
                "VisDomGaussianRegularizer needs at least two training cameras to interpolate between",
                todo="pass the batch of all training cameras",
            )
        self.config = c = replace(config or RegularizerSettings(), **settings)
        if not (
            0 <= c.weight < math.inf
            and c.every >= 1
            and c.views_per_step >= 1
            and c.bank >= 0
            and c.views in ("between", "midpoints")
            and c.points in ("surface", "volume", "shell", "voxels")
            and c.prune_every >= 0
            and 0 <= c.prune_margin_voxels < math.inf
        ):
            raise ConfigError(
                f"weight={c.weight}, every={c.every}, views_per_step={c.views_per_step}, "
                f"views={c.views!r}, bank={c.bank}, "
                f"points={c.points!r}, prune_every={c.prune_every}, prune_margin_voxels={c.prune_margin_voxels}: "
                "weight, bank, prune_every and prune_margin_voxels must be >= 0, every and views_per_step >= 1, "
                "views 'between' or 'midpoints', points 'surface', 'volume', 'shell' or 'voxels'",
                where="VisDomGaussianRegularizer",
            )
        self.hull, self.cameras, self.loss_hull = hull, cameras.to("cpu"), loss_hull or hull
        for one in {id(h): h for h in (hull, self.loss_hull)}.values():
            _check_frame(one, self.cameras)
        self.images = None if images is None else check_images(images, self.cameras)
        self._device = cameras.width.device
        self._bank: dict[int, tuple[Cameras, Tensor]] = {}
        self._midpoints = midpoint_views(self.cameras) if c.views == "midpoints" else []
        self._look_at = torch.as_tensor(hull.centre).to(self.cameras.world_from_camera)
        self._warned = False

    def initial_points(self, n: int, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
        """Points to start from: xyz (n, 3) world frame and rgb (n, 3) in [0, 1], on the device of the cameras;
        fewer where `points` is "voxels" and the hull has fewer.

        They lie in `hull.inner`, the shape inside the hull, where the hull has one; in the hull itself without.

        Both are float32; only where the hull is so far from the origin that float32 would move points, xyz is
        float64. Trainers in float32 want `hull.relative_to(origin)` and `cameras.relative_to(origin)` there.
        """
        shape = self.hull.inner or self.hull
        draw = {
            "surface": Hull.sample_points,
            "volume": Hull.sample_inside,
            "shell": sample_shell,
            "voxels": voxel_centres,
        }
        xyz = draw[self.config.points](shape, n, generator)
        if is_near(self.hull.extent, float(np.ptp(self.hull.extent, axis=0).max())):
            xyz = xyz.float()
        if self.images is None:
            rgb = torch.full(xyz.shape, 0.5)
        else:
            rgb = colour_points(shape, xyz, self.cameras, self.images)
        return xyz.to(self._device), rgb.to(self._device)

    def sample_camera(self, generator: Generator | None = None) -> Cameras:
        """One camera between a random pair of training cameras, uniform in the pair and on the way."""
        return draw_between(self.cameras, self._look_at, generator)

    def loss(
        self,
        render: Callable[[Cameras], Opacity | Tensor],
        step: int | None = None,
        generator: Generator | None = None,
    ) -> dict[str, Tensor]:
        """Weighted L_i of this step, {"visdom_outside": scalar}, or {} on steps without it.

        Args:
            render: draws the current Gaussians from one camera, which is on the device and in the dtype of the
                training cameras; returns opacity (H, W), (H, W, 1) or (1, H, W, 1), or an object that has it as
                `.alpha`.
            step: the trainer's step; only the schedule (`every`, `start`) reads it, and needs it.
            generator: CPU generator that draws the views; the default is torch's global one.

        Raises:
            ConfigError: without a step when `every` or `start` is set; when `render` returns no opacity of the
                camera's size, or, while gradients are on, one without.
        """
        if not self._is_due(step):
            return {}
        losses = []
        for i in range(self.config.views_per_step):
            camera, mask = self._draw(generator, step, i)
            alpha = _opacity(render(camera), mask.shape)
            losses.append(outside_loss(alpha, mask.to(alpha.device)))
        return {"visdom_outside": self.config.weight / len(losses) * sum(losses[1:], losses[0])}

    def _is_due(self, step: int | None) -> bool:
        c = self.config
        if step is None:
            if c.every > 1 or c.start > 0:
                raise ConfigError(
                    f"every={c.every} and start={c.start} need the trainer's step",
                    where="VisDomGaussianRegularizer.loss",
                    todo="call hook.loss(render, step)",
                )
            step = c.start
        return c.weight > 0 and step >= c.start and (step - c.start) % c.every == 0

    @_outside_graphs
    def _draw(
        self, generator: Generator | None, step: int | None = None, i: int = 0
    ) -> tuple[Cameras, Tensor]:
        """The i-th view of a step and the hull's silhouette in it, (H, W) bool."""
        if not self.config.bank and not self._midpoints:
            camera = self.sample_camera(generator)
            return camera.to(self._device), depth_and_silhouette(self.loss_hull, camera)[1]
        index = self._choose(step, i, generator)
        if index not in self._bank:
            if self._midpoints:
                camera = self._midpoints[index]
            else:
                camera = self.sample_camera(torch.Generator().manual_seed(index))
            silhouette = depth_and_silhouette(self.loss_hull, camera)[1]
            self._bank[index] = camera.to(self._device), silhouette.to(self._device)
        return self._bank[index]

    def _choose(self, step: int | None, i: int, generator: Generator | None) -> int:
        """Which view of the bank, or of the midpoints, every one of which has its turn before any has another."""
        c, count = self.config, len(self._midpoints) or self.config.bank
        if not self._midpoints or step is None:
            return int(torch.randint(count, (), generator=generator))
        turn, position = divmod((step - c.start) // c.every * c.views_per_step + i, count)
        return int(torch.randperm(count, generator=torch.Generator().manual_seed(turn))[position])

    def after_step(self, gaussians: Placed, step: int) -> Tensor | None:
        """(N,) bool, True for Gaussians the trainer should remove, or None when there is nothing to do.

        Warns once when they are all outside, which trainers take for no reason to remove them.
        """
        if not self.config.prune_every or step % self.config.prune_every:
            return None
        outside = ~self.hull.contains(gaussians.means.detach(), margin_voxels=self.config.prune_margin_voxels)
        if len(outside) and not self._warned and bool(outside.all()):
            self._warned = True
            log.warning("all %d Gaussians lie outside the hull: is it in another frame?", len(outside))
        return outside
