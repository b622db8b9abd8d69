"""Files of the diffusion networks: where they are, and what is missing. Nothing is downloaded."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from visdom_plugin.errors import ConfigError, PluginError

VARIABLE = "VISDOM_DIFFUSION_WEIGHTS"
SD, CONTROLNET = "stable-diffusion-v1-5", "control_v11f1e_sd15_tile"
SOURCES = {
    SD: "stable-diffusion-v1-5/stable-diffusion-v1-5",
    CONTROLNET: "lllyasviel/control_v11f1e_sd15_tile",
}
"""Hugging Face ids of what belongs into the folders."""
PACKAGES = ("diffusers", "transformers", "peft", "accelerate")
_SUFFIXES = (".safetensors", ".fp16.safetensors", ".bin", ".fp16.bin")
_SAMPLED = 1 << 20


@dataclass(frozen=True)
class WeightsConfig:
    """Folders of the diffusion networks, in the layout of diffusers. Nothing is downloaded."""

    folder: Path | None = None
    """Holds stable-diffusion-v1-5 and control_v11f1e_sd15_tile; by default the folder that the environment
    variable VISDOM_DIFFUSION_WEIGHTS names."""
    sd: Path | None = None
    """Stable Diffusion 1.5, where it lies elsewhere: unet, vae, text_encoder, tokenizer and scheduler."""
    controlnet: Path | None = None
    """ControlNet 1.1 tile, where it lies elsewhere."""


@dataclass(frozen=True)
class NetworkFiles:
    """The folders of the networks, looked through."""

    parts: dict[str, Path]
    """By unet, vae, text_encoder, tokenizer, scheduler and controlnet, the folder that holds it."""
    variants: dict[str, str | None]
    """By network, "fp16" where that is the only one there."""

    def config(self, part: str) -> dict[str, Any]:
        """What the part's config.json holds."""
        found: dict[str, Any] = json.loads((self.parts[part] / "config.json").read_text(encoding="utf-8"))
        return found

    def digest(self) -> str:
        """Of names, sizes, settings and samples of the weights, to tell one set of networks from another."""
        found = hashlib.sha256()
        for part in sorted(self.parts):
            for path in sorted(p for p in self.parts[part].iterdir() if p.is_file()):
                size = path.stat().st_size
                found.update(f"{part}/{path.name} {size}\n".encode())
                with path.open("rb") as file:
                    found.update(file.read(_SAMPLED))
                    file.seek(max(0, size - _SAMPLED))
                    found.update(file.read(_SAMPLED))
        return found.hexdigest()


def check(config: WeightsConfig, image_size: int) -> NetworkFiles:
    """Finds packages and files that training needs, before anything is loaded.

    Args:
        image_size: of the pictures that the networks are to see.

    Raises:
        PluginError: for a package, a folder or a file that is not there, naming where to get it.
        ConfigError: for pictures of a size that the networks cannot halve as often as they do.
    """
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise PluginError(
            f"GaussianObject's repair needs {', '.join(missing)}, not installed here",
            where="the extra [diffusion]",
            todo="pip install 'visdom-plugin[diffusion]'; method:3dgs-go, its coarse stage, does without",
            topic="not-installed",
        )
    files = find_files(config)
    halvings = sum(len(files.config(part)["block_out_channels"]) - 1 for part in ("vae", "unet"))
    if image_size % (1 << halvings):
        raise ConfigError(
            f"image_size = {image_size} cannot be halved {halvings} times, as these networks do",
            where="--method.image-size",
            todo=f"choose a multiple of {1 << halvings}; Stable Diffusion 1.5 was trained for 512",
        )
    return files


def find_files(config: WeightsConfig) -> NetworkFiles:
    """The folders of all networks.

    Raises:
        PluginError: for a folder or a file that is not there, or none named.
    """
    named = config.folder or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    roots = {SD: config.sd, CONTROLNET: config.controlnet}
    folders = {name: root or (named / name if named else None) for name, root in roots.items()}
    unnamed = [name for name, folder in folders.items() if folder is None]
    if unnamed:
        raise PluginError(
            f"no folder is named that holds the networks' weights ({', '.join(unnamed)})",
            where="--method.weights.folder",
            todo=f"name one there or in the environment variable {VARIABLE}; to fill it, on a machine with a "
            f"network: {'; '.join(_download(name) for name in unnamed)}",
            topic="weights",
        )
    sd, controlnet = (Path(folders[name] or "").expanduser() for name in (SD, CONTROLNET))
    parts = {name: sd / name for name in ("unet", "vae", "text_encoder", "tokenizer", "scheduler")}
    parts["controlnet"] = controlnet
    for part, folder in parts.items():
        source = CONTROLNET if part == "controlnet" else SD
        _demand(folder, folder.is_dir(), "folder", source)
        if part in ("tokenizer", "scheduler"):
            names = ("vocab.json", "merges.txt") if part == "tokenizer" else ("scheduler_config.json",)
        else:
            names = ("config.json",)
        for name in names:
            _demand(folder / name, (folder / name).is_file(), "file", source)
    variants = {
        part: _find_variant(folder, part)
        for part, folder in parts.items()
        if part not in ("tokenizer", "scheduler")
    }
    return NetworkFiles(parts, variants)


def _find_variant(folder: Path, part: str) -> str | None:
    stem = "model" if part == "text_encoder" else "diffusion_pytorch_model"
    found = next((s for s in _SUFFIXES if (folder / f"{stem}{s}").is_file()), None)
    source = CONTROLNET if part == "controlnet" else SD
    _demand(folder / f"{stem}.safetensors", found is not None, "file", source)
    return "fp16" if found is not None and found.startswith(".fp16") else None


def _demand(path: Path, there: bool, kind: str, source: str) -> None:
    if not there:
        raise PluginError(
            f"there is no {kind} {path.name} of {source}",
            where=path,
            cause="a folder of another layout than diffusers', or a download that was cut short",
            todo=f"on a machine with a network: {_download(source)}",
            topic="weights",
        )


def _download(name: str) -> str:
    return f"hf download {SOURCES[name]} --local-dir FOLDER/{name}"
