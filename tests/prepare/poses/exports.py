"""Writers of other programs' pose files, by their documentation: from true cameras to an export."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


class True_(NamedTuple):
    """One camera as the sensor has it: photographs turned by EXIF are not turned here."""

    name: str
    pose: np.ndarray
    """(4, 4) camera to world, OpenCV axes."""
    focal: float
    size: tuple[int, int]


def metashape(path: Path, cameras: list[True_], radial=(0.0, 0.0), tangential=(0.0, 0.0)) -> None:
    """Two components' worth of indirection: the chunk's frame is another one than the world's."""
    turn = Rotation.from_euler("xyz", [20, 40, 60], degrees=True).as_matrix()
    scale, move = 2.5, np.array([1.0, -2.0, 3.0])
    w, h = cameras[0].size
    rows = []
    for i, c in enumerate(cameras):
        inner = np.eye(4)
        inner[:3, :3] = turn.T @ c.pose[:3, :3]
        inner[:3, 3] = turn.T @ (c.pose[:3, 3] - move) / scale
        text = " ".join(f"{x:.12g}" for x in inner.ravel())
        rows.append(
            f'<camera id="{i}" sensor_id="0" component_id="0" label="{c.name.rpartition(".")[0]}">'
            f"<transform>{text}</transform></camera>"
        )
    rows.append('<camera id="99" sensor_id="0" label="not_aligned"/>')
    numbers = " ".join(f"{x:.12g}" for x in turn.ravel())
    # Metashape's P1 stands where OpenCV has p2.
    path.write_text(
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        f'<sensor id="0" label="phone" type="frame"><resolution width="{w}" height="{h}"/>'
        f'<calibration type="frame" class="initial"><f>1</f></calibration>'
        f'<calibration type="frame" class="adjusted"><f>{cameras[0].focal}</f><cx>3.5</cx><cy>-2.25</cy>'
        f"<k1>{radial[0]}</k1><k2>{radial[1]}</k2><p1>{tangential[1]}</p1><p2>{tangential[0]}</p2></calibration>"
        f'</sensor></sensors><components><component id="0"><transform><rotation>{numbers}</rotation>'
        f"<translation>{' '.join(map(str, move))}</translation><scale>{scale}</scale></transform></component>"
        f"</components><cameras>{''.join(rows)}</cameras></chunk></document>"
    )


def realityscan_csv(path: Path, cameras: list[True_]) -> None:
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for c in cameras:
        gl = (c.pose @ FLIP)[:3, :3]
        # heading about z, then pitch about x, then roll about y, each about the turned axes.
        yaw, pitch, roll = Rotation.from_matrix(gl).as_euler("ZXY", degrees=True)
        x, y, z = c.pose[:3, 3]
        f = c.focal * 36 / max(c.size)
        lines.append(f"{c.name},{x},{y},{z},{-yaw},{pitch},{roll},{f},0,0,0,0,0,0,0,0")
    path.write_text("\n".join(lines) + "\n")


def realityscan_xmp(folder: Path, cameras: list[True_]) -> None:
    folder.mkdir()
    for c in cameras:
        rotation = " ".join(f"{x:.12g}" for x in c.pose[:3, :3].T.ravel())
        f = c.focal * 36 / max(c.size)
        (folder / f"{c.name.rpartition('.')[0]}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:DistortionModel="perspective" '
            f'xcr:FocalLength35mm="{f}" xcr:PrincipalPointU="0" xcr:PrincipalPointV="0" '
            f'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation>{rotation}</xcr:Rotation>'
            f"<xcr:Position>{' '.join(map(str, c.pose[:3, 3]))}</xcr:Position>"
            "<xcr:DistortionCoeficients>0 0 0 0 0 0</xcr:DistortionCoeficients></rdf:Description></rdf:RDF>"
            "</x:xmpmeta>"
        )


def record3d(path: Path, cameras: list[True_]) -> None:
    poses = [
        [*Rotation.from_matrix((c.pose @ FLIP)[:3, :3]).as_quat().tolist(), *c.pose[:3, 3].tolist()]
        for c in cameras
    ]
    w, h = cameras[0].size
    K = [cameras[0].focal, 0, 0, 0, cameras[0].focal, 0, w / 2, h / 2, 1]
    path.write_text(json.dumps({"poses": poses, "K": K, "w": w, "h": h, "fps": 60}))


def polycam(folder: Path, cameras: list[True_]) -> None:
    inner = folder / "keyframes" / "corrected_cameras"
    inner.mkdir(parents=True)
    for c in cameras:
        gl = c.pose @ FLIP
        content = {f"t_{r}{k}": gl[r, k] for r in range(3) for k in range(4)}
        content |= {"fx": c.focal, "fy": c.focal, "cx": c.size[0] / 2, "cy": c.size[1] / 2}
        content |= {"width": c.size[0], "height": c.size[1], "blur_score": 100}
        (inner / f"{c.name.rpartition('.')[0]}.json").write_text(json.dumps(content))


def scanner(folder: Path, cameras: list[True_]) -> None:
    folder.mkdir()
    for c in cameras:
        K = [c.focal, 0, c.size[0] / 2, 0, c.focal, c.size[1] / 2, 0, 0, 1]
        content = {"cameraPoseARFrame": (c.pose @ FLIP).ravel().tolist(), "intrinsics": K, "frame_index": 1}
        (folder / f"{c.name.rpartition('.')[0]}.json").write_text(json.dumps(content))
    (folder / "info.json").write_text(json.dumps({"device": "a phone"}))


def vggt(path: Path, cameras: list[True_], *, images: bool = True, pad: bool = False) -> None:
    """The network's own copy: 518 wide and a multiple of 14 high, or padded with white to 518 x 518."""
    w, h = cameras[0].size
    scale = 518 / max(w, h) if pad else 518 / w
    high = 518 if pad else round(h * scale / 14) * 14
    K = np.zeros((len(cameras), 3, 3), np.float32)
    K[:, 0, 0] = cameras[0].focal * scale
    K[:, 1, 1] = cameras[0].focal * (scale if pad else high / h)
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = 259, high / 2, 1
    pictures = np.full((len(cameras), 3, high, 518), 0.4, np.float32)
    if pad:
        rows = (518 - round(h * scale)) // 2
        pictures[:, :, :rows] = pictures[:, :, -rows:] = 1.0
    arrays = {
        "extrinsic": np.stack([np.linalg.inv(c.pose)[:3] for c in cameras]).astype(np.float32),
        "intrinsic": K,
    }
    np.savez(path, **arrays, **({"images": pictures} if images else {}))


def pi3(path: Path, cameras: list[True_]) -> None:
    w, h = cameras[0].size
    wide, high = 224, round(224 * h / w / 14) * 14
    focal = cameras[0].focal * wide / w
    v, u = np.mgrid[:high, :wide] + 0.5
    z = 0.4 + 0.1 * np.sin(u / 30)
    # Rows were squeezed to a multiple of 14.
    points = np.stack([(u - wide / 2) / focal * z, (v - high / 2) / (focal * high * w / wide / h) * z, z], -1)
    np.savez(
        path,
        camera_poses=np.stack([c.pose for c in cameras]).astype(np.float32),
        local_points=np.stack([points] * len(cameras)).astype(np.float32),
    )


def dust3r(path: Path, cameras: list[True_]) -> None:
    w, h = cameras[0].size
    wide, high = 512, round(512 * h / w / 16) * 16
    path.write_text(
        json.dumps(
            {
                "cams2world": [c.pose.tolist() for c in cameras],
                "focals": [cameras[0].focal * wide / w] * len(cameras),
                "image_size": [high, wide],
                "image_names": [f"/somewhere/{c.name}" for c in cameras],
            }
        )
    )


def transforms(path: Path, cameras: list[True_]) -> None:
    frames = [
        {
            "file_path": f"images/{c.name}", "fl_x": c.focal, "fl_y": c.focal, "cx": c.size[0] / 2,
            "cy": c.size[1] / 2, "w": c.size[0], "h": c.size[1], "transform_matrix": (c.pose @ FLIP).tolist(),
        }
        for c in cameras
    ]  # fmt: skip
    path.write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))


def colmap(folder: Path, cameras: list[True_]) -> None:
    folder.mkdir(parents=True)
    w, h = cameras[0].size
    (folder / "cameras.txt").write_text(
        f"1 PINHOLE {w} {h} {cameras[0].focal} {cameras[0].focal} {w / 2} {h / 2}\n"
    )
    lines = []
    for i, c in enumerate(cameras, start=1):
        world = np.linalg.inv(c.pose)
        x, y, z, q = Rotation.from_matrix(world[:3, :3]).as_quat()
        numbers = " ".join(map(str, (q, x, y, z, *world[:3, 3])))
        lines.append(f"{i} {numbers} 1 {c.name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")
