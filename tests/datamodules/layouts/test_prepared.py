"""The prepared layout gives back what was written, at every size and in both forms."""

import hashlib
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from tests.datamodules.layouts.prepared_writer import same_cameras, write, write_prepared
from visdom_plugin.geometry.cameras import project


@pytest.mark.parametrize("binary", [False, True])
def test_a_written_scene_comes_back(tiny, tmp_path, binary):
    scene = load(write_prepared(tiny, tmp_path / "s", binary=binary))
    for back, views in ((scene.train, tiny.train), (scene.test, tiny.test)):
        assert list(back.names) == [f"{name}.png" for name in views.names]
        assert same_cameras(back.cameras, views.cameras, 1e-12)
        assert back.cameras.intrinsics.dtype == torch.float64
        assert all(map(torch.equal, back.images, views.images))
        assert all(map(torch.equal, back.masks, views.masks))
        assert back.mono_depths == ()


def test_text_and_binary_agree_exactly(tiny, tmp_path):
    text, binary = (load(write_prepared(tiny, tmp_path / str(b), binary=b)) for b in (False, True))
    assert same_cameras(text.train.cameras, binary.train.cameras)
    assert text.source["hashes"] == binary.source["hashes"]


def test_binary_is_preferred_where_both_exist(tiny, folder, tmp_path):
    other = write_prepared(tiny, tmp_path / "other", binary=True)
    for name in ("cameras.bin", "images.bin"):
        (folder / "sparse/0" / name).write_bytes((other / "sparse/0" / name).read_bytes())
    (folder / "sparse/0/images.txt").write_text("not a model")
    assert same_cameras(load(folder).train.cameras, load(other).train.cameras)


def test_simple_pinhole_has_one_focal_length(tiny, tmp_path):
    scene = load(write_prepared(tiny, tmp_path / "s", simple=True))
    assert same_cameras(scene.train.cameras, tiny.train.cameras, 1e-12)


@pytest.mark.parametrize("factor", [2.0, 1.5, 3.7])
def test_downscaling_averages_areas_and_moves_the_cameras_along(tiny, folder, factor):
    scene = load(folder, downscale=factor)
    width, height = round(48 / factor), round(36 / factor)
    assert scene.train.images[0].shape == (height, width, 3)
    points = tiny.mesh[0][::50]
    before, _ = project(tiny.train.cameras, points)
    after, _ = project(scene.train.cameras, points)
    ratio = torch.tensor([width / 48, height / 36], dtype=torch.float64)
    assert torch.allclose(after, before * ratio, atol=1e-9)
    if factor == 2.0:
        image = tiny.train.images[1].double().reshape(18, 2, 24, 2, 3).mean((1, 3))
        assert (scene.train.images[1].double() - image).abs().max() <= 0.5
        mask = tiny.train.masks[1].double().reshape(18, 2, 24, 2).mean((1, 3)) > 0.5
        assert torch.equal(scene.train.masks[1], mask)


def test_ready_made_smaller_images_are_used_as_they_are(tiny, folder):
    (folder / "images_2").mkdir()
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path))
        write(folder / "images_2" / path.name, 255 - image[::2, ::2])
    scene = load(folder, downscale=2)
    assert torch.equal(scene.train.images[0], 255 - tiny.train.images[0][::2, ::2])
    assert scene.source["images"] == "images_2"
    assert scene.train.masks[0].shape == (18, 24)
    assert int(scene.train.cameras.width[0]) == 24
    assert load(folder, downscale=3).source["images"] == "images"


def test_smaller_images_of_odd_sizes_keep_the_intrinsics_consistent(tiny, folder):
    # 48 / 5 = 9.6 and 36 / 5 = 7.2: some tools round down.
    (folder / "images_5").mkdir()
    for path in (folder / "images").iterdir():
        write(folder / "images_5" / path.name, cv2.resize(cv2.imread(str(path)), (9, 7)))
    cameras = load(folder, downscale=5).train.cameras
    assert torch.allclose(cameras.intrinsics[:, 0], tiny.train.cameras.intrinsics[:, 0] * 9 / 48)
    assert torch.allclose(cameras.intrinsics[:, 1], tiny.train.cameras.intrinsics[:, 1] * 7 / 36)


def _as_mask(mask: np.ndarray, kind: str) -> np.ndarray:
    grey = mask.astype(np.uint8) * 255
    full = np.full_like(grey, 255)
    return {
        "L": grey,
        "soft": np.where(mask, 128, 127).astype(np.uint8),
        "16 bit": np.where(mask, 32768, 32767).astype(np.uint16),
        "RGB": np.stack([grey] * 3, -1),
        "one colour": np.stack([grey * 0, grey * 0, grey], -1),
        "RGBA, opaque": np.stack([grey, grey, grey, full], -1),
        "RGBA, cut out": np.stack([full // 7, full // 9, full // 3, grey], -1),
        "RGBA 16 bit": np.stack([grey.astype(np.uint16) * 257] * 3 + [full.astype(np.uint16) * 257], -1),
    }[kind]


@pytest.mark.parametrize(
    "kind", ["L", "soft", "16 bit", "RGB", "one colour", "RGBA, opaque", "RGBA, cut out", "RGBA 16 bit"]
)
def test_masks_of_any_kind_mean_the_same(tiny, folder, kind):
    for name, mask in zip(tiny.train.names, tiny.train.masks, strict=True):
        write(folder / "masks" / f"{name}.png", _as_mask(mask.numpy(), kind))
    assert all(map(torch.equal, load(folder).train.masks, tiny.train.masks))


def _png(width: int, height: int, depth: int, colour: int, rows: bytes) -> bytes:
    import struct
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("kind", ["1 bit", "LA opaque", "LA cut out"])
def test_masks_of_kinds_that_opencv_does_not_write(tiny, folder, kind):
    mask = tiny.train.masks[0].numpy()
    if kind == "1 bit":
        rows = b"".join(b"\0" + np.packbits(row).tobytes() for row in mask)
        data = _png(48, 36, 1, 0, rows)
    else:
        other = np.full_like(mask, 1)
        pair = (mask, other) if kind == "LA opaque" else (other, mask)
        pixels = np.stack(pair, -1).astype(np.uint8) * 255
        data = _png(48, 36, 8, 4, b"".join(b"\0" + row.tobytes() for row in pixels))
    (folder / "masks" / f"{tiny.train.names[0]}.png").write_bytes(data)
    assert torch.equal(load(folder).train.masks[0], tiny.train.masks[0])


def test_monocular_depth_is_read_for_the_views_that_have_it(tiny, folder):
    (folder / "zoe_depth").mkdir()
    depth = np.random.default_rng(0).integers(0, 65535, (36, 48)).astype(np.uint16)
    write(folder / "zoe_depth" / f"{tiny.train.names[1]}.png", depth)
    scene = load(folder)
    assert [d is None for d in scene.train.mono_depths] == [True, False, True, True]
    assert torch.equal(
        scene.train.mono_depths[1], torch.from_numpy(depth.astype(np.float32) / np.float32(1000))
    )
    half = load(folder, downscale=2).train.mono_depths[1]
    assert torch.equal(half, scene.train.mono_depths[1][1::2, 1::2])
    assert "mono_depths" in scene.source["hashes"]


def test_depth_beside_the_photographs_is_read_as_array_or_picture(tiny, folder):
    (folder / "depths").mkdir()
    names = list(tiny.train.names)
    depth = np.random.default_rng(0).random((36, 48)).astype(np.float32) + 1
    depth[0, 0] = np.nan
    np.save(folder / "depths" / f"{names[0]}.npy", depth)
    np.save(folder / "depths" / f"{names[1]}.npy", depth.astype(np.float64)[None])
    write(folder / "depths" / f"{names[2]}.png", (1000 * np.nan_to_num(depth)).astype(np.uint16))
    maps = load(folder).train.mono_depths
    assert torch.equal(maps[0], torch.from_numpy(np.nan_to_num(depth))) and torch.equal(maps[0], maps[1])
    torch.testing.assert_close(maps[2], maps[0], rtol=0, atol=1e-3)
    assert maps[3] is None
    assert torch.equal(load(folder, downscale=2).train.mono_depths[0], maps[0][1::2, 1::2])
    # A layout's own folder comes first.
    (folder / "zoe_depth").mkdir()
    write(folder / "zoe_depth" / f"{names[3]}.png", np.full((36, 48), 2000, np.uint16))
    assert [d is None for d in load(folder).train.mono_depths] == [True, True, True, False]


def test_views_default_to_the_smallest_list(tiny, folder):
    (folder / "sparse_3.txt").write_text("\n".join((folder / "sparse_4.txt").read_text().split()[1:]))
    assert list(load(folder).train.names) == [f"{n}.png" for n in tiny.train.names[1:]]
    assert len(load(folder, views=4).train) == 4


def test_only_the_wanted_views_are_touched(folder):
    (folder / "sparse_2.txt").write_text("".join((folder / "sparse_4.txt").read_text().splitlines(True)[:2]))
    unwanted = load(folder, views=4).train.names[2:]
    for name in unwanted:
        (folder / "images" / name).write_bytes(b"no picture")
        (folder / "masks" / name).unlink()
    assert len(load(folder, views=2).train) == 2


def test_without_test_views_their_files_are_not_touched(folder):
    for name in load(folder).test.names:
        (folder / "images" / name).unlink()
        (folder / "masks" / name).unlink()
    (folder / "sparse_test.txt").unlink()
    scene = load(folder, test=False)
    assert (len(scene.train), len(scene.test), len(scene.test.cameras)) == (4, 0, 0)


def test_exif_orientation_is_ignored_as_by_colmap(tiny, folder):
    name = f"{tiny.train.names[0]}.png"
    _, data = cv2.imencode(".jpg", tiny.train.images[0].numpy()[..., ::-1])
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    data = data.tobytes()
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    (folder / "images" / name).write_bytes(turned)
    assert load(folder).train.images[0].shape == (36, 48, 3)


def test_source_tells_other_data_apart_and_is_json(tiny, folder, tmp_path):
    first = load(folder).source
    assert json.loads(json.dumps(first)) == first
    assert str(tmp_path) not in json.dumps(first)
    assert (
        first["hashes"]["sparse_4.txt"] == hashlib.sha256((folder / "sparse_4.txt").read_bytes()).hexdigest()
    )
    assert load(folder).source == first
    path = folder / "images" / f"{tiny.train.names[3]}.png"
    image = cv2.imread(str(path))
    image[5, 7, 1] ^= 1
    write(path, image)
    changed = load(folder).source["hashes"]
    assert {k for k in changed if changed[k] != first["hashes"][k]} == {"images"}


def _scenes():
    root = os.environ.get("VISDOM_SCENES")
    return sorted(p for p in Path(root).iterdir() if p.is_dir()) if root else []


@pytest.mark.scenes
@pytest.mark.skipif(not os.environ.get("VISDOM_SCENES"), reason="VISDOM_SCENES does not name the real scenes")
@pytest.mark.parametrize("path", _scenes(), ids=lambda p: p.name)
def test_real_scenes_open_and_their_cameras_look_at_one_thing(path):
    from visdom_plugin.geometry.cameras import look_at_point

    whole = {n: load(path, views=n, downscale=4) for n in (4, 6, 9)}
    assert list(whole[9].train.names[:4]) == list(whole[6].train.names[:4]) == list(whole[4].train.names)
    scene = whole[4]
    assert not set(whole[9].train.names) & set(scene.test.names)
    uv, depth = project(scene.train.cameras, look_at_point(scene.train.cameras)[None])
    size = torch.stack([scene.train.cameras.width, scene.train.cameras.height], -1)
    assert (depth > 0).all()
    assert ((uv[:, 0] > 0) & (uv[:, 0] < size)).all()
    assert all(0.01 < m.float().mean() < 0.6 for m in (*scene.train.masks, *scene.test.masks))
