"""What is shown of a run while it trains: a contact sheet that is refreshed, and TensorBoard's files."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from visdom_plugin.errors import PluginError
from visdom_plugin.figures.contact_sheet import draw_sheet, shown_on_sheet, to_bytes, write_png
from visdom_plugin.scene import Views
from visdom_plugin.training.evaluate import Renderer, draw_truth, render_on_white
from visdom_plugin.training.runs.run_directory import Record

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

SHEET = "renders/training_now.png"
SHARE = 0.015
"""Of the seconds trained, what drawing may take."""
VIEWS, WIDEST_PX, NARROWEST_PX = 3, 200, 64
"""Training views on the sheet, at most; widths of their pictures. The first sheet may be small, later ones are at
least twice as wide: they come the less often and are worth looking at."""


class LivePictures:
    """A sheet of a few training views as they are drawn now, refreshed as often as its share of the time allows.

    Drawing leaves no trace in training; see `Method.render`.

    Args:
        method: in training.
        views: the training views.
        path: of the sheet.
        keep: is handed each sheet with its step.
    """

    def __init__(
        self,
        method: Renderer,
        views: Views,
        device: torch.device,
        path: Path,
        keep: Callable[[np.ndarray, int], None] = lambda _, __: None,
    ):
        self.method, self.views, self.device, self.path, self.keep = method, views, device, path, keep
        self.spent_s = 0.0
        """Seconds that drawing took."""
        self.count = 0
        """Sheets drawn."""
        self._per_pixel = self._per_sheet = 0.0
        shown = shown_on_sheet(len(views))
        self._chosen = shown[:: max(1, len(shown) // VIEWS)][:VIEWS]

    def refresh(self, step: int, train_s: float) -> bool:
        """Draws the sheet anew if its share of the seconds trained so far pays for it; whether it did."""
        began = time.monotonic()
        left = SHARE * train_s - self.spent_s - self._per_sheet
        if left <= 0:
            return False
        if not self._per_pixel:
            # Imports that the evaluation needs anyway, and how fast a picture is drawn.
            draw_sheet([("", [np.zeros((2, 2, 3), np.uint8)])], ("",))
            began = time.monotonic()
            tiny = self._draw(self._chosen[0], NARROWEST_PX)
            seconds = time.monotonic() - began
            self._per_pixel = seconds / (tiny.shape[0] * tiny.shape[1])
            self.spent_s += seconds
            return False
        heights = sum(
            int(self.views.cameras.height[i]) / int(self.views.cameras.width[i]) for i in self._chosen
        )
        width = min(WIDEST_PX, int((left / self._per_pixel / heights) ** 0.5))
        if width < NARROWEST_PX * (2 if self.count else 1):
            return False
        drawn = [self._draw(i, width) for i in self._chosen]
        pixels = sum(picture.shape[0] * picture.shape[1] for picture in drawn)
        rendered = time.monotonic() - began
        self._per_pixel = rendered / pixels
        columns = []
        for i, picture in zip(self._chosen, drawn, strict=True):
            truth = draw_truth(self.views, i, self.views.mask_origin(i) == "given")
            smooth = cv2.resize(picture, truth.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            columns.append((self.views.names[i], [truth, smooth]))
        sheet = draw_sheet(columns, ("photograph", f"step {step}"))
        write_png(self.path, sheet)
        self.keep(sheet, step)
        seconds = time.monotonic() - began
        self._per_sheet = seconds - rendered
        self.spent_s += seconds
        self.count += 1
        return True

    def _draw(self, i: int, width: int) -> np.ndarray:
        camera = self.views.cameras[i]
        width = min(width, int(camera.width))
        height = max(1, round(int(camera.height) * width / int(camera.width)))
        return to_bytes(render_on_white(self.method, camera.resized(width, height), self.device)[0])


class TensorBoard:
    """Event files of one run.

    Args:
        folder: of the files, one for each run.

    Raises:
        PluginError: tensorboard is not installed.
    """

    def __init__(self, folder: Path):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise PluginError(
                "TensorBoard's files need the package tensorboard, which is not installed",
                where="--tensorboard",
                todo="pip install 'visdom-plugin[tensorboard]', or leave --tensorboard out",
                topic="not-installed",
            ) from error
        self.folder, self._make = folder, SummaryWriter
        self._writer: SummaryWriter | None = None

    def scalars(self, group: str, values: Mapping[str, float | None], step: int) -> None:
        """Numbers by name; those that are None or NaN are left out."""
        for name, value in values.items():
            if value is not None and value == value:
                self._open(step).add_scalar(f"{group}/{name}", value, step)

    def picture(self, picture: np.ndarray, step: int, name: str = "training views") -> None:
        """(H, W, 3) uint8."""
        self._open(step).add_image(name, picture, step, dataformats="HWC")
        self._open(step).flush()

    def close(self) -> None:
        """Closes the files."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _open(self, step: int) -> SummaryWriter:
        if self._writer is None:
            # What an earlier process wrote of later steps is dropped.
            self._writer = self._make(str(self.folder), purge_step=step)
        return self._writer


@dataclass(frozen=True)
class Live:
    """Who follows a training: called with each line of log.jsonl."""

    pictures: LivePictures | None
    board: TensorBoard | None

    def __call__(self, row: Record) -> str | None:
        """What there is to say beside the progress, once: where the sheet lies."""
        step = row["step"]
        if self.board is not None:
            self.board.scalars(
                "training", {k: v for k, v in row.items() if k not in ("step", "train_s")}, step
            )
        if self.pictures is None:
            return None
        first = not self.pictures.count
        if not self.pictures.refresh(step, row["train_s"]) or not first:
            return None
        return f"pictures, refreshed while it trains: {self.pictures.path}"
