"""Stable Diffusion with a ControlNet: pictures to latents and back, predicted noise, repair by DDIM."""

from __future__ import annotations

from typing import Any

import torch
from torch import Generator, Tensor

from visdom_plugin.compute.transfer import send
from visdom_plugin.methods.repair.configs import RepairConfig
from visdom_plugin.methods.repair.weights import NetworkFiles

NEGATIVE_PROMPT = "blur, lowres, bad anatomy, bad hands, cropped, worst quality"


class Networks:
    """The networks, frozen, in evaluation mode and in float32.

    Args:
        files: their folders; reads nothing else.
    """

    def __init__(self, files: NetworkFiles, device: torch.device):
        import diffusers
        from transformers import CLIPTextModel, CLIPTokenizer
        from transformers.utils import logging as transformers_log

        # The run has a bar of its own, or is quiet.
        transformers_log.disable_progress_bar()

        def load(kind: Any, part: str) -> Any:
            settings = {"variant": files.variants[part], "torch_dtype": torch.float32}
            network = kind.from_pretrained(str(files.parts[part]), local_files_only=True, **settings)
            return network.to(device).eval().requires_grad_(False)

        self.device = device
        self.unet = load(diffusers.UNet2DConditionModel, "unet")
        self.controlnet = load(diffusers.ControlNetModel, "controlnet")
        self.vae = load(diffusers.AutoencoderKL, "vae")
        self.text_encoder = load(CLIPTextModel, "text_encoder")
        self.tokenizer = CLIPTokenizer.from_pretrained(str(files.parts["tokenizer"]), local_files_only=True)
        self.scheduler = diffusers.DDIMScheduler.from_pretrained(
            str(files.parts["scheduler"]), local_files_only=True
        )
        self.alpha_bars: Tensor = self.scheduler.alphas_cumprod
        """(T,) of the training steps, on the CPU."""

    def encode_text(self, text: str) -> Tensor:
        """(1, L, D) states of the text encoder."""
        length = min(self.tokenizer.model_max_length, self.text_encoder.config.max_position_embeddings)
        tokens = self.tokenizer(
            [text], padding="max_length", max_length=length, truncation=True, return_tensors="pt"
        )
        states: Tensor = self.text_encoder(tokens.input_ids.to(self.device))[0]
        return states

    @torch.no_grad()
    def encode_image(self, image: Tensor, generator: Generator) -> Tensor:
        """(1, C, H / 8, W / 8) a latent of a picture (H, W, 3) in [0, 1], drawn from the autoencoder's."""
        found = self.vae.encode(2 * as_batch(image) - 1).latent_dist
        latent: Tensor = found.mean + found.std * self.noise(found.mean, generator)
        return latent * self.vae.config.scaling_factor

    @torch.no_grad()
    def decode(self, latent: Tensor) -> Tensor:
        """(H, W, 3) in [0, 1], the picture of a latent (1, C, H / 8, W / 8)."""
        image: Tensor = self.vae.decode(latent / self.vae.config.scaling_factor).sample
        return (image[0].permute(1, 2, 0) / 2 + 0.5).clamp(0, 1)

    def predict_noise(self, latent: Tensor, t: Tensor, text: Tensor, hint: Tensor) -> Tensor:
        """The noise in a latent, in its shape.

        Args:
            t: () int64 step of the noise schedule.
            text: (1, L, D) what `encode_text` gave.
            hint: (H, W, 3) in [0, 1], the picture to be repaired.
        """
        down, middle = self.controlnet(
            latent, t, encoder_hidden_states=text, controlnet_cond=as_batch(hint), return_dict=False
        )
        found: Tensor = self.unet(
            latent,
            t,
            encoder_hidden_states=text,
            down_block_additional_residuals=down,
            mid_block_additional_residual=middle,
            return_dict=False,
        )[0]
        return found

    def noise(self, like: Tensor, generator: Generator) -> Tensor:
        """Normal numbers of a shape, the CPU's on every device."""
        return send(torch.randn(like.shape, generator=generator), self.device)

    @torch.no_grad()
    def repair(
        self, image: Tensor, prompt: str, strength: float, config: RepairConfig, generator: Generator
    ) -> tuple[Tensor, float]:
        """What the networks make of a picture that was taken some way towards noise.

        Args:
            image: (H, W, 3) in [0, 1], also what the ControlNet goes by.
            strength: of the noise, above 0 to 1.

        Returns:
            (H, W, 3) in [0, 1], and the weight of its score.
        """
        scheduler = self.scheduler
        scheduler.set_timesteps(config.ddim_steps)
        # Of so many steps, the last of which is the cleanest.
        count = min(max(int(strength * config.ddim_steps), 1), config.ddim_steps)
        steps = scheduler.timesteps[-count:]
        first = int(steps[0])
        text = self.encode_text(prompt)
        other = self.encode_text(NEGATIVE_PROMPT) if config.guidance != 1 else None
        latent = self.encode_image(image, generator)
        latent = scheduler.add_noise(latent, self.noise(latent, generator), steps[:1].to(self.device))
        for t in steps:
            found = self.predict_noise(latent, t.to(self.device), text, image)
            if other is not None:
                without = self.predict_noise(latent, t.to(self.device), other, image)
                found = without + config.guidance * (found - without)
            noise = self.noise(latent, generator)
            latent = scheduler.step(found, int(t), latent, eta=config.eta, variance_noise=noise).prev_sample
        looked_up = first if config.score == "paper" else count
        return self.decode(latent), 1 - float(self.alpha_bars[looked_up])


def as_batch(image: Tensor) -> Tensor:
    """(1, 3, H, W) of a picture (H, W, 3)."""
    return image.permute(2, 0, 1)[None].contiguous()
