"""Copies to a device for which the host does not wait."""

from __future__ import annotations

import torch
from torch import Tensor


def send(tensor: Tensor, device: torch.device | str) -> Tensor:
    """A tensor on a device; itself where it is there already.

    A plain `.to` from ordinary memory waits until all that was launched before is done. From pinned memory the
    copy is one more entry in the device's queue.
    """
    if tensor.device.type == "cpu" and torch.device(device).type == "cuda":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)
