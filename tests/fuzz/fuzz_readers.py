"""Damages valid files of every reader and watches what the reader does.

    python -m tests.fuzz.fuzz_readers [--cases 100000] [--seed 0] [--only NAME] [--case I]

Allowed are a result or a SceneError. Everything else, more than a second of one case, and more memory than the
file's size warrants (measured on every 50th case) is a failure, and is printed with the case's number: case I of a
reader is a pure function of the seed, so that --only NAME --case I repeats it.
"""

from __future__ import annotations

import argparse
import io
import random
import sys
import tempfile
import time
import traceback
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from datamodules.files import colmap_model, colmap_points, images, masks
from datamodules.layouts import actorshq, llff, transforms
from datamodules.request import Request
from datamodules.synthetic.config import SyntheticConfig
from datamodules.synthetic.scene import make_scene
from datamodules.views import splits
from tests.datamodules.layouts import layout_writers as w
from tests.fuzz.mutate import damage, damage_json, damage_png
from visdom_plugin.errors import SceneError

NOWHERE = Path("/nonexistent/scene")
SECONDS = 1.0
# Python objects of a text of numbers take some 60 bytes per character of JSON such as [[[]]]; decoded pictures
# may be 1032 times their compressed size, with three channels and a copy.
BYTES_EACH, BYTES_FREE = 200, 3 * 2**20


@dataclass(frozen=True)
class Reader:
    """One entrance for strangers' bytes."""

    files: list[bytes]
    """Valid ones."""
    read: Callable[[bytes], object]
    mutate: Callable[[bytes, random.Random, list[bytes]], bytes] = damage
    bytes_each: float = BYTES_EACH


def make_readers(root: Path) -> dict[str, Reader]:
    """Readers with valid files of a small scene, which is written to `root` and must stay there."""
    scene = make_scene(SyntheticConfig(size=(24, 16), train_views=3, test_views=1))
    views = w.join(scene.train, scene.test)
    w.write_colmap(views, root / "bin")
    w.write_colmap(views, root / "txt", binary=False)
    w.write_nerfstudio(views, root / "studio")
    w.write_instant_ngp(views, root / "ngp")
    w.write_actorshq(views, root / "actor")
    w.write_poses_bounds(views, root / "poses.npy")
    model = colmap_model.read_model(root / "bin", "sparse/0")

    def of(*names: str) -> list[bytes]:
        return [(root / n).read_bytes() for n in names]

    cameras_bin, images_bin = of("bin/sparse/0/cameras.bin", "bin/sparse/0/images.bin")
    cameras_txt, images_txt = of("txt/sparse/0/cameras.txt", "txt/sparse/0/images.txt")
    jsons = of("studio/transforms.json", "ngp/transforms.json")
    poses, table = of("poses.npy", "actor/1x/calibration.csv")
    (boxes,) = of("actor/aabbs.csv")
    picture = views.images[0].numpy()[..., ::-1]
    alpha = np.concatenate([picture, views.masks[0].numpy()[..., None].astype(np.uint8) * 255], -1)
    pngs = [_encode(".png", a) for a in (picture, alpha, picture.astype(np.uint16) * 257, alpha[..., 3])]
    jpegs = [
        _encode(".jpg", picture),
        cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes(),
    ]

    def read_cameras(parse):
        def read(data: bytes):
            found = parse(data, NOWHERE)
            image = model.images[0]
            for camera_id in list(found)[:8]:
                one = colmap_model.Registered(image.name, image.quaternion, image.translation, camera_id)
                colmap_model.cameras_of(colmap_model.Model(NOWHERE, found, (one,)), [one])

        return read

    def read_images(parse):
        def read(data: bytes):
            found = parse(data, NOWHERE)
            colmap_model.cameras_of(colmap_model.Model(NOWHERE, model.cameras, tuple(found)), found)

        return read

    def read_transforms(data: bytes):
        file = transforms.parse_transforms(data, NOWHERE / "transforms.json")
        capture = transforms.make_capture(root / "ngp", Request(), "nerfstudio", [file])
        capture.calibrate(range(len(capture.frames)))

    def read_poses(data: bytes):
        rows = llff.parse_poses_bounds(data, NOWHERE)
        llff.cameras_of(rows, [str(i) for i in range(len(rows))], NOWHERE)

    def read_picture(data: bytes):
        width, height = images.read_header(data, NOWHERE).size
        picture = images.decode_photograph(data, NOWHERE)
        if picture.shape != (height, width, 3):
            raise AssertionError(f"the header says {width} x {height}, decoded are {picture.shape}")

    def read_mask(data: bytes):
        images.read_header(data, NOWHERE)
        masks.decode_mask(data, NOWHERE)

    def read_table(data: bytes):
        actorshq.cameras_of(actorshq.parse_calibration(data, NOWHERE), NOWHERE)

    def with_points(text: bool) -> bytes:
        rows = [(i, 0.1 * i, -1.0, 2.5, 9, 99, 200, 0.5, i % 4) for i in range(1, 9)]
        return write_points(rows, text)

    points_bin, points_txt = with_points(False), with_points(True)
    return {
        "cameras.bin": Reader([cameras_bin], read_cameras(colmap_model.parse_cameras_binary)),
        "images.bin": Reader([images_bin], read_images(colmap_model.parse_images_binary)),
        "points3D.bin": Reader([points_bin], lambda d: colmap_points.parse_points_binary(d, NOWHERE)),
        "cameras.txt": Reader([cameras_txt], read_cameras(colmap_model.parse_cameras_text)),
        "images.txt": Reader([images_txt], read_images(colmap_model.parse_images_text)),
        "points3D.txt": Reader([points_txt], lambda d: colmap_points.parse_points_text(d, NOWHERE)),
        "transforms.json": Reader(jsons, read_transforms, damage_json),
        "poses_bounds.npy": Reader([poses], read_poses),
        "calibration.csv": Reader([table], read_table),
        "aabbs.csv": Reader([boxes], lambda d: actorshq.parse_boxes(d, NOWHERE)),
        "sparse_N.txt": Reader([b"0\n3\n2\n", b"1 2"], lambda d: splits.parse_positions(d, 4, NOWHERE)),
        "photograph, PNG": Reader(pngs, read_picture, damage_png, bytes_each=25000),
        "photograph, JPEG": Reader(jpegs, read_picture, bytes_each=5000),
        "mask, PNG": Reader(pngs, read_mask, damage_png, bytes_each=50000),
    }  # fmt: skip


def write_points(rows: list[tuple], text: bool) -> bytes:
    """points3D of rows (id, x, y, z, r, g, b, error, track length)."""
    import struct

    if text:
        lines = [" ".join(map(str, row[:8])) + " 1 2" * row[8] for row in rows]
        return ("# comment\n" + "\n".join(lines) + "\n").encode()
    out = io.BytesIO()
    out.write(struct.pack("<Q", len(rows)))
    for point_id, x, y, z, r, g, b, error, track in rows:
        out.write(struct.pack("<Q3d3BdQ", point_id, x, y, z, r, g, b, error, track))
        out.write(struct.pack("<II", 1, 2) * track)
    return out.getvalue()


def _encode(ending: str, picture: np.ndarray, *options: int) -> bytes:
    return cv2.imencode(ending, np.ascontiguousarray(picture), options)[1].tobytes()


def make_case(name: str, reader: Reader, index: int, seed: int) -> bytes:
    """The damaged file of one case."""
    draw = random.Random(f"{seed}/{name}/{index}")
    return reader.mutate(draw.choice(reader.files), draw, reader.files)


def judge(reader: Reader, data: bytes, measure: bool) -> tuple[bool, float, str | None]:
    """Whether the file was accepted, the seconds it took, and what was wrong with the reader's conduct."""
    fault, accepted = None, False
    if measure:
        tracemalloc.start()
    start = time.thread_time()
    try:
        reader.read(data)
        accepted = True
    except SceneError as error:
        if not error.what or error.where is None:
            fault = f"a message that says too little: {error}"
    except BaseException:
        fault = traceback.format_exc(limit=-4)
    seconds = time.thread_time() - start
    if measure:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        if peak > BYTES_FREE + reader.bytes_each * len(data):
            fault = f"{peak} bytes of memory for a file of {len(data)}"
    elif seconds > SECONDS:
        fault = f"{seconds:.1f} s"
    return accepted, seconds, fault


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only")
    parser.add_argument("--case", type=int)
    options = parser.parse_args()
    torch.set_num_threads(1)  # waking a second thread costs more than these tiny tensors
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        return run(make_readers(Path(folder)), options)


def run(readers: dict[str, Reader], options: argparse.Namespace) -> int:
    """Prints the table; 1 when anything failed."""
    failures = 0
    print(
        "| reader | cases | read | refused | slowest, ms | failures |\n| --- | --- | --- | --- | --- | --- |"
    )
    for name, reader in readers.items():
        if options.only not in (None, name):
            continue
        for data in reader.files:
            reader.read(data)
        accepted, slowest, faults = 0, 0.0, 0
        cases = range(options.cases) if options.case is None else [options.case]
        for i in cases:
            fine, seconds, fault = judge(reader, make_case(name, reader, i, options.seed), i % 50 == 0)
            accepted, slowest = accepted + fine, max(slowest, seconds)
            if fault is not None:
                faults += 1
                if faults <= 5:
                    print(f"{name}, case {i}: {fault}", file=sys.stderr, flush=True)
        refused = len(cases) - accepted - faults
        print(
            f"| {name} | {len(cases)} | {accepted} | {refused} | {1e3 * slowest:.1f} | {faults} |", flush=True
        )
        failures += faults
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
