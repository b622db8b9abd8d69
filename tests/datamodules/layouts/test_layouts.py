"""The same scene, written in each layout by hand, is the same scene when it is read back."""

import json
import logging
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from datamodules.built_in import DEFAULT
from datamodules.layouts import actorshq
from datamodules.recognise import FORMATS, recognise
from datamodules.synthetic.catalogue import find_object
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import _draw, make_scene
from tests.datamodules.files.test_undistort import LENSES
from tests.datamodules.layouts import layout_writers as w
from tests.datamodules.layouts.prepared_writer import write
from visdom_plugin.errors import ConfigError, SceneError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.scene import Views

CONFIG = SyntheticConfig(size=(64, 48), train_views=7, test_views=2)


def _rendered(cameras: Cameras) -> Views:
    pictures = _draw(CONFIG, cameras, find_object(DEFAULT))
    names = tuple(f"v{i:02d}" for i in range(len(cameras)))
    return Views(cameras, tuple(p[0] for p in pictures), tuple(p[1] for p in pictures), names)


@pytest.fixture(scope="module")
def free():
    """Nine views, landscape and portrait, each with its own focal lengths and principal point."""
    cameras = w.join(*(getattr(make_scene(CONFIG), part) for part in ("train", "test"))).cameras
    K = cameras.intrinsics.clone()
    K[:, 1, 1] *= 1.07
    tall = torch.arange(9) % 3 == 1
    width, height = torch.where(tall, 48, 64), torch.where(tall, 64, 48)
    K[tall, 0, 2] -= 8
    K[tall, 1, 2] += 8
    return _rendered(Cameras(K, cameras.world_from_camera, width, height))


@pytest.fixture(scope="module")
def plain():
    """Nine views of one lens with square pixels and its axis in the middle: all that some layouts can say."""
    cameras = w.join(*(getattr(make_scene(CONFIG), part) for part in ("train", "test"))).cameras
    K = torch.tensor([[70.0, 0, 32], [0, 70, 24], [0, 0, 1]], dtype=torch.float64).expand(9, 3, 3)
    return _rendered(Cameras(K, cameras.world_from_camera, cameras.width, cameras.height))


def _part(views: Views, which) -> Views:
    pick = [i for i in range(len(views)) if which(i)]
    kept = (tuple(column[i] for i in pick) for column in (views.images, views.masks, views.names))
    return Views(views.cameras[pick], *kept)


LAYOUTS = {
    # name: (format, scene, writer, path to open below the folder written)
    "colmap binary": ("colmap", "free", w.write_colmap, ""),
    "colmap text": ("colmap", "free", lambda v, f: w.write_colmap(v, f, binary=False), ""),
    "colmap, model in sparse": ("colmap", "free", lambda v, f: w.write_colmap(v, f, model="sparse"), ""),
    "colmap, as nerfstudio": ("colmap", "free", lambda v, f: w.write_colmap(v, f, model="colmap/sparse/0"), ""),
    "mip360": ("mip360", "free", w.write_mip360, ""),
    "nerfstudio": ("nerfstudio", "free", w.write_nerfstudio, ""),
    "nerfstudio, alpha": ("nerfstudio", "free", lambda v, f: w.write_nerfstudio(v, f, alpha=True), ""),
    "instant-ngp": ("nerfstudio", "free", w.write_instant_ngp, ""),
    "blender": (
        "blender",
        "plain",
        lambda v, f: w.write_blender(
            {"test": _part(v, lambda i: i % 8 == 0), "train": _part(v, lambda i: i % 8)}, f
        ),
        "",
    ),
    "omni3d render": ("omni3d", "plain", w.write_omni3d_render, ""),
    "omni3d render, folder": ("omni3d", "plain", w.write_omni3d_render, "render"),
    "omni3d video": ("omni3d", "free", w.write_omni3d_video, ""),
    "omni3d video, llff": ("omni3d", "plain", lambda v, f: w.write_omni3d_video(v, f, poses="llff"), "standard"),
    "llff": ("llff", "plain", w.write_llff, ""),
    "actorshq": ("actorshq", "free", w.write_actorshq, ""),
    "actorshq, scale folder": ("actorshq", "free", w.write_actorshq, "1x"),
}  # fmt: skip


def _by_name(views: Views) -> dict[str, int]:
    """Positions by the original name, whatever the layout made of it."""
    return {name.rpartition("/")[2].removesuffix(".png"): i for i, name in enumerate(views.names)}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_gives_the_same_views_and_hull(name, free, plain, tmp_path):
    form, which, writer, below = LAYOUTS[name]
    views = free if which == "free" else plain
    path = writer(views, tmp_path / "thing_001") / below
    assert list(recognise(path)) == [form]
    lists = {} if form == "actorshq" else {"views": 7}
    if form == "actorshq":
        lists = {"train_list": ",".join(map(str, range(1, 8))), "test_list": "Cam001,Cam009"}
    scene = load(path, **lists)
    assert (len(scene.train), len(scene.test)) == (7, 2)
    assert scene.name == ("1x" if below == "1x" else "thing_001") and scene.source["layout"] == form
    assert json.loads(json.dumps(scene.source)) == scene.source
    both = w.join(scene.train, scene.test)
    found = _by_name(both)
    if form == "actorshq":
        found = {f"v{int(key[3:]) - 1:02d}": i for key, i in found.items()}
    order = [found[n] for n in views.names]
    cameras = both.cameras[order]
    assert torch.allclose(cameras.world_from_camera, views.cameras.world_from_camera, rtol=0, atol=1e-6)
    assert torch.allclose(cameras.intrinsics, views.cameras.intrinsics, rtol=0, atol=1e-6)
    assert torch.equal(cameras.width, views.cameras.width)
    assert torch.equal(cameras.height, views.cameras.height)
    assert all(torch.equal(both.images[i], views.images[j]) for j, i in enumerate(order))
    assert all(torch.equal(both.masks[i], views.masks[j]) for j, i in enumerate(order))
    assert not both.ignore and not both.mask_origins
    box = ((0.2, -2.6, -0.5), (3.4, 0.8, 1.9))
    carve = VisibleDomain(resolution=64, bounds=box).carve
    mine = carve(both.cameras[order], [both.masks[i] for i in order])
    assert np.array_equal(mine.occupancy, carve(views.cameras, views.masks).occupancy) and mine.voxels > 100


def test_every_format_reads_what_its_name_says(free, plain, tmp_path):
    """Forced by name, also those that are never recognised."""
    video = w.write_omni3d_video(plain, tmp_path / "video")
    assert load(video, data_format="omni3d-llff").source["layout"] == "omni3d"
    ngp = w.write_instant_ngp(free, tmp_path / "ngp")
    assert len(load(ngp, data_format="instant-ngp").train) == 4
    mip = w.write_mip360(plain, tmp_path / "mip")
    names = {form: load(mip, data_format=form).source["layout"] for form in ("mip360", "colmap", "llff")}
    assert all(form == layout for form, layout in names.items())
    for form in FORMATS:
        if form not in names:
            with pytest.raises(SceneError):
                load(mip, data_format=form)
    with pytest.raises(ConfigError, match="unknown data format 'mip'"):
        load(mip, data_format="mip")


def test_two_readings_are_an_error_that_names_both(free, tmp_path):
    folder = w.write_colmap(free, tmp_path / "s")
    w.write_nerfstudio(free, folder)
    with pytest.raises(SceneError, match=r"nerfstudio.*colmap") as caught:
        load(folder)
    assert "--data-format nerfstudio or --data-format colmap" in caught.value.todo
    assert load(folder, data_format="colmap").source["layout"] == "colmap"
    assert load(folder, data_format="nerfstudio").source["layout"] == "nerfstudio"


def test_the_standard_split_and_even_spreading_are_said(free, tmp_path, caplog):
    folder = w.write_mip360(free, tmp_path / "s")
    with caplog.at_level(logging.INFO, "datamodules"):
        scene = load(folder, views=3)
    assert scene.test.names == ("v00.png", "v08.png")
    assert scene.train.names == ("v01.png", "v04.png", "v07.png")
    assert "spread evenly over the 7" in caplog.text and "v01.png, v04.png, v07.png" in caplog.text
    assert "every 8th" in scene.source["split"] and "every 8th" in " ".join(scene.notes)
    assert load(folder, views=3, test=False).train.names == scene.train.names
    assert load(folder, views=1).train.names == ("v01.png",)
    for views in (0, 8):
        with pytest.raises(SceneError, match="7 of the 9 views"):
            load(folder, views=views)
    assert len(load(folder, views=9).train) == 9


def test_lists_by_hand_are_positions_names_or_a_file(free, tmp_path):
    folder = w.write_mip360(free, tmp_path / "s")
    (tmp_path / "mine.txt").write_text("5\n3\n")
    names = [
        load(folder, train_list=text, test_list="0, 1").train.names
        for text in ("5,3", "v05,v03.png", str(tmp_path / "mine.txt"))
    ]
    assert names == [("v05.png", "v03.png")] * 3
    assert load(folder, train_list="0,8").test.names == ()
    for text, says in (
        ("9", "'9'"),
        ("v77", "v77"),
        ("3,3", "twice"),
        (",", "no views"),
        ("no.txt", "no.txt"),
    ):
        with pytest.raises(ConfigError, match=says):
            load(folder, train_list=text)
    with pytest.raises(SceneError, match="share views 1"):
        load(folder, train_list="1,2", test_list="1")


def test_index_files_are_followed_in_any_layout(free, tmp_path):
    folder = w.write_nerfstudio(free, tmp_path / "s")
    (folder / "sparse_2.txt").write_text("8 0")
    scene = load(folder, views=2)
    assert (
        scene.train.names == ("images/v08.png", "images/v00.png") and "sparse_2.txt" in scene.source["hashes"]
    )
    assert not set(scene.test.names) & set(scene.train.names)
    assert len(load(folder, views=3).train) == 3


def test_the_files_own_lists_are_followed(free, tmp_path):
    folder = w.write_nerfstudio(free, tmp_path / "s")
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    listed = {
        "train_filenames": [f"images/v0{i}.png" for i in (1, 2, 5)],
        "test_filenames": ["./images/v03.png"],
    }
    path.write_text(json.dumps(content | listed))
    scene = load(folder, views=2)
    assert scene.train.names == ("images/v01.png", "images/v05.png")
    assert scene.test.names == ("images/v03.png",)


@pytest.mark.parametrize(
    "keys", [("fl_x",), ("camera_angle_x",), ("x_fov",), ("y_fov",), ("fl_y", "cx", "cy")]
)
def test_each_way_to_give_a_focal_length_means_the_same(keys, plain, tmp_path):
    folder = w.write_nerfstudio(plain, tmp_path / "s")
    values = {
        "fl_x": 70.0,
        "fl_y": 70.0,
        "cx": 32.0,
        "cy": 24.0,
        "camera_angle_x": w.angle(64, 70),
        "x_fov": np.degrees(w.angle(64, 70)),
        "y_fov": np.degrees(w.angle(48, 70)),
    }
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del frame[key]
    path.write_text(json.dumps(content | {key: values[key] for key in keys}))
    cameras = load(folder, views=7).train.cameras
    assert torch.allclose(cameras.intrinsics, plain.cameras.intrinsics[:7], rtol=0, atol=1e-9)


def test_actorshq_takes_the_folder_of_the_scale_and_shrinks_the_rest(free, tmp_path):
    folder = w.write_actorshq(free, tmp_path / "s", scales=(1, 2, 4))
    whole = load(folder, train_list="1,2")
    for downscale, scale in ((1, 1), (2, 2), (3, 2), (4, 4), (8, 4)):
        scene = load(folder, train_list="1,2", downscale=downscale)
        assert scene.source["scale"] == scale and scene.units == "metres"
        assert scene.source["frame_number"] == 15 and scene.source["aabb"] == [[-1, -2, -3], [1, 2, 3]]
        for i in range(2):
            size = whole.train.cameras.width[i], whole.train.cameras.height[i]
            small = scene.train.cameras
            assert (int(small.width[i]), int(small.height[i])) == tuple(
                round(int(s) / downscale) for s in size
            )
            fractions = [c.intrinsics[i, 0, 2] / c.width[i] for c in (small, whole.train.cameras)]
            assert abs(fractions[0] - fractions[1]) < 1e-9
    with pytest.raises(SceneError, match="no frame 3"):
        load(folder, frame=3)
    (folder / "1x/calibration.csv").unlink()
    with pytest.raises(SceneError, match="--downscale 2"):
        load(folder)


def test_actorshq_holds_out_30_of_160_and_spreads_the_others():
    pools = actorshq.hold_out(range(160))
    assert len(pools.test) == 30 and len(pools.train) == 130 and not set(pools.test) & set(pools.train)
    gaps = np.diff(pools.test)
    assert gaps.min() >= 5 and gaps.max() <= 6
    assert len(actorshq.hold_out(range(16)).test) == 3 and not actorshq.hold_out(range(2)).test


def test_actorshq_cameras_without_a_photograph_are_left_out(free, tmp_path, caplog):
    folder = w.write_actorshq(free, tmp_path / "s")
    (folder / "1x/rgbs/Cam004/Cam004_rgb000015.jpg").unlink()
    scene = load(folder, views=6)
    assert "Cam004" not in (*scene.train.names, *scene.test.names)
    assert "1 of 9 cameras have no photograph" in caplog.text


def test_mask_path_is_pixels_to_ignore_unless_said_otherwise(free, tmp_path):
    folder = w.write_nerfstudio(free, tmp_path / "s", alpha=True)
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        i = free.names.index(frame["file_path"][7:10])
        frame["mask_path"] = f"masks/{free.names[i]}.png"
        (folder / "masks").mkdir(exist_ok=True)
        w.write_mask(folder / frame["mask_path"], free, i)
    path.write_text(json.dumps(content))
    scene = load(folder, views=7)
    assert all(torch.equal(g, ~m) for g, m in zip(scene.train.ignore, free.masks[1:8], strict=False))
    assert any("mask_path means pixels to ignore" in note for note in scene.notes)
    other = load(folder, views=7, mask_path="foreground")
    assert not other.train.ignore and all(map(torch.equal, other.train.masks, scene.train.masks))


def test_dynamic_masks_and_the_folder_ignore_are_unknown_where_white(free, tmp_path):
    folder = w.write_instant_ngp(free, tmp_path / "s")
    spot = np.zeros((64, 48), np.uint8)
    spot[3:7, 5:9] = 255
    write(folder / "images/dynamic_mask_v01.png", spot)
    (folder / "ignore").mkdir()
    write(folder / "ignore/v02.png", spot.T)
    train = load(folder, views=7).train
    at = [name.rpartition("/")[2] for name in train.names]
    assert torch.equal(train.ignore[at.index("v01.png")], torch.from_numpy(spot > 0))
    assert torch.equal(train.ignore[at.index("v02.png")], torch.from_numpy(spot.T > 0))
    assert sum(g is not None for g in train.ignore) == 2
    half = load(folder, views=7, downscale=2).train
    assert half.ignore[at.index("v01.png")].sum() == 9


def test_mask_names_with_endings_and_suffixes(free, tmp_path):
    folder = w.write_mip360(free, tmp_path / "s")
    (folder / "masks/v01.png").rename(folder / "masks/v01.png.png")
    (folder / "masks/v02.png").rename(folder / "masks/v02_mask.png")
    scene = load(folder, views=7)
    assert all(map(torch.equal, scene.train.masks, free.masks[1:8]))


@pytest.mark.parametrize("model", LENSES)
def test_lens_models_are_undistorted_with_their_masks(model, free, tmp_path):
    """A distorted photograph of a scene, undistorted on opening, is the scene again."""
    bend = LENSES[model]
    folder = w.write_colmap(free, tmp_path / "s", binary=False)
    lines = (folder / "sparse/0/cameras.txt").read_text().splitlines()
    changed = []
    for line in lines:
        fields = line.split()
        if fields[1] == "PINHOLE":
            params = [fields[4], *fields[6:8]] if len(bend) < 3 else fields[4:8]
            line = " ".join([fields[0], model, *fields[2:4], *params, *map(str, bend)])
        changed.append(line)
    (folder / "sparse/0/cameras.txt").write_text("\n".join(changed) + "\n")
    scene = load(folder, views=7)
    from datamodules.files.undistort import Distortion, undistort

    for i in range(1, 8):
        K = scene.train.cameras.intrinsics[i - 1].numpy()
        image, mask = free.images[i].numpy(), free.masks[i].numpy().astype(np.float32)
        twin = undistort(K, Distortion(model, tuple(map(float, bend))), image, mask)
        assert np.array_equal(scene.train.images[i - 1].numpy(), twin.image)
        assert np.array_equal(scene.train.masks[i - 1].numpy(), twin.mask > 0.5)
        assert (scene.train.ignored(i - 1) is None) == (twin.ignore is None)


def test_distortion_of_transforms_is_that_of_colmap(plain, tmp_path):
    bent = {"k1": -0.1, "k2": 0.02, "p1": 0.003, "p2": -0.002}
    folder = w.write_nerfstudio(plain, tmp_path / "n")
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | bent))
    model = w.write_colmap(plain, tmp_path / "c", binary=False)
    text = (model / "sparse/0/cameras.txt").read_text()
    lines = [
        line.replace("PINHOLE", "OPENCV") + " -0.1 0.02 0.003 -0.002" if "PINHOLE" in line else line
        for line in text.splitlines()
    ]
    (model / "sparse/0/cameras.txt").write_text("\n".join(lines) + "\n")
    one, two = load(folder, views=7), load(model, views=7)
    assert all(map(torch.equal, one.train.images, two.train.images))
    assert not torch.equal(one.train.images[0], plain.images[1])
    path.write_text(json.dumps(content | bent | {"k4": 0.1}))
    with pytest.raises(SceneError, match="k4"):
        load(folder)


def test_smaller_images_are_used_in_every_layout_that_has_them(free, tmp_path):
    folder = w.write_mip360(free, tmp_path / "s")
    for path in (folder / "images_2").iterdir():
        write(path, 0 * cv2.imread(str(path)) + 77)
    scene = load(folder, views=7, downscale=2)
    assert scene.source["images"] == "images_2"
    assert all((image == 77).all() for image in scene.train.images)
    assert torch.allclose(scene.train.cameras.intrinsics[:, 0], free.cameras.intrinsics[1:8, 0] / 2)


def test_views_take_their_masks_from_where_they_are_told(free, tmp_path):
    folder = w.write_nerfstudio(free, tmp_path / "s", alpha=True)
    (folder / "masks").mkdir()
    other = replace(free, masks=tuple(~m for m in free.masks))
    for i, name in enumerate(free.names):
        w.write_mask(folder / f"masks/{name}.png", other, i)
    with pytest.raises(SceneError, match="two masks that disagree"):
        load(folder)
    assert torch.equal(load(folder, views=7, mask_source="alpha").train.masks[0], free.masks[1])
    assert torch.equal(load(folder, views=7, mask_source="folder").train.masks[0], ~free.masks[1])


def test_views_without_a_mask_are_marked_when_that_is_allowed(free, tmp_path):
    folder = w.write_mip360(free, tmp_path / "s")
    (folder / "masks/v03.png").unlink()
    with pytest.raises(SceneError, match="v03"):
        load(folder, views=7)
    train = load(folder, views=7, allow_missing_masks=True).train
    assert [train.mask_origin(i) for i in range(7)] == ["given", "given", "missing", *["given"] * 4]
    assert train.masks[2].all()
