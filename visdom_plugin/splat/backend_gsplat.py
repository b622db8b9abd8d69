"""The rasteriser on CUDA: gsplat >= 1.5 (the extra [cuda])."""

from __future__ import annotations

import torch
from torch import Tensor

from visdom_plugin.errors import PluginError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.splat.gaussians import Gaussians


def rasterise_gsplat(
    gaussians: Gaussians, camera: Cameras, background: Tensor, degree: int, near: float
) -> Render:
    """See `rasterise`."""
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise PluginError(
            "drawing Gaussians on CUDA needs gsplat, which cannot be imported",
            cause=str(error),
            todo='pip install "visdom-plugin[cuda]", or use --device cpu',
            topic="not-installed",
        ) from error
    means = gaussians.means
    width, height = camera.size
    colours, alphas, meta = rasterization(
        means=means,
        quats=gaussians.quaternions,
        scales=gaussians.log_scales.exp(),
        opacities=gaussians.opacity_logits.sigmoid(),
        colors=gaussians.sh,
        viewmats=camera.camera_from_world.to(means)[None],
        Ks=camera.intrinsics.to(means)[None],
        width=width,
        height=height,
        near_plane=near,
        sh_degree=degree,
        packed=False,
        backgrounds=background[None],
        render_mode="RGB+ED",
    )
    radii = meta["radii"][0]
    info = {
        "means2d": _with_gradient_of_first(meta["means2d"]),
        "radii": radii,
        "visible": (radii > 0).all(-1),
        "conics": meta["conics"][0].detach(),
        "depths": meta["depths"][0].detach(),
        "width": width,
        "height": height,
    }
    return Render(colours[0, ..., :3], alphas[0, ..., 0], colours[0, ..., 3], info)


def _with_gradient_of_first(means2d: Tensor) -> Tensor:
    """(N, 2) copy of the first camera's means (1, N, 2) whose `.grad` a backward pass fills in."""
    first = means2d[0].detach()

    def keep(gradient: Tensor) -> None:
        first.grad = gradient[0] if first.grad is None else first.grad + gradient[0]

    if means2d.requires_grad and torch.is_grad_enabled():
        means2d.register_hook(keep)
    return first
