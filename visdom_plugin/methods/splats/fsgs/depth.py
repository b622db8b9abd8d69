"""What FSGS holds rendered depth to: monocular depth of the photographs, and a network for pictures it draws."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from typing import NamedTuple

import torch
from torch import Tensor

from visdom_plugin.errors import ConfigError, SceneError, list_some
from visdom_plugin.scene import Views

Network = Callable[[Tensor], Tensor]
"""(H, W, 3) float32 in [0, 1] to (H, W) disparity: larger is nearer."""
DISPARITY_OFFSET = 0.2
"""Added to a network's disparity before its reciprocal is taken, in means of the picture. FSGS adds 200 to what
its network says, whose numbers have a unit of their own."""
OPAQUE = 0.5
"""Pixels of less opacity have no depth to speak of."""

log = logging.getLogger(__name__)


class MonoDepth(NamedTuple):
    """Monocular depth of one photograph."""

    forms: Tensor
    """(2, H, W): two readings of it, both growing with the distance. A render need agree with one of them."""
    known: Tensor
    """(H, W) float32, 1 where there is a depth, else 0."""


def pearson(first: Tensor, second: Tensor, weight: Tensor) -> Tensor:
    """Pearson correlation over pixels, a scalar in [-1, 1]; 0 where one of the two does not vary.

    Args:
        first, second: (...) of about the size of 1: what varies by less than 1e-6 counts as constant.
        weight: (...) of at least 0.
    """
    share = weight / weight.sum().clamp_min(1e-6)
    first, second = (x - (share * x).sum() for x in (first, second))

    def spread(x: Tensor) -> Tensor:
        return (share * x.square()).sum().clamp_min(1e-12).sqrt()

    return (share * first * second).sum() / (spread(first) * spread(second))


def of_map(depth: Tensor) -> MonoDepth:
    """From a map of depth (H, W) in any unit, 0 or less where unknown."""
    known = depth > 0
    depth = depth / torch.where(known, depth, 0).sum().clamp_min(1e-12) * known.sum().clamp_min(1)
    depth = torch.where(known, depth, 1)
    return MonoDepth(torch.stack([depth, -1 / depth]), known.float())


def of_disparity(disparity: Tensor) -> MonoDepth:
    """From a network's disparity (H, W) in any unit."""
    disparity = disparity / disparity.abs().mean().clamp_min(1e-12)
    reciprocal = 1 / (disparity.clamp_min(0) + DISPARITY_OFFSET)
    return MonoDepth(torch.stack([-disparity, reciprocal]), torch.ones_like(disparity))


def load_network(target: str) -> Network:
    """The function of a `depth_network`.

    Raises:
        ConfigError: there is none.
    """
    module, _, path = target.partition(":")
    try:
        found = import_module(module)
        for name in path.split("."):
            found = getattr(found, name)
    except Exception as error:
        raise ConfigError(
            f"the depth network cannot be loaded: {type(error).__name__}: {error}",
            where=f"--method.depth-network {target}",
            todo="name a function that takes a picture to its disparity, as module:function; code that is not "
            "installed is found where PYTHONPATH points: export PYTHONPATH=FOLDER",
            topic="depth",
        ) from error
    if not callable(found):
        raise ConfigError(
            f"the depth network is {type(found).__name__}, not a function",
            where=f"--method.depth-network {target}",
            todo="name a function that takes a picture (H, W, 3) to its disparity (H, W)",
            topic="depth",
        )
    return found


class DepthProvider:
    """Monocular depth of the training views, and a network for other pictures.

    Args:
        views: the training views, whose depth maps are used where there is no network.
        network: `module:function`, or None.
    """

    def __init__(self, views: Views, network: str | None, device: torch.device):
        self.target, self.network = network, None if network is None else load_network(network)
        self.training: list[MonoDepth] = []
        if self.network is not None:
            for i, image in enumerate(views.images):
                with torch.no_grad():
                    disparity = self.predict(image.to(device).float() / 255)
                if not bool(disparity.isfinite().all()):
                    raise self._wrong(f"gave numbers that are not finite for the photograph {views.names[i]}")
                self.training.append(of_disparity(disparity.detach()))
        elif given := [depth for depth in views.mono_depths if depth is not None]:
            lacking = [name for name, d in zip(views.names, views.mono_depths, strict=True) if d is None]
            if lacking:
                raise SceneError(
                    f"{len(given)} of {len(views)} training views have a depth map; there is none for "
                    f"{list_some(lacking)}",
                    cause="maps that were made for some of the photographs only, or are named otherwise",
                    todo="make the missing ones, or take the folder away to train without depth",
                    topic="depth",
                )
            self.training = [of_map(depth.to(device)) for depth in given]
        if not self.training:
            log.info(
                "the scene has no depth maps, and there is no depth_network: training goes without depth"
            )
        elif self.network is None:
            log.info(
                "there is no depth_network: depth is compared in training views, and there are no pseudo views"
            )

    def predict(self, image: Tensor) -> Tensor:
        """(H, W) float32 disparity of a picture (H, W, 3).

        Raises:
            ConfigError: the network returned something else.
        """
        assert self.network is not None
        found = self.network(image)
        if not isinstance(found, Tensor) or found.shape != image.shape[:2]:
            got = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise self._wrong(f"returned {got} for a picture of shape {tuple(image.shape)}")
        return found.to(image)

    def _wrong(self, what: str) -> ConfigError:
        return ConfigError(
            f"the depth network {what}",
            where=f"--method.depth-network {self.target}",
            todo="return a tensor (H, W) of disparities for a picture (H, W, 3): resize the network's answer",
            topic="depth",
        )
