"""Cameras of every program, from files written by its documentation, against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from PIL import Image

from datamodules.files.undistort import Distortion
from tests.prepare.poses import exports
from tests.prepare.poses.exports import True_
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.prepare.photographs import find_photographs
from visdom_plugin.prepare.poses.find import place_by_file

SIZE, FOCAL = (640, 480), 520.0


class Taken(NamedTuple):
    folder: Path
    cameras: list[True_]


def pose(i: int) -> np.ndarray:
    import torch

    angle = 0.9 * i
    centre = torch.tensor([0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.2 + 0.05 * i], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return look_at_camera(centre, torch.tensor([0.01, 0.02 * i, 0.03], dtype=torch.float64), up).numpy()


@pytest.fixture(scope="module")
def taken(tmp_path_factory) -> Taken:
    folder = tmp_path_factory.mktemp("taken")
    cameras = []
    for i in range(5):
        name = f"{i}.jpg"
        Image.fromarray(np.full((*SIZE[::-1], 3), 40 * i, np.uint8)).save(folder / name)
        cameras.append(True_(name, pose(i), FOCAL, SIZE))
    return Taken(folder, cameras)


WRITERS = {
    "metashape": ("cameras.xml", exports.metashape),
    "realityscan-csv": ("cameras.csv", exports.realityscan_csv),
    "realityscan-xmp": ("xmp", exports.realityscan_xmp),
    "record3d": ("metadata.json", exports.record3d),
    "polycam": ("polycam", exports.polycam),
    "3d-scanner-app": ("scan", exports.scanner),
    "vggt": ("predictions.npz", exports.vggt),
    "vggt-padded": ("padded.npz", lambda path, cameras: exports.vggt(path, cameras, pad=True)),
    "pi3": ("pi3.npz", exports.pi3),
    "dust3r": ("dust3r.json", exports.dust3r),
    "transforms": ("transforms.json", exports.transforms),
    "colmap": ("sparse/0", exports.colmap),
}


@pytest.mark.parametrize("source", WRITERS)
def test_cameras_are_the_true_ones(source, taken, tmp_path):
    name, write = WRITERS[source]
    (tmp_path / name).parent.mkdir(exist_ok=True)
    write(tmp_path / name, taken.cameras)
    placed = place_by_file(tmp_path / name, find_photographs(taken.folder)[0])
    assert [p.name for p in placed.photographs] == [c.name for c in taken.cameras] and not placed.left_out
    found = placed.cameras.world_from_camera.numpy()
    moved = found
    for i, camera in enumerate(taken.cameras):
        np.testing.assert_allclose(moved[i], camera.pose, atol=2e-6)
        K = placed.cameras.intrinsics[i].numpy()
        centre = (3.5, -2.25) if source == "metashape" else (0.0, 0.0)
        expected = [[FOCAL, 0, SIZE[0] / 2 + centre[0]], [0, FOCAL, SIZE[1] / 2 + centre[1]], [0, 0, 1]]
        np.testing.assert_allclose(K, expected, atol=0.5 if source == "pi3" else 1e-3)
        assert (int(placed.cameras.width[i]), int(placed.cameras.height[i])) == SIZE


def test_metashapes_tangential_terms_stand_the_other_way_round(taken, tmp_path):
    exports.metashape(tmp_path / "c.xml", taken.cameras, radial=(0.1, -0.05), tangential=(0.003, -0.002))
    placed = place_by_file(tmp_path / "c.xml", find_photographs(taken.folder)[0])
    # Metashape's own formula, P1 first, against OpenCV's of the model that was read.
    x, y, k1, k2, p1, p2 = 0.3, -0.2, 0.1, -0.05, -0.002, 0.003
    r2 = x * x + y * y
    bend = 1 + k1 * r2 + k2 * r2 * r2
    there = (
        x * bend + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
        y * bend + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y,
    )
    bent = placed.distortions[0]
    assert isinstance(bent, Distortion) and bent.model == "OPENCV"
    zero = np.zeros(3)
    uv, _ = cv2.projectPoints(np.array([[x, y, 1.0]]), zero, zero, np.eye(3), np.array(bent.coefficients))
    np.testing.assert_allclose(uv.ravel(), there, atol=1e-9)


def test_photographs_that_phones_turn(taken, tmp_path):
    """A portrait photograph lies on its side in the file; poses are for the sensor, or for the picture upright."""
    from visdom_plugin.prepare.placed import turn_upright

    data = Image.fromarray(np.full((*SIZE[::-1], 3), 90, np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    folder = tmp_path / "photographs"
    folder.mkdir()
    for c in taken.cameras:
        data.save(folder / c.name, exif=exif)
    exports.transforms(tmp_path / "stored.json", taken.cameras)
    stored = place_by_file(tmp_path / "stored.json", find_photographs(folder)[0])
    upright = turn_upright(stored.cameras, [6] * len(taken.cameras))
    turned = [
        True_(c.name, upright.world_from_camera[i].numpy(), FOCAL, SIZE[::-1])
        for i, c in enumerate(taken.cameras)
    ]
    exports.transforms(tmp_path / "upright.json", turned)
    again = place_by_file(tmp_path / "upright.json", find_photographs(folder)[0])
    assert again.cameras.width.tolist() == [SIZE[1]] * 5 and stored.cameras.width.tolist() == [SIZE[0]] * 5
    # A point is at the same place of the picture, turned or not.
    import torch

    from visdom_plugin.geometry.cameras import project

    point = torch.tensor([[0.02, 0.01, 0.05]], dtype=torch.float64)
    (u, v), (x, y) = (project(c, point)[0][0, 0].tolist() for c in (stored.cameras, again.cameras))
    assert (x, y) == pytest.approx((SIZE[1] - v, u), abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cameras.xml", "<document><chunk><cameras/></chunk></document>", "no camera is aligned"),
        ("cameras.xml", "<document><chunk>", "not XML"),
        ("cameras.xml", '<!DOCTYPE x [<!ENTITY a "b">]><document/>', "defines entities"),
        ("cameras.xml", "<project/>", "of no format that is read"),
        ("cameras.csv", "#name,x,y,alt,heading\n", "no column"),
        ("poses.json", '{"cams2world": [[[1,0,0,0],[0,1,0,0],[0,0,1,0]]]}', "no focal length"),
        ("poses.json", '{"what": 1}', "of no format that is read"),
        ("predictions.npz", "no archive", "no archive of arrays"),
    ],
)
def test_files_that_cannot_be_read(name, content, said, taken, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(SceneError, match=said):
        place_by_file(tmp_path / name, find_photographs(taken.folder)[0])


def test_the_folder_above_a_colmap_model_will_do_where_it_holds_one(taken, tmp_path):
    photographs = find_photographs(taken.folder)[0]
    for name in ("sparse/0", "models/first"):
        (tmp_path / name).parent.mkdir()
        exports.colmap(tmp_path / name, taken.cameras)
        placed = place_by_file((tmp_path / name).parent, photographs)
        assert [p.name for p in placed.photographs] == [c.name for c in taken.cameras]
    exports.colmap(tmp_path / "sparse/1", taken.cameras)
    with pytest.raises(SceneError, match="2 COLMAP models") as caught:
        place_by_file(tmp_path / "sparse", photographs)
    assert f"--poses {tmp_path / 'sparse/0'}, --poses {tmp_path / 'sparse/1'}" in caught.value.todo


def test_a_square_copy_of_unknown_crop_is_refused(taken, tmp_path):
    exports.vggt(tmp_path / "p.npz", taken.cameras, pad=True)
    with np.load(tmp_path / "p.npz") as arrays:
        kept = {k: arrays[k] for k in ("extrinsic", "intrinsic")}
    np.savez(tmp_path / "p.npz", **kept, depth=np.zeros((5, 518, 518, 1), np.float32))
    with pytest.raises(SceneError, match="cropped or padded"):
        place_by_file(tmp_path / "p.npz", find_photographs(taken.folder)[0])


def test_cameras_of_other_photographs_are_refused(taken, tmp_path):
    exports.transforms(tmp_path / "t.json", [c._replace(name=f"other_{c.name}") for c in taken.cameras])
    with pytest.raises(SceneError, match=r"0 of 5 photographs have a camera.*0.jpg.*other_0.jpg"):
        place_by_file(tmp_path / "t.json", find_photographs(taken.folder)[0])


def test_a_number_of_cameras_without_names_must_fit(taken, tmp_path):
    exports.vggt(tmp_path / "p.npz", taken.cameras[:4])
    with pytest.raises(SceneError, match="4 cameras without names for 5 photographs"):
        place_by_file(tmp_path / "p.npz", find_photographs(taken.folder)[0])


def test_photographs_without_a_camera_are_named(taken, tmp_path):
    exports.record3d(tmp_path / "metadata.json", taken.cameras[:3])
    placed = place_by_file(tmp_path / "metadata.json", find_photographs(taken.folder)[0])
    assert list(placed.left_out) == ["3.jpg", "4.jpg"] and len(placed.photographs) == 3
