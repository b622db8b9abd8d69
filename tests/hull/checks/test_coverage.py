"""Coverage of masks, and what an image's border says."""

import numpy as np
import pytest
import torch

from tests.hull.balls import box_masks, ring
from visdom_plugin.hull.checks.coverage import measure_coverage
from visdom_plugin.hull.checks.mask_checks import border_share
from visdom_plugin.hull.domain import VisibleDomain

SMALL = VisibleDomain(resolution=64)
BOX = ((-0.4, -0.5, -0.3), (0.5, 0.3, 0.4))


def test_coverage_counts_pixels():
    cameras = ring(3, size=64)
    masks = box_masks(cameras, *BOX)
    hull = SMALL.carve(cameras, masks)
    half = [m.clone() for m in masks]
    for m in half:
        m[:, 32:] = False
    for full, part, mask, cut in zip(
        measure_coverage(hull, cameras, masks),
        measure_coverage(hull, cameras, half),
        masks,
        half,
        strict=True,
    ):
        assert full.inside > 0.99 and full.covered > 0.9
        assert part.inside == pytest.approx(cut.sum().item() / mask.sum().item(), abs=0.05)
    assert measure_coverage(hull, cameras, [torch.zeros_like(m) for m in masks])[0].covered == 1.0


def test_border_share():
    mask = np.zeros((4, 5), bool)
    mask[0] = True
    assert border_share(mask) == 5 / 14 and border_share(~mask) == 9 / 14
