"""The visible domain as bounds of a radiance field's samples (the paper's section 4.2)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.hooks import torch_ops
from visdom_plugin.hooks.protocols import RayBounds
from visdom_plugin.hull.hull import Hull
from visdom_plugin.hull.queries.raycast import cast

DEFAULT_EPSILON_HULL_RADII = 0.1
"""About 0.03 camera distances for an object that fills half the picture; FINDINGS.md has the sweep."""


def _limit(value, like: Tensor) -> Tensor:
    value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    try:
        return value.expand(like.shape)
    except RuntimeError as error:
        raise ConfigError(
            f"near or far has shape {tuple(value.shape)}, the rays have {tuple(like.shape)}",
            where="VisDomSampler.bound",
            todo="pass a number, or one value per ray without a last dimension of size 1: near[..., 0]",
        ) from error


class VisDomSampler:
    """Confines a ray's samples to a band around the hull.

    Three lines in any trainer of radiance fields:

        sampler = VisDomSampler(hull)
        near, far, hit = sampler(origins, directions, near, far)
        # sample between near and far as before

    With t_first and t_last where the ray enters the hull and leaves it for good, the interval is

        first_hit:  [t_first - epsilon, t_first + epsilon]   (the paper's)
        entry_exit: [t_first - epsilon, t_last + epsilon]

    cut to the caller's [near, far]. That is for the rays of training, beside a mask loss (`losses.mask_loss`, with
    the paper's weight 0.1); novel views are drawn over the full range.

    Args:
        hull: the visible domain; fixed from here on.
        epsilon_hull_radii: half width of the band in units of `hull.radius`.
        epsilon_world: the same in scene units; give one of the two.
        interval: see above.
        missing: what happens to rays that miss the hull. "full" leaves them the caller's bounds, so that a mask
            loss clears the space around the object; "skip" gives them an empty interval, near = far.
        drop_outside: the method shall ask `keep` about each sample, too (VaxNeRF, Kondo et al. 2021). Bounds alone
            let a ray sample the gaps between the parts of a hull.

    Raises:
        ConfigError: for a setting out of range, or an epsilon in two units.
    """

    def __init__(
        self,
        hull: Hull,
        *,
        epsilon_hull_radii: float | None = None,
        epsilon_world: float | None = None,
        interval: Literal["first_hit", "entry_exit"] = "entry_exit",
        missing: Literal["full", "skip"] = "full",
        drop_outside: bool = False,
    ):
        if epsilon_hull_radii is not None and epsilon_world is not None:
            raise ConfigError(
                f"epsilon is given twice: {epsilon_hull_radii} hull radii and {epsilon_world} scene units",
                todo="give one of epsilon_hull_radii and epsilon_world",
            )
        if interval not in ("first_hit", "entry_exit") or missing not in ("full", "skip"):
            raise ConfigError(
                f"interval={interval!r}, missing={missing!r}: interval must be 'first_hit' or 'entry_exit', "
                "missing 'full' or 'skip'"
            )
        if epsilon_world is None:
            radii = DEFAULT_EPSILON_HULL_RADII if epsilon_hull_radii is None else epsilon_hull_radii
            epsilon_world = radii * hull.radius
        if not 0 <= epsilon_world < float("inf") or (interval == "first_hit" and epsilon_world == 0):
            raise ConfigError(
                f"epsilon = {epsilon_world:g} scene units leaves no band to sample",
                cause="an empty hull, or an epsilon that is negative, zero or not a number",
                todo="give a positive epsilon_hull_radii or epsilon_world",
            )
        self.hull, self.epsilon_world = hull, float(epsilon_world)
        self.interval, self.missing, self.drop_outside = interval, missing, drop_outside
        self._number = torch_ops.enter(self)

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._number = torch_ops.enter(self)

    def __call__(self, origins: Tensor, directions: Tensor, near, far) -> RayBounds:
        """The same as `bound`."""
        return self.bound(origins, directions, near, far)

    def bound(self, origins: Tensor, directions: Tensor, near, far) -> RayBounds:
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
            crossing = cast(self.hull, origins, directions)
            first = crossing.t_first
            near, far = (_limit(x, first) for x in (near, far))
            far = torch.maximum(far, near)
            last = first if self.interval == "first_hit" else crossing.t_last
            epsilon = self.epsilon_world / directions.norm(dim=-1).to(first)
            begin, end = torch.maximum(near, first - epsilon), torch.minimum(far, last + epsilon)
            hit = crossing.hit & (begin < end)
            if half:
                rounding = torch.finfo(half).eps
                begin = torch.maximum(near.to(half), (begin - rounding * begin.abs()).to(half))
                end = torch.minimum(far.to(half), (end + rounding * end.abs()).to(half))
                near, far = near.to(half), far.to(half)
            begin = torch.where(hit, begin, near)
            end = torch.where(hit, end, far if self.missing == "full" else near)
        return RayBounds(begin, end, hit)

    def keep(self, points: Tensor) -> Tensor:
        """(...) bool of sample points (..., 3), world frame: False where they shall count nothing."""
        if torch.compiler.is_compiling():
            return torch.ops.visdom_plugin.keep(points.detach(), self._number)
        if not self.drop_outside:
            return torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
        return self.hull.contains(points)
