"""What lies in folders of captures in real life: litter of systems, other encodings, other people's habits."""

import json
import shutil
import zipfile

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from visdom_plugin.errors import SceneError

LITTER = (".DS_Store", "Thumbs.db", "._v0.png", ".hidden.png", "@eaDir/v0.png", "__MACOSX/._v1.png", "a.mp4")


@pytest.fixture(scope="module")
def views():
    return make_scene(SyntheticConfig(size=(32, 24), train_views=8, test_views=0)).train


@pytest.fixture(params=["colmap", "nerfstudio", "llff"])
def folder(request, views, tmp_path):
    return getattr(w, f"write_{request.param}")(views, tmp_path / "scene")


def _same(one, other):
    assert one.train.names == other.train.names
    assert all(map(torch.equal, one.train.images, other.train.images))
    assert all(map(torch.equal, one.train.masks, other.train.masks))


def _write(layout, views, tmp_path):
    if layout == "colmap":
        return w.write_colmap(views, tmp_path / "scene", binary=False)
    return w.write_nerfstudio(views, tmp_path / "scene")


def _refused(folder, *words):
    with pytest.raises(SceneError) as caught:
        load(folder)
    missing = [word for word in words if word not in str(caught.value)]
    assert not missing, f"{missing} not in: {caught.value}"


def test_litter_of_systems_is_no_photograph_and_no_mask(folder):
    clean = load(folder)
    for part in ("images", "masks", "."):
        for name in LITTER:
            path = folder / part / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"litter")
    _same(load(folder), clean)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "crlf"])
@pytest.mark.parametrize("layout", ["colmap", "nerfstudio"])
def test_text_of_windows_programs_is_read(views, tmp_path, layout, encoding):
    folder = _write(layout, views, tmp_path)
    clean = load(folder)
    for path in [*folder.glob("sparse/0/*.txt"), *folder.glob("*.json")]:
        text = path.read_text()
        crlf = encoding == "crlf"
        path.write_bytes(text.replace("\n", "\r\n").encode() if crlf else text.encode(encoding))
    _same(load(folder), clean)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda t: t.rstrip()[:-1] + ",}", ["a comma behind the last", "remove this comma"]),
        (lambda t: "// mine\n" + t, ["a comment", "remove all comments"]),
        (lambda t: t.replace('"', "'"), ["single quotes", "json.dump"]),
        (lambda t: '{"w": 3,5, ' + t[1:], ["decimal comma", "with a point"]),
        (lambda t: '{"fl_x": "3,5", ' + t[1:].replace('"fl_x"', '"x"'), ["decimal comma", "3.5"]),
        (lambda t: "", ["is empty", "copy the file again"]),
        (lambda t: t[: len(t) // 2], ["not JSON", "truncated"]),
    ],
)
def test_json_written_by_hand_is_refused_with_its_mistake(views, tmp_path, change, words):
    folder = w.write_nerfstudio(views, tmp_path / "scene")
    path = folder / "transforms.json"
    path.write_text(change(json.dumps({"fl_x": 9, **json.loads(path.read_text())})))
    _refused(folder, *words)


def test_text_in_another_encoding_is_called_that(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "scene")
    path = folder / "transforms.json"
    path.write_bytes(b'{"note": "K\xf6rper", ' + path.read_bytes()[1:])
    _refused(folder, "not text in UTF-8", "another encoding", "save it as UTF-8")


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
def test_decimal_commas_in_a_model_are_called_that(views, tmp_path, name):
    folder = _write("colmap", views, tmp_path)
    path = next(folder.rglob(name))
    words = [word.replace(".", ",") if "png" not in word else word for word in path.read_text().split(" ")]
    path.write_text(" ".join(words))
    _refused(folder, "decimal comma", "write all numbers with points")


def test_index_files_may_have_commas(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    (folder / "sparse_3.txt").write_bytes(b"\xef\xbb\xbf0, 2,4\r\n")
    assert len(load(folder, views=3, test=False).train) == 3


@pytest.mark.parametrize("save", ["gif", "npy"])
def test_masks_in_a_format_that_is_not_read_are_to_be_converted(views, tmp_path, save):
    folder = w.write_colmap(views, tmp_path / "scene")
    for path in (folder / "masks").iterdir():
        if save == "gif":
            Image.open(path).save(path.with_suffix(".gif"))
        else:
            np.save(path.with_suffix(".npy"), cv2.imread(str(path)))
        path.unlink()
    _refused(folder, f".{save}", "save masks as PNG")


def test_no_mask_at_all_is_not_advised_to_be_left_out(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    first, *others = sorted((folder / "masks").iterdir())
    for path in others:
        path.unlink()
    with pytest.raises(SceneError) as caught:
        load(folder, train_list="0,1,2,3")
    assert "--data.missing-masks" in caught.value.todo
    first.unlink()
    with pytest.raises(SceneError) as caught:
        load(folder)
    assert "--data.missing-masks" not in caught.value.todo


def test_masks_below_the_name_of_the_photographs_folder(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    clean = load(folder)
    (folder / "masks").rename(folder / "kept")
    (folder / "masks").mkdir()
    (folder / "kept").rename(folder / "masks/images")
    _same(load(folder), clean)


def test_a_name_that_differs_in_case_goes_before_one_of_another_ending(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    clean = load(folder)
    for path in sorted((folder / "images").iterdir()):
        path.rename(path.with_suffix(".PNG"))
        cv2.imwrite(str(path.with_suffix(".jpg")), np.zeros((24, 32, 3), np.uint8))
    _same(load(folder), clean)


def test_all_empty_masks_are_counted(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    for path in (folder / "masks").iterdir():
        cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))
    _refused(folder, "the mask is empty", "the same of 3 other views")


def test_an_empty_file_is_an_interrupted_copy(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    for path in (folder / "images").iterdir():
        path.write_bytes(b"")
    _refused(folder, "the file is empty", "interrupted copy", "copy the file again")


def test_exif_data_that_cannot_be_read_turns_nothing(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    clean = load(folder)
    for path in (folder / "images").iterdir():
        image = Image.open(path)
        image.load()
        image.save(path.with_suffix(".webp"), lossless=True, exif=b"Exif\0\0" + b"x" * 400)
        path.unlink()
    _same(load(folder), clean)


def test_folders_without_poses_say_how_one_gets_them(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "scene")
    shutil.rmtree(folder / "sparse")
    _refused(folder, "photographs without poses", "visdom-prepare")
    shutil.rmtree(folder / "images")
    (folder / "IMG_1.MOV").write_bytes(b"film")
    _refused(folder, "IMG_1.MOV is a video")
    with zipfile.ZipFile(folder / "IMG_0.zip", "w"):
        pass
    _refused(folder, "IMG_0.zip is not unpacked")
