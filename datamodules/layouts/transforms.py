"""transforms.json of Blender's NeRF scenes, nerfstudio and instant-ngp.

transforms.json                            one file (nerfstudio, instant-ngp)
transforms_{train,test}.json               or one per split (Blender; transform_{train,test}.json will do)
<file_path>                                photographs, with or without their extension
masks/                                     foreground masks named after the photographs; or alpha channels

Poses are camera-to-world with OpenGL axes (x right, y up, z backward), and stay in the file's world frame:
`scale`, `offset` and `aabb_scale` of instant-ngp say how that program places the scene in its own box, and
`applied_transform` of nerfstudio what was done to COLMAP's frame before. Angles and focal lengths after the
formats' documentation; the principal point has its origin at the image's corner, as everywhere here. NeuS2's
dialect is read, too: a matrix of intrinsics per frame, and OpenCV's axes where `from_na` says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from datamodules.capture import Calibration, Capture, Frame, Pools, sort_frames
from datamodules.files import images
from datamodules.files.parsers import damaged, matrix, number, parse_json, size, text
from datamodules.files.paths import check_name, inside, printable, read_file, read_inside
from datamodules.files.pinholes import pinholes
from datamodules.files.undistort import FISHEYES, Distortion
from datamodules.request import Request
from datamodules.views import splits
from datamodules.views.find_files import ImageFiles, localise, note_localised
from visdom_plugin.errors import SceneError, list_some

_MATRICES = ("intrinsic_matrix", "intrinsics", "intrinsic", "K", "camera_intrinsics")
"""Names under which other programs give a 3 x 3 or 4 x 4 matrix of intrinsics in pixels."""
_LENS = ("x_fov", "y_fov", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "cx", "cy", "sk_x")
_LEAST_FOV = 2.5
"""Degrees; no smaller angle of view is believed, as it would be a wide one in radians."""
_BENT = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclass(frozen=True)
class Entry:
    """One frame of a file, checked but for what its image decides."""

    file_path: str
    pose: list[list[float]]
    """3 x 4 camera to world, OpenGL axes."""
    own: dict[str, float]
    """Lens numbers given for this frame."""
    size: tuple[int, int] | None
    distortion: Distortion | None
    mask_path: str | None = None
    depth_path: str | None = None


@dataclass(frozen=True)
class Transforms:
    """One file: its lens for all frames, its frames, and the file names of its splits."""

    path: Path
    shared: dict[str, float]
    entries: tuple[Entry, ...]
    train: tuple[str, ...] | None = None
    test: tuple[str, ...] | None = None
    convention: str = "opengl"
    """Axes of the poses; NeuS2's `from_na` says OpenCV's."""


def recognise(root: Path) -> str | None:
    """transforms.json, or None."""
    return "transforms.json" if (root / "transforms.json").exists() else None


def recognise_blender(root: Path) -> str | None:
    """transforms_train.json or transform_train.json, or None."""
    names = ("transforms_train.json", "transform_train.json")
    return next((name for name in names if (root / name).exists()), None)


def read(root: Path, request: Request) -> Capture:
    """Reads transforms.json; without lists of its own every 8th view is for testing."""
    file = read_transforms(root, "transforms.json", request)
    return make_capture(root, request, "nerfstudio", [file])


def read_blender(root: Path, request: Request) -> Capture:
    """Reads transforms_train.json (or transform_train.json) and, where it is there, the file of the test views."""
    names = [recognise_blender(root) or "transforms_train.json"]
    test = names[0].replace("train", "test")
    if inside(root, test, outside=request.allow_outside).exists():
        names.append(test)
    return make_capture(root, request, "blender", [read_transforms(root, name, request) for name in names])


def read_transforms(root: Path, name: str, request: Request) -> Transforms:
    """One file of the scene, checked."""
    return parse_transforms(read_inside(root, name, outside=request.allow_outside, most=2**28), root / name)


def parse_transforms(data: bytes, path: Path) -> Transforms:
    """Checks types, numbers and matrices of a file; opens no other.

    Raises:
        SceneError: for everything that is not as the formats say.
    """
    content = parse_json(data, path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        damaged(
            path, f"{path.name} lists no frames", cause="another kind of file, or a capture without images"
        )
    entries = tuple(_entry(frame, i, content, path) for i, frame in enumerate(frames))
    lists = {}
    for key in ("train_filenames", "test_filenames"):
        value = content.get(key)
        if value is not None and not isinstance(value, list):
            damaged(path, f"{key} is no list of names")
        lists[key] = None if value is None else tuple(_normalise(text(v, key, path)) for v in value)
    axes = "opencv" if content.get("from_na") else "opengl"
    shared = _lens_numbers(content, "the file", path)
    return Transforms(path, shared, entries, lists["train_filenames"], lists["test_filenames"], axes)


def _entry(frame: Any, index: int, content: dict[str, Any], path: Path) -> Entry:
    if not isinstance(frame, dict):
        damaged(path, f"frame {index} is no object")
    what = f"of frame {index}"
    if "transform_matrix" not in frame:
        rolling = "transform_matrix_start" in frame
        raise SceneError(
            f"frame {index} has no transform_matrix; it has {list_some(sorted(frame), 12)}",
            where=path,
            cause="a rolling shutter: a video, not photographs"
            if rolling
            else "another program's form of the file",
            todo="give each photograph one camera-to-world matrix (x right, y up, z backward) as transform_matrix",
            topic="poses",
        )
    width, height = (frame.get(key, content.get(key)) for key in ("w", "h"))
    if (width is None) != (height is None):
        damaged(path, f"only one of w and h {what} is given")
    given = {key: frame.get(key) for key in ("mask_path", "depth_file_path")}
    return Entry(
        _normalise(text(frame.get("file_path"), f"file_path {what}", path)),
        matrix(frame.get("transform_matrix"), f"transform_matrix {what}", path),
        _lens_numbers(frame, f"frame {index}", path),
        None if width is None else (size(width, f"w {what}", path), size(height, f"h {what}", path)),
        _distortion(content | frame, what, path),
        *(
            None if value is None else _normalise(text(value, f"{key} {what}", path))
            for key, value in given.items()
        ),
    )


def _lens_numbers(scope: dict[str, Any], what: str, path: Path) -> dict[str, float]:
    """Numbers of the lens that a frame gives, or the file for all; a matrix of intrinsics as fl_x and so on."""
    found = {key: number(scope[key], key, path) for key in _LENS if scope.get(key) is not None}
    for key in _LENS:
        if key.startswith("camera_angle") and found.get(key, 0) >= math.pi:
            degrees, radians = found[key], math.radians(found[key])
            damaged(
                path,
                f"{key} of {what} is {degrees:g}, more than half a turn",
                "an angle in degrees: this key is in radians",
                f"write {radians:.6g}" if degrees < 180 else "give fl_x and fl_y in pixels",
            )
        if key.endswith("_fov") and 0 < found.get(key, 9) < _LEAST_FOV:
            cause = "an angle in radians: this key is in degrees"
            damaged(
                path, f"{key} of {what} is {found[key]:g}", cause, f"write {math.degrees(found[key]):.6g}"
            )
    for key in _MATRICES:
        if scope.get(key) is not None:
            rows = scope[key] if isinstance(scope[key], list) else []
            if len(rows) in (9, 16) and not any(isinstance(x, list) for x in rows):
                edge = math.isqrt(len(rows))
                rows = [rows[i : i + edge] for i in range(0, len(rows), edge)]
            form = "write it by rows, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, or fl_x, fl_y, cx, cy"
            if len(rows) not in (3, 4) or any(not isinstance(r, list) or len(r) not in (3, 4) for r in rows):
                damaged(
                    path, f"{key} of {what} is no 3 x 3 or 4 x 4 matrix", "another program's dialect", form
                )
            if [number(x, key, path) for x in rows[2][:3]] != [0, 0, 1]:
                cause = "a matrix written by columns, or scaled"
                damaged(path, f"the third row of {key} of {what} is {rows[2][:3]}, not 0 0 1", cause, form)
            (fx, skew, cx), (_, fy, cy) = ([number(x, key, path) for x in row[:3]] for row in rows[:2])
            found |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "sk_x": skew}
    skew = found.pop("sk_x", 0.0)
    odd = next((key for key in sorted(scope) if key.startswith("ftheta_") and scope[key] is not None), None)
    if odd or abs(skew) > 0.01 * abs(found.get("fl_x", 1.0)):
        raise SceneError(
            f"{what} has {f'an f-theta lens ({odd})' if odd else f'skewed pixels (by {skew:g})'}",
            where=path,
            cause="a lens that cannot be undistorted here",
            todo="undistort photographs, masks and ignored pixels alike and give a pinhole: fl_x, fl_y, cx, cy",
            topic="lens",
        )
    return found


def _normalise(name: str) -> str:
    name = name.replace("\\", "/")
    while name.startswith("./"):
        name = name[2:]
    return name


def _distortion(scope: dict[str, Any], what: str, path: Path) -> Distortion | None:
    """The lens model in COLMAP's terms; nerfstudio's k4 of OPENCV multiplies r^8, which OpenCV has not."""
    model = scope.get("camera_model", "OPENCV_FISHEYE" if scope.get("is_fisheye") is True else "OPENCV")
    k = {
        key: number(scope[key], f"{key} {what}", path) if scope.get(key) is not None else 0.0 for key in _BENT
    }
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return None
    if model == "FISHEYE" or model in FISHEYES:
        return Distortion("OPENCV_FISHEYE", (k["k1"], k["k2"], k["k3"], k["k4"]))
    if model not in ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE"):
        raise SceneError(
            f"camera_model {what} is {model!r:.60}, which cannot be undistorted here",
            where=path,
            cause="an unusual lens, or a damaged file",
            todo="undistort photographs, masks and ignored pixels alike and give camera_model PINHOLE",
            topic="lens",
        )
    if k["k4"]:
        raise SceneError(
            f"k4 {what} is {k['k4']:g}: this radial term has no counterpart in OpenCV's model",
            where=path,
            cause="a fisheye lens without camera_model OPENCV_FISHEYE, or a calibration by another program",
            todo="undistort photographs, masks and ignored pixels alike and remove the coefficients",
        )
    short = (k["k1"], k["k2"], k["p1"], k["p2"])
    if k["k3"]:
        return Distortion("FULL_OPENCV", (*short, k["k3"], 0.0, 0.0, 0.0))
    return Distortion("OPENCV", short) if any(short) else None


def make_capture(
    root: Path,
    request: Request,
    layout: str,
    files: Sequence[Transforms],
    *,
    rename: Callable[[str], str] | None = None,
) -> Capture:
    """The capture of one or more files: of two, the second holds the test views.

    Args:
        rename: from a file_path to the photograph's path below the root, for layouts that have a rule.
    """
    of_name: dict[str, tuple[Transforms, Entry, int]] = {}
    frames, there = [], ImageFiles(root)
    said: list[str] = []
    for part, file in enumerate(files):
        entries = file.entries
        if rename is None and not request.allow_outside:
            entries = tuple(_localise(there, entry) for entry in entries)
            said += note_localised([e.file_path for e in file.entries], [e.file_path for e in entries])
        for entry in entries:
            check_name(entry.file_path, file.path, outside=request.allow_outside or rename is not None)
            name = rename(entry.file_path) if rename else _find_photograph(there, entry.file_path)
            of_name[name] = file, entry, part
            frames.append(_frame(root, name, entry, request))
    ordered = sort_frames(frames)
    pools, notes = _pools(ordered, of_name, files), said
    if any(frame.ignore for frame in ordered):
        notes.append("mask_path means pixels to ignore, as in nerfstudio, not the object's outline")
    # mask_path may point into the folder masks: these files are then no foreground masks.
    pointed = {PurePosixPath(e.mask_path).parts[0] for file in files for e in file.entries if e.mask_path}
    masks = "masks" if not pointed or ("masks" not in pointed and (root / "masks").is_dir()) else None

    def calibrate(wanted: Sequence[int]) -> Calibration:
        lenses = [_lens(there, ordered[i], *of_name[ordered[i].name][:2], request) for i in wanted]
        entries = [of_name[ordered[i].name][1] for i in wanted]
        cameras = pinholes(
            [K for K, _ in lenses],
            [entry.pose for entry in entries],
            [dimensions for _, dimensions in lenses],
            names=[ordered[i].name for i in wanted],
            where=files[0].path,
            convention=files[0].convention,
        )
        return Calibration(cameras, [entry.distortion for entry in entries])

    return Capture(
        root,
        layout,
        ordered,
        calibrate,
        pools,
        tuple(file.path.name for file in files),
        photographs="images" if all(f.image.startswith("images/") for f in ordered) else None,
        mask_folder=masks,
        honours=("mask_path",) if pointed else (),
        notes=tuple(notes),
    )


def _localise(there: ImageFiles, entry: Entry) -> Entry:
    """The entry with paths of another machine as they are found below the folder."""
    path = entry.file_path
    if PurePosixPath(path).suffix.lower() not in images.ENDINGS:
        found = localise(there, f"{path}.png")
        path = path if found == f"{path}.png" else found
    mask, depth = (p and localise(there, p) for p in (entry.mask_path, entry.depth_path))
    return replace(entry, file_path=localise(there, path), mask_path=mask, depth_path=depth)


def _find_photograph(there: ImageFiles, file_path: str) -> str:
    """The photograph's path below the root: extensions may be left out."""
    if PurePosixPath(file_path).suffix.lower() in images.ENDINGS:
        return file_path
    return there.find(f"{file_path}.png", anywhere=False) or f"{file_path}.png"


def _frame(root: Path, name: str, entry: Entry, request: Request) -> Frame:
    """With the side files that instant-ngp knows: <name>.alpha.<ext> and dynamic_mask_<name>.png."""
    path = PurePosixPath(name)
    alpha = str(path.with_suffix(f".alpha{path.suffix}"))
    dynamic = str(path.with_name(f"dynamic_mask_{path.stem}.png"))
    frame = Frame(name, name, depth=entry.depth_path)
    if (root / alpha).is_file():
        frame = replace(frame, mask=alpha)
    if (root / dynamic).is_file():
        frame = replace(frame, excluded=dynamic)
    if entry.mask_path is not None:
        frame = replace(frame, **{"mask" if request.mask_path == "foreground" else "ignore": entry.mask_path})
    return frame


def _pools(frames: Sequence[Frame], of_name: dict, files: Sequence[Transforms]) -> Pools:
    if len(files) > 1:
        test = tuple(i for i, frame in enumerate(frames) if of_name[frame.name][2] == 1)
        rule = f"{files[0].path.name} and {files[1].path.name}"
    elif files[0].test is not None:
        listed = set(files[0].test)
        test = tuple(i for i, frame in enumerate(frames) if of_name[frame.name][1].file_path in listed)
        rule = "test_filenames"
    else:
        return splits.every_eighth(range(len(frames)))
    held = set(test)
    train = [i for i in range(len(frames)) if i not in held]
    if len(files) == 1 and files[0].train is not None:
        listed = set(files[0].train)
        train = [i for i in train if of_name[frames[i].name][1].file_path in listed]
    return Pools(tuple(train), test, rule)


def _lens(
    there: ImageFiles, frame: Frame, file: Transforms, entry: Entry, request: Request
) -> tuple[tuple[float, float, float, float], tuple[int, int]]:
    """(fx, fy, cx, cy) in pixels and (width, height); the size is the photograph's where none is given."""
    dimensions = entry.size
    if dimensions is None:
        path = inside(there.root, there.find(frame.image) or frame.image, outside=request.allow_outside)
        dimensions = images.read_header(read_file(path), path).size
    both = {**file.shared, **entry.own}
    focal = _focal(entry.own, dimensions) or _focal(file.shared, dimensions)
    if focal is None:
        raise SceneError(
            f"there is no focal length for {printable(frame.name)}: none of fl_x, camera_angle_x, x_fov, "
            "intrinsic_matrix",
            where=file.path,
            cause="another program's dialect",
            todo="give fl_x, fl_y, cx, cy in pixels, for the file or in each frame",
            topic="poses",
        )
    return (*focal, both.get("cx", dimensions[0] / 2), both.get("cy", dimensions[1] / 2)), dimensions


def _focal(scope: dict[str, float], dimensions: tuple[int, int]) -> tuple[float, float] | None:
    """Focal lengths in pixels; where one axis is given it serves both."""

    def of_angle(angle: float, pixels: int) -> float:
        # An angle of 0 or 180 degrees and beyond is no field of view; 0 is refused as a focal length later.
        return 0.5 * pixels / math.tan(angle / 2) if 0 < angle < math.pi else 0.0

    for keys, radians in (
        (("x_fov", "y_fov"), math.pi / 180),
        (("fl_x", "fl_y"), None),
        (("camera_angle_x", "camera_angle_y"), 1.0),
    ):
        found = [
            None
            if key not in scope
            else scope[key]
            if radians is None
            else of_angle(scope[key] * radians, pixels)
            for key, pixels in zip(keys, dimensions, strict=True)
        ]
        given = [value for value in found if value is not None]
        if given:
            return given[0], given[-1]
    return None
