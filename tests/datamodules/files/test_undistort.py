"""Undistorted pictures look along the rays that their intrinsics name; nothing is filled in."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datamodules.files.undistort import COEFFICIENTS, FISHEYES, Distortion, undistort
from visdom_plugin.errors import SceneError

K = np.array([[70.0, 0, 33.3], [0, 66.0, 22.1], [0, 0, 1]])
WIDTH, HEIGHT = 64, 48
LENSES = {
    "SIMPLE_RADIAL": (-0.12,),
    "RADIAL": (0.2, -0.1),
    "OPENCV": (0.1, -0.03, 0.006, -0.004),
    "FULL_OPENCV": (0.3, 0.1, 0.002, -0.003, 0.02, 0.15, 0.05, 0.01),
    "SIMPLE_RADIAL_FISHEYE": (0.06,),
    "RADIAL_FISHEYE": (0.05, -0.03),
    "OPENCV_FISHEYE": (0.05, -0.02, 0.01, 0.003),
}


def distort(model, k, u, v):
    """COLMAP's models, written out: undistorted pixel to pixel of the photograph, corner origin."""
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    r2 = x * x + y * y
    if model in FISHEYES:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
        x, y = (a * np.where(r > 0, bent / np.maximum(r, 1e-12), 1) for a in (x, y))
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*k, *([0] * 8))[:8]
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    return K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]


@pytest.mark.parametrize("model", LENSES)
def test_every_pixel_is_fetched_from_where_the_lens_put_it(model):
    """A photograph whose value is its own pixel centre's position gives the source of each corrected pixel."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    photograph = np.stack([u, v], -1).astype(np.float32)
    mask = (np.hypot(u - 30, v - 20) < 15).astype(bool)
    out = undistort(K, Distortion(model, LENSES[model]), photograph, mask)
    source = np.stack(distort(model, LENSES[model], u, v), -1)
    lost = ~((source >= 0) & (source < [WIDTH, HEIGHT])).all(-1)
    ignored = np.zeros_like(lost) if out.ignore is None else out.ignore
    # Pixels within 1e-3 of the frame's edge may fall on either side in OpenCV's single precision.
    edge = (np.abs(source) < 1e-3).any(-1) | (np.abs(source - [WIDTH, HEIGHT]) < 1e-3).any(-1)
    assert np.array_equal(ignored[~edge], lost[~edge])
    inner = ((source > 1) & (source < [WIDTH - 1, HEIGHT - 1])).all(-1)
    assert inner.mean() > 0.6
    # OpenCV interpolates on a grid of 1/32 pixel.
    assert np.abs(out.image - source)[inner].max() < 1 / 32
    column, row = (np.floor(source[..., i]).astype(int) for i in (0, 1))
    clear = inner & (np.abs(source - np.floor(source) - 0.5) < 0.45).all(-1)
    assert np.array_equal(out.mask[clear], mask[row[clear], column[clear]])
    assert not out.mask[ignored].any()


def test_a_printed_line_becomes_straight():
    """What a straight edge in space looks like through the lens is straight again."""
    model, k = "OPENCV", LENSES["OPENCV"]
    big = cv2.resize(np.zeros((1, 1), np.float32), (WIDTH * 8, HEIGHT * 8))
    t = np.linspace(-5, 70, 40000)
    for a, b in ((0.3, 5.0), (-0.2, 40.0)):
        x, y = distort(model, k, t, a * t + b)
        column, row = (x * 8).astype(int), (y * 8).astype(int)
        seen = (column >= 0) & (column < WIDTH * 8) & (row >= 0) & (row < HEIGHT * 8)
        big[row[seen], column[seen]] = 1
    scaled = K * np.array([[8], [8], [1]])
    out = undistort(scaled, Distortion(model, k), cv2.GaussianBlur(big, (0, 0), 2), None).image
    row, column = np.nonzero(out > 0.5 * out.max())
    u, v = (column + 0.5) / 8, (row + 0.5) / 8
    off = np.minimum(np.abs(0.3 * u + 5 - v), np.abs(-0.2 * u + 40 - v))
    assert len(u) > 1000 and off.max() < 0.6


@given(st.sampled_from(sorted(COEFFICIENTS)), st.floats(-0.02, 0.02))
@settings(max_examples=30, deadline=None)
def test_a_weak_lens_changes_little_and_none_changes_nothing(model, strength):
    image = np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)
    mask = image[..., 0] > 99
    none = undistort(K, Distortion(model, (0.0,) * COEFFICIENTS[model]), image, mask)
    if model not in FISHEYES:
        assert none.image is image and none.mask is mask and none.ignore is None
    if COEFFICIENTS[model]:
        k = (strength,) + (0.0,) * (COEFFICIENTS[model] - 1)
        assert undistort(K, Distortion(model, k), image, mask).image.shape == image.shape


def test_ignored_pixels_move_along_and_lost_ones_join_them():
    ignore = np.zeros((HEIGHT, WIDTH), bool)
    ignore[20:24, 30:36] = True
    outward = Distortion("SIMPLE_RADIAL", (0.3,))
    moved = undistort(K, outward, ignore.astype(np.uint8), None, ignore).ignore
    alone = undistort(K, outward, np.zeros((HEIGHT, WIDTH), np.uint8)).ignore
    assert alone[0, 0] and not alone[20:24, 30:36].any()
    assert moved[21:23, 31:35].all() and np.array_equal(moved & alone, alone)
    inward = Distortion("SIMPLE_RADIAL", (-0.1,))
    assert undistort(K, inward, np.zeros((HEIGHT, WIDTH), np.uint8)).ignore is None


def test_a_lens_that_folds_is_cut_where_it_folds():
    """r (1 - 2 r^2) turns round at r = sqrt(1/6)."""
    out = undistort(K, Distortion("SIMPLE_RADIAL", (-2.0,)), np.zeros((HEIGHT, WIDTH), np.uint8))
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    r = np.hypot((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    off = np.abs(r - np.sqrt(1 / 6)) > 1e-3
    assert np.array_equal(out.ignore[off], (r > np.sqrt(1 / 6))[off])


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "nonsense"])
def test_other_models_are_refused_with_the_reason(model):
    with pytest.raises(
        SceneError,
        match=rf"{model}[\s\S]*possible are[\s\S]*OPENCV[\s\S]*--image_path images[\s\S]*--image_path masks",
    ):
        undistort(K, Distortion(model, (0.1,)), np.zeros((4, 4), np.uint8), where="cameras.txt")


@pytest.mark.parametrize("k", [(0.1,), (0.1, float("nan"), 0, 0), (900.0, 0.0, 0.0, 0.0)])
def test_impossible_coefficients_are_refused(k):
    with pytest.raises(SceneError, match=r"OPENCV"):
        undistort(K, Distortion("OPENCV", k), np.zeros((HEIGHT, WIDTH), np.uint8))
