"""What a caller wants of a scene on disk."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import Literal, NoReturn

from visdom_plugin.errors import ConfigError

OF_SOME = {
    "frame": "has no frames in time: it is no video",
    "colmap_model": "is not read from a COLMAP model",
    "mask_path": "has no mask_path in a transforms.json",
}
"""Fields of a request that only some captures can honour, and why the others cannot."""
_OF_ALL = ("views", "downscale", "test", "hold_out", "allow_missing_masks")


@dataclass(frozen=True)
class Request:
    """How to read a scene; every layout takes the same."""

    views: int | None = None
    """Number of training views; None takes the smallest index file, or 4 where there is none. All train where
    the scene has no more."""
    downscale: float = 1
    """>= 1, how much smaller than the photographs to work."""
    test: bool = True
    """False leaves the test views out and does not look at their files. Training views stay the same; only where
    more are wanted than the layout's test views leave, these are taken as well."""
    train_list: str | None = None
    """Training views by hand: an index file, positions and names with commas between, or "all"."""
    test_list: str | None = None
    """Test views by hand, in the same way."""
    split: str | None = None
    """Name of a published split (`views.named_splits`), with ":SCENE" where the folder is not named after it."""
    hold_out: bool = True
    """False lets views train that only the layout's own rule sets aside for testing (leave-one-out)."""
    frame: int | None = None
    """Of a video layout (ActorsHQ): which frame; None takes the first there is."""
    mask_source: Literal["auto", "folder", "alpha"] = "auto"
    """Where foreground masks are: files, the photographs' alpha channels, or whichever there is; where both
    are, they must agree."""
    masks: str | None = None
    """Folder of the foreground masks, below the scene's; None takes the layout's, or one that is called alike."""
    colmap_model: str | None = None
    """Folder of the COLMAP model below the scene's, such as sparse/1; None takes the one with most photographs."""
    invert_masks: bool = False
    """Whether masks are black on the object; they are turned over as they are read."""
    mask_path: Literal["ignore", "foreground"] = "ignore"
    """What the files named by `mask_path` in a transforms.json mean: black pixels are to be ignored, which is
    nerfstudio's meaning, or white pixels are the object."""
    allow_missing_masks: bool = False
    """Whether views without a mask are read all the same, with `mask_origins` "missing"."""
    allow_outside: bool = False
    """Whether files outside the scene's folder may be read because the data names them."""

    def refuse_unused(self, layout: str, honoured: Collection[str]) -> None:
        """Raises ConfigError for a field that is given and that a capture cannot honour.

        Args:
            honoured: of `OF_SOME`, the fields that make a difference.
        """
        for name, reason in OF_SOME.items():
            if name not in honoured and getattr(self, name) != getattr(Request, name):
                self._refuse(name, f"the scene (read as {layout}) {reason}")

    def refuse_for_built_in(self) -> None:
        """Raises ConfigError for a field that is given and that the built-in scene cannot honour."""
        for field in fields(self):
            if field.name not in _OF_ALL and getattr(self, field.name) != field.default:
                what = "the built-in scene is drawn, not read from files: this option changes nothing"
                self._refuse(field.name, what, "name a scene with --data, or leave it out")

    def _refuse(self, name: str, what: str, todo: str = "leave it out") -> NoReturn:
        group = "data." if name == "mask_source" else ""
        raise ConfigError(what, where=f"--{group}{name.replace('_', '-')}", todo=todo)

    def check(self) -> None:
        """Raises ConfigError for a field out of range."""
        if not (math.isfinite(self.downscale) and self.downscale >= 1):
            raise ConfigError(f"downscale is {self.downscale:g}; it must be 1 or more", where="--downscale")
        if self.frame is not None and self.frame < 0:
            raise ConfigError(f"frame is {self.frame}; frames are counted from 0", where="--frame")
