"""The visible domain as bounds of a radiance field's samples (the paper's section 4.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.local_frame import capture_ball
from visdom_plugin.geometry.pixel_rays import rays_of_pixels
from visdom_plugin.hooks import torch_ops
from visdom_plugin.hooks.protocols import EmptyRays, RayBounds
from visdom_plugin.hooks.settings import SamplerSettings
from visdom_plugin.hooks.virtual_views import OutsideRays, virtual_views
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import Crossing, cast

CAMERA_DISTANCE_HULL_RADII = 10 / 3
"""How far cameras are that nobody told of: about where the object fills half of the picture."""

MOST_PIXELS = 1 << 26
"""Pixels whose crossings are kept: 600 MB."""
PIXELS_AT_ONCE = 1 << 18


def _limit(value: Tensor | float, like: Tensor) -> Tensor:
    value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    try:
        return value.expand(like.shape)
    except RuntimeError as error:
        raise ConfigError(
            f"near or far has shape {tuple(value.shape)}, the rays have {tuple(like.shape)}",
            where="VisDomSampler.bound",
            todo="pass a number, or one value per ray without a last dimension of size 1: near[..., 0]",
        ) from error


def _epsilon_world(config: SamplerSettings, hull: Hull, cameras: Cameras | None) -> float:
    """How far the band reaches from the hull, in scene units."""
    units = ("epsilon_hull_radii", "epsilon_world", "epsilon_capture_radii")
    given = [f"{name} = {getattr(config, name)}" for name in units if getattr(config, name) is not None]
    if len(given) > 1:
        raise ConfigError(
            f"epsilon is given twice: {' and '.join(given)}", todo=f"give one of {', '.join(units)}"
        )
    if config.epsilon_world is not None:
        return config.epsilon_world
    if config.epsilon_hull_radii is not None:
        return config.epsilon_hull_radii * hull.radius
    if config.epsilon_capture_radii is not None:
        if cameras is None:
            raise ConfigError(
                "epsilon_capture_radii needs the training cameras, whose spread is its unit",
                where="VisDomSampler",
                todo="pass the batch of all training cameras: VisDomSampler(hull, cameras=cameras, ...)",
            )
        return config.epsilon_capture_radii * float(capture_ball(cameras)[1])
    distance = CAMERA_DISTANCE_HULL_RADII * hull.radius
    if cameras is not None:
        offsets = cameras.centres.cpu().numpy() - hull.centre
        distance = sum((d @ d) ** 0.5 for d in offsets) / len(cameras)
    return config.epsilon_camera_distances * distance


@dataclass
class _Pixels:
    """All training pixels, and where their rays meet the hull."""

    cameras: Cameras
    ends: Tensor
    """(N,) int64 one past each view's last pixel."""
    found: Crossing | None = None
    """(P,) float32, float32 and bool."""

    def crossing(self, hull: Hull) -> Crossing:
        """Of all pixels; found once."""
        if self.found is None:
            parts = []
            for begin in range(0, int(self.ends[-1]), PIXELS_AT_ONCE):
                end = min(begin + PIXELS_AT_ONCE, int(self.ends[-1]))
                flat = torch.arange(begin, end, device=self.ends.device)
                view = torch.searchsorted(self.ends, flat, right=True)
                start = self.ends[view] - (self.cameras.width * self.cameras.height)[view]
                parts.append(cast(hull, *rays_of_pixels(self.cameras, view, flat - start)))
            self.found = Crossing(*(torch.cat(x) for x in zip(*parts, strict=True)))
        return self.found


class VisDomSampler:
    """Confines a ray's samples to a band around the hull.

    Three lines in any trainer of radiance fields:

        sampler = VisDomSampler(hull)
        near, far, hit = sampler(origins, directions, near, far)
        # sample between near and far as before

    With t_first and t_last where the ray enters the hull and leaves it for good, the interval is

        first_hit:  [t_first - epsilon, t_first + epsilon]   (the paper's)
        entry_exit: [t_first - epsilon, t_last + epsilon]

    cut to the caller's [near, far]; `front_share` shortens the part in front. That is for the rays of training,
    beside a mask loss (`losses.mask_loss`, with the paper's weight 0.1); novel views are drawn over the full
    range.

    Args:
        hull: the visible domain; fixed from here on.
        config: its settings, SamplerSettings's own by default.
        cameras: (N,) training cameras, whose mean distance from the hull's centre is the unit of
            `epsilon_camera_distances`; without them it is 10/3 radii of the hull.
        settings: single fields of the config to change: `VisDomSampler(hull, missing="skip")`.

    Raises:
        ConfigError: for a setting out of range, or an epsilon in two units.
    """

    def __init__(
        self,
        hull: Hull,
        config: SamplerSettings | None = None,
        *,
        cameras: Cameras | None = None,
        **settings: Any,
    ):
        self.hull = hull
        self.config = config = replace(config or SamplerSettings(), **settings)
        if config.interval not in ("first_hit", "entry_exit") or config.missing not in ("full", "skip"):
            raise ConfigError(
                f"interval={config.interval!r}, missing={config.missing!r}: interval must be 'first_hit' or "
                "'entry_exit', missing 'full' or 'skip'"
            )
        self.epsilon_world = epsilon = float(_epsilon_world(config, hull, cameras))
        if not (
            config.virtual_views in ("none", "between", "midpoints")
            and 0 <= config.virtual_weight < float("inf")
            and 0 < config.virtual_rays < float("inf")
        ):
            raise ConfigError(
                f"virtual_views={config.virtual_views!r}, virtual_weight={config.virtual_weight}, "
                f"virtual_rays={config.virtual_rays}: virtual_views must be 'none', 'between' or 'midpoints', "
                "virtual_weight 0 or more, virtual_rays above 0",
                where="VisDomSampler",
            )
        if not 0 <= epsilon < float("inf") or (config.interval == "first_hit" and epsilon == 0):
            raise ConfigError(
                f"epsilon = {epsilon:g} scene units leaves no band to sample",
                cause="an empty hull, or an epsilon that is negative, zero or not a number",
                todo="give a positive epsilon_camera_distances, epsilon_hull_radii or epsilon_world",
            )
        if not 0 <= config.front_share < float("inf"):
            raise ConfigError(
                f"front_share = {config.front_share} is out of range",
                where="VisDomSampler",
                todo="choose 0 or more",
            )
        self._outside: OutsideRays | None = None
        if config.virtual_views != "none":
            if cameras is None or len(cameras) < 2:
                raise ConfigError(
                    f"virtual_views={config.virtual_views!r} needs at least two training cameras to stand between",
                    where="VisDomSampler",
                    todo="pass the batch of all training cameras: VisDomSampler(hull, cameras=cameras, ...)",
                )
            here = cameras.to("cpu")
            look_at = torch.as_tensor(hull.centre).to(here.world_from_camera)
            self._outside = OutsideRays(hull, virtual_views(here, config.virtual_views, look_at))
        self._pixels: _Pixels | None = None
        self._number = torch_ops.enter(self)

    @property
    def drop_outside(self) -> bool:
        """Whether `keep` has a say: a method that can shall then ask it about each sample."""
        return self.config.drop_outside

    @property
    def virtual_weight(self) -> float:
        """Weight of the loss on `empty_rays`; 0 where there are no virtual views."""
        return 0.0 if self._outside is None else self.config.virtual_weight

    def empty_rays(
        self, photographed: int, generator: Generator | None = None, device: torch.device | None = None
    ) -> EmptyRays:
        """Rays of virtual views that miss the hull, `virtual_rays` for each of `photographed` ones.

        Three lines in any trainer, besides those that bound its rays:

            rays = sampler.empty_rays(len(batch))
            alpha = opacity(rays.origins, rays.directions)   # within the trainer's own near and far
            loss = loss + sampler.virtual_weight * mask_loss(alpha, torch.zeros_like(alpha))

        Args:
            generator: CPU generator that draws them; the default is torch's global one.
            device: where they are wanted, the CPU by default.

        Raises:
            ConfigError: the sampler was made without virtual views.
        """
        if self._outside is None:
            raise ConfigError(
                "the sampler has no virtual views", todo='make it with virtual_views="between" or "midpoints"'
            )
        count = max(1, round(self.config.virtual_rays * photographed))
        return self._outside.draw(count, generator, device or torch.device("cpu"))

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._number = torch_ops.enter(self)

    def __call__(
        self, origins: Tensor, directions: Tensor, near: Tensor | float, far: Tensor | float
    ) -> RayBounds:
        """The same as `bound`."""
        return self.bound(origins, directions, near, far)

    def bound(
        self, origins: Tensor, directions: Tensor, near: Tensor | float, far: Tensor | float
    ) -> RayBounds:
        """Where along each ray samples may be taken. Pure; no gradient.

        A ray counts as a hit only when its band overlaps the caller's [near, far].

        Args:
            origins, directions: (..., 3) tensors or arrays, world frame, broadcast against each other; directions
                of any length but zero.
            near, far: (...) tensors or numbers, in units of the direction's length. Where far < near, as of a ray
                that misses the caller's box, far is taken to be near.

        Returns:
            RayBounds of shape (...), in the directions' dtype, on their device; near <= far everywhere. In half
            precision the band is rounded outwards.

        Raises:
            ConfigError: when near or far does not fit the rays' shape.
        """
        origins, directions = (torch.as_tensor(x).detach() for x in (origins, directions))
        if not directions.is_floating_point():
            directions = directions.double()
        if torch.compiler.is_compiling():
            near, far = (torch.as_tensor(x, device=directions.device).detach() for x in (near, far))
            return RayBounds(
                *torch.ops.visdom_plugin.ray_bounds(origins, directions, near, far, self._number)
            )
        half = directions.dtype if directions.dtype in (torch.float16, torch.bfloat16) else None
        if half:
            directions = directions.float()
        with torch.no_grad():
            return self._limit_band(cast(self.hull, origins, directions), directions, near, far, half)

    def follow_pixels(self, cameras: Cameras) -> None:
        """Names the training cameras (N,) whose pixels `bound_pixels` is asked about.

        Where they meet the hull is found at the first question, once for all of them, and kept: 9 bytes per pixel.
        Above `MOST_PIXELS` pixels each question is answered for itself.
        """
        ends = (cameras.width * cameras.height).cumsum(0)
        self._pixels = _Pixels(cameras, ends) if int(ends[-1]) <= MOST_PIXELS else None

    def bound_pixels(
        self, pixels: Tensor, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
    ) -> RayBounds:
        """The same as `bound`, for pixels (n,) of the cameras that `follow_pixels` was told of."""
        if self._pixels is None:
            return self.bound(origins, directions, near, far)
        with torch.no_grad():
            crossing = self._pixels.crossing(self.hull)
            found = Crossing(*(x[pixels] for x in crossing))
            return self._limit_band(found, directions.detach(), near, far, None)

    def _limit_band(
        self,
        crossing: Crossing,
        directions: Tensor,
        near: Tensor | float,
        far: Tensor | float,
        half: torch.dtype | None,
    ) -> RayBounds:
        """The band around a crossing, inside [near, far], rounded outwards to half precision if asked for."""
        first = crossing.t_first
        near, far = (_limit(x, first) for x in (near, far))
        far = torch.maximum(far, near)
        last = first if self.config.interval == "first_hit" else crossing.t_last
        epsilon = self.epsilon_world / directions.norm(dim=-1).to(first)
        front = epsilon if self.config.front_share == 1 else self.config.front_share * epsilon
        begin, end = torch.maximum(near, first - front), torch.minimum(far, last + epsilon)
        hit = crossing.hit & (begin < end)
        if half:
            rounding = torch.finfo(half).eps
            begin = torch.maximum(near.to(half), (begin - rounding * begin.abs()).to(half))
            end = torch.minimum(far.to(half), (end + rounding * end.abs()).to(half))
            near, far = near.to(half), far.to(half)
        begin = torch.where(hit, begin, near)
        end = torch.where(hit, end, far if self.config.missing == "full" else near)
        return RayBounds(begin, end, hit)

    def keep(self, points: Tensor) -> Tensor:
        """(...) bool of sample points (..., 3), world frame: False where they shall count nothing."""
        if torch.compiler.is_compiling():
            return torch.ops.visdom_plugin.keep(points.detach(), self._number)
        if not self.drop_outside:
            return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
        return self.hull.contains(points)
