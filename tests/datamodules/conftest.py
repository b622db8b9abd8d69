import pytest

from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from tests.datamodules.layouts.prepared_writer import write_prepared


@pytest.fixture(scope="session")
def tiny():
    """The built-in scene, small: 4 training and 3 test views of 48 x 36."""
    return make_scene(SyntheticConfig(size=(48, 36), test_views=3))


@pytest.fixture
def folder(tiny, tmp_path):
    """The small scene on disk, text form."""
    return write_prepared(tiny, tmp_path / "scene")


@pytest.fixture
def binary_folder(tiny, tmp_path):
    return write_prepared(tiny, tmp_path / "scene", binary=True)
