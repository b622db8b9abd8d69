"""One module per on-disk layout, the built-in scene, and the batches that training draws from them."""

from __future__ import annotations

from typing import Any

__all__ = ["load"]


def __getattr__(name: str) -> Any:
    # Lazy: importing the package must not import torch.
    if name == "load":
        from datamodules.recognise import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
