"""However photographs and masks were turned, and said so, they come back as the cameras saw them."""

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.prepared_writer import write_prepared
from visdom_plugin.errors import SceneError

TAGS = range(1, 9)
SIZES = {"oblong": (48, 36), "square": (40, 40)}


@pytest.fixture(scope="module", params=SIZES)
def scene(request):
    return make_scene(SyntheticConfig(size=SIZES[request.param], test_views=2, background="white"))


def _tag(value: int) -> Image.Exif:
    exif = Image.Exif()
    exif[274] = value
    return exif


def _store(path, tag: int, *, upright: bool, tagged: bool) -> None:
    """The picture turned to what a viewer shows (upright) or as it is, with its tag or without."""
    picture = Image.open(path)
    picture.load()
    if upright:
        picture.getexif()[274] = tag
        picture = ImageOps.exif_transpose(picture)
    picture.save(path, **({"exif": _tag(tag)} if tagged else {}))


def _same(views, truth) -> bool:
    pairs = [*zip(views.images, truth.images, strict=True), *zip(views.masks, truth.masks, strict=True)]
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("tag", TAGS)
@pytest.mark.parametrize("masks", ["as stored", "as stored, tagged", "upright"])
def test_masks_are_matched_to_tagged_photographs(scene, tmp_path, tag, masks):
    folder = write_prepared(scene, tmp_path / "s")
    for path in (folder / "images").iterdir():
        _store(path, tag, upright=False, tagged=True)
    for path in (folder / "masks").iterdir():
        _store(path, tag, upright=masks == "upright", tagged=masks.endswith("tagged"))
    loaded = load(folder)
    assert _same(loaded.train, scene.train) and _same(loaded.test, scene.test)
    said = [note for note in loaded.notes if "EXIF" in note]
    assert len(said) == (tag > 1 and masks == "upright")


@pytest.mark.parametrize("tag", [5, 6, 7, 8])
@pytest.mark.parametrize("masks", ["as the camera", "as stored", "as stored, tagged"])
def test_cameras_of_upright_pictures_turn_the_photographs(tmp_path, tag, masks):
    truth = make_scene(SyntheticConfig(size=SIZES["oblong"], test_views=2, background="white"))
    folder = write_prepared(truth, tmp_path / "s")
    back = {6: 8, 8: 6}.get(tag, tag)
    stored = ["images"] if masks == "as the camera" else ["images", "masks"]
    for name in stored:
        for path in (folder / name).iterdir():
            _store(path, back, upright=True, tagged=False)
            if name == "images" or masks.endswith("tagged"):
                _store(path, tag, upright=False, tagged=True)
    loaded = load(folder)
    assert _same(loaded.train, truth.train) and _same(loaded.test, truth.test)
    assert any(f"EXIF orientation {tag}" in note for note in loaded.notes)


def test_what_neither_sizes_nor_outlines_tell_is_said(scene, tmp_path):
    folder = write_prepared(scene, tmp_path / "s")
    for path in (folder / "images").iterdir():
        Image.new("RGB", Image.open(path).size, "grey").save(path, exif=_tag(3))
    assert any("neither sizes nor outlines tell" in note for note in load(folder).notes)


def test_a_quarter_turn_without_a_tag_is_named(tmp_path):
    folder = write_prepared(make_scene(SyntheticConfig(size=(48, 36), test_views=1)), tmp_path / "s")
    for name in ("masks", "images"):
        path = folder / name / "train_000.png"
        Image.fromarray(np.rot90(np.asarray(Image.open(path))).copy()).save(path)
        with pytest.raises(SceneError, match="turned by a quarter"):
            load(folder)
