"""Photographs of another size than their cameras say: evenly resized ones are read, and that is said."""

import logging

import cv2
import pytest
import torch

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from visdom_plugin.errors import SceneError


@pytest.fixture(scope="module")
def views():
    return make_scene(SyntheticConfig(size=(48, 36), train_views=8, test_views=0)).train


def _resize_photographs(folder, width, height):
    for path in (folder / "images").iterdir():
        cv2.imwrite(
            str(path), cv2.resize(cv2.imread(str(path)), (width, height), interpolation=cv2.INTER_AREA)
        )


@pytest.mark.parametrize("writer", [w.write_colmap, w.write_nerfstudio, w.write_llff])
@pytest.mark.parametrize("width, height", [(24, 18), (32, 24), (96, 72)])
def test_evenly_resized_photographs_take_their_cameras_along(writer, width, height, views, tmp_path, caplog):
    expected = load(writer(views, tmp_path / "full"), views=4).train
    folder = writer(views, tmp_path / "resized")
    _resize_photographs(folder, width, height)
    with caplog.at_level(logging.WARNING):
        scene = load(folder, views=4)
    found = scene.train
    assert found.cameras.width.tolist() == [width] * 4
    factor = torch.tensor([width / 48, height / 36, 1.0], dtype=torch.float64)
    assert torch.allclose(found.cameras.intrinsics, expected.cameras.intrinsics * factor[:, None])
    assert [mask.shape for mask in found.masks] == [(height, width)] * 4
    said = f"4 of 4 training views: photographs of {width} x {height} for cameras of 48 x 36"
    assert said in caplog.text and any(said in note for note in scene.notes)


@pytest.mark.parametrize("width, height", [(24, 20), (47, 36), (36, 48)])
def test_unevenly_resized_photographs_are_refused(width, height, views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    _resize_photographs(folder, width, height)
    with pytest.raises(SceneError, match=f"the image is {width} x {height} but its camera says 48 x 36"):
        load(folder, views=4)


def test_photographs_of_the_expected_size_are_passed_over_in_silence(views, tmp_path, caplog):
    scene = load(w.write_colmap(views, tmp_path / "s"), views=4, downscale=2)
    assert not any("resized" in note for note in scene.notes) and not caplog.records
