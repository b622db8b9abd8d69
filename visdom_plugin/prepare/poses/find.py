"""The reader for a file or folder of poses, found by what it holds."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from datamodules.capture import Capture
from datamodules.files.find_model import FILES, find_model
from datamodules.files.parsers import damaged, parse_json
from datamodules.files.paths import read_file
from datamodules.layouts import colmap, transforms
from datamodules.recognise import read_capture, recognise
from datamodules.request import Request
from visdom_plugin.errors import SceneError, list_some
from visdom_plugin.prepare.photographs import Photograph
from visdom_plugin.prepare.placed import Placed
from visdom_plugin.prepare.poses import metashape, networks, phones, realityscan
from visdom_plugin.prepare.poses.listed import Listed, match

_KNOWN = (
    "a COLMAP model; transforms.json; Metashape's cameras.xml; RealityScan's CSV or XMP files; metadata.json of "
    "Record3D; JSON files of Polycam or 3D Scanner App; .npz or .json of VGGT, pi3, DUSt3R"
)
_MOST_JSON = 5000


def place_by_file(path: Path, photographs: Sequence[Photograph]) -> Placed:
    """Photographs with the cameras of a file or folder.

    Raises:
        SceneError: nothing that is read lies there, or it does not fit the photographs.
    """
    if not path.exists():
        there = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else []
        raise SceneError(
            "there is no such file or folder of poses",
            where=f"--poses {path}",
            todo=f"one of what lies there: {list_some(there)}"
            if there
            else f"--poses board, or one of {_KNOWN}",
            topic="no-scene",
        )
    found = _read_folder(path, photographs) if path.is_dir() else _read_file(path, photographs)
    if isinstance(found, Capture):
        return _match_capture(found, photographs, path)
    return match(found, photographs, path)


def holds_poses(root: Path) -> bool:
    """Whether a folder of photographs has cameras of its own."""
    return find_model(root) is not None or len(recognise(root)) == 1 or any(root.glob("*.xmp"))


def _read_file(path: Path, photographs: Sequence[Photograph]) -> Listed | Capture:
    if path.name in FILES:
        return colmap.read(path.parent, _request())
    data, ending = read_file(path), path.suffix.lower()
    if ending == ".xml":
        root = _parse_xml(data, path)
        if metashape.recognise(root):
            return metashape.read(root, path)
    elif ending == ".csv" and realityscan.recognise_csv(data):
        return realityscan.read_csv(data, path, photographs)
    elif ending == ".npz":
        return networks.read_npz(path, photographs)
    elif ending == ".json" or path.name == "metadata":
        content = parse_json(data, path)
        if "frames" in content:
            file = transforms.parse_transforms(data, path)
            return transforms.make_capture(path.parent, _request(), "nerfstudio", [file])
        if phones.is_record3d(content):
            return phones.read_record3d(content, path)
        if networks.recognise(list(content)):
            return networks.read_json(content, path, photographs)
    raise _unknown(path)


def _read_folder(path: Path, photographs: Sequence[Photograph]) -> Listed | Capture:
    if find_model(path) is not None:
        return colmap.read(path, _request())
    layouts = recognise(path)
    if len(layouts) == 1:
        return read_capture(path, next(iter(layouts)), _request())
    for name in ("metadata.json", "metadata", "cameras.xml"):
        if (path / name).is_file():
            return _read_file(path / name, photographs)
    xmp = sorted(p for p in path.iterdir() if p.suffix.lower() == ".xmp")
    if xmp:
        return realityscan.read_xmp(xmp, photographs)
    for folder in (path / "keyframes" / "corrected_cameras", path / "keyframes" / "cameras", path):
        files = sorted(folder.glob("*.json"))[:_MOST_JSON] if folder.is_dir() else []
        listed = phones.read_folder(files, photographs)
        if listed is not None:
            return listed
    # COLMAP's `sparse`, which holds models by number.
    models = [below for below in sorted(path.iterdir()) if below.is_dir() and find_model(below) is not None]
    if len(models) == 1:
        return _read_folder(models[0], photographs)
    raise _unknown(path, models)


def _unknown(path: Path, models: Sequence[Path] = ()) -> SceneError:
    where = f"--poses {path}"
    if models:
        return SceneError(
            f"there are {len(models)} COLMAP models in this folder",
            where=where,
            todo=f"name one, as a rule the one of most photographs: {list_some(f'--poses {m}' for m in models)}",
            topic="layout",
        )
    inside = f"; it holds {list_some(sorted(p.name for p in path.iterdir()))}" if path.is_dir() else ""
    return SceneError(
        f"these poses are of no format that is read{inside}",
        where=where,
        cause="a project file in place of an export, or the folder above or below",
        todo=f"export one of: {_KNOWN}",
        topic="layout",
    )


def _request() -> Request:
    return Request(allow_missing_masks=True, allow_outside=True)


def _match_capture(capture: Capture, photographs: Sequence[Photograph], where: Path) -> Placed:
    """Cameras that one of the scenes' readers knows."""
    calibration = capture.calibrate(range(len(capture.frames)))
    cameras = calibration.cameras
    K = cameras.intrinsics
    listed = Listed(
        {"colmap": "a COLMAP model"}.get(capture.layout, f"{capture.layout}'s file"),
        [frame.image for frame in capture.frames],
        K[:, [0, 1, 0, 1], [0, 1, 2, 2]].numpy(),
        list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True)),
        cameras.world_from_camera.numpy(),
        calibration.distortions,
        units=capture.units,
        notes=list(capture.notes),
    )
    return match(listed, photographs, where)


def _parse_xml(data: bytes, path: Path) -> ET.Element:
    if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
        damaged(path, f"{path.name} defines entities", cause="another kind of file, or a malicious one")
    try:
        return ET.fromstring(data)
    except ET.ParseError as error:
        damaged(path, f"{path.name} is not XML: {error}")
