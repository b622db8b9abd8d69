"""Low-rank updates of the networks' weights (Hu et al. 2022): their places, their start, their optimiser."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from visdom_plugin import seeding
from visdom_plugin.errors import CheckpointError
from visdom_plugin.methods.repair.configs import LoraConfig
from visdom_plugin.methods.repair.diffusion import Networks

BLOCKS = r".*transformer_blocks\..*\.(to_q|to_k|to_v|to_out\.0|net\.0\.proj|net\.2)"
"""Linear layers of the transformer blocks of UNet and ControlNet."""
TEXT = r".*\.(q_proj|k_proj|v_proj|out_proj|fc1|fc2|token_embedding|position_embedding)"
"""Linear layers and embeddings of the text encoder."""


class LowRankUpdates:
    """Updates put into the networks, which change nothing at first; their pairs of matrices are what is
    trained.

    Args:
        seed: of the first matrix of each pair; the second starts at zero.
    """

    parameters: dict[str, torch.nn.Parameter]
    """By network and place in it."""

    def __init__(self, networks: Networks, config: LoraConfig, seed: int):
        from peft import LoraConfig as PeftConfig
        from peft import inject_adapter_in_model

        self.parameters = {}
        places = {"unet": BLOCKS, "controlnet": BLOCKS} | (
            {"text_encoder": TEXT} if config.text_encoder else {}
        )
        for name, pattern in places.items():
            network = getattr(networks, name)
            settings: dict[str, Any] = {"r": config.rank, "lora_alpha": config.alpha}
            inject_adapter_in_model(PeftConfig(**settings, target_modules=pattern), network)
            network.requires_grad_(False)
            network.eval()
            self.parameters |= {f"{name}.{k}": p for k, p in network.named_parameters() if ".lora_" in k}
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                _start(name, parameter, seed)

    def train(self, lr: float) -> None:
        """From here on they have gradients, and an optimiser."""
        for parameter in self.parameters.values():
            parameter.requires_grad_()
        self.adam = torch.optim.AdamW(self.parameters.values(), lr=lr)

    def step(self) -> None:
        """One step of the optimiser; gradients are dropped afterwards."""
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)

    def weights(self) -> dict[str, Tensor]:
        """The matrices by name, outside the graph."""
        return {name: p.detach() for name, p in self.parameters.items()}

    @torch.no_grad()
    def load_weights(self, weights: Mapping[str, Tensor]) -> None:
        """Takes over what `weights` gave.

        Raises:
            CheckpointError: where they are of other places.
        """
        if weights.keys() != self.parameters.keys():
            raise CheckpointError(
                f"the saved low-rank updates are of {len(weights)} matrices, these networks have "
                f"{len(self.parameters)} or others",
                cause="another version of transformers or diffusers, which names its layers otherwise",
                todo="go on with the versions that run.json names, or train again with --overwrite",
            )
        for name, parameter in self.parameters.items():
            parameter.copy_(weights[name])

    def moments(self) -> dict[str, Tensor]:
        """The optimiser's moments and counts, by name."""
        found = {}
        for name, parameter in self.parameters.items():
            for key, value in self.adam.state.get(parameter, {}).items():
                found[f"{name}/{key}"] = torch.as_tensor(value)
        return found

    def load_moments(self, moments: Mapping[str, Tensor]) -> None:
        """Takes over what `moments` gave."""
        for key, value in moments.items():
            name, _, kind = key.rpartition("/")
            parameter = self.parameters[name]
            kept = value.clone() if kind == "step" else value.to(parameter).clone()
            self.adam.state[parameter][kind] = kept


def _start(name: str, parameter: Tensor, seed: int) -> None:
    if "lora_B" in name or "lora_embedding_B" in name:
        parameter.zero_()
        return
    # Kaiming's uniform range with a = sqrt 5, as LoRA starts.
    bound = 1 / math.sqrt(parameter.shape[-1])
    draw = torch.rand(parameter.shape, generator=seeding.generator(seed, "lora", name))
    parameter.copy_(bound * (2 * draw - 1))
