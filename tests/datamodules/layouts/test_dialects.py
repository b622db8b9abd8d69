"""Neighbouring programs' forms of a capture: what can be understood is read, the rest is named as what it is."""

import json

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.layouts import neus
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from tests.datamodules.layouts.prepared_writer import same_cameras
from visdom_plugin.errors import SceneError


@pytest.fixture(scope="module")
def views():
    """Eight views, each with its own focal length and principal point."""
    return make_scene(SyntheticConfig(size=(40, 30), train_views=8, test_views=0)).train


def _edit(folder, change, name="transforms.json"):
    path = folder / name
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def _as_matrix(rows, key):
    def change(content):
        for frame in content["frames"]:
            K = np.eye(rows)
            K[0, 0], K[1, 1], K[0, 2], K[1, 2] = (frame.pop(name) for name in ("fl_x", "fl_y", "cx", "cy"))
            frame[key] = K.tolist()

    return change


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("key", ["intrinsic_matrix", "K", "intrinsics"])
def test_a_matrix_of_intrinsics_per_frame_is_read(rows, key, views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    expected = load(folder, views=4).train.cameras
    _edit(folder, _as_matrix(rows, key))
    assert same_cameras(load(folder, views=4).train.cameras, expected)


def test_neus2s_axes_are_opencvs(views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    expected = load(folder, views=4).train.cameras

    def change(content):
        content["from_na"] = True
        for frame in content["frames"]:
            frame["transform_matrix"] = (
                np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
            ).tolist()

    _edit(folder, change)
    assert same_cameras(load(folder, views=4).train.cameras, expected)


def _set(**values):
    return lambda content: [frame.update(values) for frame in content["frames"]]


@pytest.mark.parametrize(
    "change, words",
    [
        (_set(intrinsic_matrix=[[50, 9, 20], [0, 50, 15], [0, 0, 1]]), ["frame 0", "skewed", "undistort"]),
        (_set(sk_x=9.0), ["frame 0", "skewed"]),
        (lambda c: c.update(camera_model=["OPENCV"]), ["camera_model", "['OPENCV']", "photographs, masks"]),
        (_set(ftheta_p0=0.1), ["f-theta", "ftheta_p0"]),
        (_set(K=[1, 2, 3]), ["K of frame 0", "3 x 3"]),
        (
            lambda c: [f.update(rot_mat=f.pop("transform_matrix")) for f in c["frames"]],
            ["frame 0 has no transform_matrix", "rot_mat", "camera-to-world"],
        ),
        (
            lambda c: [f.pop("fl_x") and f.pop("fl_y") for f in c["frames"]],
            ["no focal length", "give fl_x, fl_y, cx, cy in pixels"],
        ),
    ],
)
def test_what_cannot_be_read_is_named(change, words, views, tmp_path):
    folder = w.write_nerfstudio(views, tmp_path / "s")
    _edit(folder, change)
    with pytest.raises(SceneError) as error:
        load(folder, views=4)
    assert all(word in str(error.value) for word in words), str(error.value)
    assert "copy the file again" not in str(error.value) or "wrongly written" in str(error.value)


@pytest.mark.parametrize("lens", ["SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"])
def test_short_fisheyes_are_opencvs_with_zeros(lens, views, tmp_path):
    def give(model, **bend):
        _edit(folder, lambda content: content.update(camera_model=model, **bend))
        return load(folder, views=4).train.images

    folder = w.write_nerfstudio(views, tmp_path / "s")
    bent = give(lens, k1=0.1, k2=0.0 if lens.startswith("SIMPLE") else -0.05)
    assert all(map(torch.equal, bent, give("OPENCV_FISHEYE")))
    assert not all(map(torch.equal, bent, give("OPENCV", k1=0.0, k2=0.0)))


def test_transform_without_s_is_blenders_file(views, tmp_path):
    parts = {"train": views.take(range(6)), "test": views.take([6, 7])}
    folder = w.write_blender(parts, tmp_path / "s")
    expected = load(folder, views=4)
    for part in parts:
        (folder / f"transforms_{part}.json").rename(folder / f"transform_{part}.json")
    found = load(folder, views=4)
    assert (
        same_cameras(found.train.cameras, expected.train.cameras) and found.test.names == expected.test.names
    )


def _write_neus(views, folder, *, file="cameras_sphere.npz", image="image", mask="mask", digits=3):
    arrays = {}
    for i in range(len(views)):
        w.write_photograph(folder / image / f"{i:06d}.png", views, i)
        w.write_mask(folder / mask / f"{i:0{digits}d}.png", views, i)
        P = np.eye(4)
        P[:3] = (views.cameras.intrinsics[i] @ views.cameras.camera_from_world[i, :3]).numpy()
        arrays |= {f"world_mat_{i}": -2.5 * P if i % 2 else P, f"scale_mat_{i}": 3 * np.eye(4)}
    np.savez(folder / file, **arrays)
    return folder


@pytest.mark.parametrize(
    "names", [{}, {"file": "cameras.npz", "image": "images", "mask": "masks"}, {"image": "rgb", "digits": 6}]
)
def test_projections_of_neus_and_idr_are_read(names, views, tmp_path):
    scene = load(_write_neus(views, tmp_path / "s", **names), views=7, hold_out=False)
    for i, name in enumerate(scene.train.names):
        known = int(name.removesuffix(".png"))
        assert same_cameras(scene.train.cameras[i], views.cameras[known], 1e-9)
        assert torch.equal(scene.train.masks[i], views.masks[known])
        assert torch.equal(scene.train.images[i], views.images[known])
    assert scene.source["layout"] == "neus"


def test_faults_of_neus_files_are_named(views, tmp_path):
    folder = _write_neus(views, tmp_path / "s")
    good = (folder / "cameras_sphere.npz").read_bytes()
    arrays = dict(np.load(folder / "cameras_sphere.npz"))
    for change, words in (
        ({"world_mat_3": None}, "has world_mat_4, but no world_mat_3"),
        ({"world_mat_2": np.eye(3)}, "world_mat_2 is no 4 x 4"),
        ({"world_mat_1": np.zeros((4, 4))}, "no projection"),
        ({"world_mat_8": np.eye(4)}, "9 matrices, but image holds 8 photographs"),
    ):
        changed = {k: v for k, v in (arrays | change).items() if v is not None}
        np.savez(folder / "cameras_sphere.npz", **changed)
        with pytest.raises(SceneError, match=words):
            load(folder, views=7)
    for damaged in (good[: len(good) // 2], b"PK\3\4", b""):
        (folder / "cameras_sphere.npz").write_bytes(damaged)
        with pytest.raises(SceneError, match="no archive of NumPy arrays"):
            load(folder, views=7)


def test_a_matrix_comes_apart_into_what_it_was_made_of():
    draw = np.random.default_rng(0)
    for _ in range(50):
        K = np.array(
            [[draw.uniform(5, 900), 0, draw.uniform(-50, 900)], [0, draw.uniform(5, 900), 30], [0, 0, 1]]
        )
        rotation = np.linalg.qr(draw.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        centre = draw.normal(size=3) * 10
        P = draw.choice([-3.0, 0.2]) * K @ np.concatenate([rotation, -rotation @ centre[:, None]], 1)
        found, pose = neus.decompose(P, "x", None)
        assert np.allclose(found, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        assert np.allclose(pose, np.concatenate([rotation.T, centre[:, None]], 1))


@pytest.mark.parametrize("name", ["meta_data.json", "cameras.xml", "bundle.out", "database.db"])
def test_other_programs_files_are_named_with_what_to_do(name, tmp_path):
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / name).write_text("{}")
    with pytest.raises(SceneError, match=f"likely cause: {name} is"):
        load(tmp_path)
