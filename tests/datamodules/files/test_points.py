"""Points of structure from motion come with the scene, and cost nothing before they are asked for."""

import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.fingerprint import take_fingerprint
from tests.datamodules.layouts.prepared_writer import write_prepared
from tests.fuzz.fuzz_readers import write_points
from visdom_plugin.errors import SceneError

ROWS = [(i, 0.1 * i, -1.0 / i, 5e6 + i, 9 * i, 0, 255, 0.5, i % 4) for i in range(1, 9)]


@pytest.mark.parametrize("text", [True, False])
def test_points_are_those_of_the_file(tiny, tmp_path, text):
    folder = write_prepared(tiny, tmp_path / "scene", binary=not text)
    (folder / f"sparse/0/points3D.{'txt' if text else 'bin'}").write_bytes(write_points(ROWS, text))
    xyz, rgb = load(folder).points
    assert xyz.dtype == torch.float64 and xyz.tolist() == [list(row[1:4]) for row in ROWS]
    assert np.allclose(255 * rgb.numpy(), [row[4:7] for row in ROWS], atol=1e-4) and rgb.max() == 1


def test_a_damaged_file_of_points_is_told_when_it_is_asked_for(folder):
    (folder / "sparse/0/points3D.bin").write_bytes(write_points(ROWS, False)[:-3])
    scene = load(folder)
    with pytest.raises(SceneError, match=r"points3D\.bin"):
        _ = scene.points


def test_no_points_are_none(folder, tiny):
    assert load(folder).points is None and tiny.points is None
    (folder / "sparse/0/points3D.txt").write_text("# nothing\n")
    assert load(folder).points is None


def test_other_points_are_another_scene(folder):
    before = take_fingerprint(folder).digest
    (folder / "sparse/0/points3D.bin").write_bytes(write_points(ROWS, False))
    assert take_fingerprint(folder).digest != before
