"""One door to both rasterisers."""

from __future__ import annotations

from torch import Tensor

from visdom_plugin.errors import ConfigError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.render import Render
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.spherical_harmonics import MAX_DEGREE

NEAR = 0.01
"""Where pictures begin, in mean distances of the cameras from what they look at."""


def rasterise(
    gaussians: Gaussians,
    camera: Cameras,
    background: Tensor,
    *,
    sh_degree: int | None = None,
    backend: str = "auto",
    near: float | None = None,
) -> Render:
    """Draws Gaussians as one camera sees them, differentiable in every parameter and the background.

    The image model is gsplat's "classic" mode (3DGS): EWA projection with the Jacobian clamped, 0.3 px^2 added to
    the covariance, alpha = min(0.999, opacity exp(-sigma)) skipped below 1/255, front to back by camera z until
    the transmittance would fall to 1e-4, pixel centres at +0.5. Gaussians of equal z keep their order. The
    camera gets no gradient.

    Args:
        gaussians: N >= 0 Gaussians, world frame; float32, or float64 on the CPU.
        camera: one camera, of shape ().
        background: (3,) colour in the space of the Gaussians' colours.
        sh_degree: harmonics in use, at most the stored degree; None uses all.
        backend: "cpu", "gsplat" (CUDA), or "auto": by the device of the Gaussians.
        near: Gaussians nearer than this camera z are not drawn, scene units; None for a hundredth of the camera's
            distance from their middle, which a GPU waits for.

    Returns:
        Render whose info holds means2d (N, 2) pixels, whose `.grad` after a backward pass is the gradient by the
        pixel-space means; radii (N, 2) int32 pixels, 0 where not drawn; visible (N,) bool; conics (N, 3)
        per px^2; colours (N, 3) (CPU only); depths (N,) camera z; width and height.

    Raises:
        ConfigError: for an unknown backend, a backend that does not fit the device, or a degree not stored.
        PluginError: when gsplat is needed and missing.
    """
    degree = gaussians.degree if sh_degree is None else sh_degree
    if not 0 <= degree <= min(gaussians.degree, MAX_DEGREE):
        raise ConfigError(
            f"sh_degree is {degree}, the Gaussians hold harmonics to degree {gaussians.degree}",
            todo=f"use a degree from 0 to {min(gaussians.degree, MAX_DEGREE)}",
        )
    if camera.shape:
        raise ConfigError(
            f"rasterise draws one camera, {tuple(camera.shape)} were given", todo="index one: cameras[i]"
        )
    on_cpu = gaussians.means.device.type == "cpu"
    background = background.to(gaussians.means)
    chosen = ("cpu" if on_cpu else "gsplat") if backend == "auto" else backend
    if chosen not in ("cpu", "gsplat"):
        raise ConfigError(f"unknown backend {backend!r}", todo='use "auto", "cpu" or "gsplat"')
    if (chosen == "cpu") != on_cpu:
        raise ConfigError(
            f"backend {chosen!r} cannot draw Gaussians on device {gaussians.means.device}",
            todo='use backend="auto", or move the Gaussians with .to(device)',
        )
    if near is None:
        near = NEAR * float((gaussians.means.detach().mean(0) - camera.centres.to(gaussians.means)).norm())
    if chosen == "cpu":
        from visdom_plugin.splat.cpu.backend import rasterise_cpu as draw
    else:
        from visdom_plugin.splat.backend_gsplat import rasterise_gsplat as draw
    return draw(gaussians, camera, background, degree, near)
