"""One camera that is turned is named with its angle, and no angle is said where a turn is not what is wrong."""

import json
import os
from pathlib import Path

import pytest

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.hull.checks.faults import FAULTS, capture_of, turned_about
from visdom_plugin.cli.commands.check import describe_check
from visdom_plugin.hull.checks.check import check
from visdom_plugin.hull.wording import for_commands

ROOT = os.environ.get("VISDOM_SCENES")
SLANTED = (0.6, -0.7, 0.4)


@pytest.fixture(scope="module")
def sound():
    return capture_of(make_scene(SyntheticConfig(size=100, train_views=6, test_views=0)).train)


def findings(capture, **options):
    return check(capture.cameras, capture.masks, (), capture.names, **options).findings


@pytest.mark.parametrize(
    ("view", "axis", "degrees"), [(1, SLANTED, 1.0), (4, (0, 1, 0), 2.0), (0, (1, 0, 0), 3.0)]
)
def test_a_turned_camera_is_named_with_its_angle(sound, view, axis, degrees):
    (found,) = findings(turned_about(sound, view, axis, degrees))
    assert (found.kind, found.views) == ("view", (view,))
    assert found.turned_deg == pytest.approx(degrees, abs=0.25)
    assert f"turned by about {found.turned_deg:.1f} degrees" in found.what
    assert f"refine_poses(cameras, masks, free=[{view}])" in found.todo and "leave the view out" in found.todo


def test_the_command_says_it_in_its_own_terms_and_in_json(sound):
    capture = turned_about(sound, 1, SLANTED, 1.5)
    with for_commands():
        found = check(capture.cameras, capture.masks, (), capture.names)
    (plain,) = json.loads(json.dumps(describe_check(found, capture.names)))["findings"]
    assert plain["turned_deg"] == pytest.approx(1.5, abs=0.25) and plain["views"] == [capture.names[1]]
    assert "--refine-poses" in plain["todo"] and "free=" not in plain["todo"]


def test_many_views_that_leave_one_little_to_say_tell_its_angle():
    """The others narrow the hull down by themselves, so the one that is turned back adds little to that."""
    sound = capture_of(make_scene(SyntheticConfig(size=100, train_views=9, test_views=0)).train)
    (found,) = findings(turned_about(sound, 3, SLANTED, 1.5))
    assert found.views == (3,) and found.turned_deg == pytest.approx(1.5, abs=0.25)


def test_a_turn_of_many_pixels_is_found_as_well(sound):
    """From the pose as given the masks' pull leads elsewhere."""
    (found,) = findings(turned_about(sound, 2, (0.3, 1, 0), 7.0))
    assert found.views == (2,) and found.turned_deg == pytest.approx(7.0, abs=0.3)


@pytest.mark.parametrize("fault", ["half_mask", "mirrored_mask", "focal_one", "opengl_one"])
def test_no_angle_where_something_else_is_wrong(sound, fault):
    (found,) = findings(FAULTS[fault](sound, 1).capture)
    assert found.views == (1,) and found.turned_deg is None and "degrees" not in found.what.partition(":")[2]


def test_a_displaced_mask_looks_turned_and_that_is_said(sound):
    (found,) = findings(FAULTS["shifted_mask"](sound, 1).capture)
    assert "or of its mask, looks the same" in found.what and "look whether its mask lies" in found.todo


def test_no_angle_of_few_views_and_of_two_turned_ones(sound):
    five = check(*(lambda c: (c.cameras[:5], c.masks[:5]))(turned_about(sound, 1, SLANTED, 2.0))).findings
    assert five and all(f.turned_deg is None for f in five)
    two = findings(turned_about(turned_about(sound, 1, SLANTED, 3.0), 4, (0, 1, 0), 3.0))
    assert two and all(f.turned_deg is None for f in two)


def test_the_brief_check_refines_nothing(sound, monkeypatch):
    monkeypatch.setattr("visdom_plugin.hull.checks.check.measure_turn", lambda *_: pytest.fail("asked"))
    (found,) = findings(turned_about(sound, 1, SLANTED, 2.0), brief=True)
    assert found.views == (1,)


def test_sound_views_are_not_refined(sound, monkeypatch):
    monkeypatch.setattr("visdom_plugin.hull.checks.check.measure_turn", lambda *_: pytest.fail("asked"))
    assert findings(sound) == []


@pytest.mark.scenes
@pytest.mark.skipif(not ROOT, reason="VISDOM_SCENES does not name the folder of real scenes")
def test_a_turned_camera_of_real_masks():
    sound = capture_of(load(Path(ROOT) / "vgg_dinosaur", views=6, downscale=8, test=False).train)
    (found,) = findings(turned_about(sound, 2, SLANTED, 3.0))
    assert found.views == (2,) and found.turned_deg == pytest.approx(3.0, abs=0.3)
