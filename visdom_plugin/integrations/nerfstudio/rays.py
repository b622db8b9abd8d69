"""The sampler hook on rays of nerfstudio's frame: plain arithmetic, without nerfstudio."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.hooks.protocols import RayBounds, SamplerHook
from visdom_plugin.integrations.nerfstudio.frame import Similarity


@torch.no_grad()
def bound_model_rays(
    hook: SamplerHook, frame: Similarity, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
) -> RayBounds:
    """Bounds by the hull, which lives in the world, for rays of the model's frame, before any contraction.

    Args:
        origins, directions: (..., 3) model frame.
        near, far: (...) the model's own bounds, along the directions in model units.

    Returns:
        RayBounds of shape (...) in model units, in `near`'s dtype, on its device; inside [near, far].
    """
    bounds = hook.bound(
        frame.points_to_world(origins),
        frame.directions_to_world(directions),
        near.double() / frame.scale,
        far.double() / frame.scale,
    )
    # Rounding on the way to the world and back must not leave the model's own bounds.
    begin = torch.maximum((bounds.near * frame.scale).to(near), near)
    end = torch.minimum((bounds.far * frame.scale).to(far), far)
    return RayBounds(begin, torch.maximum(end, begin), bounds.hit)
