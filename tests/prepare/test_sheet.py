"""The sheet of a prepared scene: masks can be judged on it, whatever the photographs' colours and shapes."""

import numpy as np
import pytest

from visdom_plugin.prepare.sheet import _CELL, _OUTLINES, _draw_object, draw_outlines


def photograph(height, width, colour, top, left, size):
    """A grey photograph with a square of a colour, and its mask."""
    image = np.full((height, width, 3), 110, np.uint8)
    mask = np.zeros((height, width), bool)
    mask[top : top + size, left : left + size] = True
    image[mask] = colour
    return image, mask


@pytest.mark.parametrize("colour", _OUTLINES)
@pytest.mark.parametrize(("top", "left"), [(300, 500), (0, 0), (560, 740)])
def test_a_small_object_is_drawn_large_and_its_outline_is_seen(colour, top, left):
    picture = _draw_object(*photograph(600, 800, colour, top, left, 40))
    assert max(picture.shape[:2]) == _CELL
    share = float((np.abs(picture.astype(int) - colour).sum(-1) < 60).mean())
    assert 0.2 < share < 0.6  # of the whole photograph it has 1 in 300
    drawn = {c: int((np.abs(picture.astype(int) - c).sum(-1) < 60).sum()) for c in _OUTLINES if c != colour}
    assert max(drawn.values()) > 2 * _CELL * 0.35  # two sides of the square at least, also at the border


def test_the_whole_photograph_is_in_the_corner_that_hides_least_of_the_object():
    image, mask = photograph(400, 400, (255, 214, 0), 150, 150, 100)
    mask[100:200, 100:200] = True  # the object reaches into the upper left corner
    image[:5] = (10, 20, 30)
    picture = _draw_object(image, mask)
    line = (np.abs(picture.astype(int) - (10, 20, 30)).sum(-1) < 30).nonzero()
    assert len(line[0]) > 50  # the photograph's upper border, which the crop does not reach
    assert line[0].min() > _CELL / 2 or line[1].min() > _CELL / 2


def test_photographs_of_any_shape_and_masks_that_are_missing_or_empty_fill_one_grid():
    views = [
        photograph(300, 400, (255, 0, 0), 100, 100, 50),
        photograph(400, 300, (0, 0, 255), 100, 100, 50),
        (np.full((300, 400, 3), 200, np.uint8), None),
        (np.full((200, 900, 3), 200, np.uint8), np.zeros((200, 900), bool)),
    ]
    sheet = draw_outlines(*zip(*views, strict=True), names=list("abcd"), said=["mask: given"] * 4)
    assert sheet.shape[1] == 3 * (_CELL + 6) + 6 and sheet.shape[0] < 2 * (_CELL + 50)
