"""Laws of the canvas: pixels stay, words appear in any script, and nothing overlaps."""

import warnings

import numpy as np
import pytest

from visdom_plugin.figures.canvas import Canvas
from visdom_plugin.figures.contact_sheet import SHEET_WIDTH_PX, draw_sheet


@pytest.mark.parametrize("size", [(1, 1), (49, 57), (333, 777), (115, 229), (721, 1163)])
def test_pasted_pixels_are_there_as_they_were(size):
    picture = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    canvas = Canvas(size[0] + 7, size[1] + 12, 24)
    canvas.paste(picture, 5, 3)
    drawn = canvas.draw()
    assert drawn.shape == canvas.pixels.shape and (drawn == canvas.pixels).all()
    assert (drawn[3 : 3 + size[0], 5 : 5 + size[1]] == picture).all()


def written(text, **options):
    """What a line of text makes of a grey canvas: (40, 400) bool."""
    canvas = Canvas(40, 400, 224)
    canvas.write(text, 10, 25, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return (canvas.draw() != 224).any(-1)


def test_words_are_not_question_marks():
    """Names outside ASCII used to be printed as `?`, and all alike."""
    names = ["Überall_写真", "????????_??", "Uberall_??", "Ωμέγα", "Снимок", "é\udcff", "$x_1$", "x_1"]
    drawn = [written(name) for name in names]
    assert all(ink.any() for ink in drawn)
    assert len({ink.tobytes() for ink in drawn}) == len(names)


def test_words_stand_where_they_are_written():
    ink = np.argwhere(written("HH"))
    assert ink[:, 0].max() == 24 and 10 <= ink[:, 1].min() <= 12


def test_long_words_lose_their_beginning():
    one, other = (written(f"{head * 40}{'x' * 40}_0001.png", width=150) for head in "AB")
    assert (one == other).all()
    assert (one != written(f"{'A' * 40}{'x' * 40}_0002.png", width=150)).any()
    assert np.argwhere(one)[:, 1].max() <= 160 < np.argwhere(written("A" * 40))[:, 1].max()


def test_titles_of_a_sheet_stay_in_their_column():
    picture = np.full((8, SHEET_WIDTH_PX, 3), 224, np.uint8)
    sheet = draw_sheet([("写" * 60, [picture]), ("", [picture])], ["r"])
    margin = sheet.shape[1] - 2 * (SHEET_WIDTH_PX + 4)
    assert (sheet[:, margin : margin + SHEET_WIDTH_PX] != 224).any()
    assert (sheet[:, margin + SHEET_WIDTH_PX :] == 224).all()
