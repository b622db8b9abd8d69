"""A data set that was exported is read back as the same capture, by each of its two sets of cameras."""

import json

import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.recognise import REPEATED_BY
from visdom_plugin.errors import SceneError
from visdom_plugin.export.dataset import write_dataset
from visdom_plugin.export.upright import upright
from visdom_plugin.hull.domain import VisibleDomain


@pytest.fixture(scope="module")
def scene():
    return load(None, views=4, downscale=4)


@pytest.fixture(scope="module")
def hull(scene):
    return VisibleDomain(resolution=48).carve(*scene.train.silhouettes())


@pytest.mark.parametrize("data_format", ["nerfstudio", "colmap"])
def test_cameras_pictures_and_masks_come_back(tmp_path, scene, hull, data_format):
    write_dataset(tmp_path / "d", scene, hull)
    folder = "images/" if data_format == "nerfstudio" else ""
    names = ",".join(f"{folder}{n}.png" for n in scene.train.names)
    back = load(tmp_path / "d", views=4, data_format=data_format, train_list=names + ",")
    stems = [n.removeprefix("images/").removesuffix(".png") for n in back.train.names]
    assert stems == [n.removesuffix(".png") for n in scene.train.names]
    for name in ("intrinsics", "world_from_camera"):
        ours, theirs = getattr(scene.train.cameras, name), getattr(back.train.cameras, name)
        assert torch.allclose(ours.double(), theirs.double(), atol=1e-6), name
    for i in range(4):
        mask = np.asarray(scene.train.masks[i])
        assert np.array_equal(np.asarray(back.train.masks[i]), mask)
        assert np.array_equal(np.asarray(back.train.images[i])[mask], np.asarray(scene.train.images[i])[mask])
    if data_format == "nerfstudio":  # its reader leaves the point cloud to nerfstudio
        return
    assert back.points is not None
    inside = hull.contains(back.points[0], margin_voxels=1)
    assert inside.all() and len(inside) == 20_000


def test_the_folder_has_one_reading(tmp_path, scene, hull):
    write_dataset(tmp_path / "d", scene, hull)
    back = load(tmp_path / "d", views=4)
    assert [n.removeprefix("images/").removesuffix(".png") for n in back.train.names] == list(
        scene.train.names
    )
    assert len(back.test) == len(scene.test)
    file = tmp_path / "d" / "transforms.json"
    file.write_text(json.dumps({k: v for k, v in json.loads(file.read_text()).items() if k != REPEATED_BY}))
    with pytest.raises(SceneError, match="in more than one way"):
        load(tmp_path / "d", views=4)


def test_moved_cameras_see_the_moved_hull(tmp_path, scene, hull):
    import trimesh

    centre = torch.as_tensor(hull.centre)
    write_dataset(tmp_path / "d", scene, hull, upright(scene.train.cameras, centre, "-y"))
    back = load(tmp_path / "d", views=4, data_format="nerfstudio")
    mesh = trimesh.load(tmp_path / "d" / "hull.ply", process=False)
    assert np.abs(np.asarray(mesh.vertices).mean(0)).max() < 0.2
    # y points down: every camera's own y axis does, too.
    assert (back.train.cameras.world_from_camera[:, 1, 1] > 0).all()
    distances = back.train.cameras.centres.norm(dim=-1).sort().values
    assert torch.all((distances - distances.mean()).abs() < 0.5 * distances.mean())
