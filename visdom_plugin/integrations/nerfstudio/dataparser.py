"""The data parser `visdom`: masked sparse scenes in all our layouts, with our splits, for any method.

ns-train nerfacto visdom --data DIR --views 4
"""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Optional

import torch
from nerfstudio.cameras.cameras import Cameras as HostCameras
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from datamodules import load
from visdom_plugin.errors import VisDomError
from visdom_plugin.geometry.cameras import Cameras
from visdom_plugin.integrations.nerfstudio.frame import Similarity, similarity_of
from visdom_plugin.integrations.nerfstudio.pictures import TrainingViews, default_cache, write_pictures
from visdom_plugin.scene import Scene

log = logging.getLogger(__name__)

METADATA = "visdom"
"""Key of the training views in the metadata that nerfstudio hands from data parser to model."""


@dataclass
class VisdomDataParserConfig(DataParserConfig):
    """Posed, masked photographs from a handful of views."""

    _target: type = field(default_factory=lambda: VisdomDataParser)
    data: Optional[Path] = None  # noqa: UP045  (nerfstudio's reader of configs)
    """Folder of the scene, in any layout of visdom-train, or builtin:NAME; without it, the built-in scene."""
    views: int = 4
    """Training views."""
    downscale: float = 1.0
    """Work on images smaller by this factor."""
    background: Literal["white", "black", "alpha"] = "white"
    """What photographs show outside their masks. "alpha": masks reach the model as a fourth channel."""
    data_format: Optional[str] = None  # noqa: UP045
    """How the scene lies on disk; by default recognised."""
    train_list: Optional[str] = None  # noqa: UP045
    """Training views by hand: an index file, or positions and names with commas between."""
    test_list: Optional[str] = None  # noqa: UP045
    """Test views by hand, in the same way."""
    split: Optional[str] = None  # noqa: UP045
    """A published split by name: visdom. With :SCENE where the folder is not named after the data set's scene."""
    frame: Optional[int] = None  # noqa: UP045
    """Which frame of a video layout (ActorsHQ); by default the first there is."""
    mask_source: Literal["auto", "folder", "alpha"] = "auto"
    """Where masks are read: their folder, the photographs' alpha channel, or whichever there is."""
    mask_path: Literal["ignore", "foreground"] = "ignore"
    """What mask_path in a transforms.json names: black is to be ignored (nerfstudio), or white is the object."""
    allow_outside: bool = False
    """Read files outside the scene's folder when the scene names them."""
    scene_seed: int = 0
    """Of the built-in scene."""
    cache: Optional[Path] = None  # noqa: UP045
    """Where the photographs are kept as nerfstudio reads them; by default in the user's cache folder."""


@contextlib.contextmanager
def told() -> Iterator[None]:
    """A user's mistake ends the program with its message and status 2, as everywhere in this project."""
    try:
        yield
    except VisDomError as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(2) from error


class VisdomDataParser(DataParser):
    """Loads through `datamodules`. The frame is made of the training cameras alone; see `frame.similarity_of`."""

    config: VisdomDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train", **_) -> DataparserOutputs:
        with told():
            training = split == "train"
            scene = self._load(test=not training)
            frame = similarity_of(scene.train.cameras)
            views = scene.train if training else scene.test
            if not training and not len(views):
                log.warning("the scene has no test views: evaluating on the training views")
                views = scene.train
            pictures, counted = write_pictures(views, self.config.cache or default_cache())
        colour = {"white": 1.0, "black": 0.0, "alpha": None}[self.config.background]
        return DataparserOutputs(
            image_filenames=pictures,
            cameras=host_cameras(views.cameras, frame),
            alpha_color=None if colour is None else torch.full((3,), colour),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
            mask_filenames=counted,
            # Models must not see test views: these are the training split's alone.
            metadata={METADATA: TrainingViews(views, frame)} if training else {},
            # Nerfstudio's tools multiply it with float32; the exact one is in the metadata.
            dataparser_transform=frame.transform.float(),
            dataparser_scale=frame.scale,
        )

    def _load(self, test: bool) -> Scene:
        c = self.config
        return load(
            c.data,
            views=c.views,
            downscale=c.downscale,
            seed=c.scene_seed,
            test=test,
            data_format=c.data_format,
            train_list=c.train_list,
            test_list=c.test_list,
            split=c.split,
            frame=c.frame,
            mask_source=c.mask_source,
            mask_path=c.mask_path,
            allow_outside=c.allow_outside,
        )


def host_cameras(cameras: Cameras, frame: Similarity) -> HostCameras:
    """Nerfstudio's cameras (N,), float32, of ours (N,); pixel centres lie at +0.5 in both."""
    K = cameras.intrinsics.float()
    return HostCameras(
        camera_to_worlds=frame.poses_to_model(cameras).float(),
        fx=K[:, 0, 0],
        fy=K[:, 1, 1],
        cx=K[:, 0, 2],
        cy=K[:, 1, 2],
        width=cameras.width,
        height=cameras.height,
        camera_type=CameraType.PERSPECTIVE,
    )


SPECIFICATION = DataParserSpecification(
    config=VisdomDataParserConfig(),
    description="Posed, masked photographs from a handful of views (visdom-plugin)",
)
