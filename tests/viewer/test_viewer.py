"""The viewer shows a scene and a run in a browser, and what is toggled there changes the picture."""

import signal
import socket
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules import load
from tests import browser
from tests.splat.twin import make_gaussians
from visdom_plugin.cli.commands import train, view
from visdom_plugin.cli.subject import PointCloud
from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.geometry.path_files import read_path
from visdom_plugin.hull.domain import VisibleDomain
from visdom_plugin.render import Render
from visdom_plugin.splat.rasterise import rasterise
from visdom_plugin.training.runs import checkpoints
from visdom_plugin.viewer.drawing import SIDE_BY_SIDE, UNDER_SLIDER, Look, draw
from visdom_plugin.viewer.serve import choose_port, describe_address
from visdom_plugin.viewer.shown import (
    Reconstruction,
    Subject,
    camera_from,
    nearest_view,
    pose_of,
    splat_arrays,
)


@pytest.fixture(scope="module")
def subject():
    scene = load(None, views=4, downscale=4)
    hull = VisibleDomain(resolution=48).carve(*scene.train.silhouettes())
    gaussians = replace(
        make_gaussians(n=60, dtype=torch.float32).detach(), log_scales=torch.full((60, 3), -2.5)
    )
    origin = torch.as_tensor(hull.centre)
    cloud = PointCloud(gaussians, origin, 0.01)
    run = Reconstruction(
        "cloud", cloud, torch.device("cpu"), lambda: (gaussians, origin), lambda: None, lambda: None
    )
    return Subject(scene, hull, (run,))


def test_a_camera_goes_to_the_browser_and_back(subject):
    camera = subject.scene.train.cameras[2].to(dtype=torch.float64)
    middle = np.array([5.0, -3, 2])
    pose = pose_of(camera, middle)
    fov = 2 * float(torch.atan(camera.height / 2 / camera.intrinsics[1, 1]))
    size = int(camera.width), int(camera.height)
    back = camera_from(pose["wxyz"], pose["position"], fov, size, middle)
    assert torch.allclose(back.world_from_camera, camera.world_from_camera, atol=1e-9)
    assert torch.allclose(back.intrinsics[1, 1], camera.intrinsics[1, 1])


def test_the_nearest_view_of_a_view_is_itself(subject):
    cameras = subject.scene.train.cameras
    middle = np.zeros(3)
    for i in range(len(cameras)):
        pose = pose_of(cameras[i], middle)
        assert nearest_view(cameras, camera_from(pose["wxyz"], pose["position"], 1.0, (32, 24), middle)) == i


def test_covariances_are_those_that_are_drawn():
    gaussians = make_gaussians(n=7, dtype=torch.float64).detach()
    arrays = splat_arrays(gaussians, np.array([1.0, 2, 3]))
    assert np.allclose(arrays["centers"], gaussians.means + torch.tensor([1.0, 2, 3]), atol=1e-5)
    values = np.linalg.eigvalsh(arrays["covariances"].astype(np.float64))
    wanted = np.sort((2 * gaussians.log_scales).exp().numpy(), axis=1)
    assert np.allclose(values, wanted, rtol=1e-3, atol=1e-7)


def test_a_port_in_use_is_refused_and_a_free_one_is_found():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"port {port} "):
            choose_port("127.0.0.1", port)
    assert choose_port("127.0.0.1", None) >= 8080
    assert describe_address("127.0.0.1", 8123)[0] == "http://localhost:8123"
    assert "ssh -L 8123:localhost:8123" in describe_address("127.0.0.1", 8123)[1]


def test_bad_input_gets_one_clear_line(tmp_path, capsys):
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        busy = str(taken.getsockname()[1])
        for words, said in (
            ([str(tmp_path / "nothing")], "there is no such"),
            ([str(tmp_path / "nothing")], "what to do: name a run directory"),
            ([str(tmp_path / "nothing")], "#no-scene"),
            ([str(tmp_path / "broken.ply")], "not a PLY point cloud"),
            (["--beside", str(tmp_path)], "two runs are compared"),
            (["--port", busy], f"port {busy}"),
        ):
            assert view.main(words) == 2
            assert said in capsys.readouterr().err


def test_without_viser_the_extra_is_named(subject, monkeypatch):
    import sys

    from visdom_plugin.viewer.app import Viewer

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(PluginError, match=r"(?s)viser.*visdom-plugin\[viewer\]"):
        Viewer(subject, "127.0.0.1", 0)


@pytest.mark.parametrize("words", [["builtin:duck"], ["builtin:duck", "--wait"]])
def test_the_viewer_refuses_before_it_waits_or_loads_and_so_does_training(words, monkeypatch, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    for module, name in ((view, "load_torch"), (view, "wait_for_state"), (train, "load_torch")):
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("too late"))
    assert view.main(words) == 2 and train.main(["method:ingp", "--view"]) == 2
    assert capsys.readouterr().err.count("viser, which is not installed") == 2


def test_ctrl_c_is_the_end_that_was_announced(subject, monkeypatch, capsys):
    pytest.importorskip("viser")
    from visdom_plugin.viewer.app import Viewer

    monkeypatch.setattr(view, "open_shown", lambda options: subject)
    monkeypatch.setattr(Viewer, "wait", lambda self: signal.raise_signal(signal.SIGINT))
    assert view.main([]) == 0
    assert capsys.readouterr().err.splitlines()[-1] == "Ctrl-C ends it"


def test_a_run_that_trains_is_followed(tmp_path):
    import threading

    folder = tmp_path / "run"
    loaded = []

    class Method:
        def load_state_dict(self, state):
            loaded.append(int(state["x"]))

    def begin():
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "run.json").write_text("{}")
        checkpoints.save(folder / "checkpoints", 10, {"x": torch.tensor(1)}, {})

    later = threading.Timer(0.3, begin)
    later.start()
    view.wait_for_state(folder, 0.02)
    later.join()
    refresh = view._follow(folder, Method())
    assert refresh() is None and not loaded
    checkpoints.save(folder / "checkpoints", 20, {"x": torch.tensor(2)}, {})
    assert refresh() == 20 and loaded == [2]
    assert refresh() is None
    checkpoints.save(folder / "checkpoints", 30, {"x": torch.tensor(3)}, {})
    (folder / "checkpoints" / "step-00000030.safetensors").write_bytes(b"torn")
    assert refresh() is None and loaded == [2]


def test_training_is_shown_by_a_viewer_of_its_own(fakes, monkeypatch):
    pytest.importorskip("viser")
    import subprocess

    calls = []

    class Process:
        def __init__(self, words):
            calls.append(words)

        def terminate(self):
            calls.append("terminated")

        def wait(self):
            calls.append("waited")

    real = subprocess.Popen

    def start(words, **others):
        return Process(words) if "visdom_plugin.cli.commands.view" in words else real(words, **others)

    monkeypatch.setattr(subprocess, "Popen", start)
    words = ["method:fake", "--view", "--quiet", "--no-report", "--out", "run", "--method.steps", "3"]
    assert train.main(words) == 0
    assert calls[0][1:] == ["-m", "visdom_plugin.cli.commands.view", "run", "--wait"]
    assert calls[1:] == ["terminated", "waited"]


@pytest.fixture
def viewer(subject):
    pytest.importorskip("viser")
    from visdom_plugin.viewer.app import Viewer

    made = Viewer(subject, "127.0.0.1", choose_port("127.0.0.1", None))
    yield made
    made.stop()


def test_the_rendered_picture_is_the_methods_own(viewer, subject):
    camera = subject.scene.train.cameras[0].to(dtype=torch.float64)
    width, height = int(camera.width), int(camera.height)
    # A browser looks through the middle of its window.
    K = camera.intrinsics.clone()
    K[:2, 2] = torch.tensor([width / 2, height / 2])
    K[0, 0] = K[1, 1]
    camera = replace(camera, intrinsics=K)
    pose = pose_of(camera, viewer.middle)

    class Browser:
        wxyz, position, aspect = pose["wxyz"], pose["position"], width / height
        fov = 2 * float(torch.atan(height / 2 / camera.intrinsics[1, 1]))

    drawn = viewer.draw(Browser, width)
    run = subject.runs[0].renderer
    wanted = rasterise(run.gaussians, camera.relative_to(run.origin), torch.ones(3), near=0.01).rgb
    assert (np.abs(drawn / 255 - wanted.clamp(0, 1).numpy()) < 0.02).mean() > 0.98
    viewer.controls["background"].value = "black"
    assert viewer.draw(Browser, width)[0, 0].max() == 0 and drawn[0, 0].min() == 255
    viewer.controls["error"].value = True
    assert viewer.draw(Browser, width).shape == drawn.shape


class View:
    """A browser's camera, looking as a training view does."""

    def __init__(self, camera, middle, aspect=1.6):
        pose = pose_of(camera, middle)
        self.wxyz, self.position, self.aspect = pose["wxyz"], pose["position"], aspect
        self.fov = 2 * float(torch.atan(camera.height / 2 / camera.intrinsics[1, 1]))


class Plain:
    """Draws a picture whose red is the column of each pixel from the middle, and whose blue is its own."""

    def __init__(self, blue):
        self.blue = blue

    def render(self, camera, background):
        width, height = int(camera.width), int(camera.height)
        ahead = (torch.arange(width) + 0.5 - camera.intrinsics[0, 2]) / camera.intrinsics[0, 0]
        rgb = torch.full((height, width, 3), self.blue)
        rgb[..., 0] = (ahead + 0.5).clamp(0, 1)
        return Render(rgb, torch.ones(height, width), torch.ones(height, width))


def test_two_runs_stand_side_by_side_at_the_same_scale(subject):
    runs = tuple(replace(subject.runs[0], renderer=Plain(blue)) for blue in (0.2, 0.8))
    both, middle = replace(subject, runs=runs), np.zeros(3)
    view = View(subject.scene.train.cameras[0], middle)
    alone, _ = draw(both, view, 200, middle, Look(1))
    pair, said = draw(both, view, 200, middle, Look(comparison=SIDE_BY_SIDE))
    assert pair.shape == alone.shape == (125, 200, 3) and said is None
    assert pair[0, 40, 2] == 51 and pair[0, 160, 2] == 204 and alone[0, 40, 2] == 204
    # Each shows the middle half of what one alone shows.
    assert np.allclose(pair[0, 5:95, 0], alone[0, 55:145, 0], atol=1)
    assert np.allclose(pair[0, 105:195, 0], alone[0, 55:145, 0], atol=1)
    slid, _ = draw(both, view, 200, middle, Look(comparison=UNDER_SLIDER, share=0.25))
    assert slid[0, 40, 2] == 51 and slid[0, 60, 2] == 204
    assert np.allclose(slid[0, 60:, 0], alone[0, 60:, 0], atol=1)


def test_the_error_is_as_large_as_fits_and_not_stretched(subject):
    camera = subject.scene.train.cameras[1]
    view = View(camera, np.zeros(3), aspect=3.0)
    picture, said = draw(subject, view, 300, np.zeros(3), Look(error=True))
    assert picture.shape == (100, 300, 3) and said == f"error against {subject.scene.train.names[1]}"
    width = round(100 * int(camera.width) / int(camera.height))
    beside = (300 - width) // 2
    assert (picture[:, : beside - 1] == 48).all() and (picture[:, beside + 2 : -beside - 2] != 48).any()


def test_a_path_of_views_is_saved_for_rendering(viewer, subject, tmp_path):
    path = viewer.path
    path.file = tmp_path / "way.json"
    path.save()
    assert "no views yet" in path.said.content and not path.file.exists()
    for i in (0, 1, 2):
        path.add(View(subject.scene.train.cameras[i], viewer.middle))
    path.remove()
    path.save()
    assert "--path" in path.said.content and "2 views" in path.said.content
    back, fps = read_path(path.file, subject.scene.train.cameras)
    wanted = subject.scene.train.cameras[:2]
    assert torch.allclose(back.world_from_camera, wanted.world_from_camera.double(), atol=1e-6) and fps == 30
    assert (int(back.width[0]), int(back.height[0])) == (1152, 720)


@browser.needed
@pytest.mark.slow
def test_toggles_change_what_the_browser_shows(viewer):
    def still(page):
        """The picture, once two in a row are the same."""
        before = page.picture()[:, :600]
        for _ in range(60):
            time.sleep(0.5)
            now = page.picture()[:, :600]
            if (now == before).all():
                return now
            before = now
        raise TimeoutError("the picture never comes to rest")

    with browser.Page() as page:
        page.size(900, 600)
        page.open(f"http://127.0.0.1:{viewer.server.get_port()}")
        page.until("document.querySelector('canvas')")
        page.until("document.body.innerText.includes('Shape inside')")
        time.sleep(2)
        seen = still(page)
        assert seen.std() > 1
        for name, value in (("hull", True), ("test", True), ("train", False), ("background", "black")):
            viewer.controls[name].value = value
            after = still(page)
            assert (after != seen).any(), name
            seen = after
        position = next(iter(viewer.server.get_clients().values())).camera.position.copy()
        viewer.controls["view"].value = viewer.subject.scene.train.names[1]
        still(page)
        moved = next(iter(viewer.server.get_clients().values())).camera.position
        wanted = viewer.subject.scene.train.cameras[1].centres.numpy() - viewer.middle
        assert np.allclose(moved, wanted, atol=0.05) and not np.allclose(position, wanted, atol=0.05)
        # The eye is in this view's frustum, which is not drawn, whatever is switched meanwhile.
        own = viewer.handles["train"]
        viewer.controls["train"].value = True
        still(page)
        assert [h.visible for h in own] == [True, False, True, True]
        viewer.controls["error"].value = True
        still(page)
        assert not any(h.visible for h in own)
        viewer.controls["error"].value = False
        still(page)
        assert [h.visible for h in own] == [True, False, True, True]
        # viser's quads of Gaussians have corners of two numbers, of which three.js wants a radius, in vain.
        assert [e for e in page.errors if "Computed radius is NaN" not in e] == []
