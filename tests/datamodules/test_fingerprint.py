"""What loading opens is what the fingerprint hashes: no more, and no less."""

import json
import os
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.fingerprint import hash_file, take_fingerprint
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from tests.datamodules.layouts.prepared_writer import write, write_prepared
from visdom_plugin.errors import ConfigError, SceneError

_watched: list[set[str]] = []


def _watch(event, args):
    if event == "open" and _watched and isinstance(args[0], (str, os.PathLike)):
        _watched[-1].add(os.path.realpath(args[0]))


sys.addaudithook(_watch)  # It stays for the process's life, and does nothing most of the time.


def _opened(call) -> set[str]:
    _watched.append(set())
    try:
        call()
    finally:
        seen = _watched.pop()
    return {path for path in seen if Path(path).is_file() and not path.endswith((".py", ".pyc", ".so"))}


@pytest.fixture(scope="module")
def scene():
    return make_scene(SyntheticConfig(size=(32, 24), train_views=7, test_views=2))


def _prepared(scene, folder):
    """With depths of training views, and a folder of pixels to ignore."""
    write_prepared(scene, folder)
    for kind, value in (("zoe_depth", np.uint16(900)), ("ignore", np.uint8(0))):
        (folder / kind).mkdir()
        write(folder / kind / f"{scene.train.names[0]}.png", np.full((24, 32), value))
    return folder


def _blender(scene, folder):
    return w.write_blender({"train": scene.train, "test": scene.test}, folder)


def _pointed(scene, folder):
    """nerfstudio with masks and depths named in its file, the sizes left to the photographs."""
    w.write_nerfstudio(_all(scene), folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        name = frame["file_path"].removeprefix("images/")
        frame |= {"mask_path": f"outlines/{name}", "depth_file_path": f"deep/{name}"}
        del frame["w"], frame["h"]
    (folder / "transforms.json").write_text(json.dumps(content))
    (folder / "masks").rename(folder / "outlines")
    (folder / "deep").mkdir()
    write(folder / "deep" / f"{scene.train.names[0]}.png", np.full((24, 32), 900, np.uint16))
    return folder


def _dynamic(scene, folder):
    w.write_instant_ngp(_all(scene), folder)
    for name in (scene.train.names[0], scene.test.names[0]):
        write(folder / f"images/dynamic_mask_{name}.png", np.zeros((24, 32), np.uint8))
    return folder


def _elsewhere(scene, folder):
    """Photographs in a folder of their own, masks and ignored pixels by bare name with endings in capitals."""
    w.write_nerfstudio(_all(scene), folder)
    text = (folder / "transforms.json").read_text()
    (folder / "transforms.json").write_text(text.replace("images/", "photos/"))
    (folder / "images").rename(folder / "photos")
    for path in (folder / "masks").iterdir():
        path.rename(path.with_suffix(".PNG"))
    (folder / "ignore").mkdir()
    write(folder / f"ignore/{scene.train.names[0]}.png", np.zeros((24, 32), np.uint8))
    return folder


def _smaller(scene, folder):
    w.write_mip360(_all(scene), folder)
    for path in (folder / "masks").iterdir():
        write(path, cv2.resize(cv2.imread(str(path), 0), (16, 12), interpolation=cv2.INTER_AREA))
    return folder


def _all(scene):
    return w.join(scene.train, scene.test)


LAYOUTS = {
    # name: (writer, options of load)
    "prepared": (_prepared, {"views": 7}),
    "prepared, lists": (_prepared, {"train_list": "2,5,7", "test_list": "1"}),
    "colmap binary": (lambda s, f: w.write_colmap(_all(s), f), {}),
    "colmap text": (lambda s, f: w.write_colmap(_all(s), f, binary=False, model="sparse"), {"views": 3}),
    "mip360": (lambda s, f: w.write_mip360(_all(s), f), {}),
    "mip360, half size": (_smaller, {"downscale": 2}),
    "mip360 as llff": (lambda s, f: w.write_mip360(_all(s), f), {"data_format": "llff"}),
    "nerfstudio": (lambda s, f: w.write_nerfstudio(_all(s), f), {}),
    "nerfstudio, alpha": (lambda s, f: w.write_nerfstudio(_all(s), f, alpha=True), {"mask_source": "alpha"}),
    "nerfstudio, files named": (_pointed, {"mask_path": "foreground"}),
    "nerfstudio, pixels ignored": (_pointed, {"mask_path": "ignore", "allow_missing_masks": True}),
    "nerfstudio, masks by bare name": (_elsewhere, {}),
    "instant-ngp": (lambda s, f: w.write_instant_ngp(_all(s), f), {}),
    "instant-ngp, dynamic masks": (_dynamic, {}),
    "blender": (_blender, {}),
    "omni3d render": (lambda s, f: w.write_omni3d_render(_all(s), f), {}),
    "omni3d video": (lambda s, f: w.write_omni3d_video(_all(s), f), {}),
    "omni3d video, llff": (lambda s, f: w.write_omni3d_video(_all(s), f, poses="llff"), {}),
    "llff": (lambda s, f: w.write_llff(_all(s), f), {"hold_out": False}),
    "actorshq": (lambda s, f: w.write_actorshq(_all(s), f, scales=(1, 2)), {}),
    "actorshq, half size": (lambda s, f: w.write_actorshq(_all(s), f, scales=(1, 2)), {"downscale": 2}),
}  # fmt: skip


def _decode_everything(root, options):
    scene = load(root, **options)
    for views in (scene.train, scene.test):
        assert all(torch.is_tensor(image) for image in views.images)
        assert all(torch.is_tensor(mask) for mask in views.masks)


def _digest_or_refusal(root, options) -> str:
    try:
        return take_fingerprint(root, **options).digest
    except SceneError:
        return "refused"


@pytest.mark.parametrize("name", LAYOUTS)
def test_each_file_that_loading_opens_counts_and_no_other(name, scene, tmp_path):
    writer, options = LAYOUTS[name]
    root = Path(writer(scene, tmp_path / "thing"))
    read = _opened(lambda: _decode_everything(root, options))
    assert len(read) > 3 and all(path.startswith(str(tmp_path)) for path in read)
    assert _opened(lambda: take_fingerprint(root, **options)) == read
    found = take_fingerprint(root, **options)
    assert found.train == len(load(root, **options).train)
    for path in sorted(read):
        before = Path(path).read_bytes()
        Path(path).write_bytes(before + b"\n")
        assert _digest_or_refusal(root, options) != found.digest, path
        Path(path).write_bytes(before)
    for path in {str(p) for p in root.rglob("*") if p.is_file()} - read:
        Path(path).write_bytes(Path(path).read_bytes() + b"\n")
    assert take_fingerprint(root, **options) == found


@pytest.mark.parametrize("name", LAYOUTS)
def test_what_this_software_writes_into_the_folder_does_not_count(name, scene, tmp_path):
    writer, options = LAYOUTS[name]
    root = Path(writer(scene, tmp_path / "thing"))
    found = take_fingerprint(root, **options)
    picture = np.full((24, 32, 3), 7, np.uint8)
    for place in ("", "runs/thing/4/ingp/0/renders/test", "tables/t/runs/ingp-thing-4-s0-01/hull", "0-out"):
        (root / place).mkdir(parents=True, exist_ok=True)
        for image in ("render.png", "sheet.jpg", f"{scene.train.names[0]}.png"):
            write(root / place / image, picture)
        for file in ("hull.ply", "mesh.ply", "hull.npz", "run.json", "log.jsonl", "table.csv", "t.yaml"):
            (root / place / file).write_text("{}")
    assert take_fingerprint(root, **options) == found
    moved = Path(shutil.move(tmp_path / "thing", tmp_path / "elsewhere"))
    assert take_fingerprint(moved / root.relative_to(tmp_path / "thing"), **options) == found


def test_what_is_asked_for_counts(scene, tmp_path):
    root = _prepared(scene, tmp_path / "thing")
    w.write_mip360(_all(scene), tmp_path / "other")
    asked = [{"views": 7}, {"train_list": "2,5"}, {"train_list": "5,2"}, {"views": 7, "test_list": "0"}]
    asked += [{"views": 7, "test": False}, {"views": 7, "data_format": "colmap"}]
    digests = [take_fingerprint(root, **options).digest for options in asked]
    digests += [take_fingerprint(tmp_path / "other", downscale=f).digest for f in (1, 2)]
    assert len(set(digests)) == len(digests)


def test_a_change_in_the_middle_of_a_large_file_counts(scene, tmp_path):
    root = w.write_colmap(_all(scene), tmp_path / "thing", binary=False)
    path = root / "sparse/0/images.txt"
    text = path.read_text()
    digests = set()
    for letter in "ab":
        path.write_text("#" + "x" * 3_000_000 + letter + "x" * 3_000_000 + "\n" + text)
        digests.add(take_fingerprint(root).digest)
    assert len(digests) == 2


def test_files_behind_links_count_where_they_may_be_read(scene, tmp_path):
    root = w.write_colmap(_all(scene), tmp_path / "thing")
    shutil.move(root / "images", tmp_path / "raw")
    (root / "images").symlink_to("../raw", target_is_directory=True)
    with pytest.raises(SceneError, match="leads out"):
        take_fingerprint(root)
    before = take_fingerprint(root, allow_outside=True)
    (root / "sparse/loop").symlink_to("..", target_is_directory=True)
    assert take_fingerprint(root, allow_outside=True) == before
    for photograph in (tmp_path / "raw").iterdir():
        photograph.write_bytes(photograph.read_bytes() + b"\n")
    assert take_fingerprint(root, allow_outside=True) != before


def test_a_list_counts_by_what_it_holds(scene, tmp_path):
    root = _prepared(scene, tmp_path / "thing")
    listed = tmp_path / "list.txt"
    found = []
    for text in ("2 3", "2 4", "2,3", "2 3 4"):
        listed.write_text(text)
        found.append(take_fingerprint(root, train_list=str(listed)))
    assert found[0] == found[2] and len(set(found)) == 3
    assert [f.train for f in found] == [2, 2, 2, 3]
    with pytest.raises(ConfigError, match="no view of this scene"):
        take_fingerprint(root, train_list="2,99")


def test_hashes_that_are_known_are_not_made_again(scene, tmp_path):
    root = w.write_llff(_all(scene), tmp_path / "thing")
    known = {}
    found = take_fingerprint(root, known=known)
    assert known == {path: hash_file(path) for path in known} and len(known) > 8
    images = {os.path.realpath(path) for path in known if path.suffix == ".png"}
    again = _opened(lambda: take_fingerprint(root, known=known))
    assert not again & images and take_fingerprint(root, known=known) == found
    with pytest.raises(SceneError, match="cannot be read"):
        hash_file(tmp_path)
    assert hash_file(tmp_path / "nothing") == ""
