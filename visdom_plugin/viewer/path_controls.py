"""Controls with which a camera path is gathered view by view, and saved for visdom-render."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from visdom_plugin.errors import VisDomError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.geometry.path_files import write_path
from visdom_plugin.viewer.shown import camera_from

HEIGHT_PX, FPS, FRAMES = 720, 30, 120
"""Of the path that is saved, and the frames that the command named beside it draws."""


class PathControls:
    """A folder of buttons: add the present view, remove the last one, save.

    Args:
        gui: viser's.
        file: where the path is saved.
        middle: (3,) of the browser's frame in the capture's.
        subject: what visdom-render is to draw along the path, for the command that is said.
    """

    def __init__(self, gui: Any, file: Path, middle: np.ndarray, subject: Path | None):
        self.file, self.middle, self.subject = file, middle, subject
        self.views: list[tuple[np.ndarray, np.ndarray, float]] = []
        """wxyz, position and fov of each."""
        self._aspect = 16 / 9
        with gui.add_folder("Camera path", expand_by_default=False):
            gui.add_button("Add this view").on_click(lambda event: self.add(event.client.camera))
            gui.add_button("Remove last").on_click(lambda _: self.remove())
            gui.add_button("Save").on_click(lambda _: self.save())
            self.said = gui.add_markdown("no views yet")

    def add(self, view: Any) -> None:
        """Adds a browser's view: wxyz, position, fov and aspect."""
        self.views.append((np.array(view.wxyz), np.array(view.position), float(view.fov)))
        self._aspect = float(view.aspect)
        self.said.content = f"{len(self.views)} views"

    def remove(self) -> None:
        """Removes the last view, if there is one."""
        del self.views[-1:]
        self.said.content = f"{len(self.views)} views"

    def save(self) -> None:
        """Writes the file, and says how it is drawn."""
        if not self.views:
            self.said.content = "no views yet: add some first"
            return
        size = 2 * round(HEIGHT_PX * self._aspect / 2), HEIGHT_PX
        cameras = Cameras.stack([camera_from(*view, size, self.middle) for view in self.views])
        try:
            write_path(self.file, cameras, FPS)
        except (OSError, VisDomError) as error:
            self.said.content = f"not saved: {error}"
            return
        what = self.subject if self.subject is not None else "RUN"
        command = f"visdom-render {what} --path {self.file} --frames {FRAMES}"
        self.said.content = f"saved {len(self.views)} views; draw them with\n\n`{command}`"
