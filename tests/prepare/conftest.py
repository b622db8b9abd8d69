"""Photographs of the built-in object on the board, drawn once."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from visdom_plugin.prepare.demo import DemoConfig, Truth, write_demo


class Photographs(NamedTuple):
    """A folder of photographs, and what is true of them."""

    folder: object
    truths: list[Truth]
    config: DemoConfig


@pytest.fixture(scope="session")
def photographs(tmp_path_factory) -> Photographs:
    """Six photographs of 960 x 720, two of them upright, with distortion, blur and noise. Not to be written to."""
    folder = tmp_path_factory.mktemp("taken") / "photographs"
    config = DemoConfig(views=6, size=(960, 720), samples=1, radial=(-0.2, 0.06))
    return Photographs(folder, write_demo(folder, config), config)


@pytest.fixture(scope="session")
def prepared(photographs, tmp_path_factory):
    """The scene made of them by the command, with its defaults."""
    from visdom_plugin.cli.commands.prepare import main

    out = tmp_path_factory.mktemp("made") / "scene"
    assert main([str(photographs.folder), "--out", str(out)]) == 0
    return out
