"""Only the photographs in use are decoded, and what is decoded later is what would have been decoded at once."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.files import images
from datamodules.views.reader import map_on_cores
from tests.datamodules.layouts.prepared_writer import write
from visdom_plugin.errors import SceneError
from visdom_plugin.training.runs.run_directory import hash_views


@pytest.fixture
def decoded(monkeypatch):
    """Names of the photographs decoded so far."""
    seen, lock, real = [], threading.Lock(), images.decode_photograph

    def decode(data, path):
        with lock:
            seen.append(path.name)
        return real(data, path)

    monkeypatch.setattr(images, "decode_photograph", decode)
    return seen


def test_opening_decodes_the_training_views_and_looking_decodes_once(tiny, folder, decoded):
    scene = load(folder)
    assert sorted(decoded) == [f"{name}.png" for name in tiny.train.names]
    one, other = hash_views(scene.test), hash_views(load(folder).test)
    assert one == other and not any(name.startswith("test") for name in decoded), "hashing decodes nothing"
    decoded.clear()
    for _ in range(2):
        assert torch.equal(scene.test.images[1], tiny.test.images[1])
        assert torch.equal(scene.test.masks[1], tiny.test.masks[1])
        assert torch.equal(scene.test.masks[-2], tiny.test.masks[1])
    assert decoded == ["test_001.png"]
    assert all(map(torch.equal, scene.test.images, tiny.test.images))
    assert len(scene.test.images[:]) == len(tiny.test) and sorted(set(decoded)) == sorted(decoded)


def test_later_views_equal_those_decoded_at_once(tiny, folder):
    """The test views, taken for training, are the same tensors."""
    (folder / "sparse_3.txt").write_text((folder / "sparse_test.txt").read_text())
    for factor in (1, 1.7):
        at_once = load(folder, views=3, downscale=factor, test=False).train
        later = load(folder, views=4, downscale=factor).test
        assert at_once.names == later.names
        assert torch.equal(at_once.cameras.intrinsics, later.cameras.intrinsics)
        assert all(map(torch.equal, at_once.images, later.images))
        assert all(map(torch.equal, at_once.masks, later.masks))


def test_the_hash_follows_the_files_and_what_is_made_of_them(tiny, folder):
    before = hash_views(load(folder).test)
    assert hash_views(load(folder, downscale=2).test) != before
    path = folder / "images/test_002.png"
    image = cv2.imread(str(path))
    write(path, image ^ 1)
    assert hash_views(load(folder).test) != before
    write(path, image)
    assert hash_views(load(folder).test) == before
    write(folder / "masks/test_000.png", np.full(tiny.test.masks[0].shape, 255, np.uint8))
    assert hash_views(load(folder).test) != before


def test_a_broken_test_view_is_found_before_training(folder, decoded):
    path = folder / "images/test_001.png"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(SceneError, match="stops before its end"):
        load(folder)
    assert not any(name.startswith("test") for name in decoded)


def test_the_first_error_in_order_is_told():
    def fail(i):
        raise ValueError(i)

    for _ in range(5):
        with pytest.raises(ValueError, match="3"):
            map_on_cores(fail, range(3, 40))
    assert map_on_cores(lambda i: i * i, range(5)) == [0, 1, 4, 9, 16]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the process's memory from /proc")
def test_memory_is_that_of_the_views_in_use(tiny, tmp_path):
    """50 test views of 4 megabytes each, of which two are looked at."""
    import subprocess
    import sys

    from tests.datamodules.layouts.prepared_writer import write_model

    for name in ("images", "masks", "sparse/0"):
        (tmp_path / name).mkdir(parents=True)
    size = 1160
    image = np.full((size, size, 3), 80, np.uint8)
    mask = np.zeros((size, size), np.uint8)
    mask[300:800, 300:800] = 255
    photograph = cv2.imencode(".jpg", image)[1].tobytes()
    shape = cv2.imencode(".png", mask)[1].tobytes()
    rows = []
    for i in range(54):
        (tmp_path / f"images/v{i:03d}.jpg").write_bytes(photograph)
        (tmp_path / f"masks/v{i:03d}.png").write_bytes(shape)
        rows.append((f"v{i:03d}.jpg", [1, 0, 0, 0, 0, 0, 3.0 + i], [900.0, 900.0, 580.0, 580.0], size, size))
    (tmp_path / "sparse_4.txt").write_text("0 1 2 3")
    (tmp_path / "sparse_test.txt").write_text(" ".join(map(str, range(4, 54))))
    write_model(tmp_path / "sparse/0", rows, True, "PINHOLE")
    program = (
        "import resource, sys, torch, cv2, datamodules\n"
        "from datamodules import load\n"
        "from visdom_plugin.training.runs.run_directory import hash_views\n"
        "load(sys.argv[1], views=4, test=False)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "scene = load(sys.argv[1], views=4)\n"
        "hash_views(scene.test), scene.test.images[7], scene.test.images[40]\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)\n"
    )
    run = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True)
    assert float(run.stdout) < 80, (run.stdout, run.stderr)
