"""Published splits: what is shipped agrees with what is known of it, and a scene that does not fit is refused."""

from pathlib import Path

import pytest

import datamodules
from datamodules.request import Request
from datamodules.views.named_splits import choose_named, list_names, load_rows
from tests.datamodules.layouts.layout_writers import write_actorshq
from visdom_plugin.errors import ConfigError, SceneError


def _names(count):
    return [f"IMG_{i:04d}" for i in range(count)]


@pytest.mark.parametrize("row", load_rows("visdom"), ids=lambda row: f"{row.scene} {row.views}")
def test_every_row_has_its_number_of_views_and_shares_none_with_the_test(row):
    assert len(row.train) == row.views == len(set(row.train))
    assert not set(row.train) & set(row.test) and len(set(row.test)) == len(row.test)
    held_out = {"actorshq": 30, "omni3d": 23}.get(row.dataset)
    if row.dataset == "mip360":
        assert row.test == tuple(range(0, 8 * len(row.test), 8))
    else:
        assert len(row.test) == held_out


def test_the_split_holds_the_papers_scenes_and_numbers_of_views():
    found = {}
    for row in load_rows("visdom"):
        found.setdefault(row.dataset, {}).setdefault(row.scene, []).append(row.views)
    assert {d: len(scenes) for d, scenes in found.items()} == {"mip360": 3, "omni3d": 17, "actorshq": 8}
    for dataset, scenes in found.items():
        assert set(map(tuple, scenes.values())) == {(5, 8, 12) if dataset == "actorshq" else (4, 6, 9)}


def test_positions_are_those_of_the_sorted_list(tmp_path):
    root = tmp_path / "bonsai"
    split = choose_named(root, _names(292), Request(views=4, split="visdom"))
    assert split.train == [22, 151, 225, 282] and split.test == list(range(0, 292, 8))
    assert split.rule == "split visdom of bonsai at 4 views"
    assert choose_named(root, _names(292), Request(split="visdom", test=False)).test == []


def test_the_scene_may_be_named_and_is_found_above_the_folder(tmp_path):
    by_name = choose_named(tmp_path, _names(292), Request(views=9, split="visdom:bonsai"))
    below = choose_named(tmp_path / "bonsai/v2", _names(292), Request(views=9, split="visdom"))
    assert by_name.train == below.train


@pytest.mark.parametrize(
    ("request_", "folder", "count", "words"),
    [
        (Request(views=4, split="visdum"), "bonsai", 292, "there is no split 'visdum'"),
        (Request(views=4, split="visdom"), "my_scene", 292, "has no scene 'my_scene'"),
        (Request(views=4, split="visdom:bonzai"), "bonsai", 292, "has no scene 'bonzai'"),
        (Request(views=5, split="visdom"), "bonsai", 292, "no 5 training views of bonsai"),
        (Request(views=4, split="visdom", train_list="1,2"), "bonsai", 292, "a list of views are given"),
        (Request(views=4, split="visdom"), "bonsai", 250, "250 photographs are registered"),
        (Request(views=4, split="visdom"), "bonsai", 310, "310 photographs are registered"),
        (Request(views=4, split="visdom"), "backpack_016", 150, "150 photographs are registered"),
        (Request(views=5, split="visdom"), "Actor01", 160, "cameras .*Cam"),
    ],
)
def test_what_does_not_fit_is_refused(request_, folder, count, words, tmp_path):
    with pytest.raises((ConfigError, SceneError), match=words):
        choose_named(tmp_path / folder, _names(count), request_)


def test_an_actor_is_read_at_the_splits_frame_by_the_names_of_its_cameras(tiny, tmp_path):
    """A copy of a sequence whose table lacks cameras, and has the others in another order, still fits."""
    row = next(r for r in load_rows("visdom") if r.scene == "Actor01" and r.views == 5)
    numbers = [i + 1 for i in (*row.test[::-1], *row.train[::-1])]
    views = tiny.train.take([i % 4 for i in range(len(numbers))])
    for frame in (3, 12):
        folder = write_actorshq(views, tmp_path / "Actor01/Sequence1", frame=frame, rig=numbers)
    scene = datamodules.load(folder, views=5, split="visdom")
    assert scene.train.names == tuple(f"Cam{i + 1:03d}" for i in row.train)
    assert scene.test.names == tuple(f"Cam{i + 1:03d}" for i in row.test)
    assert scene.source["frame_number"] == 12
    assert datamodules.load(folder, views=5, split="visdom", frame=3).source["frame_number"] == 3
    assert datamodules.load(folder, views=5).source["frame_number"] == 3


def test_every_split_that_is_listed_is_read():
    assert list_names() == ["visdom"] and all(Path(r.scene).name == r.scene for r in load_rows("visdom"))


@pytest.mark.parametrize("scene", ["gloves_009", "timer_010"])
def test_objects_whose_size_stands_in_the_releases_name_are_found_without_it(scene, tmp_path):
    one, other = (
        choose_named(tmp_path / folder, _names(200), Request(views=4, split="visdom"))
        for folder in (scene, f"{scene}_1080")
    )
    assert one == other


def test_the_built_in_scene_has_no_published_split():
    with pytest.raises(ConfigError, match="built-in scene is drawn, not read from files"):
        datamodules.load(None, views=4, split="visdom")
