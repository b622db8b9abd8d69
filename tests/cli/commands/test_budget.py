"""What visdom-train says of a budget that few views do not fill."""

from dataclasses import replace

import pytest

from tests.training import fake
from visdom_plugin import registry
from visdom_plugin.cli.commands import train
from visdom_plugin.geometry.cameras import Cameras


@pytest.mark.parametrize("views, warned", [("4", True), ("6", False)])
def test_standard_with_too_few_views_is_said(views, warned, tmp_path, monkeypatch, capsys):
    found = registry.Registry()
    between = replace(fake.PRESET, standard=fake.FakeConfig(steps=3), standard_views=6)
    found.add({"fake": between}, "tests")
    monkeypatch.setattr(registry, "installed", lambda: found)
    words = [
        "method:fake",
        "--views",
        views,
        "--budget",
        "standard",
        "--no-report",
        "--out",
        str(tmp_path / "run"),
    ]
    assert train.main(words) == 0
    said = " ".join("".join(capsys.readouterr()).split())
    assert ("standard gains from 6 views on" in said) == warned


@pytest.mark.parametrize(
    ("size", "asked", "said"), [((50, 99), 4, True), ((50, 99), 1, False), ((40, 100), 2, None)]
)
def test_photographs_made_too_small_are_told_of(size, asked, said):
    note = train._describe_size(fake.tiny_scene().train.cameras.resized(*size), asked)
    assert (note is None) == (said is None)
    if note is not None:
        assert "50 x 99 pixels, of which little" in note and ("leave out --downscale" in note) == said


@pytest.mark.parametrize(
    ("size", "asked", "factor"), [((300, 799), 1, None), ((1600, 1200), 1, 4), ((600, 801), 2, 4)]
)
def test_photographs_too_large_for_a_quick_schedule_are_told_of(size, asked, factor):
    cameras = fake.tiny_scene().train.cameras.resized(*size)
    turned = Cameras.stack([cameras[0], cameras[1].resized(*size[::-1]), cameras[2]])
    note = train._describe_size(turned, asked)
    assert (note is None) == (factor is None)
    if note is not None:
        assert note.endswith(f"--downscale {factor}") and f"{size[0]} x {size[1]} pixels" in note
