"""What lies in real folders beside what a format asks for: read where it is clear, else said with what to do."""

import json
import math
import shutil

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.recognise import FORMATS, recognise
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from tests.datamodules.layouts.prepared_writer import same_cameras
from visdom_plugin.errors import SceneError


@pytest.fixture(scope="module")
def views():
    return make_scene(SyntheticConfig(size=(40, 30), train_views=8, test_views=0)).train


def _edit(folder, change):
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        change(frame)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("start", ["/home/me/scan/", "C:\\scans\\me\\", "../", "D:/x/", "images\\..\\"])
def test_paths_of_another_machine_are_found_by_their_ends(start, views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    expected = load(folder, views=6).train

    def change(frame):
        frame["file_path"] = start + frame["file_path"]

    _edit(folder, change)
    found = load(folder, views=6)
    assert same_cameras(found.train.cameras, expected.cameras)
    assert all(map(torch.equal, found.train.images, expected.images))
    assert any("8 of 8 photographs are named by paths of another folder" in note for note in found.notes)


def test_a_models_windows_paths_are_found_by_their_ends(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s", binary=False)
    expected = load(folder, views=6).train
    text = folder / "sparse/0/images.txt"
    for name in views.names:
        text.write_text(text.read_text().replace(f" {name}.png", f" C:\\me\\images\\{name}.png"))
    found = load(folder, views=6).train
    assert all(map(torch.equal, found.images, expected.images)) and found.names == expected.names


def test_paths_that_lead_to_nothing_below_stay_refused(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    _edit(folder, lambda frame: frame.update(file_path=f"/elsewhere/{frame['file_path']}x.png"))
    with pytest.raises(SceneError, match="outside its folder"):
        load(folder)


def test_angles_in_the_other_unit_are_told(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    lens = ("fl_x", "fl_y")

    def degrees(frame):
        frame |= {"camera_angle_x": 51.5, **dict.fromkeys(lens)}

    _edit(folder, degrees)
    with pytest.raises(SceneError, match=r"more than half a turn[\s\S]*in radians[\s\S]*write 0.8988"):
        load(folder)
    _edit(folder, lambda frame: frame.update(camera_angle_x=None, x_fov=math.radians(51.5)))
    with pytest.raises(SceneError, match=r"x_fov of frame 0 is 0.8988[\s\S]*in degrees[\s\S]*write 51.5"):
        load(folder)


def test_matrices_in_a_row_are_read_and_those_by_columns_refused(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    expected = load(folder, views=4).train.cameras

    def flatten(frame):
        fx, fy, cx, cy = (frame.pop(name) for name in ("fl_x", "fl_y", "cx", "cy"))
        frame["K"] = [fx, 0, cx, 0, fy, cy, 0, 0, 1]

    _edit(folder, flatten)
    assert same_cameras(load(folder, views=4).train.cameras, expected)
    _edit(folder, lambda frame: frame.update(K=np.array(frame["K"]).reshape(3, 3).T.tolist()))
    with pytest.raises(SceneError, match=r"third row of K of frame 0[\s\S]*by columns[\s\S]*by rows"):
        load(folder)
    _edit(folder, lambda frame: frame.update(K=[900, 900, 20, 15]))
    with pytest.raises(SceneError, match=r"no 3 x 3[\s\S]*fl_x, fl_y, cx, cy") as caught:
        load(folder)
    assert "copy the file" not in str(caught.value)


def test_numbers_in_quotes_are_named(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    _edit(folder, lambda frame: frame.update(fl_x=str(frame["fl_x"])))
    with pytest.raises(SceneError, match="without quotes"):
        load(folder)


@pytest.mark.parametrize("file", ["images/{}.png", "masks/{}.png"])
def test_pointers_of_git_lfs_are_named(file, views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    for name in views.names:
        pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
        (folder / file.format(name)).write_text(pointer)
    with pytest.raises(SceneError, match=r"pointer of Git LFS[\s\S]*git lfs pull"):
        load(folder)


def test_photographs_and_masks_in_unread_formats_are_named(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    for name in views.names:
        (folder / f"masks/{name}.png").rename(folder / f"masks/{name}.npy")
    with pytest.raises(SceneError, match=r"it holds .*\.npy.*read as no image"):
        load(folder)
    for name in views.names:
        (folder / f"images/{name}.png").rename(folder / f"images/{name}.gif")
    with pytest.raises(SceneError, match=r"there is .*\.gif[\s\S]*convert them to PNG"):
        load(folder)


@pytest.mark.parametrize("pattern", ["{}_mask.png", "mask_{}.png", "{}.Alpha.jpg", "{}-seg.png"])
def test_masks_among_the_photographs_are_named(pattern, views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    for name in views.names:
        mask = cv2.imread(str(folder / f"masks/{name}.png"))
        (folder / f"masks/{name}.png").unlink()
        cv2.imwrite(str(folder / "images" / pattern.format(name)), mask)
    (folder / "masks").rmdir()
    with pytest.raises(SceneError, match="masks among the photographs") as caught:
        load(folder)
    assert "move such files to masks/" in caught.value.todo


@pytest.mark.parametrize("place", ["Masks", "images/masks"])
def test_folders_of_masks_beside_the_usual_one(place, views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    expected = load(folder, views=4).train.masks
    (folder / "masks").rename(folder / "aside")
    (folder / "aside").rename(folder / place)
    if place == "images/masks":
        with pytest.raises(SceneError, match="--masks images/masks"):
            load(folder, views=4)
    found = load(folder, views=4, masks=place if "/" in place else None).train.masks
    assert all(map(torch.equal, found, expected))


def test_masks_and_files_of_valid_pixels_are_both_read(views, tmp_path):
    """nerfstudio's mask_path beside a folder of foreground masks."""
    folder = w.write_nerfstudio(views, tmp_path / "s")
    (folder / "mask").mkdir()
    valid = np.full((30, 40), 255, np.uint8)
    valid[:5] = 0

    def change(frame):
        frame["mask_path"] = frame["file_path"].replace("images/", "mask/")
        cv2.imwrite(str(folder / frame["mask_path"]), valid)

    expected = load(folder, views=4).train
    _edit(folder, change)
    found = load(folder, views=4).train
    assert all(map(torch.equal, found.masks, expected.masks))
    assert found.ignored(0)[:5].all() and not found.ignored(0)[5:].any()
    shutil.rmtree(folder / "masks")
    with pytest.raises(SceneError, match="says which pixels to ignore"):
        load(folder, views=4)


def test_byte_order_marks_and_lists_at_the_top(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s", binary=False)
    expected = load(folder, views=4).train.cameras
    for name in ("cameras.txt", "images.txt"):
        path = folder / "sparse/0" / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert same_cameras(load(folder, views=4).train.cameras, expected)
    other = w.write_nerfstudio(views, tmp_path / "t")
    (other / "transforms.json").rename(other / "cameras_all.json")
    with pytest.raises(SceneError, match=r"cameras_all\.json lists frames .* rename it to transforms\.json"):
        load(other)
    (other / "transforms.json").write_text("[]")
    with pytest.raises(SceneError, match="another program's form"):
        load(other)


def test_a_model_far_below_and_a_scene_far_below(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "a/b/c")
    with pytest.raises(SceneError, match=r"three levels too high: .*/a/b/c looks like a scene"):
        load(tmp_path)
    expected = load(folder, views=4).train
    (folder / "distorted").mkdir()
    (folder / "sparse").rename(folder / "distorted/sparse")
    assert list(recognise(folder)) == ["colmap"] and "colmap" in FORMATS
    assert all(map(torch.equal, load(folder, views=4).train.images, expected.images))
    (folder / "distorted").rename(folder / "own")
    with pytest.raises(SceneError, match="poses lie in own, without photographs"):
        load(folder)


@pytest.mark.parametrize("name", ["images", "photos", "my photos"])
def test_the_folder_of_photographs_in_place_of_the_scenes_is_told(views, tmp_path, monkeypatch, name):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    inner = folder / name
    inner.mkdir(exist_ok=True)
    with pytest.raises(SceneError, match=r"one level too deep: .*transforms\.json") as caught:
        load(inner)
    assert caught.value.todo == f"name that folder: --data {folder}"
    monkeypatch.chdir(folder)
    with pytest.raises(SceneError, match="one level too deep") as caught:
        load(name)
    assert caught.value.todo == "name that folder: --data ."
    (inner / "far").mkdir()
    with pytest.raises(SceneError, match="two levels too deep"):
        load(inner / "far")
    (folder / "transforms.json").unlink()
    with pytest.raises(SceneError) as caught:
        load(inner)
    assert "too deep" not in str(caught.value)
    with pytest.raises(SceneError, match="one level too high") as caught:
        load(w.write_nerfstudio(views, tmp_path / "above/it").parent)
    assert caught.value.todo == f"name it: --data {tmp_path}/above/it"
