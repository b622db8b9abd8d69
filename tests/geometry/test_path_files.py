"""Camera paths are read from files by hand, by us and by nerfstudio, and refused where they are unclear."""

import json
import math

import pytest
import torch

from tests.training import fake
from visdom_plugin.errors import SceneError
from visdom_plugin.geometry.camera_paths import framed, orbit, resample, widen
from visdom_plugin.geometry.cameras import project
from visdom_plugin.geometry.path_files import NERFSTUDIO, read_path, write_path
from visdom_plugin.geometry.rotations import matrix_from_quaternion


@pytest.fixture
def capture():
    return fake.tiny_views(4, 0, "v_").cameras.to(dtype=torch.float64)


def write(path, **content):
    path.write_text(json.dumps(content))
    return path


def test_what_is_written_is_read_back(capture, tmp_path):
    path = framed(orbit(capture, 5), 64, 32)
    write_path(tmp_path / "path.json", path, 12)
    back, fps = read_path(tmp_path / "path.json", capture)
    assert fps == 12 and back.width.tolist() == [64] * 5 and back.height.tolist() == [32] * 5
    assert torch.allclose(back.world_from_camera, path.world_from_camera, atol=1e-12)
    assert torch.allclose(back.intrinsics[:, 1, 1], path.intrinsics[:, 1, 1])


def test_a_hand_written_camera_looks_where_it_is_told(capture, tmp_path):
    file = write(
        tmp_path / "path.json",
        camera_path=[{"position": [3, 1, 2], "look_at": [0.5, 0, 0.25], "up": [0, 0, 1], "fov": 60}],
        render_width=200,
        render_height=100,
    )
    cameras, fps = read_path(file, capture)
    assert fps is None
    targets = torch.tensor([[0.5, 0, 0.25], [0.5, 0, 1.25]], dtype=torch.float64)
    uv, depth = project(cameras[0], targets)
    assert torch.allclose(uv[0], torch.tensor([100.0, 50.0], dtype=torch.float64)) and uv[1, 1] < 50
    assert depth[0] == pytest.approx(math.dist((3, 1, 2), (0.5, 0, 0.25)))
    assert float(cameras.intrinsics[0, 1, 1]) == pytest.approx(50 / math.tan(math.radians(30)))


def test_size_and_angle_are_the_captures_where_the_file_is_silent(capture, tmp_path):
    file = write(tmp_path / "path.json", camera_path=[{"position": [3, 1, 2], "look_at": [0, 0, 0]}])
    (camera,) = (read_path(file, capture).cameras[0],)
    assert camera.size == capture[0].size
    assert torch.allclose(camera.intrinsics[1, 1], capture.intrinsics[0, 1, 1])


def test_nerfstudios_frame_is_undone_by_its_own_file_alone(capture, tmp_path):
    turn = matrix_from_quaternion(torch.tensor([0.8, 0.2, -0.4, 0.4], dtype=torch.float64))
    shift, scale = torch.tensor([1.0, -2, 0.5], dtype=torch.float64), 0.3
    theirs = capture.world_from_camera.clone()
    theirs[:, :3, :3] = turn @ theirs[:, :3, :3]
    theirs[:, :3, 3] = scale * (capture.centres @ turn.mT + shift)
    flip = torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)
    entries = [{"camera_to_world": m.reshape(-1).tolist(), "fov": 50, "aspect": 1} for m in theirs * flip]
    content = {"keyframes": [], "camera_type": "perspective", "fps": 24, "camera_path": entries}
    file = write(tmp_path / "camera_path.json", **content)
    with pytest.raises(SceneError, match=f"(?s)nerfstudio's own frame.*{NERFSTUDIO}"):
        read_path(file, capture)
    transform = torch.cat([turn, shift[:, None]], 1).tolist()
    write(tmp_path / NERFSTUDIO, transform=transform, scale=scale)
    back, fps = read_path(file, capture)
    assert fps == 24 and torch.allclose(back.world_from_camera, capture.world_from_camera, atol=1e-9)
    # Where it was trained in the capture's frame, the file says so.
    back, _ = read_path(write(file, **content, frame="capture"), capture)
    assert torch.allclose(back.world_from_camera, theirs, atol=1e-9)


GOOD = {"position": [3, 1, 2], "look_at": [0, 0, 0]}
ROWS = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ([1, 2], "is a JSON object"),
        ({"frames": []}, "no list camera_path"),
        ({"camera_path": []}, "no list camera_path"),
        ({"camera_type": "fisheye", "camera_path": [GOOD]}, "'fisheye'"),
        ({"camera_path": [GOOD | {"fov": 190}]}, "fov is 190"),
        ({"camera_path": [GOOD, {"position": [1, 2, 3]}]}, r"(?s)needs camera_to_world.*camera_path\[1\]"),
        ({"camera_path": [GOOD | {"look_at": [3, 1, 2]}]}, "the same point"),
        ({"camera_path": [GOOD | {"position": [1, 2]}]}, "a list of 3 numbers"),
        ({"camera_path": [{"camera_to_world": ROWS[:12]}]}, "a list of 16 numbers"),
        ({"camera_path": [{"camera_to_world": [2 * x for x in ROWS]}]}, "not a rotation"),
        ({"camera_path": [GOOD], "render_width": 0}, "render_width is 0"),
        ({"camera_path": [3]}, "this is no camera"),
    ],
)
def test_what_is_no_path_is_one_clear_error(capture, tmp_path, content, says):
    (tmp_path / "path.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match=says) as error:
        read_path(tmp_path / "path.json", capture)
    assert str(tmp_path / "path.json") in str(error.value)
    (tmp_path / "path.json").write_text("{")
    with pytest.raises(SceneError, match="cannot be read"):
        read_path(tmp_path / "path.json", capture)


def test_a_resampled_path_passes_through_its_cameras(capture):
    fine = resample(capture, 3 * (len(capture) - 1) + 1, torch.zeros(3))
    assert torch.allclose(fine.world_from_camera[::3], capture.world_from_camera, atol=1e-9)


def test_another_size_keeps_the_view_from_top_to_bottom(capture):
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 0.1
    before, _ = project(capture, points)
    height, width = int(capture.height[0]), int(capture.width[0])
    alone = framed(capture, 3 * width, None)
    assert alone.height.tolist() == [3 * height] * len(capture)
    assert torch.allclose(project(alone, points)[0], 3 * before)
    assert torch.allclose(project(framed(capture, None, 3 * height), points)[0], 3 * before)
    both = framed(capture, 4 * width, 2 * height)
    centre = before.new_tensor([width, height]) / 2
    assert torch.allclose(
        project(both, points)[0], 2 * (before - centre) + 2 * centre * before.new_tensor([2, 1])
    )
    assert framed(capture, None, None) is capture


def test_a_wider_view_has_all_points_and_no_more_than_it_must(capture):
    circle = orbit(capture, 12, torch.zeros(3))
    points = torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)) * 0.6
    size = circle.width[0].double(), circle.height[0].double()
    wide = widen(circle, points)
    uv, _ = project(wide, points)
    inside = [(uv[..., a] / size[a] - 0.5).abs().max() for a in range(2)]
    assert max(inside) == pytest.approx(0.475, abs=1e-6)
    # What is in the picture anyway stays as large as it is.
    near = widen(circle, 0.001 * points)
    assert torch.equal(near.intrinsics[:, [0, 1], [0, 1]], circle.intrinsics[:, [0, 1], [0, 1]])
    assert torch.equal(near.intrinsics[:, :2, 2], torch.stack(size).expand(12, 2) / 2)
