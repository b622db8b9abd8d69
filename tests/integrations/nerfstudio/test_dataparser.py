"""The data parser inside the real nerfstudio."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: see scripts/nerfstudio_env.sh")


from visdom_plugin.geometry.cameras import rays_of
from visdom_plugin.integrations.nerfstudio.dataparser import METADATA, VisdomDataParserConfig

from .host import pixel_rays


def test_nerfstudios_own_inverse_gives_the_poses_back(train):
    """`transform_poses_to_original_space` is what its exporters and renderers trust."""
    views = train.metadata[METADATA].views
    back = train.transform_poses_to_original_space(train.cameras.camera_to_worlds, "opengl")
    world = views.cameras.world_from_camera[:, :3] * torch.tensor([1.0, -1, -1, 1]).double()
    assert torch.allclose(back.double(), world, atol=1e-5)


def test_nerfstudios_rays_are_ours(train):
    known = train.metadata[METADATA]
    for i in range(len(known.views)):
        bundle, ours = pixel_rays(train, i), rays_of(known.views.cameras[i])
        assert torch.allclose(
            known.frame.points_to_world(bundle.origins), ours.origins.reshape(-1, 3), atol=1e-5
        )
        turned = known.frame.directions_to_world(bundle.directions)
        assert torch.allclose(turned, ours.directions.reshape(-1, 3), atol=1e-5)


def test_test_views_reach_neither_training_nor_the_frame(folder, parser, train, tmp_path):
    blind = shutil.copytree(folder, tmp_path / "blind")
    for path in [*blind.glob("images/*"), *blind.glob("masks/*")]:
        if path.stem not in {Path(name).stem for name in train.metadata[METADATA].views.names}:
            path.unlink()
    config = VisdomDataParserConfig(data=blind, cache=tmp_path / "cache")
    again = config.setup().get_dataparser_outputs("train")
    with pytest.raises(SystemExit):
        config.setup().get_dataparser_outputs("test")
    assert torch.equal(again.cameras.camera_to_worlds, train.cameras.camera_to_worlds)
    test = parser.get_dataparser_outputs("test")
    assert METADATA not in test.metadata and METADATA in train.metadata
    assert torch.equal(test.dataparser_transform, train.dataparser_transform)
    assert test.dataparser_scale == train.dataparser_scale
    assert set(test.image_filenames).isdisjoint(train.image_filenames)


def test_bare_methods_see_white_outside_the_masks(folder, tmp_path):
    from nerfstudio.data.datasets.base_dataset import InputDataset

    outputs = VisdomDataParserConfig(data=folder, cache=tmp_path).setup().get_dataparser_outputs("train")
    dataset, views = InputDataset(outputs), outputs.metadata[METADATA].views
    for i in range(len(views)):
        image = dataset.get_image_float32(i)
        expected = torch.where(views.masks[i][..., None], views.images[i].float() / 255, 1.0)
        assert torch.allclose(image, expected)


def test_a_users_mistake_ends_with_status_2(tmp_path, capsys):
    parser = VisdomDataParserConfig(data=tmp_path / "nothing").setup()
    with pytest.raises(SystemExit) as stop:
        parser.get_dataparser_outputs("train")
    assert stop.value.code == 2 and "no such folder" in capsys.readouterr().err
