"""The one door to data: recognises a folder's layout and loads it."""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from datamodules.built_in import NAMES, PREFIX, named_built_in
from datamodules.request import Request
from visdom_plugin.errors import ConfigError, SceneError

if TYPE_CHECKING:
    from datamodules.capture import Capture
    from datamodules.open_scene import FreeViews
    from visdom_plugin.scene import Scene

log = logging.getLogger(__name__)


class _Format(NamedTuple):
    module: str
    holds: str
    """What a folder of this layout holds, for people."""
    covers: tuple[str, ...] = ()
    """Layouts whose marks are part of this one, so that finding both is no ambiguity."""
    reader: str = "read"
    recogniser: str | None = "recognise"
    """None for a layout that has to be asked for."""


FORMATS = {
    "prepared": _Format(
        "prepared", "sparse/0 (COLMAP model), images, masks, sparse_<N>.txt", ("colmap", "mip360", "llff")
    ),
    "mip360": _Format("mip360", "sparse/0, images and images_<F>, masks", ("colmap", "llff")),
    "omni3d": _Format(
        "omni3d",
        "render/ with transforms.json, or standard/ with matting",
        ("colmap", "mip360", "llff", "nerfstudio"),
    ),
    "omni3d-llff": _Format("omni3d", "the same, with its LLFF poses", reader="read_llff", recogniser=None),
    "actorshq": _Format("actorshq", "1x, 2x or 4x with calibration.csv, rgbs and masks"),
    "nerfstudio": _Format("transforms", "transforms.json"),
    "instant-ngp": _Format("transforms", "transforms.json", recogniser=None),
    "blender": _Format(
        "transforms", "transforms_train.json", reader="read_blender", recogniser="recognise_blender"
    ),
    "neus": _Format("neus", "cameras_sphere.npz or cameras.npz of NeuS and IDR, image and mask"),
    "colmap": _Format("colmap", "a COLMAP model and images"),
    "llff": _Format("llff", "poses_bounds.npy and images"),
}
"""Names for --data-format."""

REPEATED_BY = "repeated_by"
"""Key of a transforms.json that names a COLMAP model beside it with the same cameras, as `visdom-export` does."""

_ELSEWHERE = {
    "meta_data.json": "SDFStudio's, which is not read: write its camtoworld and intrinsics into a transforms.json "
    'as transform_matrix and intrinsic_matrix, with "from_na": true',
    "cameras.xml": "Metashape's, which is not read: export COLMAP's format, or run ns-process-data metashape",
    "cameras.json": "the record of a trained Gaussian model: the scene is the folder that it was trained on",
    "bundle.out": "Bundler's, which is not read: export COLMAP's format",
    "reconstruction.json": "OpenSfM's, which is not read: opensfm export_colmap",
    "cams": "MVSNet's, which is not read: give the COLMAP model that it was made from",
    "database.db": "COLMAP's database of features: run colmap mapper, which writes sparse/0",
}
"""Files by which neighbouring programs' captures are known, and what to do with them."""


_MOST_FOLDERS, _PEEKED = 200, 1 << 16
_PACKED = (".zip", ".7z", ".rar", ".gz", ".tgz", ".tar", ".xz")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm")


def load(
    path: str | Path | None,
    *,
    views: int | None = None,
    downscale: float = 1,
    seed: int = 0,
    test: bool = True,
    data_format: str | None = None,
    **reading: Any,
) -> Scene:
    """Opens a scene.

    Args:
        path: the scene's folder, or "builtin:NAME", a name out of `built_in.NAMES`; None is the first of these.
        views: number of training views; None takes the smallest index file, or 4.
        downscale: how much smaller than the photographs to work, at least 1.
        seed: of the built-in scene's noise; real data does not depend on it.
        test: False leaves the test views out, for callers that do not evaluate.
        data_format: the layout, one of `FORMATS`; None recognises it.
        reading: further fields of `request.Request`.

    Returns:
        Scene with train and test views, cameras float64 on the CPU.

    Raises:
        SceneError: for every fault of the data, a missing folder, and an unknown or ambiguous layout.
        ConfigError: for an option out of range, or one that the scene cannot honour.
    """
    request = Request(views=views, downscale=downscale, test=test, **reading)
    _check_format(data_format)
    built_in = named_built_in(path)
    if built_in is not None:
        if data_format is not None:
            raise ConfigError(
                "the built-in scene has no files", where="--data-format", todo="name a scene with --data"
            )
        request.refuse_for_built_in()
        from datamodules.synthetic.config import SyntheticConfig
        from datamodules.synthetic.scene import make_scene

        config = SyntheticConfig(downscale=downscale, seed=seed)
        if views is not None:
            config = replace(config, train_views=views)
        return make_scene(config if test else replace(config, test_views=0), built_in)
    from datamodules.open_scene import open_capture

    assert path is not None
    with opening(path) as root:
        return open_capture(read_capture(root, data_format, request), request)


def load_free_views(path: str | Path, *, data_format: str | None = None, **reading: Any) -> FreeViews | None:
    """`open_scene.find_free_views` of the scene in a folder; `reading` holds fields of `request.Request`."""
    from datamodules.open_scene import find_free_views

    request = Request(**reading)
    with opening(path) as root:
        return find_free_views(read_capture(root, data_format, request), request)


@contextmanager
def opening(path: str | Path) -> Iterator[Path]:
    """The folder of that name; what goes wrong while it is read is told as SceneError."""
    root = find_folder(path)
    try:
        yield root
    except RecursionError as error:
        raise SceneError("the data is nested too deeply", where=root) from error
    except OSError as error:
        raise SceneError(
            f"the scene cannot be read: {error.strerror or error}",
            where=error.filename or root,
            todo="make its files plain files that you may read",
        ) from error


_SCENE_TODO = "name the folder of a scene, or a built-in scene: " + ", ".join(PREFIX + name for name in NAMES)


def find_folder(path: str | Path, todo: str = _SCENE_TODO) -> Path:
    """The folder of that name.

    Args:
        todo: what to do where there is none.

    Raises:
        SceneError: there is none.
    """
    root = Path(path)
    try:
        root = root.expanduser()
        exists, is_folder = root.exists(), root.is_dir()
    except (OSError, ValueError, RuntimeError):
        exists = is_folder = False
    if not is_folder:
        raise SceneError(
            "this is a file, not a folder" if exists else "there is no such folder",
            where=root,
            todo=todo,
            topic="no-scene",
        )
    return root


def recognise(root: Path) -> dict[str, str]:
    """The layouts that a folder could have, each with what speaks for it. More than one is ambiguous."""
    found = {}
    for name, form in FORMATS.items():
        if form.recogniser is not None:
            reason = getattr(import_module(f"datamodules.layouts.{form.module}"), form.recogniser)(root)
            if reason is not None:
                found[name] = reason
    covered = {name for other in found for name in FORMATS[other].covers}
    if {"nerfstudio", "colmap"} <= found.keys():
        covered |= {"colmap"} if is_repeated(root) else set()
    return {name: reason for name, reason in found.items() if name not in covered}


def is_repeated(root: Path) -> bool:
    """Whether transforms.json says that the COLMAP model beside it holds the same cameras."""
    try:
        content = json.loads((root / "transforms.json").read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and isinstance(content.get(REPEATED_BY), str)


def read_capture(root: Path, data_format: str | None, request: Request) -> Capture:
    """What the layout's reader makes of the folder, before any pixel is read.

    Args:
        data_format: the layout; None recognises it.

    Raises:
        SceneError: for an unknown or ambiguous layout, and for a calibration that is damaged.
        ConfigError: for an option out of range.
    """
    _check_format(data_format)
    request.check()
    if data_format is None:
        data_format = _only_reading(root)
    form = FORMATS[data_format]
    read: Callable[[Path, Request], Capture] = getattr(
        import_module(f"datamodules.layouts.{form.module}"), form.reader
    )
    capture = read(root, request)
    request.refuse_unused(capture.layout, capture.honours)
    return capture


def _check_format(data_format: str | None) -> None:
    if data_format is not None and data_format not in FORMATS:
        raise ConfigError(
            f"unknown data format {data_format!r}",
            where="--data-format",
            todo=f"one of {', '.join(FORMATS)}",
            topic="layout",
        )


def _only_reading(root: Path) -> str:
    found = recognise(root)
    if len(found) == 1:
        ((name, reason),) = found.items()
        log.info("%s: read as %s, because of %s", root, name, reason)
        return name
    if found:
        raise SceneError(
            "this folder can be read in more than one way: "
            + " or ".join(f"{name} ({reason})" for name, reason in found.items()),
            where=root,
            todo=f"say which one is meant: --data-format {' or --data-format '.join(found)}",
            topic="layout",
        )
    cause, todo = _find_near(root) or (_guess(root), None)
    layouts = "; ".join(f"{name}: {form.holds}" for name, form in FORMATS.items() if form.recogniser)
    raise SceneError(
        "this folder is not a scene of a known layout",
        where=root,
        cause=cause,
        todo=todo or f"pass a folder of one of these layouts, or name it with --data-format. {layouts}",
        topic="no-scene",
    )


_LEVELS = ("one level", "two levels", "three levels")


def _find_near(root: Path) -> tuple[str, str] | None:
    """The scene that a folder is a part of, or that lies in it: cause and what to do; None where there is none."""
    from datamodules.files.images import ENDINGS  # with NumPy and Pillow, which --help need not wait for

    whole = root.resolve()
    for level, folder in zip(_LEVELS[:2], whole.parents, strict=False):
        found = {}
        with suppress(OSError):  # nobody asked for this one
            found = recognise(folder)
        if found:
            shown = root.parent if folder == whole.parent and root.name == whole.name else folder
            reason = " or ".join(f"{name} ({reason})" for name, reason in found.items())
            return (
                f"{level} too deep: {shown} is a scene, {reason}",
                f"name that folder: --data {_quoted(shown)}",
            )
    for folder in _folders_below(root, 3):
        if recognise(folder):
            if any(p.suffix.lower() in ENDINGS for p in folder.rglob("*")):
                level = _LEVELS[len(folder.relative_to(root).parts) - 1]
                return f"{level} too high: {folder} looks like a scene", f"name it: --data {_quoted(folder)}"
            poses = folder.relative_to(root).as_posix()
            return f"poses lie in {poses}, without photographs", "put poses and photographs into one folder"
    return None


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _guess(root: Path) -> str:
    from datamodules.files.images import ENDINGS

    for name, meaning in _ELSEWHERE.items():
        if (root / name).exists():
            return f"{name} is {meaning}"
    for path in sorted(root.glob("*.json")):
        with path.open("rb") as file:
            if b'"frames"' in file.read(_PEEKED):
                return f"{path.name} lists frames as a transforms.json does: rename it to transforms.json"
    if (root / "images").is_dir() or any(p.suffix.lower() in ENDINGS for p in root.iterdir()):
        return "photographs without poses: `visdom-prepare PHOTOS --out SCENE` finds poses and masks"
    for path in sorted(root.iterdir()):
        if path.suffix.lower() in _PACKED:
            return f"{path.name} is not unpacked"
        if path.suffix.lower() in _VIDEOS:
            return (
                f"{path.name} is a video: save some sharp frames of it as photographs, and "
                "`visdom-prepare PHOTOS --out SCENE` finds their poses"
            )
    return (
        "it holds none of the files that the layouts are known by" if any(root.iterdir()) else "it is empty"
    )


def _folders_below(root: Path, depth: int) -> Iterator[Path]:
    """Folders below, the nearer first; of many only the first."""
    level = [root]
    for _ in range(depth):
        level = [p for folder in level for p in sorted(folder.iterdir()) if p.is_dir() and p.name[0] != "."]
        level = level[:_MOST_FOLDERS]
        yield from level
