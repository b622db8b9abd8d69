"""Photographs and settings that cannot be used: one clear error, and nothing written."""

from __future__ import annotations

import builtins
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image

from visdom_plugin.cli.commands.prepare import main
from visdom_plugin.prepare import from_board
from visdom_plugin.prepare.board import Corners


def save(folder, name, size=(320, 240), *, model="A", focal=5.0, **more):
    exif = Image.Exif()
    exif[0x0110] = model
    exif.get_ifd(0x8769)[0x920A] = focal
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(len(name))
    pixels = rng.integers(0, 255, (*size[::-1], 3), np.uint8)
    Image.fromarray(pixels).save(folder / name, **({"exif": exif} if name.endswith("jpg") else {}), **more)


def refusal(folder, tmp_path, capsys, *words) -> str:
    assert main([str(folder), "--out", str(tmp_path / "scene"), *words]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) in ([], ["photographs"], ["masks", "photographs"])
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "photographs"


def test_no_board(folder, tmp_path, capsys):
    for i in range(3):
        save(folder, f"{i}.jpg")
    said = refusal(folder, tmp_path, capsys)
    assert "no board (7 x 10 squares, markers 4X4_50) was found in any of 3 photographs" in said
    assert "--print-board" in said and "--poses" in said and str(folder) in said


def test_another_dictionary_is_named(photographs, tmp_path, capsys):
    said = refusal(photographs.folder, tmp_path, capsys, "--dictionary", "6X6_250")
    assert "the photographs show markers of 4X4_50" in said and "--dictionary 4X4_50" in said


def test_too_little_of_the_board(photographs, folder, tmp_path, capsys):
    folder.mkdir()
    for truth in photographs.truths[:2]:
        image = cv2.imread(str(photographs.folder / truth.name))
        found = cv2.aruco.CharucoDetector(_board()).detectBoard(image)
        x, y = np.asarray(found[0]).reshape(-1, 2)[-1]
        kept = np.full_like(image, 200)
        part = slice(max(0, int(y) - 75), int(y) + 75), slice(max(0, int(x) - 75), int(x) + 75)
        kept[part] = image[part]
        cv2.imwrite(str(folder / truth.name), kept)
    said = refusal(folder, tmp_path, capsys)
    assert "the board can be used in 0 of 2 photographs" in said and "are needed" in said


def test_one_photograph_is_too_few(photographs, folder, tmp_path, capsys):
    folder.mkdir()
    shutil.copy(photographs.folder / photographs.truths[0].name, folder)
    said = refusal(folder, tmp_path, capsys)
    assert "there is one photograph" in said and "take six or more" in said and "#no-board" in said


@pytest.mark.parametrize(("markers", "cause"), [(3, "3 of its markers can be read"), (20, "try --legacy")])
def test_markers_without_corners(markers, cause, folder, tmp_path, capsys, monkeypatch):
    save(folder, "a.jpg")
    save(folder, "b.jpg")
    nothing = Corners(np.zeros(0, np.int64), np.zeros((0, 2)), markers)
    monkeypatch.setattr(from_board, "find_corners", lambda *_: nothing)
    assert cause in refusal(folder, tmp_path, capsys)


def _board():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.CharucoBoard((7, 10), 0.025, 0.018, dictionary)


def test_one_bad_view_is_left_out_and_named(photographs, folder, tmp_path, capsys):
    folder.mkdir()
    for truth in photographs.truths[:4]:
        shutil.copy(photographs.folder / truth.name, folder)
    # The board bent in one photograph: its rows run away to the side.
    image = cv2.imread(str(folder / "IMG_0002.jpg"), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    bent = cv2.remap(image, u + 12 * np.sin(v / 40), v, cv2.INTER_LINEAR)
    data = Image.fromarray(bent[..., ::-1])
    data.save(folder / "IMG_0002.jpg", exif=Image.open(photographs.folder / "IMG_0002.jpg").getexif())
    save(folder, "IMG_0009.jpg", (960, 720), model="demo phone", focal=5.7)
    exif = Image.open(photographs.folder / "IMG_0001.jpg").getexif()
    Image.open(folder / "IMG_0009.jpg").save(folder / "IMG_0009.jpg", exif=exif)
    assert main([str(folder), "--out", str(tmp_path / "scene"), "--mask-source", "none"]) == 0
    said = capsys.readouterr().out
    assert "photographs  3 of 5" in said
    assert "IMG_0002.jpg: the board's corners are" in said and "IMG_0009.jpg: no board found" in said


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"model": "B"}, "by B"),
        ({"focal": 2.2}, "at 2.2 mm"),
        ({"size": (400, 240)}, "of 400 x 240"),
    ],
)
def test_mixed_cameras(other, said, folder, tmp_path, capsys):
    for i in range(3):
        save(folder, f"{i}.jpg")
    save(folder, "other.jpg", **other)
    text = refusal(folder, tmp_path, capsys)
    assert (
        "the photographs are of 2 cameras, lenses or sizes" in text and said in text and "other.jpg" in text
    )


def test_videos(folder, tmp_path, capsys):
    folder.mkdir()
    (folder / "walk.MOV").write_bytes(b"video")
    said = refusal(folder, tmp_path, capsys)
    assert "there are no photographs" in said and "walk.MOV" in said and "ffmpeg" in said


def test_raw_photographs(folder, tmp_path, capsys):
    folder.mkdir()
    (folder / "a.DNG").write_bytes(b"raw")
    assert "develop them" in refusal(folder, tmp_path, capsys)


def test_an_empty_folder(folder, tmp_path, capsys):
    folder.mkdir()
    assert "there are no photographs" in refusal(folder, tmp_path, capsys)


def test_names_that_clash(folder, tmp_path, capsys):
    save(folder, "IMG_1.jpg")
    save(folder, "img_1.png")
    said = refusal(folder, tmp_path, capsys)
    assert "1 names occur twice" in said and "IMG_1.jpg and img_1.png" in said


def test_heic_without_the_extra(folder, tmp_path, capsys, monkeypatch):
    folder.mkdir()
    (folder / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 100)
    real = builtins.__import__

    def absent(name, *args, **more):
        if name.startswith("pillow_heif"):
            raise ImportError(name)
        return real(name, *args, **more)

    monkeypatch.setattr(builtins, "__import__", absent)
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    said = refusal(folder, tmp_path, capsys)
    assert "a.heic" in said and "visdom-plugin[heic]" in said


def test_a_damaged_photograph(folder, tmp_path, capsys):
    save(folder, "a.jpg")
    data = (folder / "a.jpg").read_bytes()
    (folder / "b.jpg").write_bytes(data[: len(data) // 2])
    assert "b.jpg" in refusal(folder, tmp_path, capsys)


def test_a_scene_inside_the_photographs(folder, tmp_path, capsys):
    save(folder, "a.jpg")
    assert main([str(folder), "--out", str(folder / "scene")]) == 2
    assert "photographs are never touched" in capsys.readouterr().err
    assert [p.name for p in folder.iterdir()] == ["a.jpg"]


def test_a_folder_that_is_no_scene_of_ours_is_kept(folder, tmp_path, capsys):
    save(folder, "a.jpg")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.txt").write_text("mine")
    for words in ([], ["--overwrite"]):
        assert main([str(folder), "--out", str(tmp_path / "scene"), *words]) == 2
        assert "no scene of visdom-prepare" in capsys.readouterr().err
    assert (tmp_path / "scene" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "visdom-prepare PHOTOS --out SCENE"),
        (["nowhere"], "there is no such folder"),
        (["HERE", "--poses", "nowhere.json"], "no such file or folder of poses"),
        (["HERE", "--poses", "board", "--colmap"], "poses of two sources"),
        (["HERE", "--size", "10"], "--size is 10"),
        (["HERE", "--mask-rounds", "-1"], "--mask-rounds is -1"),
        (["HERE", "--focal-35mm", "0"], "--focal-35mm is 0"),
    ],
)
def test_settings_that_cannot_be(words, said, folder, tmp_path, capsys, monkeypatch):
    save(folder, "a.jpg")
    monkeypatch.chdir(tmp_path)
    assert main([str(folder) if w == "HERE" else w for w in words]) == 2
    assert said in capsys.readouterr().err and [p.name for p in tmp_path.iterdir()] == ["photographs"]


def test_masks_that_are_asked_for_and_missing(photographs, tmp_path, capsys):
    said = refusal(photographs.folder, tmp_path, capsys, "--mask-source", "given")
    assert "6 of 6 photographs have no mask" in said


def test_a_name_of_poses_that_is_a_little_wrong(folder, tmp_path, capsys):
    save(folder, "a.jpg")
    (folder / "cameras.xml").write_text("<document/>")
    said = refusal(folder, tmp_path, capsys, "--poses", str(folder / "camera.xml"))
    assert "cameras.xml" in said


def test_rembg_without_models(photographs, tmp_path, capsys):
    said = refusal(photographs.folder, tmp_path, capsys, "--mask-source", "rembg")
    assert "--rembg-models DIR" in said
    said = refusal(
        photographs.folder, tmp_path, capsys, "--mask-source", "rembg", "--rembg-models", str(tmp_path)
    )
    assert "there is no isnet-general-use.onnx" in said


def test_a_box_beside_the_cameras(photographs, tmp_path, capsys):
    words = ["--box", "5", "5", "5", "6", "6", "6"]
    assert "the box that the object is in" in refusal(photographs.folder, tmp_path, capsys, *words)
    words = ["--box", "1", "0", "0", "-1", "1", "1"]
    assert "is no box" in refusal(photographs.folder, tmp_path, capsys, *words)


def test_a_folder_above_the_photographs_names_the_one_that_holds_them(folder, tmp_path, capsys):
    folder.mkdir()
    save(folder / "phone", "0.jpg")
    for i in range(3):
        save(folder / "masks", f"{i}.png")
    said = refusal(folder, tmp_path, capsys)
    assert "they lie in folders below: phone (1), masks (3)" in said
    assert f"visdom-prepare {folder}/phone\n" in said
    shutil.rmtree(folder / "masks")
    (folder / "phone/0.jpg").rename(folder / "phone/0.txt")
    assert "another folder is meant" in refusal(folder, tmp_path, capsys)
