"""The viewer: cameras, hull and reconstructions in a browser, with a rendered picture where the camera rests.

The browser draws Gaussians and meshes while the camera moves. Where it rests, the method itself renders, from
coarse to fine, as it would for an evaluation; nothing needs a GPU.
"""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from typing import Any

import numpy as np
import torch

from visdom_plugin.geometry.camera_paths import capture_up
from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.viewer.drawing import COMPARISONS, SIDE_BY_SIDE, UNDER_SLIDER, Look, draw
from visdom_plugin.viewer.path_controls import PathControls
from visdom_plugin.viewer.serve import require_viser
from visdom_plugin.viewer.shown import Subject, pose_of, splat_arrays

log = logging.getLogger(__name__)

WIDTHS = (120, 240, 480, 960)
"""Widths of the rendered picture, one after the other."""
_PATIENCE = 1.0
"""Seconds that a picture may have taken for the next one, of four times the pixels, to be drawn."""
_REST, _LOOK = 0.25, 2.0
"""Seconds for which the camera must be still, and between two looks for a newer state of a run."""
_AT = 0.03
"""How near the eye is to a camera whose frustum it is in, in mean camera distances."""
_BACKGROUNDS = {"white": 1.0, "grey": 0.5, "black": 0.0}
_COLOURS = {"train": (20, 110, 200), "test": (210, 110, 20)}
_PICTURE_PX = 160


class Viewer:
    """A server that shows a subject until `stop`.

    Args:
        subject: scene, hull and runs.
        host, port: where it listens.

    Raises:
        PluginError: viser is not installed.
    """

    def __init__(self, subject: Subject, host: str, port: int):
        require_viser()
        import viser

        self.subject = subject
        cameras = subject.scene.train.cameras
        centre = look_at_point(cameras).double().numpy() if subject.hull is None else subject.hull.centre
        self.middle = np.asarray(centre, np.float64)
        self.size = float((cameras.centres.double() - torch.as_tensor(self.middle)).norm(dim=-1).mean())
        # Standard output is for the address alone.
        with contextlib.redirect_stdout(io.StringIO()):
            self.server = viser.ViserServer(host=host, port=port, label="visdom-view", verbose=False)
        self.server.scene.set_up_direction(tuple(capture_up(cameras).double().tolist()))
        self.handles: dict[str, list[Any]] = {"train": [], "test": [], "hull": [], "inner": [], "runs": []}
        self.controls: dict[str, Any] = {}
        self.moved: dict[int, float] = {}
        self.drawn: dict[int, tuple[float, int]] = {}
        self._pictured: set[int] = set()
        self._at: Any = None
        self._done = threading.Event()
        self._lock = threading.RLock()
        self._add_controls()
        self._add_all_views()
        self._add_hull()
        self._add_runs()
        self.server.on_client_connect(self._welcome)
        self._worker = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._worker.start()

    def stop(self) -> None:
        """Ends the server."""
        self._done.set()
        self._worker.join(30)
        self.server.stop()

    def wait(self) -> None:
        """Returns when `stop` is called."""
        while not self._done.wait(0.5):
            pass

    def _add_controls(self) -> None:
        gui, controls, subject = self.server.gui, self.controls, self.subject
        gui.configure_theme(show_logo=False, show_share_button=False)
        # Beside the scene, not upon it: two runs side by side need the whole width. viser 1.0 has no such panel.
        if hasattr(gui, "main_panel"):
            gui.main_panel.dock_right()
        names = [*subject.scene.train.names, *subject.scene.test.names]
        controls["view"] = gui.add_dropdown("Go to view", ("-", *map(str, names)))
        controls["view"].on_update(self._go_to_view)
        with gui.add_folder("Cameras"):
            controls["train"] = gui.add_checkbox("Training views", True)
            controls["test"] = gui.add_checkbox("Test views", False, disabled=not len(subject.scene.test))
            controls["pictures"] = gui.add_dropdown("Pictures", ("photographs", "masks", "none"))
        with gui.add_folder("Hull"):
            controls["hull"] = gui.add_checkbox("Hull", not subject.runs, disabled=subject.hull is None)
            controls["opacity"] = gui.add_slider(
                "Opacity", 0.05, 1.0, 0.05, 0.4, disabled=subject.hull is None
            )
            inner = subject.hull is not None and subject.hull.inner is not None
            controls["inner"] = gui.add_checkbox("Shape inside", False, disabled=not inner)
        none = not subject.runs
        with gui.add_folder("Reconstruction"):
            controls["runs"] = gui.add_checkbox("Gaussians or mesh", not none, disabled=none)
            controls["crop"] = gui.add_checkbox("Crop by hull", False, disabled=none or subject.hull is None)
            controls["render"] = gui.add_checkbox("Render at rest", not none, disabled=none)
            controls["background"] = gui.add_dropdown("Background", tuple(_BACKGROUNDS))
            controls["error"] = gui.add_checkbox("Error, nearest photo", False, disabled=none)
            labels = tuple(run.label for run in subject.runs)
            if len(labels) > 1:
                controls["compare"] = gui.add_dropdown("Compare", COMPARISONS)
                controls["split"] = gui.add_slider("Left run's share", 0, 100, 1, 50, visible=False)
                controls["run"] = gui.add_dropdown("Run", labels, visible=False)
                controls["sides"] = gui.add_markdown(f"left **{labels[0]}**, right **{labels[1]}**")
            controls["state"] = gui.add_markdown("")
        self.path = PathControls(gui, subject.path_file, self.middle, subject.path)
        for name in ("train", "test", "hull", "inner"):
            controls[name].on_update(lambda _, name=name: self._show(name))
        controls["runs"].on_update(lambda _: self._again())
        controls["pictures"].on_update(lambda _: self._add_all_views())
        controls["opacity"].on_update(lambda _: self._add_hull())
        controls["crop"].on_update(lambda _: self._add_runs())
        for name in ("render", "background", "split"):
            if name in controls:
                controls[name].on_update(lambda _: self._again())
        for name in ("error", "compare"):
            if name in controls:
                controls[name].on_update(lambda _: self._change_look())
        if "run" in controls:
            controls["run"].on_update(lambda _: self._add_runs())

    def _change_look(self) -> None:
        """Shows the controls that the comparison has, and hides what does not lie upon the picture."""
        if "compare" in self.controls:
            comparison = self.look.comparison
            self.controls["split"].visible = comparison == UNDER_SLIDER
            self.controls["run"].visible = comparison == COMPARISONS[-1]
            self.controls["sides"].visible = comparison != COMPARISONS[-1]
        self.controls["state"].content = ""
        for name in ("train", "test", "hull", "inner"):
            self._show(name)
        self._again()

    def _show(self, name: str) -> None:
        for handle in self.handles[name]:
            # From where a photograph was taken, its own picture would stand before the eye.
            handle.visible = self.controls[name].value and not self._covered and handle is not self._at

    def _clear(self, name: str) -> None:
        for handle in self.handles[name]:
            handle.remove()
        self.handles[name] = []

    def _add_all_views(self) -> None:
        for part in ("train", "test"):
            self._add_views(part)

    def _add_views(self, part: str) -> None:
        with self._lock:
            self._clear(part)
            self._at = None
            views, kind = getattr(self.subject.scene, part), self.controls["pictures"].value
            for i, name in enumerate(views.names):
                camera = views.cameras[i]
                width, height = int(camera.width), int(camera.height)
                step = max(1, width // _PICTURE_PX)
                image = None
                if kind == "photographs":
                    image = np.asarray(views.images[i])[::step, ::step]
                elif kind == "masks":
                    mask = np.asarray(views.masks[i])[::step, ::step]
                    image = np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, 2)
                self.handles[part].append(
                    self.server.scene.add_camera_frustum(
                        f"/{part}/{i}_{name}",
                        fov=2 * float(torch.atan(height / 2 / camera.intrinsics[1, 1].double())),
                        aspect=width / height,
                        scale=0.1 * self.size,
                        thickness=0.003 * self.size,
                        color=_COLOURS[part],
                        image=image,
                        visible=self.controls[part].value and not self._covered,
                        **pose_of(camera, self.middle),
                    )
                )
                self.handles[part][-1].on_click(lambda _, name=name: self._jump(str(name)))

    def _add_hull(self) -> None:
        with self._lock:
            hull = self.subject.hull
            if hull is None:
                return
            for name, shape, colour in (
                ("hull", hull, (90, 170, 230)),
                ("inner", hull.inner, (240, 150, 60)),
            ):
                self._clear(name)
                if shape is not None:
                    vertices, faces = shape.to_mesh()
                    self.handles[name].append(
                        self.server.scene.add_mesh_simple(
                            f"/{name}",
                            (vertices - self.middle).astype(np.float32),
                            faces.astype(np.uint32),
                            color=colour,
                            opacity=self.controls["opacity"].value,
                            side="double",
                            visible=self.controls[name].value and not self._covered,
                        )
                    )

    @property
    def chosen(self) -> int:
        """Number of the run that the browser draws."""
        control = self.controls.get("run")
        return 0 if control is None else [r.label for r in self.subject.runs].index(control.value)

    def _add_runs(self) -> None:
        if not self.subject.runs:
            return
        with self._lock:
            run = self.subject.runs[self.chosen]
            crop = self.controls["crop"].value and self.subject.hull is not None
            found = run.gaussians()
            made: Any = None
            if found is not None:
                arrays = splat_arrays(found[0], found[1].numpy() - self.middle)
                if crop:
                    kept = self._inside(arrays["centers"])
                    arrays = {name: value[kept] for name, value in arrays.items()}
                self._clear("runs")
                made = self.server.scene.add_gaussian_splats(
                    "/run", arrays["centers"], arrays["covariances"], arrays["rgbs"], arrays["opacities"]
                )
            elif (mesh := run.mesh()) is not None:
                from trimesh import Trimesh

                from visdom_plugin.export.meshes import crop as crop_mesh

                if crop:
                    mesh = crop_mesh(mesh, lambda x: self._inside(x - self.middle))
                self._clear("runs")
                shape = Trimesh(
                    mesh.vertices - self.middle, mesh.faces, vertex_colors=mesh.rgb, process=False
                )
                made = self.server.scene.add_mesh_trimesh("/run", shape)
            if made is not None:
                self.handles["runs"] = [made]
            self._again()

    def _inside(self, points: np.ndarray) -> np.ndarray:
        assert self.subject.hull is not None
        return self.subject.hull.contains(np.asarray(points, np.float64) + self.middle, margin_voxels=1)

    def _welcome(self, client: Any) -> None:
        # From beside the first camera, so that its picture and the object are in sight.
        self._place(client, self.subject.scene.train.cameras[0], back=0.8 * self.size)
        client.camera.on_update(lambda _: self._moved(client))
        self._moved(client)

    def _place(self, client: Any, camera: Cameras, back: float = 0.0) -> None:
        pose = pose_of(camera, self.middle)
        ahead = camera.forward.double().cpu().numpy()
        right = camera.world_from_camera[:3, 0].double().cpu().numpy()
        up = -camera.world_from_camera[:3, 1].double().cpu().numpy()
        pose["position"] = pose["position"] + back * (0.5 * up + right - 0.5 * ahead)
        with client.atomic():
            client.camera.fov = 2 * float(torch.atan(camera.height / 2 / camera.intrinsics[1, 1].double()))
            client.camera.wxyz = pose["wxyz"]
            client.camera.position = pose["position"]
            depth = max(-float(pose["position"] @ ahead), 0.1 * self.size)
            client.camera.look_at = np.zeros(3) if back else pose["position"] + ahead * depth

    def _go_to_view(self, _: Any) -> None:
        self._jump(self.controls["view"].value)

    def _jump(self, name: str) -> None:
        for part in ("train", "test"):
            views = getattr(self.subject.scene, part)
            names = [str(n) for n in views.names]
            if name in names:
                for client in self.server.get_clients().values():
                    self._place(client, views.cameras[names.index(name)])

    def _find_own_frustum(self, client: Any) -> None:
        """Hides the frustum that the eye is in."""
        eye, found = np.asarray(client.camera.position), None
        for handle in (*self.handles["train"], *self.handles["test"]):
            if np.linalg.norm(eye - np.asarray(handle.position)) < _AT * self.size:
                found = handle
        if found is not self._at:
            self._at = found
            for part in ("train", "test"):
                self._show(part)

    def _moved(self, client: Any) -> None:
        self.moved[client.client_id] = time.monotonic()
        self._find_own_frustum(client)
        # Two runs beside each other are drawn while the camera moves, too: the last picture stays until then.
        self.drawn.pop(client.client_id, None)
        if client.client_id in self._pictured and not self._covered:
            self._pictured.discard(client.client_id)
            client.scene.set_background_image(None)
        self._show_runs(not self._covered)

    def _again(self) -> None:
        """The pictures at rest are drawn anew."""
        for client in self.server.get_clients().values():
            self._moved(client)

    def _show_runs(self, moving: bool) -> None:
        for handle in self.handles["runs"]:
            handle.visible = self.controls["runs"].value and moving

    def _work(self) -> None:
        looked = time.monotonic()
        while not self._done.wait(0.05):
            try:
                for client in list(self.server.get_clients().values()):
                    self._refine(client)
                if time.monotonic() - looked > _LOOK:
                    looked = time.monotonic()
                    self._look_for_news()
            except Exception as error:
                if not self._done.is_set():
                    log.warning("the viewer could not draw: %r", error)
                    time.sleep(1)

    def _look_for_news(self) -> None:
        steps = [run.refresh() for run in self.subject.runs]
        if any(step is not None for step in steps):
            said = [
                f"{r.label}: step {s}" for r, s in zip(self.subject.runs, steps, strict=True) if s is not None
            ]
            self.controls["state"].content = ", ".join(said)
            self._add_runs()

    def _refine(self, client: Any) -> None:
        """Draws the next finer picture of a camera that rests."""
        since, covered = self.moved.get(client.client_id), self._covered
        if since is None or not (self.controls["render"].value or covered):
            return
        level = self.drawn.get(client.client_id, (since, 0))[1]
        resting = time.monotonic() - since >= _REST or (covered and level == 0)
        if level >= len(WIDTHS) or not resting:
            return
        began = time.monotonic()
        with self._lock:
            picture = self.draw(client.camera, WIDTHS[level])
        slow = time.monotonic() - began > _PATIENCE
        still = self.moved.get(client.client_id) == since
        if still or covered:
            self._pictured.add(client.client_id)
            client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)
        if still:
            self.drawn[client.client_id] = since, len(WIDTHS) if slow else level + 1
            self._show_runs(False)

    def draw(self, view: Any, width: int) -> np.ndarray:
        """(H, W, 3) uint8 of a browser's view (wxyz, position, fov, aspect) as the controls ask for it."""
        picture, said = draw(self.subject, view, width, self.middle, self.look)
        if said is not None:
            self.controls["state"].content = said
        return picture

    @property
    def look(self) -> Look:
        """What the controls ask for."""
        controls = self.controls
        comparison, share = COMPARISONS[-1], 0.5
        if "compare" in controls:
            comparison, share = controls["compare"].value, controls["split"].value / 100
        shade = _BACKGROUNDS[controls["background"].value]
        return Look(self.chosen, comparison, share, shade, controls["error"].value)

    @property
    def _covered(self) -> bool:
        """Whether pictures are shown that the browser's own scene does not lie upon."""
        look = self.look
        return bool(self.subject.runs) and (look.error or look.comparison == SIDE_BY_SIDE)
