"""Focal lengths in another unit that look like pixels: told by the masks, or said to be odd."""

import logging

import numpy as np
import pytest
import torch

from tests.hull.balls import ball_masks
from tests.hull.checks.test_degenerate import OBJECT, SMALL, turntable
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.checks.causes.intrinsics import may_be_other_units
from visdom_plugin.hull.checks.check import check

W, H, F = 192, 128, 180.0


def _capture(focal, count=6):
    """Cameras of the given focal lengths with the masks of focal length F."""
    motion = turntable(count, (0.5, 1.2))[0].world_from_camera
    right, given = np.diag([F, F, 1.0]), np.diag([*focal, 1.0])
    right[:2, 2] = given[:2, 2] = W / 2, H / 2
    made = [Cameras.from_matrices(K, motion, width=W, height=H) for K in (right, given)]
    return made[1], ball_masks(made[0], OBJECT)


def _degrees(length):
    return np.degrees(2 * np.arctan(length / 2 / F))


@pytest.mark.parametrize("count", [6, 9])
@pytest.mark.parametrize(
    "focal, words",
    [
        ((_degrees(H),) * 2, "degrees across the height"),
        ((_degrees(W),) * 2, "degrees across the width"),
        ((_degrees(np.hypot(W, H)),) * 2, "degrees across the diagonal"),
        ((_degrees(W), _degrees(H)), "angles of view in degrees"),
        ((F * 36 / W,) * 2, "millimetres of full frame"),
    ],
)
def test_focal_lengths_in_another_unit_are_refused_and_found(focal, words, count):
    cameras, masks = _capture(focal, count)
    with pytest.raises(SceneError, match=words) as caught:
        SMALL.carve(cameras, masks)
    assert caught.value.where == "camera intrinsics" and "give pixels, here about (1" in caught.value.todo
    (found,) = (f for f in check(cameras, masks).findings if f.kind == "scale")
    assert words in found.what and found.views == ()


def test_one_angle_for_both_axes_is_said_to_be_odd(caplog):
    """Masks of round objects hardly tell it; the equality of two ratios does."""
    cameras, masks = _capture((F, F * H / W), 4)
    with caplog.at_level(logging.WARNING):
        try:
            SMALL.carve(cameras, masks)
            said = caplog.text
        except SceneError as error:
            said = str(error)
    assert "fx = fy" in said


def test_wide_lenses_that_masks_confirm_are_cameras(caplog):
    """A short focal length is an angle only where the masks say so."""
    motion = turntable(6, (0.5, 1.2))[0].world_from_camera
    K = np.array([[70.0, 0, 96], [0, 70, 64], [0, 0, 1]])
    cameras = Cameras.from_matrices(K, motion, width=W, height=H)
    masks = ball_masks(cameras, OBJECT)
    assert may_be_other_units(cameras)
    with caplog.at_level(logging.WARNING):
        assert SMALL.carve(cameras, masks).voxels
    assert "angle of view of 108 degrees" in caplog.text
    assert not check(cameras, masks).findings


def test_common_cameras_are_not_asked():
    K = torch.tensor([[900.0, 0, 400], [0, 900, 300], [0, 0, 1]]).double()
    cameras = Cameras.from_matrices(K, np.eye(4)[None], width=800, height=600)
    assert not may_be_other_units(cameras)
    assert may_be_other_units(cameras.resized(100, 75))


def test_fractions_are_no_angles():
    """What is normalised is said to be that, all of it."""
    cameras, masks = _capture((F, F))
    K = cameras.intrinsics / torch.tensor([[W], [H], [1]])
    normalised = Cameras(K, cameras.world_from_camera, cameras.width, cameras.height)
    (found,) = (f for f in check(normalised, masks).findings if f.sure == "certain")
    assert found.kind == "principal" and "so are fx and fy" in found.todo
    assert not may_be_other_units(normalised)


def _small(focal, count=6):
    """The same at a third of the size, in which outlines hardly move."""
    motion = turntable(count, (0.5, 1.2))[0].world_from_camera
    right, given = np.diag([F / 3, F / 3, 1.0]), np.diag([focal, focal, 1.0])
    right[:2, 2] = given[:2, 2] = W / 6, H / 6
    made = [Cameras.from_matrices(K, motion, width=W // 3, height=H // 3) for K in (right, given)]
    return made[1], ball_masks(made[0], OBJECT)


def test_the_check_says_how_far_focal_lengths_are_open():
    def width(cameras, masks):
        low, high = check(cameras, masks).focal_range
        assert 0.5 <= low <= 1 <= high <= 2
        return high / low

    # Small pictures leave more of it open than large ones.
    assert width(*_small(F / 3)) > width(*_capture((F, F))) and width(*_small(F / 3)) >= 1.25


def test_sound_small_pictures_are_not_taken_for_degrees(caplog):
    cameras, masks = _small(F / 3)
    with caplog.at_level(logging.WARNING):
        SMALL.carve(cameras, masks)
    assert "in degrees across" not in caplog.text
    assert not check(cameras, masks).findings


def test_degrees_in_small_pictures_are_told_faintly(caplog):
    """They move clean outlines by less than those of usual masks are off: a warning, and no refusal."""
    motion, w, h, f = turntable(6, (0.5, 1.2))[0].world_from_camera, 64, 48, 66.0
    degrees = np.degrees(2 * np.arctan(w / 2 / f))
    right, given = (
        Cameras.from_matrices(np.array([[x, 0, w / 2], [0, x, h / 2], [0, 0, 1]]), motion, width=w, height=h)
        for x in (f, degrees)
    )
    masks = ball_masks(right, OBJECT)
    with caplog.at_level(logging.WARNING):
        assert SMALL.carve(given, masks).voxels
    assert "degrees across the width" in caplog.text and "here about (66, 66)" in caplog.text
    (found,) = (f for f in check(given, masks).findings if f.kind == "scale")
    assert found.sure == "possible" and "degrees across the width" in found.what
