"""Clips of rendered frames as files: mp4 and GIF."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from visdom_plugin.atomic_files import appearing

SUFFIXES = (".mp4", ".gif")
GIF_FPS = 50
"""Frames per second of a GIF at most: browsers slow faster ones down to ten."""
AddFrame = Callable[[np.ndarray], None]
"""Takes the next frame, (H, W, 3) uint8; all are of one size."""


def name_codec(path: Path) -> str:
    """What `write_clip` will write: gif, h264 where PyAV is there, or mp4v."""
    return "gif" if path.suffix.lower() == ".gif" else "mp4v" if _find_av() is None else "h264"


@contextmanager
def write_clip(path: Path, fps: int) -> Iterator[AddFrame]:
    """Writes a clip by its ending; it appears when the block ends, or not at all where that raises.

    H.264 wants even sizes: an odd last row or column is repeated.
    """
    writers = {"gif": _write_gif, "h264": _write_h264, "mp4v": _write_mpeg4}
    with appearing(path) as part, writers[name_codec(path)](part, fps) as add:
        yield add


def _find_av():
    try:
        import av
    except ImportError:
        return None
    return av


def _make_even(frame: np.ndarray) -> np.ndarray:
    h, w = frame.shape[:2]
    return np.pad(frame, ((0, h % 2), (0, w % 2), (0, 0)), mode="edge")


@contextmanager
def _write_h264(path: Path, fps: int) -> Iterator[AddFrame]:
    av = _find_av()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "18"})
        stream.pix_fmt = "yuv420p"

        def add(frame: np.ndarray) -> None:
            frame = _make_even(frame)
            if not stream.codec_context.is_open:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))

        yield add
        container.mux(stream.encode())


@contextmanager
def _write_mpeg4(path: Path, fps: int) -> Iterator[AddFrame]:
    import cv2

    writer = cv2.VideoWriter()

    def add(frame: np.ndarray) -> None:
        frame = _make_even(frame)
        size = frame.shape[1], frame.shape[0]
        if not writer.isOpened() and not writer.open(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size):
            raise OSError(f"OpenCV could not open {path} for video")
        writer.write(np.ascontiguousarray(frame[..., ::-1]))

    try:
        yield add
    finally:
        writer.release()


@contextmanager
def _write_gif(path: Path, fps: int) -> Iterator[AddFrame]:
    from PIL import Image

    frames: list[Image.Image] = []

    def add(frame: np.ndarray) -> None:
        picture = Image.fromarray(np.ascontiguousarray(frame))
        frames.append(picture.convert("P", palette=Image.Palette.ADAPTIVE, colors=256))

    yield add
    # GIF counts hundredths of a second: rounded so that the whole lasts as long as it should.
    ends = [10 * round(100 * (i + 1) / fps) for i in range(len(frames))]
    lasting = [b - a for a, b in zip([0, *ends], ends, strict=False)]
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=lasting, loop=0, disposal=1
    )
