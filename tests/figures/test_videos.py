"""Clips play as they were drawn: as many frames, as long, as large; a clip that fails leaves no file."""

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from visdom_plugin.figures.videos import name_codec, write_clip


def draw(count, size=(21, 33)):
    grey = np.linspace(20, 235, count).round().astype(np.uint8)
    frames = np.zeros((count, *size, 3), np.uint8) + grey[:, None, None, None]
    frames[:, :10, :10] = 255 - frames[:, :10, :10]
    return frames


@pytest.mark.parametrize("fps", [7, 24, 30, 50])
def test_a_gif_has_all_frames_and_lasts_as_long(tmp_path, fps):
    frames = draw(30)
    with write_clip(tmp_path / "clip.gif", fps) as add:
        for frame in frames:
            add(frame)
    assert name_codec(tmp_path / "clip.gif") == "gif"
    with Image.open(tmp_path / "clip.gif") as clip:
        assert clip.info["loop"] == 0
        seen = [(np.asarray(f.convert("RGB")), f.info["duration"]) for f in ImageSequence.Iterator(clip)]
    assert len(seen) == len(frames)
    for (picture, _), frame in zip(seen, frames, strict=True):
        assert np.abs(picture.astype(int) - frame).max() <= 2
    assert sum(ms for _, ms in seen) == pytest.approx(1000 * len(frames) / fps, abs=6)


@pytest.mark.parametrize("own", [True, False])
def test_an_mp4_has_all_frames_with_or_without_the_extra(tmp_path, own, monkeypatch):
    import sys

    if own:
        pytest.importorskip("av")
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    path = tmp_path / "clip.mp4"
    with write_clip(path, 10) as add:
        for frame in draw(12):
            add(frame)
    assert name_codec(path) == ("h264" if own else "mp4v")
    video, count = cv2.VideoCapture(str(path)), 0
    while (read := video.read())[0]:
        # An odd last row and column is repeated.
        assert (
            read[1].shape == (22, 34, 3) and abs(int(read[1][-1, -1, 0]) - int(draw(12)[count, 0, -1, 0])) < 9
        )
        count += 1
    assert count == 12 and video.get(cv2.CAP_PROP_FPS) == pytest.approx(10)


@pytest.mark.parametrize("name", ["clip.gif", "clip.mp4"])
def test_a_clip_that_fails_leaves_nothing(tmp_path, name):
    with pytest.raises(ValueError, match="no more"), write_clip(tmp_path / name, 10) as add:
        add(draw(1)[0])
        raise ValueError("no more")
    assert not list(tmp_path.iterdir())
