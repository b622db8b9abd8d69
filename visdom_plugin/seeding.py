"""Random numbers without global state: a generator is a pure function of the seed and of what it is for."""

from __future__ import annotations

import hashlib

import torch
from torch import Generator, Tensor


def generator(seed: int, *stream: int | str) -> Generator:
    """A CPU generator for one purpose, e.g. `generator(seed, "virtual-views", step)`.

    Equal arguments give equal numbers in any process and on any machine, so that a step repeated after a
    resume draws what it drew before. Different arguments give unrelated numbers; the text "1" and the
    number 1 are different.

    Args:
        seed: the run's seed, any integer.
        stream: what the numbers are for: names, step numbers, view indices.

    Raises:
        TypeError: for a part of the stream that is neither text nor an integer.
    """
    digest = hashlib.blake2b(digest_size=8)
    for part in (seed, *stream):
        if isinstance(part, str):
            text = f"s{len(part)}:{part}"
        elif hasattr(part, "__index__"):
            text = f"i{part.__index__()};"
        else:
            raise TypeError(f"a random stream is named by text and integers, not by {part!r}")
        digest.update(text.encode())
    return Generator().manual_seed(int.from_bytes(digest.digest(), "little"))


EVERYWHERE_ALIKE = False
"""Whether all devices draw the CPU's numbers, so that they can be compared. Drawing many is slow then."""


def draw_on(device: torch.device, generator: Generator) -> Generator:
    """The generator for many numbers that are wanted on a device; see `uniform`.

    The one given where it is the CPU. On CUDA one of the device's own, started by the next number of the one
    given: its numbers are others than the CPU's, and as much a function of the seed.
    """
    if device.type != "cuda" or EVERYWHERE_ALIKE:
        return generator
    return Generator(device).manual_seed(int(torch.randint(1 << 62, (), generator=generator)))


def uniform(generator: Generator, device: torch.device, *shape: int) -> Tensor:
    """Float32 numbers in [0, 1) on a device, drawn where the generator is."""
    return torch.rand(shape, generator=generator, device=generator.device).to(device)
