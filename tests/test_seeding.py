"""A generator is a function of its arguments, and nothing else."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from visdom_plugin.seeding import generator


def _draw(*key) -> tuple[float, ...]:
    return tuple(torch.rand(3, generator=generator(*key)).tolist())


def test_equal_arguments_draw_equal_numbers_whatever_was_drawn_before():
    first = _draw(1, "step", 7)
    torch.manual_seed(5)
    _draw(2)
    assert _draw(1, "step", 7) == first
    assert _draw(np.int64(1), "step", np.int32(7)) == first


def test_different_arguments_draw_different_numbers():
    keys = [
        (0,),
        (1,),
        (-1,),
        (2**40,),
        (0, 0),
        (0, "0"),
        (0, 1, 2),
        (0, 12),
        (0, "a", "b"),
        (0, "ab"),
        (0, "a;b"),
    ]
    drawn = [_draw(*key) for key in keys]
    assert all(a != b for a, b in itertools.combinations(drawn, 2))


def test_streams_look_uniform_across_steps():
    first = torch.tensor([_draw(0, "step", i)[0] for i in range(2000)])
    assert abs(float(first.mean()) - 0.5) < 4 / (12 * 2000) ** 0.5
    assert abs(float(torch.corrcoef(torch.stack([first[1:], first[:-1]]))[0, 1])) < 0.1


def test_a_stream_of_something_else_is_refused():
    with pytest.raises(TypeError, match=r"1\.5"):
        generator(0, 1.5)
