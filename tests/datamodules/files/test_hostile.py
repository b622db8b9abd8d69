"""Broken and hostile scenes in every layout: one error with a place, no traceback, no hang, no file outside."""

import json
import os
import random
import shutil
import threading
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datamodules import load
from datamodules.files.parsers import parse_json, parse_npy
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from tests.fuzz.fuzz_readers import judge, make_case, make_readers
from tests.fuzz.mutate import damage, damage_json
from visdom_plugin.errors import SceneError, VisDomError


@pytest.fixture(scope="module")
def views():
    scene = make_scene(SyntheticConfig(size=(24, 16), train_views=4, test_views=1))
    return w.join(scene.train, scene.test)


WRITERS = {
    "colmap": w.write_colmap,
    "text": lambda v, f: w.write_colmap(v, f, binary=False),
    "nerfstudio": w.write_nerfstudio,
    "alpha": lambda v, f: w.write_nerfstudio(v, f, alpha=True),
    "blender": lambda v, f: w.write_blender({"train": v}, f),
    "ngp": w.write_instant_ngp,
    "render": w.write_omni3d_render,
    "video": w.write_omni3d_video,
    "llff": w.write_llff,
    "actorshq": w.write_actorshq,
}


@pytest.fixture(scope="module")
def originals(views, tmp_path_factory):
    root = tmp_path_factory.mktemp("originals")
    return {name: writer(views, root / name) for name, writer in WRITERS.items()}


@pytest.fixture
def copy(originals, tmp_path):
    """A scene of a layout to spoil."""

    def make(name: str) -> Path:
        return Path(shutil.copytree(originals[name], tmp_path / "scene"))

    return make


def _refused(folder: Path, *words: str, **options) -> SceneError:
    with pytest.raises(SceneError) as caught:
        load(folder, **options)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert caught.value.where is not None
    return caught.value


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    return make_readers(tmp_path_factory.mktemp("readers"))


READERS = (
    "cameras.bin", "images.bin", "points3D.bin", "cameras.txt", "images.txt", "points3D.txt", "transforms.json",
    "poses_bounds.npy", "calibration.csv", "aabbs.csv", "sparse_N.txt", "photograph, PNG",
    "photograph, JPEG", "mask, PNG",
)  # fmt: skip


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=40, deadline=None)
@given(index=st.integers(0, 2**40), measure=st.booleans())
def test_readers_read_or_refuse(readers, name, index, measure):
    assert set(readers) == set(READERS)
    _, _, fault = judge(readers[name], make_case(name, readers[name], index, seed=1), measure)
    assert fault is None


@settings(max_examples=60, deadline=None)
@given(
    tree=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(), st.lists, max_leaves=9
    )
)
def test_any_value_in_any_place_of_a_transforms_file(tree, originals):
    content = json.loads((originals["nerfstudio"] / "transforms.json").read_bytes())
    from datamodules.layouts.transforms import parse_transforms

    for key in ("file_path", "transform_matrix", "fl_x", "w", "k1", "camera_model", "mask_path"):
        frames = [{**content["frames"][0], key: tree}]
        with_key = json.dumps({**content, "frames": frames}).encode("utf-8", "surrogatepass")
        try:
            parse_transforms(with_key, Path("/x/transforms.json"))
        except SceneError as error:
            assert error.where is not None


@pytest.mark.parametrize("name", WRITERS)
def test_scenes_with_any_damaged_file_load_or_are_refused(name, originals, tmp_path):
    """Whole folders: any file damaged, emptied, replaced by a folder or a link, or gone."""
    draw = random.Random(name)
    folder = Path(shutil.copytree(originals[name], tmp_path / "scene"))
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    small = [path for path in files if path.suffix not in (".png", ".jpg")]
    for step in range(50):
        path = draw.choice(small if step % 2 else files)
        good = path.read_bytes()
        kind = draw.randrange(8)
        if kind == 0:
            path.unlink()
        elif kind == 1:
            path.unlink()
            path.mkdir()
        elif kind == 2:
            path.unlink()
            path.symlink_to(path.name)
        else:
            mutate = damage_json if path.suffix == ".json" else damage
            path.write_bytes(mutate(good, draw, [good]))
        try:
            scene = load(folder)
            assert scene.train.cameras.intrinsics.isfinite().all()
        except VisDomError as error:
            assert error.what
        finally:
            if path.is_dir() and not path.is_symlink():
                path.rmdir()
            path.unlink(missing_ok=True)
            path.write_bytes(good)
    load(folder)


@pytest.mark.parametrize("name", WRITERS)
def test_half_copied_scenes_are_refused_by_a_message(name, originals, tmp_path):
    """Copies that stopped after each file, in the order of a plain copy."""
    files = sorted(path for path in originals[name].rglob("*") if path.is_file())
    for count in range(len(files)):
        folder = tmp_path / str(count)
        folder.mkdir()
        for path in files[:count]:
            target = folder / path.relative_to(originals[name])
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link(path, target)
        try:
            load(folder)
        except SceneError as error:
            assert error.where is not None and (error.todo or error.cause)


OUTSIDE = ("../secret.png", "/{}/secret.png", "images/../../secret.png", "..\\secret.png", "C:\\secret.png")


@pytest.mark.parametrize("written", OUTSIDE)
@pytest.mark.parametrize("key", ["file_path", "mask_path"])
def test_transforms_name_no_file_outside(copy, written, key):
    folder = copy("alpha")
    shutil.copy(folder / "images/train_000.png", folder.parent / "secret.png")
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    name = written.format(str(folder.parent).lstrip("/"))
    for frame in content["frames"]:
        if "train_000" in frame["file_path"] or key == "mask_path":
            frame[key] = name
    path.write_text(json.dumps(content))
    _refused(folder, "outside its folder", "--allow-outside")
    if "\\" not in written and key == "file_path":
        assert len(load(folder, views=4, allow_outside=True).train) == 4


def test_links_out_of_the_folder_are_followed_only_when_allowed(copy):
    for name, relative in (
        ("nerfstudio", "transforms.json"),
        ("nerfstudio", "images/train_001.png"),
        ("nerfstudio", "masks"),
        ("blender", "transforms_train.json"),
        ("llff", "poses_bounds.npy"),
        ("llff", "images"),
        ("actorshq", "1x/calibration.csv"),
        ("actorshq", "aabbs.csv"),
        ("video", "standard"),
        ("colmap", "sparse"),
    ):
        folder = copy(name)
        options = {"train_list": "1,2,3,4"} if name == "actorshq" else {"views": 4}
        load(folder, **options)
        outside = folder.parent / "outside"
        (folder / relative).rename(outside)
        (folder / relative).symlink_to(outside, target_is_directory=outside.is_dir())
        _refused(folder, "symbolic link", **options)
        load(folder, allow_outside=True, **options)
        shutil.rmtree(folder)
        shutil.rmtree(outside) if outside.is_dir() else outside.unlink()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize(
    "name, relative",
    [
        ("nerfstudio", "transforms.json"),
        ("nerfstudio", "images/train_000.png"),
        ("nerfstudio", "masks/train_000.png"),
        ("colmap", "sparse/0/images.bin"),
        ("llff", "poses_bounds.npy"),
        ("actorshq", "1x/calibration.csv"),
        ("colmap", "sparse_4.txt"),
    ],
)
def test_pipes_do_not_hang_a_reader(copy, name, relative):
    folder = copy(name)
    (folder / relative).unlink(missing_ok=True)
    os.mkfifo(folder / relative)
    ended = []

    def try_to_load():
        try:
            load(folder, views=4)
            ended.append("loaded")
        except SceneError:
            ended.append("refused")

    thread = threading.Thread(target=try_to_load, daemon=True)
    thread.start()
    thread.join(60)
    assert ended == ["refused"]


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e300, 10**400])
@pytest.mark.parametrize("name", ["nerfstudio", "llff", "actorshq", "text"])
def test_poses_that_are_no_numbers_are_refused_by_name(copy, name, bad):
    folder = copy(name)
    views = {"train_list": "1,2,3"} if name == "actorshq" else {"views": 4}
    if name == "nerfstudio":
        content = json.loads((folder / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["transform_matrix"][1][3] = bad
        (folder / "transforms.json").write_text(json.dumps(content))
    elif name == "llff":
        table = np.load(folder / "poses_bounds.npy")
        table[:, 3] = min(bad, 1e300)
        np.save(folder / "poses_bounds.npy", table)
    else:
        path = folder / ("1x/calibration.csv" if name == "actorshq" else "sparse/0/images.txt")
        lines = path.read_text().splitlines()
        split, column = (",", 7) if name == "actorshq" else (" ", 5)
        for i, line in enumerate(lines):
            if line.startswith("Cam") or ".png" in line:
                fields = line.split(split)
                fields[column] = str(float(bad) if bad < 10**300 else bad)
                lines[i] = split.join(fields)
        path.write_text("\n".join(lines) + "\n")
    _refused(folder, **views)


def test_json_bombs_end_quickly_and_cheaply():
    where = Path("transforms.json")
    for text in (
        "[" * 10**6,
        '{"a":' * 10**5,
        '{"frames": ' + "[" * 50_000 + "]" * 50_000 + "}",
        '{"frames": [' + "9" * 10**6 + "]}",
        '{"frames": ' + "1" * 10**6 + "e" + "9" * 10**5 + "}",
        "[1, 2]",
        "{} x",
        '"' + "\\u0000" * 9,
    ):
        tracemalloc.start()
        try:
            parse_json(text.encode(), where)
        except SceneError as error:
            assert error.where == where
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**20 + 60 * len(text)


def test_arrays_that_claim_to_be_huge_cost_nothing():
    import io

    stream = io.BytesIO()
    np.save(stream, np.zeros((20, 17)))
    good = stream.getvalue()

    def claiming(shape: str, kind: str = "<f8") -> bytes:
        header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        return good[:8] + len(header).to_bytes(2, "little") + header + bytes(20 * 17 * 8)

    assert parse_npy(good, Path("x")).shape == parse_npy(claiming("(20, 17)"), Path("x")).shape == (20, 17)
    for shape in (
        "(20000000000, 17)",
        f"({10**30}, 17)",
        "(20, 17, 2)",
        "()",
        "(-1, 17)",
        "(20, 17",
        "(" + "1," * 90 + ")",
    ):
        with pytest.raises(SceneError):
            parse_npy(claiming(shape), Path("x"))
    for kind in ("|O", "|O8", "<U9", "<f3", "<f99"):
        with pytest.raises(SceneError):
            parse_npy(claiming("(20, 17)", kind), Path("x"))
    for bad in (good.replace(b"{", b"["), good[:50], b"", b"PK\3\4" + good):
        with pytest.raises(SceneError):
            parse_npy(bad, Path("x"))


def test_fortran_order_and_single_precision_arrays_are_read():
    import io

    table = np.arange(40.0).reshape(8, 5)
    for array in (table.astype(">f4"), np.asfortranarray(table), table.astype(np.int16)):
        stream = io.BytesIO()
        np.save(stream, array)
        assert np.array_equal(parse_npy(stream.getvalue(), Path("x")), table)


@pytest.mark.skipif(os.name == "nt", reason="names are UTF-16 there")
def test_file_names_that_are_not_utf8(copy):
    folder = copy("llff")
    strange = folder / "images" / os.fsdecode(b"tr\xffain.png")
    (folder / "images/train_000.png").rename(strange)
    error = _refused(folder, "not UTF-8")
    str(error).encode("utf-8")
    strange.rename(folder / "images/train_000.png")
    folder = folder.rename(folder.parent / os.fsdecode(b"sc\xffene"))
    scene = load(folder, views=3)
    scene.name.encode("utf-8")
    json.dumps(scene.source).encode("utf-8")


def test_huge_pictures_are_refused_before_they_are_decoded(copy):
    import struct
    import zlib

    for width, height in ((60000, 60000), (16000, 16000)):
        folder = copy("blender")
        path = folder / "train/train_000.png"
        data = path.read_bytes()
        header = struct.pack(">II", width, height) + data[24:29]
        path.write_bytes(data[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + data[33:])
        tracemalloc.start()
        _refused(folder, f"{width} x {height}", train_list="0,1,2,3,4", test=False)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**22
        shutil.rmtree(folder)
