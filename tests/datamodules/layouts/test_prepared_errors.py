"""Every fault of users' data is planted, and answered by one error: what, where, what to do."""

import logging
import os
import shutil
import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datamodules import load
from tests.datamodules.layouts.prepared_writer import write
from visdom_plugin.errors import ConfigError, SceneError


def _edit(path, old, new, count=-1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def _pose(folder, field, value, image="train_001"):
    """Sets one field (0 = id, 1..4 = quaternion, 5..7 = translation, 8 = camera, 9 = name) of one image."""
    path = folder / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    for i, line in enumerate(lines):
        if image in line:
            fields = line.split()
            for f in [field] if isinstance(field, int) else field:
                fields[f] = value
            lines[i] = " ".join(fields)
    path.write_text("\n".join(lines) + "\n")


def _lens(folder, model, params):
    path = folder / "sparse/0/cameras.txt"
    path.write_text("".join(f"{2 + 3 * i} {model} 48 36 {params}\n" for i in range(7)))


def _mask(folder, change, name="train_002"):
    path = folder / f"masks/{name}.png"
    write(path, change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def _cut(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def _huge_png(path, width=60000, height=60000):
    data = path.read_bytes()
    header = struct.pack(">II", width, height) + data[24:29]
    path.write_bytes(data[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + data[33:])


def _jpeg(folder, keep):
    path = folder / "images/train_001.png"
    _, data = cv2.imencode(".jpg", cv2.imread(str(path)))
    path.write_bytes(data.tobytes()[: int(len(data) * keep)])


def _link_out(folder, relative):
    path, outside = folder / relative, folder.parent / "outside"
    path.rename(outside)
    path.symlink_to(outside, target_is_directory=outside.is_dir())


def _shift_masks(folder):
    paths = sorted((folder / "masks").iterdir())
    for path in paths[::-1]:
        stem, number = path.stem.split("_")
        path.rename(path.with_name(f"{stem}_{int(number) + 1:03d}.png"))


# name: (what is done to the folder, words that the message must hold)
FAULTS = {
    "no model": (lambda f: (f / "sparse/0/images.txt").unlink(), ["no COLMAP model", "images.bin"]),
    "no images folder": (lambda f: shutil.rmtree(f / "images"), ["folder images is missing"]),
    "images folder only at half size": (
        lambda f: (f / "images").rename(f / "images_2"),
        ["folder images is missing", "--downscale 2"],
    ),
    "no masks folder": (lambda f: shutil.rmtree(f / "masks"), ["no folder masks", "no alpha channel", "rembg"]),
    "no training list": (lambda f: (f / "sparse_4.txt").unlink(), ["no sparse_<N>.txt"]),
    "no test list": (lambda f: (f / "sparse_test.txt").unlink(), ["sparse_test.txt is missing"]),
    "missing mask": (lambda f: (f / "masks/train_002.png").unlink(), ["train_002", "no mask"]),
    "missing test mask": (lambda f: (f / "masks/test_001.png").unlink(), ["test_001", "no mask"]),
    "masks shifted by one": (_shift_masks, ["train_000", "no mask", "shifted", "train_004"]),
    "masks named otherwise": (
        lambda f: [p.rename(p.with_name("m" + p.name)) for p in (f / "masks").iterdir()],
        ["no mask", "mtrain_000", "named otherwise"],
    ),
    "two masks for one image": (
        lambda f: (f / "masks/train_001.png.png").write_bytes((f / "masks/train_001.png").read_bytes()),
        ["more than one mask", "train_001.png.png"],
    ),
    "missing image": (lambda f: (f / "images/train_003.png").unlink(), ["missing", "train_003.png"]),
    "image is a folder": (
        lambda f: ((f / "images/train_003.png").unlink(), (f / "images/train_003.png").mkdir()),
        ["cannot be read", "train_003.png"],
    ),
    "mask of another size": (lambda f: _mask(f, lambda m: m[:-1]), ["48 x 35", "48 x 36", "train_002"]),
    "image of another size": (
        lambda f: write(f / "images/train_001.png", np.zeros((48, 36, 3), np.uint8)),
        ["36 x 48", "48 x 36", "train_001"],
    ),
    "empty mask": (lambda f: _mask(f, lambda m: m * 0), ["mask is empty", "train_002"]),
    "empty test mask": (lambda f: _mask(f, lambda m: m * 0, "test_002"), ["mask is empty", "test_002"]),
    "mask of 8 bits in 16": (lambda f: _mask(f, lambda m: m.astype(np.uint16)), ["mask is empty", "16-bit"]),
    "distorted": (
        lambda f: _lens(f, "THIN_PRISM_FISHEYE", "50 50 24 18 0.1" + " 0" * 7),
        ["THIN_PRISM_FISHEYE", *(f"--input_path sparse/0 --image_path {x} " for x in ("images", "masks"))],
    ),
    "a lens that bends too far": (
        lambda f: _lens(f, "SIMPLE_RADIAL", "50 24 18 -90"),
        ["SIMPLE_RADIAL", "of the 48 x 36 frame"],
    ),
    "a lens of NaN": (lambda f: _lens(f, "OPENCV", "50 50 24 18 0 0 nan 0"), ["OPENCV", "finite", "nan"]),
    "unknown lens": (lambda f: _lens(f, "FOO", "1 2"), ["unknown lens model FOO"]),
    "wrong number of parameters": (lambda f: _lens(f, "PINHOLE", "50 24 18"), ["PINHOLE needs 4", "line 1"]),
    "focal length zero": (lambda f: _lens(f, "PINHOLE", "0 50 24 18"), ["impossible", "focal lengths 0"]),
    "focal length NaN": (lambda f: _lens(f, "PINHOLE", "nan 50 24 18"), ["impossible", "nan"]),
    "size absurd": (
        lambda f: (f / "sparse/0/cameras.txt").write_text(
            "".join(f"{2 + 3 * i} PINHOLE 99999999999 36 50 50 24 18\n" for i in range(7))
        ),
        ["impossible", "99999999999"],
    ),
    "camera that is not there": (lambda f: _pose(f, 8, "77"), ["camera 77", "train_001.png"]),
    "camera listed twice": (
        lambda f: (f / "sparse/0/cameras.txt").write_text("2 PINHOLE 48 36 50 50 24 18\n" * 2),
        ["id 2 twice"],
    ),
    "image id twice": (lambda f: _pose(f, 0, "5"), ["id 5 twice"]),
    "image name twice": (lambda f: _pose(f, 9, "train_000.png"), ["share the name train_000"]),
    "image name twice but for the ending": (lambda f: _pose(f, 9, "train_000.jpg"), ["train_000.jpg"]),
    "NaN pose": (lambda f: _pose(f, 6, "nan"), ["train_001.png", "NaN"]),
    "infinite pose": (lambda f: _pose(f, 2, "-inf"), ["train_001.png", "infinite"]),
    "absurd pose": (lambda f: _pose(f, 5, "1e300"), ["train_001.png", "absurd"]),
    "zero quaternion": (lambda f: _pose(f, (1, 2, 3, 4), "0"), ["quaternion", "train_001.png", "zero"]),
    "not a number in a pose": (lambda f: _pose(f, 3, "abc"), ["is not `ID QW", "line"]),
    "points lines removed": (
        lambda f: (f / "sparse/0/images.txt").write_text(
            "\n".join(x for x in (f / "sparse/0/images.txt").read_text().splitlines() if ".png" in x)
        ),
        ["second line", "removed"],
    ),
    "a binary file named .txt": (
        lambda f: (f / "sparse/0/images.txt").write_bytes(b"\xff\xfe\x00\x81" * 9),
        ["not text", "images.txt"],
    ),
    "name climbs out": (lambda f: _pose(f, 9, "../../etc/passwd.png"), ["outside its folder", "../../etc"]),
    "name is absolute": (lambda f: _pose(f, 9, "/etc/passwd.png"), ["outside its folder", "/etc/passwd"]),
    "name climbs out, backslashes": (lambda f: _pose(f, 9, "..\\..\\x.png"), ["outside its folder"]),
    "name on a drive": (lambda f: _pose(f, 9, "C:\\x.png"), ["outside its folder"]),
    "image links out": (lambda f: _link_out(f, "images/train_001.png"), ["symbolic link", "outside"]),
    "mask links out": (lambda f: _link_out(f, "masks/train_001.png"), ["symbolic link", "outside"]),
    "images folder links out": (lambda f: _link_out(f, "images"), ["symbolic link", "outside"]),
    "model links out": (lambda f: _link_out(f, "sparse/0/images.txt"), ["symbolic link", "outside"]),
    "index file links out": (lambda f: _link_out(f, "sparse_4.txt"), ["symbolic link", "outside"]),
    "link in a circle": (
        lambda f: ((f / "sparse_test.txt").unlink(), (f / "sparse_test.txt").symlink_to("sparse_test.txt")),
        ["sparse_test.txt"],
    ),
    "index past the end": (lambda f: (f / "sparse_4.txt").write_text("0 1 2 7"), ["position 7", "0 to 6"]),
    "index negative": (lambda f: (f / "sparse_test.txt").write_text("-1"), ["position -1", "0 to 6"]),
    "index twice": (lambda f: (f / "sparse_4.txt").write_text("3 4 5 3"), ["position 3 twice"]),
    "index not an integer": (lambda f: (f / "sparse_4.txt").write_text("3\n4\n5.0\n6"), ["'5.0'"]),
    "index is a name": (lambda f: (f / "sparse_4.txt").write_text("train_000.png"), ["not an integer"]),
    "index file not text": (lambda f: (f / "sparse_4.txt").write_bytes(b"\xff\xfe1\0"), ["not an integer"]),
    "index file too short": (lambda f: (f / "sparse_4.txt").write_text("3 4 5"), ["lists 3 views"]),
    "index file empty": (lambda f: (f / "sparse_test.txt").write_text("\n"), ["lists no views"]),
    "train and test share a view": (lambda f: (f / "sparse_test.txt").write_text("0 4"), ["share views 4"]),
    "PNG cut": (lambda f: _cut(f / "images/train_001.png", 0.6), ["stops before its end", "train_001"]),
    "PNG's last bytes cut": (lambda f: _cut(f / "masks/test_001.png", 0.95), ["stops before its end", "test_001"]),
    "JPEG cut": (lambda f: _jpeg(f, 0.7), ["stops before its end", "train_001"]),
    "JPEG cut in its header": (lambda f: _jpeg(f, 0.1), ["JPEG", "train_001"]),
    "empty file": (lambda f: (f / "images/train_001.png").write_bytes(b""), ["is empty", "train_001"]),
    "another format": (lambda f: (f / "images/train_001.png").write_bytes(b"GIF89a"), ["none of PNG, JPEG"]),
    "huge image header": (lambda f: _huge_png(f / "images/train_001.png"), ["60000 x 60000", "train_001"]),
    "large mask header": (lambda f: _huge_png(f / "masks/train_001.png", 9600, 7200), ["9600 x 7200"]),
    "8-bit depth": (
        lambda f: ((f / "zoe_depth").mkdir(), write(f / "zoe_depth/train_000.png", np.ones((36, 48), np.uint8))),
        ["16-bit", "train_000"],
    ),
    "depth of another shape": (
        lambda f: ((f / "zoe_depth").mkdir(), write(f / "zoe_depth/train_000.png", np.ones((40, 36), np.uint16))),
        ["36 x 40", "train_000"],
    ),
    "depth array of another shape": (lambda f: _depths(f, np.ones((40, 36))), ["36 x 40", "train_000"]),
    "depth array in colours": (lambda f: _depths(f, np.ones((36, 48, 3))), ["(H, W)", "train_000"]),
    "depth array of words": (lambda f: _depths(f, np.full((36, 48), "a")), ["(H, W)", "train_000"]),
    "depth array of objects": (lambda f: _depths(f, np.full((36, 48), None)), ["cannot be read", "train_000"]),
    "depth array cut": (
        lambda f: (_depths(f, np.ones((36, 48))), _cut(f / "depths/train_000.npy", 0.5)),
        ["cannot be read", "train_000"],
    ),
    "two depth maps of a view": (
        lambda f: (_depths(f, np.ones((36, 48))), write(f / "depths/train_000.png", np.ones((36, 48), np.uint16))),
        ["two depth maps", "train_000"],
    ),
}  # fmt: skip


def _depths(folder, array):
    (folder / "depths").mkdir()
    np.save(folder / "depths/train_000.npy", array)


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_are_named(folder, fault):
    plant, words = FAULTS[fault]
    load(folder)
    plant(folder)
    with pytest.raises(SceneError) as caught:
        load(folder)
    error = caught.value
    missing = [word for word in words if word not in str(error)]
    assert not missing, f"{missing} not in: {error}"
    assert error.where is not None
    assert error.todo or error.cause


def _patch(path, at, data):
    raw = bytearray(path.read_bytes())
    raw[at : at + len(data)] = data
    path.write_bytes(bytes(raw))


BINARY_FAULTS = {
    "cameras cut": (lambda f: _cut(f / "cameras.bin", 0.7), ["cameras.bin ends too early"]),
    "images cut": (lambda f: _cut(f / "images.bin", 0.7), ["images.bin ends too early"]),
    "images cut in a name": (lambda f: _cut(f / "images.bin", 75 / 779), ["images.bin"]),
    "empty": (lambda f: (f / "images.bin").write_bytes(b""), ["ends too early"]),
    "count of images huge": (
        lambda f: _patch(f / "images.bin", 0, b"\xff" * 7 + b"\x7f"),
        ["ends too early"],
    ),
    "count of images too small": (lambda f: _patch(f / "images.bin", 0, b"\x02"), ["goes on for"]),
    "count of cameras huge": (lambda f: _patch(f / "cameras.bin", 0, b"\xff" * 8), ["ends too early"]),
    "count of points huge": (
        lambda f: _patch(f / "images.bin", 8 + 64 + len("test_002.png") + 1, b"\xff" * 8),
        ["ends too early"],
    ),
    "unknown model id": (lambda f: _patch(f / "cameras.bin", 12, b"\x63"), ["unknown model id 99"]),
    "name not UTF-8": (lambda f: _patch(f / "images.bin", 8 + 64, b"\xff\xfe"), ["not UTF-8"]),
    "name empty": (lambda f: _patch(f / "images.bin", 8 + 64, b"\0"), ["images.bin"]),
}


@pytest.mark.parametrize("fault", BINARY_FAULTS)
def test_damaged_binaries_are_named_and_cost_no_memory(binary_folder, fault):
    plant, words = BINARY_FAULTS[fault]
    load(binary_folder)
    plant(binary_folder / "sparse/0")
    tracemalloc.start()
    with pytest.raises(SceneError) as caught:
        load(binary_folder)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert peak < 2**20


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_bits_load_or_raise_a_scene_error(binary_folder, data):
    name = data.draw(st.sampled_from(["sparse/0/images.bin", "sparse/0/cameras.bin"]))
    path = binary_folder / name
    good = path.read_bytes()
    bit = data.draw(st.integers(0, 8 * len(good) - 1))
    bad = bytearray(good)
    bad[bit // 8] ^= 1 << bit % 8
    path.write_bytes(bytes(bad[: data.draw(st.sampled_from([len(bad), len(bad) - 1, len(bad) // 2]))]))
    try:
        scene = load(binary_folder)
    except SceneError:
        scene = None
    finally:
        path.write_bytes(good)
    assert scene is None or scene.train.cameras.intrinsics.isfinite().all()


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_flipped_bit_in_a_png_is_always_found(folder, data):
    path = folder / data.draw(st.sampled_from(["images/train_001.png", "masks/test_000.png"]))
    good = path.read_bytes()
    bit = data.draw(st.integers(0, 8 * len(good) - 1))
    bad = bytearray(good)
    bad[bit // 8] ^= 1 << bit % 8
    path.write_bytes(bytes(bad))
    try:
        with pytest.raises(SceneError):
            load(folder)
    finally:
        path.write_bytes(good)


@pytest.mark.parametrize("views", [0, -1, 5, 100])
def test_unavailable_views_list_the_available_ones(folder, views):
    (folder / "sparse_3.txt").write_text("3 4 5")
    with pytest.raises(SceneError, match="3, 4 views"):
        load(folder, views=views)


def test_the_list_that_is_advised_is_taken(folder):
    """Advice leads into no second refusal."""
    for views in (1, 2):
        with pytest.raises(SceneError) as caught:
            load(folder, views=views)
        by_hand = caught.value.todo.split("--train-list ")[1].split()[0]
        assert len(load(folder, train_list=by_hand).train) == views


@pytest.mark.parametrize("downscale", [0.5, 0, -2, float("nan"), float("inf")])
def test_impossible_downscales(folder, downscale):
    with pytest.raises(ConfigError, match="downscale"):
        load(folder, downscale=downscale)
    with pytest.raises(ConfigError, match="downscale"):
        load(None, downscale=downscale)


def test_an_object_lost_by_downscaling_is_named(tiny, folder):
    spot = np.zeros((36, 48), np.uint8)
    spot[3, 3] = 255
    write(folder / "masks/train_000.png", spot)
    load(folder)
    with pytest.raises(SceneError, match="thinner than a pixel"):
        load(folder, downscale=4)


def test_folders_that_are_not_scenes(folder, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    cases = {
        tmp_path / "nowhere": "no such folder",
        folder / "sparse_4.txt": "a file, not a folder",
        empty: "it is empty",
        tmp_path: "one level too high",
        folder / "images": "one level too deep",
        "a\0b": "no such folder",
        "~nobody-of-this-name/x": "no such folder",
        "x" * 5000: "no such folder",
    }
    for path, words in cases.items():
        with pytest.raises(SceneError, match=words) as caught:
            load(path)
        assert caught.value.todo
    (empty / "a.txt").write_text("")
    with pytest.raises(SceneError, match="sparse/0"):
        load(empty)


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="needs a user whom permissions bind")
def test_unreadable_files(folder):
    (folder / "images/train_000.png").chmod(0)
    with pytest.raises(SceneError, match="cannot be read"):
        load(folder)


def test_extra_masks_are_ignored_with_a_note(folder, caplog):
    write(folder / "masks/preview.png", np.ones((3, 3), np.uint8))
    with caplog.at_level(logging.INFO, "datamodules"):
        load(folder)
    assert "preview" in caplog.text
    assert "ignored" in caplog.text


def test_inverted_masks_are_warned_of(tiny, folder, caplog):
    with caplog.at_level(logging.WARNING, "datamodules"):
        load(folder)
        assert not caplog.records
        for name in tiny.train.names:
            _mask(folder, lambda m: 255 - m, name)
        load(folder)
    assert "look inverted" in caplog.text
