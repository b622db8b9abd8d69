"""Opening a 48-view scene for 4 training views, against decoding everything one after another; and reading a
large COLMAP model, against unpacking it number by number.

    python benchmarks/system/load_scene.py [--data DIR] [--views 4] [--downscale 1] [--repeat 7]

Without --data a scene of 48 photographs of 800 x 800 is written to a temporary folder (half PNG, half JPEG), and
a model of 300 images with 2000 points each and 200,000 points in space. Ratios are against the reference of the
same run, minimum over the repeats.
"""

from __future__ import annotations

import argparse
import struct
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from datamodules import load
from datamodules.files import colmap_model, colmap_points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--downscale", type=float, default=1)
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.data or write_scene(Path(temporary))
        arguments = {"views": options.views, "downscale": options.downscale}
        load(folder, **arguments)
        serial = fastest(lambda: decode_everything(folder), options.repeat)
        whole = fastest(lambda: load(folder, **arguments), options.repeat)
        train = fastest(lambda: load(folder, test=False, **arguments), options.repeat)
        scene = load(folder, **arguments)
    count = len(list((folder / "images").iterdir())) if options.data else 48
    both = f"{len(scene.train)} train and {len(scene.test)} test views opened"
    only = f"{len(scene.train)} train views opened (test=False)"
    for label, seconds in ((f"{count} views decoded serially", serial), (both, whole), (only, train)):
        print(f"{label:40s} {1e3 * seconds:8.1f} ms  {serial / seconds:5.1f} x")
    report_model(options.repeat)
    start = time.perf_counter()
    load(None)
    first = time.perf_counter() - start
    again = fastest(lambda: load(None), options.repeat)
    print(f"built-in scene, first call {first:.2f} s, again {again:.2f} s")


def fastest(work, repeat: int) -> float:
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def decode_everything(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir()):
        cv2.imread(str(path))
        cv2.imread(str(folder / "masks" / f"{path.stem}.png"), cv2.IMREAD_GRAYSCALE)


def write_scene(folder: Path, count: int = 48, width: int = 800, height: int = 800) -> Path:
    """A ring of cameras with photographs of smooth noise: sizes on disk are like those of real ones."""
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    draw = np.random.default_rng(0)
    lines = []
    for i in range(count):
        coarse = draw.integers(0, 256, (60, 80, 3)).astype(np.uint8)
        photograph = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        name = f"{i:03d}.{'png' if i % 2 else 'jpg'}"
        cv2.imwrite(str(folder / "images" / name), photograph)
        mask = np.zeros((height, width), np.uint8)
        cv2.circle(mask, (width // 2, height // 2), height // 3, 255, -1)
        cv2.imwrite(str(folder / "masks" / f"{i:03d}.png"), mask)
        half = np.pi * i / count
        lines.append(f"{i + 1} {np.cos(half)} 0 {np.sin(half)} 0 0 0 4 1 {name}\n\n")
    (folder / "sparse/0/cameras.txt").write_text(
        f"1 PINHOLE {width} {height} 900 900 {width / 2} {height / 2}\n"
    )
    (folder / "sparse/0/images.txt").write_text("".join(lines))
    (folder / "sparse_4.txt").write_text("0\n12\n24\n36\n")
    (folder / "sparse_test.txt").write_text("\n".join(str(3 * i + 1) for i in range(16)))
    return folder


def report_model(repeat: int) -> None:
    """Times the readers of a binary model."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_model(folder)

        def read():
            model = colmap_model.read_model(folder, "")
            colmap_model.cameras_of(model, model.images)

        plain = fastest(lambda: unpack_points(folder / "points3D.bin"), min(repeat, 3))
        seconds = {
            "points3D.bin, number by number": plain,
            "cameras and images of 300 photographs": fastest(read, repeat),
            "200,000 points": fastest(lambda: colmap_points.read_points(folder, "points3D.bin"), repeat),
        }
    for label, value in seconds.items():
        print(f"{label:40s} {1e3 * value:8.1f} ms  {plain / value:5.1f} x")


def write_model(folder: Path, images: int = 300, seen: int = 2000, points: int = 200_000) -> None:
    """A model of one camera, in binary."""
    draw = np.random.default_rng(0)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 800, 600, 700, 700, 400, 300))
    parts = [struct.pack("<Q", images)]
    for i in range(images):
        parts.append(struct.pack("<I7dI", i, 1, 0, 0, 0, 0.1 * i, 0, 4, 1) + f"{i:05d}.jpg".encode() + b"\0")
        parts.append(struct.pack("<Q", seen) + draw.bytes(24 * seen))
    (folder / "images.bin").write_bytes(b"".join(parts))
    parts = [struct.pack("<Q", points)]
    for i in range(points):
        track = 2 + i % 6
        parts.append(struct.pack("<Q3d3BdQ", i, 0.1, 0.2, 0.3, 1, 2, 3, 0.5, track) + bytes(8 * track))
    (folder / "points3D.bin").write_bytes(b"".join(parts))


def unpack_points(path: Path) -> list[tuple]:
    """The obvious reader."""
    found = []
    with path.open("rb") as file:
        (count,) = struct.unpack("<Q", file.read(8))
        for _ in range(count):
            row = struct.unpack("<Q3d3BdQ", file.read(51))
            found.append((row, struct.unpack(f"<{2 * row[-1]}I", file.read(8 * row[-1]))))
    return found


if __name__ == "__main__":
    main()
