"""Options that a scene cannot honour are refused, never passed over."""

import json

import pytest

from datamodules import load
from datamodules.fingerprint import take_fingerprint
from tests.datamodules.layouts import layout_writers as w
from visdom_plugin.cli.commands import check, hull, train
from visdom_plugin.errors import ConfigError

GIVEN = {
    "train_list": "0,1", "test_list": "2,", "split": "visdom", "frame": 3, "mask_source": "alpha",
    "masks": "mask", "colmap_model": "sparse/1", "invert_masks": True, "mask_path": "foreground",
    "allow_outside": True, "data_format": "colmap",
}  # fmt: skip


@pytest.mark.parametrize("name", GIVEN)
def test_the_built_in_scene_refuses_what_needs_files(name):
    with pytest.raises(ConfigError, match="built-in scene") as caught:
        load(None, **{name: GIVEN[name]})
    assert name.replace("_", "-") in caught.value.where


@pytest.mark.parametrize(
    "command", [check.main, hull.main, lambda words: train.main(["method:3dgs-go", *words])]
)
def test_commands_refuse_them_too(command, capsys):
    assert command(["--train-list", "0,1,2,3"]) == 2
    said = capsys.readouterr().err
    assert "--train-list" in said and "name a scene with --data, or leave it out" in said


@pytest.mark.parametrize(
    "writer, refused",
    [
        (w.write_colmap, ("frame", "mask_path")),
        (w.write_nerfstudio, ("frame", "colmap_model", "mask_path")),
        (w.write_actorshq, ("colmap_model", "mask_path", "masks")),
    ],
)
def test_layouts_refuse_what_they_do_not_read(writer, refused, tiny, tmp_path):
    folder = writer(tiny.train, tmp_path / "s")
    load(folder)
    for name in refused:
        for read in (load, take_fingerprint):
            with pytest.raises(ConfigError) as caught:
                read(folder, **{name: GIVEN[name]})
            assert name.replace("_", "-") in caught.value.where


def test_mask_path_is_honoured_where_the_data_has_it(tiny, tmp_path):
    folder = w.write_nerfstudio(tiny.train, tmp_path / "s")
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["mask_path"] = frame["file_path"].replace("images/", "masks/")
    (folder / "transforms.json").write_text(json.dumps(content))
    assert not load(folder, mask_path="foreground").train.mask_origins
    with pytest.raises(ConfigError, match="names each photograph's mask"):
        load(folder, mask_path="foreground", masks="masks2")


def test_masks_and_alpha_at_once_are_refused(folder):
    with pytest.raises(ConfigError, match="alpha channels"):
        load(folder, masks="masks", mask_source="alpha")
