"""Colours as spherical harmonics, as 3DGS has them:

colour = max(0, sum_b basis_b(direction) sh_b + 0.5), the direction from the camera's centre to the mean.
"""

from __future__ import annotations

from torch import Tensor

from visdom_plugin.geometry.harmonics import C0

MAX_DEGREE = 3


def sh_from_rgb(rgb: Tensor) -> Tensor:
    """Constant coefficients (..., 3) that show the colours (..., 3) from every side."""
    return (rgb - 0.5) / C0
