"""What the cases of all parts share: the device, sizes, timing, comparing."""

from __future__ import annotations

import json
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Case:
    """One row of the page."""

    name: str
    run: Callable[[Bench], dict[str, Any] | None]
    limit: float = 30.0
    """Seconds after which it is ended."""
    needs: tuple[str, ...] = ()
    """Packages whose compiled CUDA code it needs on CUDA; left out where that is not there."""
    only_cuda: bool = False
    """Whether a dry run has nothing to do in it."""


class Disagrees(Exception):
    """Two results that should be alike are not."""

    def __init__(self, message: str, values: dict[str, Any]):
        super().__init__(message)
        self.values = values


class Bench:
    """Settings of a call, and how to measure."""

    def __init__(self, settings: dict[str, Any]):
        self.settings = settings
        self.tiny: bool = settings["tiny"]
        self.on_cuda = settings["device"] == "cuda"
        self.device = torch.device(settings["device"])
        self.scene_path = None if settings["scene"] is None else Path(settings["scene"])
        self.work, self.out = Path(settings["work"]), Path(settings["out"])
        self._end = time.monotonic() + settings["seconds"]
        if self.on_cuda and not torch.cuda.is_available():
            raise RuntimeError("torch sees no CUDA device")

    def choose(self, cases: list[Case]) -> list[Case]:
        """The cases to run: those that `--only` names and whose compiled code is there."""
        word, compiled = self.settings["only"], self.settings["compiled"]
        chosen = [c for c in cases if word is None or word in c.name]
        if not self.on_cuda:
            return [c for c in chosen if not c.only_cuda]
        return [c if set(c.needs) <= set(compiled) else _left_out(c) for c in chosen]

    def left(self) -> float:
        """Seconds until this process is ended."""
        return self._end - time.monotonic()

    def size(self, full: int, tiny: int) -> int:
        """A size for measuring, or for the dry run."""
        return tiny if self.tiny else full

    def synchronise(self) -> None:
        """Waits for the device."""
        if self.on_cuda:
            torch.cuda.synchronize()

    def median_ms(self, function: Callable[[], Any], repeats: int = 20, warm_up: int = 3) -> float:
        """Median milliseconds of a call, waiting for the device before and after each."""
        repeats, warm_up = (2, 1) if self.tiny else (repeats, warm_up)
        for _ in range(warm_up):
            function()
        spent = []
        for _ in range(repeats):
            self.synchronise()
            began = time.perf_counter()
            function()
            self.synchronise()
            spent.append(1000 * (time.perf_counter() - began))
        return statistics.median(spent)

    def device_use(self, function: Callable[[], Any]) -> dict[str, int | None]:
        """How often one call launches a kernel or copy, and how often the host waits for the device."""
        if not self.on_cuda:
            return {"launches": None, "waits": None}
        function()
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode(1)
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                function()
        finally:
            torch.cuda.set_sync_debug_mode(0)
        waits = sum("synchroniz" in str(w.message) for w in caught)
        return {"launches": _count_launches(function), "waits": waits}

    def peak_mb(self) -> float | None:
        """Most memory torch has held on the device since `reset_peak`, MB."""
        return round(torch.cuda.max_memory_allocated() / 1e6, 1) if self.on_cuda else None

    def reset_peak(self) -> None:
        if self.on_cuda:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()

    def references(self, part: str) -> dict[str, dict[str, Any]]:
        """The values of an earlier call's part by case, as on the CPU; empty where there are none."""
        path = self.settings["reference"]
        if path is None:
            return {}
        cases = json.loads(Path(path).read_text())["parts"].get(part, {}).get("cases", {})
        return {name: row.get("values", {}) for name, row in cases.items()}


def _left_out(case: Case) -> Case:
    def skip(bench: Bench) -> dict[str, Any]:
        return {"note": f"left out: no compiled {' or '.join(case.needs)}"}

    return Case(case.name, skip, 5.0)


def _count_launches(function: Callable[[], Any]) -> int | None:
    from torch.autograd import DeviceType
    from torch.profiler import ProfilerActivity, profile

    try:
        with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as found:
            function()
            torch.cuda.synchronize()
        return sum(event.device_type == DeviceType.CUDA for event in found.events())
    except RuntimeError:
        return None


def relative(found: Tensor, wanted: Tensor) -> float:
    """||found - wanted|| / ||wanted||, in float64; infinite where NaN stands or shapes differ."""
    if found.shape != wanted.shape:
        return float("inf")
    a, b = found.detach().cpu().double(), wanted.detach().cpu().double()
    if not torch.isfinite(a).all():
        return float("inf")
    return float((a - b).norm() / b.norm().clamp_min(1e-30))
