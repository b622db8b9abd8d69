"""Fine-tuning of the networks on pairs of a corrupted render and the photograph of the same view."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from visdom_plugin import seeding
from visdom_plugin.losses import composite_target
from visdom_plugin.methods.repair.configs import GaussianObjectConfig
from visdom_plugin.methods.repair.diffusion import Networks
from visdom_plugin.methods.repair.leave_one_out import State, add_noise
from visdom_plugin.methods.repair.lora import LowRankUpdates
from visdom_plugin.methods.repair.pictures import centre_square
from visdom_plugin.methods.splats.gs_go import GsGo
from visdom_plugin.training.protocols import StepOutput, ViewBatch

TEMPLATES = (
    "a photo of a {}",
    "a photo of the {}",
    "a close-up photo of a {}",
    "a good photo of the {}",
    "a cropped photo of the {}",
    "a photo of one {}",
    "a rendering of a {}",
    "a depiction of the {}",
)
"""Sentences about the object."""


class FineTuning:
    """Steps of the networks towards drawing the photographs.

    Args:
        coarse: the coarse stage, at its end.
        kept: what `LeaveOneOut.result` gave.
        load: the networks.
    """

    def __init__(
        self,
        config: GaussianObjectConfig,
        coarse: GsGo,
        kept: Mapping[str, Tensor],
        load: Callable[[], Networks],
        seed: int,
    ):
        self.config, self.coarse, self.kept, self.seed = config, coarse, kept, seed
        self.steps = config.lora.steps
        self.networks = load()
        self.updates = LowRankUpdates(self.networks, config.lora, seed)
        self.updates.train(config.lora.lr)

    def view_at(self, step: int) -> int | None:
        """Any, in turn."""
        return None

    def train_step(self, batch: ViewBatch, step: int) -> StepOutput:
        networks, c = self.networks, self.config.lora
        draw = seeding.generator(self.seed, "lora", step)
        hint = self.corrupted(batch, step, draw)
        target = self.photograph(batch, hint)
        template = TEMPLATES[int(torch.randint(len(TEMPLATES), (), generator=draw))]
        text = networks.encode_text(template.format(c.token))
        latent = networks.encode_image(target, draw)
        t = torch.randint(len(networks.alpha_bars), (1,), generator=draw)
        noise = networks.noise(latent, draw)
        t = t.to(latent.device)
        noisy = networks.scheduler.add_noise(latent, noise, t)
        found = networks.predict_noise(noisy, t[0], text, hint)
        return StepOutput({"denoising": torch.nn.functional.mse_loss(found, noise)})

    def optimise(self, step: int, output: StepOutput) -> None:
        self.updates.step()

    @torch.no_grad()
    def photograph(self, batch: ViewBatch, hint: Tensor) -> Tensor:
        """(S, S, 3) the view's photograph on white: of an unknown mask the coarse Gaussians tell what is the
        object, and where pixels are ignored the render stays as it is."""
        white = torch.ones(3, device=batch.image.device)
        alpha = None if batch.mask_known else self.coarse.splats.draw(batch.camera, white).alpha
        seen = composite_target(batch.image, batch.mask, white, alpha=alpha, mask_known=batch.mask_known)
        target = centre_square(seen, self.config.image_size)
        if batch.weight is None:
            return target
        counted = centre_square(batch.weight[..., None].expand(-1, -1, 3), self.config.image_size)
        return torch.where(counted > 0, target, hint)

    @torch.no_grad()
    def corrupted(self, batch: ViewBatch, step: int, draw: torch.Generator) -> Tensor:
        """(S, S, 3) a poor render of the view: of noisy Gaussians, or one kept when the view was left out."""
        c = self.config.lora
        share = c.noise_decay ** max(0, step + 1 - c.noise_steps)
        cached = sorted(k for k in self.kept if k.startswith(f"renders.{batch.index}."))
        if float(torch.rand((), generator=draw)) < share:
            noisy = add_noise(self.coarse.splats.gaussians().detach(), self.kept, self.config, draw)
            white = torch.ones(3, device=batch.image.device)
            render = self.coarse.splats.draw(batch.camera, white, noisy)
            return centre_square(render.rgb.clamp(0, 1), self.config.image_size)
        chosen = cached[int(torch.randint(len(cached), (), generator=draw))]
        return self.kept[chosen].to(batch.image.device).float() / 255

    def result(self) -> State:
        """What the last stage needs."""
        return {name: value.clone() for name, value in self.updates.weights().items()}

    def state_dict(self) -> State:
        moments = {f"adam.{k}": v for k, v in self.updates.moments().items()}
        return {f"lora.{k}": v for k, v in self.updates.weights().items()} | moments

    def load_state_dict(self, state: Mapping[str, Tensor], step: int) -> None:
        def part(prefix: str) -> State:
            return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}

        self.updates.load_weights(part("lora."))
        self.updates.load_moments(part("adam."))
