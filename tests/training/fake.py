"""The smallest method there is, and a scene for it: one colour per training view, learnt by Adam.

`python -m tests.training.fake RUN STEPS` trains it in a process of its own, to be killed.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from visdom_plugin import registry
from visdom_plugin.geometry.camera_paths import look_at_camera
from visdom_plugin.geometry.cameras import Cameras, rays_of
from visdom_plugin.render import Render
from visdom_plugin.scene import Scene, Views
from visdom_plugin.seeding import generator
from visdom_plugin.training.protocols import StepOutput
from visdom_plugin.training.runs import checkpoints

NAME = "fake"


@dataclass(frozen=True)
class FakeInner:
    """A nested setting."""

    weight: float = 0.5
    """How much noise a step adds."""


@dataclass(frozen=True)
class FakeConfig:
    """Settings of the fake method."""

    steps: int = 40
    """Optimisation steps."""
    lr: float = 0.05
    """Learning rate."""
    nan_at: int = -1
    """Step whose loss is NaN."""
    pause_s: float = 0.0
    """Sleep per step, so that a killer finds the time."""
    inner: FakeInner = FakeInner()
    """Nested settings."""
    hull: Any = None


class FakeMethod:
    """Draws every camera as a disc in the mean of the learnt colours."""

    def __init__(self, config):
        self.config, self.total_steps = config, config.steps

    def setup(self, views, hooks, *, hull, device, seed):
        self.views, self.hooks, self.hull, self.device, self.seed = views, list(hooks), hull, device, seed
        self.colours = torch.full((len(views), 3), 0.5, device=device).requires_grad_()
        self.adam = torch.optim.Adam([self.colours], lr=self.config.lr)

    def train_step(self, batch, step):
        time.sleep(self.config.pause_s)
        image, mask = batch.image, batch.mask[..., None]
        noise = torch.rand(3, generator=generator(self.seed, "noise", step))
        target = (image * mask).sum((0, 1)) / mask.sum() + self.config.inner.weight * 0.1 * noise
        loss = (self.colours[batch.index] - target).square().mean()
        return StepOutput({"colour": loss * (float("nan") if step == self.config.nan_at else 1)})

    def optimise(self, step, output):
        self.adam.step()
        self.adam.zero_grad()

    def render(self, camera, background):
        height, width = int(camera.height), int(camera.width)
        y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        alpha = (((x / width - 0.5) ** 2 + (y / height - 0.5) ** 2) < 0.09).float()
        rgb = alpha[..., None] * self.colours.detach().mean(0) + (1 - alpha[..., None]) * background
        return Render(rgb, alpha, alpha)

    def state_dict(self):
        state = self.adam.state[self.colours]
        zero = torch.zeros_like(self.colours)
        return {
            "colours": self.colours.detach(),
            "exp_avg": state.get("exp_avg", zero),
            "exp_avg_sq": state.get("exp_avg_sq", zero),
            "adam_step": torch.as_tensor(state.get("step", 0.0)),
        }

    def load_state_dict(self, state):
        with torch.no_grad():
            self.colours.copy_(state["colours"])
        self.adam.state[self.colours] = {
            "exp_avg": state["exp_avg"].clone(),
            "exp_avg_sq": state["exp_avg_sq"].clone(),
            "step": state["adam_step"].clone(),
        }

    def export(self, folder):
        (Path(folder) / "colours.txt").write_text(str(self.colours.tolist()))
        return [Path(folder) / "colours.txt"]


class FakeManager:
    """Batches as the real data manager gives them."""

    def __init__(self, views, seed, device):
        self.views, self.seed = views, seed

    def view_batch(self, step):
        n = len(self.views)
        order = torch.randperm(n, generator=generator(self.seed, "order", step // n))
        i = int(order[step % n])
        image, mask = self.views.images[i].float() / 255, self.views.masks[i].float()
        return SimpleNamespace(index=i, camera=self.views.cameras[i], image=image, mask=mask)


PRESET = registry.Preset(
    NAME,
    "one colour per view",
    "tests.training.fake:FakeMethod",
    FakeConfig(),
    FakeConfig(steps=80, inner=FakeInner(weight=0.25)),
)
FASTER = registry.Preset(
    "fake+fast", "the same, larger steps", PRESET.target, FakeConfig(lr=0.5), FakeConfig(steps=80, lr=0.4)
)


def fake_registry() -> registry.Registry:
    """A registry with the fake methods alone."""
    found = registry.Registry()
    found.add({"fake": PRESET, "fake+fast": FASTER, "pretend": PRESET}, "tests")
    return found


def tiny_views(count: int, start_degrees: float, prefix: str, size: tuple[int, int] = (24, 20)) -> Views:
    """Views of a ball of radius 0.5 around (1, 2, 3) from a ring of cameras at distance 2."""
    angle = torch.deg2rad(start_degrees + torch.arange(count).double() * 360 / count)
    target = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    centre = target + 2 * torch.stack([angle.cos(), angle.sin(), 0.3 * (2 * angle).cos()], -1)
    motion = look_at_camera(centre, target, torch.tensor([0.0, 0, 1], dtype=torch.float64))
    width, height = size
    K = torch.tensor([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]]).double().expand(count, 3, 3)
    cameras = Cameras.from_matrices(K, motion, width=width, height=height)
    images, masks = [], []
    for i in range(count):
        rays = rays_of(cameras[i])
        along = ((target - rays.origins) * rays.directions).sum(-1, keepdim=True)
        masks.append((rays.origins + along * rays.directions - target).norm(dim=-1) < 0.5)
        images.append((rays.directions * 90 + 120).round().to(torch.uint8))
    return Views(cameras, images, masks, [f"{prefix}{i}.png" for i in range(count)])


def tiny_scene() -> Scene:
    """Four training and three test views, named so that they cannot be mixed up."""
    return Scene("ball", tiny_views(4, 0, "train_"), tiny_views(3, 30, "test_"), source={"layout": "fake"})


def install() -> None:
    """Makes the fake methods the only ones of this process."""
    registry.installed = fake_registry


def main(run_dir: str, steps: str) -> None:
    from visdom_plugin.training.run import train

    install()
    config = FakeConfig(steps=int(steps), pause_s=0.004)
    train(
        NAME,
        config,
        tiny_scene(),
        data_manager=FakeManager,
        run_dir=Path(run_dir),
        quiet=True,
        checkpoint_seconds=0.02,
    )


def state_of(run_dir: Path) -> dict[str, torch.Tensor]:
    return checkpoints.load_newest(run_dir / "checkpoints").tensors


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def log_of(run_dir: Path) -> list[dict]:
    return [json.loads(line) for line in (run_dir / "log.jsonl").read_text().splitlines()]


if __name__ == "__main__":
    main(*sys.argv[1:])
