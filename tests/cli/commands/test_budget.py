"""What visdom-train says of a budget that few views do not fill."""

from dataclasses import replace

import pytest

from tests.training import fake
from visdom_plugin import registry
from visdom_plugin.cli.commands import train


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
