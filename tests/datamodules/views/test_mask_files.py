"""Which mask belongs to which photograph: ordinary folders are read, shifted ones are not."""

import json
import logging
import shutil
from dataclasses import replace

import cv2
import pytest
import torch

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from visdom_plugin.errors import ConfigError, SceneError


@pytest.fixture(scope="module")
def views():
    return make_scene(SyntheticConfig(size=(32, 24), train_views=8, test_views=0)).train


def _masks(folder):
    return load(folder, views=7).train.masks


def _rename(folder, change):
    for path in sorted((folder / "masks").iterdir()):
        path.rename(path.with_name("moved_" + path.name))
    for path in sorted((folder / "masks").iterdir()):
        path.rename(path.with_name(change(path.name.removeprefix("moved_"))))


@pytest.mark.parametrize("ending", [".PNG", "_mask.PNG", ".png.PNG"])
def test_endings_may_be_in_capitals(ending, views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    expected = _masks(folder)
    _rename(folder, lambda name: name.removesuffix(".png") + ending)
    assert all(map(torch.equal, _masks(folder), expected))


def test_photographs_without_ending_may_end_in_capitals(views, tmp_path):
    folder = w.write_instant_ngp(views, tmp_path / "s")
    expected = load(folder, views=7).train
    for path in (folder / "images").iterdir():
        path.rename(path.with_suffix(".PNG"))
    found = load(folder, views=7).train
    assert all(map(torch.equal, found.images, expected.images)) and found.names[0].endswith(".PNG")


def _in_folders(views, folder):
    """The scene with its photographs in photos/, and what its own writer put into masks/."""
    w.write_nerfstudio(views, folder)
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace("images/", "photos/"))
    (folder / "images").rename(folder / "photos")
    return folder


def test_masks_may_leave_the_photographs_folder_out(views, tmp_path):
    folder = _in_folders(views, tmp_path / "s")
    expected = [views.masks[i] for i in range(1, 8)]
    assert all(map(torch.equal, _masks(folder), expected))
    first = (folder / "masks" / f"{views.names[1]}.png").read_bytes()
    (folder / "masks/photos").mkdir()
    (folder / "masks/photos" / f"{views.names[2]}.png").write_bytes(first)
    assert torch.equal(_masks(folder)[1], expected[0]), "the whole path goes first"
    (folder / "masks" / f"{views.names[3]}.png").unlink()
    with pytest.raises(SceneError) as caught:
        _masks(folder)
    for place in ("masks/photos/", "masks/"):
        assert f"{place}{views.names[3]}.png" in caught.value.todo


def test_a_bare_name_of_two_photographs_is_no_name(views, tmp_path):
    folder = _in_folders(views, tmp_path / "s")
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "more").mkdir()
    other, same = f"more/{views.names[4]}.png", f"photos/{views.names[4]}.png"
    (folder / other).write_bytes((folder / same).read_bytes())
    entry = next(f for f in content["frames"] if f["file_path"] == same)
    content["frames"].append(entry | {"file_path": other})
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match=f"no mask: .*{views.names[4]}"):
        load(folder, train_list=f"{other},{same}")


@pytest.mark.parametrize("shift", [-3, -1, 1, 4])
@pytest.mark.parametrize("lost", [False, True])
def test_shifted_masks_are_refused_and_warned_of(shift, lost, views, tmp_path, caplog):
    named = replace(views, names=tuple(f"img_{10 + i:03d}" for i in range(8)))
    folder = w.write_colmap(named, tmp_path / "s")
    _rename(folder, lambda name: f"img_{int(name[4:7]) + shift:03d}.png")
    if lost:
        (folder / f"masks/img_{14 + shift:03d}.png").unlink()
    with pytest.raises(SceneError) as caught:
        load(folder, train_list="3,4")
    assert f"shifted by {shift}" in caught.value.cause
    with caplog.at_level(logging.WARNING, "datamodules"):
        load(folder, train_list="3,4", allow_missing_masks=True)
    assert f"shifted by {shift}" in caplog.text


def test_missing_masks_beside_stray_ones_are_not_called_shifted(views, tmp_path, caplog):
    folder = w.write_colmap(views, tmp_path / "s")
    for i in (0, 3):
        (folder / f"masks/{views.names[i]}.png").rename(folder / f"masks/{views.names[i]}_old.png")
    with caplog.at_level(logging.WARNING, "datamodules"):
        train = load(folder, train_list="1,2,3", allow_missing_masks=True).train
        assert [train.mask_origin(i) for i in range(3)] == ["given", "given", "missing"]
        assert len(load(folder, train_list="1,2", test=False).train) == 2
        (folder / "masks/train_999.png").write_bytes((folder / "masks/train_001.png").read_bytes())
        assert len(load(folder, train_list="1,2", test=False).train) == 2
    assert "shifted" not in caplog.text


def test_a_folder_of_masks_may_be_named_from_where_one_is(views, tmp_path, monkeypatch):
    folder = w.write_colmap(views, tmp_path / "s")
    (folder / "masks").rename(folder / "cut_outs")
    wanted = load(folder, views=7, masks="cut_outs").train
    monkeypatch.chdir(tmp_path)
    for named in ("s/cut_outs", "./s/cut_outs", str(folder / "cut_outs")):
        found = load(folder, views=7, masks=named).train
        assert all(torch.equal(a, b) for a, b in zip(found.masks, wanted.masks, strict=True))
    with pytest.raises(SceneError, match="no folder cut_out for the masks; did you mean 'cut_outs'"):
        load(folder, views=7, masks="cut_out")
    (tmp_path / "cut_outs").mkdir()
    with pytest.raises(ConfigError, match="two folders are called cut_outs"):
        load(folder, views=7, masks="cut_outs")
    (folder / "cut_outs").rename(tmp_path / "beside")
    assert len(load(folder, views=7, masks="beside", allow_outside=True).train.masks) == 7


def test_views_that_neither_train_nor_test_are_told_of(views, tmp_path, caplog):
    folder = w.write_colmap(views, tmp_path / "s")
    names = ",".join(views.names[:4])
    with caplog.at_level(logging.INFO, "datamodules"):
        scene = load(folder, train_list=names)
    unused = len(views) - 4 - len(scene.test)
    assert unused and f"{unused} views neither train nor test" in caplog.text and "--test-list" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.INFO, "datamodules"):
        load(folder, train_list=names, test_list=views.names[5] + ",")
        load(folder, views=4)
    assert "neither train nor" not in caplog.text


def test_the_folder_that_may_hold_the_masks_is_named(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    (folder / "masks").rename(folder / "cut_outs")
    with pytest.raises(SceneError, match=r"no folder masks, and it has no alpha[\s\S]*pass --masks cut_outs"):
        load(folder, views=7)
    assert len(load(folder, views=7, masks="cut_outs").train.masks) == 7


def test_an_opaque_alpha_channel_is_not_called_absent(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s", alpha=True)
    for path in (folder / "images").iterdir():
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        pixels[..., 3] = 255
        cv2.imwrite(str(path), pixels)
    with pytest.raises(SceneError, match="no folder masks, and its alpha channel is opaque everywhere"):
        load(folder, views=7)


def test_of_two_folders_of_masks_the_usual_one_is_read_and_that_is_said(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    expected = _masks(folder)
    shutil.copytree(folder / "masks", folder / "mask")
    for path in (folder / "mask").iterdir():
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), 0))
    scene = load(folder, views=7)
    assert all(map(torch.equal, scene.train.masks, expected))
    assert any("masks are read from masks, not from mask" in note for note in scene.notes)
    shutil.rmtree(folder / "masks")
    (folder / "masks").mkdir()
    assert torch.equal(load(folder, views=7).train.masks[0], ~expected[0])
