"""Several COLMAP models in one folder: the one with most photographs is read, and the choice is said."""

import pytest

from datamodules import load
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts import layout_writers as w
from tests.datamodules.layouts.prepared_writer import write_model
from visdom_plugin.errors import SceneError


@pytest.fixture(scope="module")
def views():
    return make_scene(SyntheticConfig(size=(32, 24), train_views=10, test_views=0)).train


def _add_model(folder, views, where, *, binary=True):
    (folder / where).mkdir(parents=True)
    write_model(folder / where, w.colmap_rows(views), binary, "PINHOLE")


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("place", ["sparse", "colmap_sparse", "colmap/sparse"])
def test_the_model_with_most_photographs_is_read_and_said(binary, place, views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s", model=f"{place}/2")
    _add_model(folder, views.take([0, 1, 2]), f"{place}/0", binary=binary)
    _add_model(folder, views.take([4, 5]), f"{place}/10", binary=binary)
    scene = load(folder, views=4)
    assert len(scene.train) == 4
    said = f"{place}/2 with 10 photographs is read, not {place}/0 with 3, {place}/10 with 2"
    assert any(said in note for note in scene.notes)
    assert len(load(folder, views=2, colmap_model=f"{place}/0").train) == 2
    with pytest.raises(SceneError, match=f"no COLMAP model in {place}/7[\\s\\S]*one of {place}/0, {place}/2"):
        load(folder, views=4, colmap_model=f"{place}/7")


def test_of_equal_models_the_first_is_read(views, tmp_path):
    folder = w.write_colmap(views, tmp_path / "s")
    _add_model(folder, views, "sparse/1")
    assert any("sparse/0 with 10 photographs is read" in note for note in load(folder, views=4).notes)


def test_index_files_belong_to_the_first_model(views, tmp_path):
    folder = w.write_colmap(views.take(range(6)), tmp_path / "s")
    _add_model(folder, views, "sparse/1")
    (folder / "sparse_4.txt").write_text("0 1 2 3")
    (folder / "sparse_test.txt").write_text("4 5")
    scene = load(folder)
    assert scene.train.names == tuple(sorted(f"{name}.png" for name in views.names[:6])[:4])
    assert any("sparse/0 is read" in note and "not sparse/1" in note for note in scene.notes)


def test_instant_splats_folders_are_read(views, tmp_path):
    folder = w.write_colmap(views.take(range(6)), tmp_path / "s", model="sparse_6/0")
    assert len(load(folder, views=4).train) == 4
    _add_model(folder, views.take([0, 1, 2]), "sparse_3/0", binary=False)
    scene = load(folder, views=4)
    assert any("sparse_6/0 with 6 photographs is read, not sparse_3/0 with 3" in note for note in scene.notes)
    assert len(load(folder, views=2, colmap_model="sparse_3/0").train) == 2
