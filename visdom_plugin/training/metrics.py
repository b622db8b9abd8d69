"""How close a rendered view is to the photograph, and its silhouette to the mask.

Conventions of every number here: whole frame, white background (the photograph is whitened outside its
mask), both images clamped to [0, 1] and rounded to 8 bits first.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import torch
from torch import Tensor

log = logging.getLogger(__name__)

PerceptualDistance: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""Two images (1, 3, H, W) in [-1, 1] to their distance, a scalar."""

SILHOUETTE_ALPHA = 0.5
PROTOCOL = {"background": "white", "definition": 1}
"""Noted beside the numbers. `definition` goes up with every change of what a number here means, so that tables do
not set the old and the new side by side."""
NAMES = (
    "psnr",
    "psnr_per_channel",
    "ssim",
    "ssim_uniform7",
    "psnr_foreground",
    "silhouette_iou",
    "outside_hull_mass",
    "lpips",
)


def whiten(image: Tensor, mask: Tensor) -> Tensor:
    """The photograph on white: (H, W, 3) uint8 and (H, W) bool to (H, W, 3) float64 in [0, 1]."""
    return torch.where(mask[..., None], image.double() / 255, 1.0)


def psnr(x: Tensor, y: Tensor) -> float:
    """Peak signal-to-noise ratio in dB, one mean squared error over pixels and channels; peak 1."""
    return _decibel((x - y).square().mean())


def psnr_per_channel(x: Tensor, y: Tensor) -> float:
    """Mean over channels of each channel's PSNR, GaussianObject's main number; never below `psnr`."""
    errors = (x - y).square().flatten(0, -2).mean(0)
    return sum(_decibel(error) for error in errors) / len(errors)


def psnr_foreground(x: Tensor, y: Tensor, mask: Tensor) -> float:
    """PSNR over the mask's pixels alone; NaN for an empty mask."""
    return psnr(x[mask], y[mask]) if bool(mask.any()) else math.nan


def ssim_uniform7(x: Tensor, y: Tensor) -> float:
    """Mean structural similarity over windows of 7 x 7 equal weights that lie inside the image, channels apart.

    The variant of scikit-image (sample covariance), which the paper's release says is the paper's; `ssim` is that
    of 3DGS. NaN for an image smaller than a window.

    Args:
        x, y: (H, W, 3) float64 in [0, 1].
    """
    from skimage.metrics import structural_similarity

    if min(x.shape[:2]) < 7:
        return math.nan
    return float(structural_similarity(x.numpy(), y.numpy(), win_size=7, channel_axis=-1, data_range=1.0))


def silhouette_iou(alpha: Tensor, mask: Tensor) -> float:
    """Intersection over union of `alpha > 0.5` and the mask, both (H, W); 1 when both are empty."""
    drawn = alpha > SILHOUETTE_ALPHA
    union = (drawn | mask).sum()
    return float((drawn & mask).sum() / union) if union else 1.0


def outside_hull_mass(alpha: Tensor, hull_silhouette: Tensor) -> float:
    """Share of the opacity that lies outside the hull, as one view sees it.

    The sum of alpha over pixels whose ray misses the hull, divided by the sum over all pixels: 0 when all
    opacity falls inside the hull's silhouette, 1 when none does, 0 for an empty image. A floater in front of
    or behind the hull goes uncounted in this view and shows in another.

    Args:
        alpha: (H, W) in [0, 1].
        hull_silhouette: (H, W) bool, True where the pixel's ray meets the hull.
    """
    total = alpha.double().sum()
    return float(alpha.double()[~hull_silhouette].sum() / total) if total > 0 else 0.0


def compare(
    rgb: Tensor,
    alpha: Tensor,
    image: Tensor,
    mask: Tensor,
    *,
    hull_silhouette: Tensor | None = None,
    perceptual: PerceptualDistance | None = None,
    ignore: Tensor | None = None,
) -> dict[str, float]:
    """All metrics of one view.

    Args:
        rgb: (H, W, 3) render on white, unclamped.
        alpha: (H, W) its opacity.
        image: (H, W, 3) uint8 photograph.
        mask: (H, W) bool.
        hull_silhouette: (H, W) bool, the reference hull seen by this camera.
        perceptual: the network of `load_lpips`.
        ignore: (H, W) bool, pixels that count for nothing; None where all count. SSIM and LPIPS see them white
            in both pictures. SSIM is 1 - (1 - S) / share, with S its mean over the whole frame and `share` that of
            the pixels that count: their mean, less what ignored pixels lose whose windows reach among them.

    Returns:
        A dict with the keys `NAMES`; NaN where a metric does not apply.
    """
    from visdom_plugin.render import quantise
    from visdom_plugin.ssim import ssim

    x, y = quantise(rgb), quantise(whiten(image, mask))
    if ignore is None or not bool(ignore.any()):
        similarity, uniform = float(ssim(x.float(), y.float())), ssim_uniform7(x, y)
        a, b = x, y
    else:
        counted = ~ignore
        if not bool(counted.any()):
            return dict.fromkeys(NAMES, math.nan)
        x, y = (torch.where(counted[..., None], z, 1.0) for z in (x, y))
        share = float(counted.double().mean())
        similarity, uniform = (
            1 - (1 - s) / share for s in (float(ssim(x.float(), y.float())), ssim_uniform7(x, y))
        )
        # One row of the pixels that count: the other metrics do not ask how they lie.
        a, b, mask, alpha = x[counted][None], y[counted][None], mask[counted][None], alpha[counted][None]
        hull_silhouette = None if hull_silhouette is None else hull_silhouette[counted][None]
    return {
        "psnr": psnr(a, b),
        "psnr_per_channel": psnr_per_channel(a, b),
        "ssim": similarity,
        "ssim_uniform7": uniform,
        "psnr_foreground": psnr_foreground(a, b, mask),
        "silhouette_iou": silhouette_iou(alpha, mask),
        "outside_hull_mass": math.nan
        if hull_silhouette is None
        else outside_hull_mass(alpha, hull_silhouette),
        "lpips": math.nan if perceptual is None else lpips(perceptual, x, y),
    }


def mean_over_views(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean of each metric over the views where it is defined; NaN where it is defined for none."""
    means = {}
    for name in NAMES:
        values = [row[name] for row in rows if not math.isnan(row[name])]
        means[name] = sum(values) / len(values) if values else math.nan
    return means


def lpips(network: PerceptualDistance, x: Tensor, y: Tensor) -> float:
    """LPIPS-VGG (Zhang et al. 2018) of two images (H, W, 3) in [0, 1], in the network's own range [-1, 1]."""
    with torch.no_grad():
        pair = [(2 * image.float() - 1).permute(2, 0, 1)[None] for image in (x, y)]
        return float(network(*pair))


def load_lpips() -> PerceptualDistance | None:
    """The LPIPS network, or None, with a message that says what is missing.

    The weights of its backbone must already be on this machine; nothing is downloaded.
    """
    try:
        import lpips as package
    except ImportError:
        return None
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "vgg16-397923af.pth"
    if not weights.exists():
        log.warning(
            "LPIPS is left out: its VGG weights are not at %s\n  what to do: on a machine with a network "
            "run `python -c 'import lpips; lpips.LPIPS(net=\"vgg\")'` and copy that file, then visdom-eval",
            weights,
        )
        return None
    return package.LPIPS(net="vgg", verbose=False).eval().requires_grad_(False)


def _decibel(mse: Tensor) -> float:
    return -10 * math.log10(float(mse)) if mse > 0 else math.inf
