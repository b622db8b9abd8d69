"""However the names of poses and files differ, the same pictures are read where only one file can be meant."""

import shutil
import unicodedata
from dataclasses import replace

import pytest
import torch
from PIL import Image

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from visdom_plugin.errors import SceneError


@pytest.fixture(scope="module")
def views():
    made = make_scene(SyntheticConfig(size=(32, 24), train_views=8, test_views=0)).train
    return replace(made, names=tuple(f"töpf_{i}" for i in range(8)))


WRITERS = {"model": w.write_colmap, "transforms": w.write_nerfstudio}
CHANGES = {
    "case": lambda name: name.upper(),
    "Unicode form": lambda name: unicodedata.normalize("NFD", name),
    "another folder": lambda name: f"left/{name}",
    "another ending": lambda name: name.replace(".png", ".bmp"),
}


def _move(folder, part, change):
    for path in sorted((folder / part).iterdir()):
        target = folder / part / change(path.name)
        target.parent.mkdir(exist_ok=True)
        path.rename(target)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("change", CHANGES)
def test_photographs_under_another_name(views, tmp_path, writer, change):
    folder = WRITERS[writer](views, tmp_path / "s")
    _move(folder, "images", CHANGES[change])
    found = load(folder, views=6)
    assert any("under another name" in note for note in found.notes)
    for image, name in zip(found.train.images, found.train.names, strict=True):
        stem = name.rpartition("/")[2].removesuffix(".png")
        assert torch.equal(image, views.images[views.names.index(stem)])


@pytest.mark.parametrize("change", ["case", "Unicode form"])
def test_masks_under_another_name(views, tmp_path, change):
    folder = w.write_colmap(views, tmp_path / "s")
    expected = load(folder, views=6).train.masks
    _move(folder, "masks", CHANGES[change])
    assert all(map(torch.equal, load(folder, views=6).train.masks, expected))


def test_two_candidates_are_not_chosen_between(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    path = folder / "images/töpf_1.png"
    shutil.copy(path, path.with_suffix(".bmp"))
    path.rename(path.with_suffix(".tif"))
    with pytest.raises(SceneError, match=r"töpf_1\.png"):
        load(folder, train_list="0,1,2", test=False)


@pytest.mark.parametrize("writer", WRITERS)
def test_frames_without_a_photograph_are_left_out_and_said(views, tmp_path, writer):
    folder = WRITERS[writer](views, tmp_path / "s")
    for i in (0, 3):
        (folder / f"images/töpf_{i}.png").unlink()
    scene = load(folder)
    used = [name.rpartition("/")[2].removesuffix(".png") for name in (*scene.train.names, *scene.test.names)]
    assert not {"töpf_0", "töpf_3"} & set(used) and len(scene.test) == 1
    assert any("2 of 8 frames have no photograph" in note for note in scene.notes)
    with pytest.raises(SceneError, match="missing"):
        load(folder, train_list="0,1,2", test=False)


@pytest.mark.parametrize("other", ["mask", "images_mask", "matting"])
@pytest.mark.parametrize("form", ["{}", "{}-removebg-preview", "mask_{}", "{}.mask"])
def test_masks_in_a_folder_of_another_name(views, tmp_path, other, form):
    folder = w.write_colmap(views, tmp_path / "s")
    expected = load(folder, views=6).train.masks
    _move(folder, "masks", lambda name: form.format(name.removesuffix(".png")) + ".png")
    (folder / "masks").rename(folder / other)
    # A folder matting is the mark of another layout.
    scene = load(folder, views=6, data_format="colmap")
    assert all(map(torch.equal, scene.train.masks, expected))
    assert any(f"folder {other}" in note for note in scene.notes)
    shutil.copytree(folder / other, folder / "alpha")
    with pytest.raises(SceneError, match="--masks"):
        load(folder, views=6, data_format="colmap")
    assert all(
        map(torch.equal, load(folder, views=6, data_format="colmap", masks=other).train.masks, expected)
    )


@pytest.mark.parametrize("writer", [w.write_colmap, w.write_nerfstudio])
def test_a_photograph_listed_twice_is_named(writer, views, tmp_path):
    folder = writer(w.join(views, views.take([2])), tmp_path / "s")
    with pytest.raises(SceneError, match=f"{views.names[2]}: it is listed twice"):
        load(folder, views=3)


@pytest.mark.parametrize("ending", [".jpg", ".JPG", ".webp"])
def test_blenders_names_without_ending_and_sizes_are_found(ending, views, tmp_path):
    parts = {"train": views.take(range(6)), "test": views.take([6, 7])}
    folder = w.write_blender(parts, tmp_path / "s")
    for part in parts:
        for path in (folder / part).iterdir():
            with Image.open(path) as image:
                image.convert("RGB").save(path.with_suffix(ending))
            path.unlink()
    scene = load(folder, views=4, allow_missing_masks=True)
    assert scene.train.names[0].endswith(ending) and scene.train.cameras.width.tolist() == [32] * 4
