"""Poses that are off are turned back on the way to a scene, and what was done is said."""

import json

import numpy as np
import pytest
from PIL import Image

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.geometry.pointing import pointing_error
from visdom_plugin.cli.commands.prepare import main
from visdom_plugin.export.dataset import write_transforms


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photographs and masks of the built-in scene with poses that are off by a degree."""
    folder = tmp_path_factory.mktemp("off") / "photographs"
    config = SyntheticConfig(size=160, train_views=7, test_views=0, rotation_noise_deg=1.0)
    scene = make_scene(config)
    views = scene.train
    names = [f"{name}.png" for name in views.names]
    for i, name in enumerate(names):
        for kind, pixels in (("images", views.images[i]), ("masks", views.masks[i].numpy() * np.uint8(255))):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.asarray(pixels)).save(folder / kind / name)
    write_transforms(folder, [views.cameras[i] for i in range(len(names))], names)
    return folder, make_scene(SyntheticConfig(size=160, train_views=7, test_views=0)), views.cameras


def test_poses_are_refined_and_said(capture, tmp_path):
    folder, true, given = capture
    out = tmp_path / "scene"
    assert main([str(folder), "--out", str(out), "--refine-poses", "--quiet"]) == 0
    record = json.loads((out / "prepare.json").read_text())
    assert any(note.startswith("poses refined") for note in record["notes"])
    assert max(view["turned_deg"] for view in record["views"].values()) > 0.2
    views = load(out, views=99, train_list="all", test=False).train
    assert len(views.names) == 7 and list(views.names) == sorted(views.names)
    surface = np.asarray(true.mesh[0])[::60]
    before = pointing_error(given, true.train.cameras, surface).mean()
    after = pointing_error(views.cameras, true.train.cameras, surface).mean()
    assert after < before / 2.5


def test_without_masks_there_is_nothing_to_refine_by(capture, tmp_path, capsys):
    folder, _, _ = capture
    words = [str(folder), "--out", str(tmp_path / "scene"), "--mask-source", "none", "--refine-poses"]
    assert main(words) == 2
    assert "poses are refined by masks of 6 views or more; 0 of 7" in capsys.readouterr().err
    assert not (tmp_path / "scene").exists()
