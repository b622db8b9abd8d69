"""Metashape's cameras, File > Export > Export Cameras, Agisoft XML.

Metashape's appendix on camera models: f, cx and cy in pixels, cx and cy from the image's centre; poses are camera
to chunk, x right, y down, z forward; P1 and P2 stand the other way round than OpenCV's.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from datamodules.files.parsers import damaged
from datamodules.files.undistort import Distortion
from visdom_plugin.errors import SceneError
from visdom_plugin.prepare.poses.listed import Listed

_MOST_SKEW = 0.01


def recognise(root: ET.Element) -> bool:
    """Whether an XML document is Metashape's."""
    return root.tag == "document" and root.find("chunk") is not None


def read(root: ET.Element, path: Path) -> Listed:
    """The cameras that are aligned.

    Raises:
        SceneError: no aligned camera, a lens that is not a frame camera's, a missing number.
    """
    chunk = root.find("chunk")
    assert chunk is not None
    lenses = {s.get("id"): s for s in chunk.iterfind("sensors/sensor")}
    components = {c.get("id"): _component(c, path) for c in chunk.iterfind("components/component")}
    names, K, sizes, poses, bent, loose = [], [], [], [], [], []
    for camera in chunk.iterfind(".//cameras//camera"):
        label = camera.get("label") or ""
        transform = camera.findtext("transform")
        lens = lenses.get(camera.get("sensor_id"))
        if transform is None or lens is None:
            loose.append(label)
            continue
        pose = _numbers(transform, 16, f"transform of {label}", path).reshape(4, 4)
        pose = components.get(camera.get("component_id"), np.eye(4)) @ pose
        scale = np.cbrt(np.linalg.det(pose[:3, :3]))
        pose[:3, :3] /= scale
        focal, size, distortion = _lens(lens, path)
        names.append(label)
        K.append(focal)
        sizes.append(size)
        poses.append(pose)
        bent.append(distortion)
    if not names:
        raise SceneError(
            "no camera is aligned",
            where=path,
            cause="exported before Workflow > Align Photos, or of another chunk",
            todo="align the photographs in Metashape and export the cameras again",
            topic="poses",
        )
    notes = [f"{len(loose)} photographs are not aligned in Metashape"] if loose else []
    return Listed("Metashape", names, np.array(K), sizes, np.stack(poses), bent, notes=notes)


def _component(component: ET.Element, path: Path) -> np.ndarray:
    """From the component's frame to the world's."""
    matrix = np.eye(4)
    rotation = component.findtext("transform/rotation")
    move, scale = component.findtext("transform/translation"), component.findtext("transform/scale")
    if rotation is not None:
        matrix[:3, :3] = _numbers(rotation, 9, "rotation of a component", path).reshape(3, 3)
    if scale is not None:
        matrix[:3, :3] *= _numbers(scale, 1, "scale of a component", path)[0]
    if move is not None:
        matrix[:3, 3] = _numbers(move, 3, "translation of a component", path)
    # Geographic chunks stand on the earth's surface, where pictures' frames lose their digits.
    return matrix


def _lens(sensor: ET.Element, path: Path) -> tuple[list[float], tuple[int, int], Distortion | None]:
    name = sensor.get("label") or "a sensor"
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise SceneError(
            f"the sensor {name} is of type {kind}",
            where=path,
            todo="use photographs of a frame camera",
            topic="lens",
        )
    resolution = sensor.find("resolution")
    adjusted = [c for c in sensor.iterfind("calibration") if c.get("class", "adjusted") == "adjusted"]
    calibration = adjusted[-1] if adjusted else sensor.find("calibration")
    if resolution is None or calibration is None:
        damaged(path, f"the sensor {name} has no resolution or no calibration", cause="it was not aligned")
    size = tuple(int(_numbers(resolution.get(k) or "", 1, k, path)[0]) for k in ("width", "height"))

    def term(key: str) -> float:
        text = calibration.findtext(key)
        return 0.0 if text is None else float(_numbers(text, 1, key, path)[0])

    focal = term("f") or term("fx")
    if abs(term("b2")) > _MOST_SKEW * focal:
        raise SceneError(
            f"the sensor {name} has skewed pixels",
            where=path,
            todo="calibrate without B1 and B2 in Metashape",
            topic="lens",
        )
    K = [focal + term("b1"), focal, size[0] / 2 + term("cx"), size[1] / 2 + term("cy")]
    if kind == "fisheye":
        terms = (term("k1"), term("k2"), term("k3"), term("k4"))
        return K, (size[0], size[1]), Distortion("OPENCV_FISHEYE", terms) if any(terms) else None
    if term("k4"):
        raise SceneError(
            f"the sensor {name} has a K4, which cannot be undistorted here",
            where=path,
            todo="optimise cameras in Metashape without K4, or export undistorted photographs",
            topic="lens",
        )
    four = (term("k1"), term("k2"), term("p2"), term("p1"))
    if term("k3"):
        bent = Distortion("FULL_OPENCV", (*four, term("k3"), 0.0, 0.0, 0.0))
    else:
        bent = Distortion("OPENCV", four)
    return K, (size[0], size[1]), None if bent.absent else bent


def _numbers(text: str, count: int, what: str, path: Path) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        damaged(path, f"{what} is no {count} numbers: {text[:60]!r}")
    return values
