"""Hooks whose answers are known, to see what a method does with them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Generator, Tensor

from visdom_plugin.conformance.subject import scene
from visdom_plugin.geometry.cameras import Cameras, look_at_point
from visdom_plugin.hooks.protocols import Placed, RayBounds
from visdom_plugin.hull.hull import Hull
from visdom_plugin.render import Render
from visdom_plugin.training.protocols import Method, PixelBatch, ViewBatch


class SamplerProbe:
    """Leaves rays the method's own bounds, until it is told to leave them next to nothing.

    `place` is where that is: "near" or "far", at the end of the method's own bounds and of no length, with
    hit = False; or a factor of the distance to what the cameras look at, of `width` times that, with hit = True.
    With "missed", bounds stay and hit is False; with "nowhere", bounds stay and `keep` keeps no sample.
    """

    def __init__(self, drop_outside: bool = False) -> None:
        self.place: str | float | None = None
        self.width = 1e-3
        self.drop_outside = drop_outside
        self.calls = 0
        self.centre = look_at_point(scene().train.cameras)

    def bound(self, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> RayBounds:
        self.calls += 1
        shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
        near, far = (torch.as_tensor(x).to(directions).expand(shape) for x in (near, far))
        everywhere = torch.ones(shape, dtype=torch.bool, device=directions.device)
        if self.place in (None, "nowhere"):
            return RayBounds(near, far, everywhere)
        if self.place == "missed":
            return RayBounds(near, far, ~everywhere)
        if isinstance(self.place, str):
            end = near if self.place == "near" else far
            return RayBounds(end, end, ~everywhere)
        away = (self.centre.to(origins) - origins).norm(dim=-1) / directions.norm(dim=-1)
        away = away.to(directions).expand(shape)
        begin = torch.minimum(torch.maximum(self.place * away, near), far)
        return RayBounds(begin, torch.minimum(begin + self.width * away, far), everywhere)

    def keep(self, points: Tensor) -> Tensor:
        return torch.full(points.shape[:-1], self.place != "nowhere", device=points.device)


class GaussianProbe:
    """Gives points to start from that nobody else would choose, crowded in the hull's middle, adds a known loss,
    and has every tenth Gaussian removed."""

    LOSS = "conformance_probe"

    def __init__(self, hull: Hull):
        self.hull = hull
        self.points: list[Tensor] = []
        self.renders: list[Render] = []
        self.seen: dict[int, list[Tensor]] = {}
        """Means of the Gaussians of each call of `after_step`, by step."""
        self.marked: dict[int, list[Tensor]] = {}

    def initial_points(self, n: int, generator: Generator | None = None) -> tuple[Tensor, Tensor]:
        middle = torch.as_tensor(self.hull.centre).float()
        xyz = middle + 0.1 * (self.hull.sample_inside(n, generator).float() - middle)
        self.points.append(xyz)
        return xyz, torch.full_like(xyz, 0.5)

    def loss(self, render: Callable[[Cameras], Render], step: int, generator: Generator) -> dict[str, Tensor]:
        shown = render(scene().train.cameras[0])
        self.renders.append(shown)
        return {self.LOSS: 0.01 * shown.alpha.mean()}

    def after_step(self, gaussians: Placed, step: int) -> Tensor:
        means = gaussians.means.detach().clone()
        gone = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        gone[::10] = True
        self.seen.setdefault(step, []).append(means)
        self.marked.setdefault(step, []).append(gone)
        return gone


def gradient(method: Method, batch: PixelBatch | ViewBatch, step: int) -> dict[int, Tensor]:
    """What `train_step` says of the parameters, by their identity: leaves of the losses' graph, no step taken."""
    total = method.train_step(batch, step).total
    leaves, seen = {}, set()
    stack = [total.grad_fn] if total.requires_grad else []
    while stack:
        node = stack.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if hasattr(node, "variable"):
            leaves[id(node.variable)] = node.variable
        stack += [parent for parent, _ in node.next_functions]
    if not leaves:
        return {}
    found = torch.autograd.grad(total, list(leaves.values()), allow_unused=True)
    pairs = zip(leaves, found, strict=True)
    return {name: g.to_dense().clone() if g.is_sparse else g.clone() for name, g in pairs if g is not None}


def distance(one: dict[int, Tensor], other: dict[int, Tensor]) -> float:
    """Euclidean distance of two gradients."""
    total = 0.0
    for name in one.keys() | other.keys():
        absent = torch.zeros(())
        gap = one.get(name, absent) - other.get(name, absent)
        total += float(gap.double().square().sum())
    return total**0.5
