"""Measures that a table can show of a run: place in run.json, unit, and which way is better."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from visdom_plugin.errors import unknown_name


@dataclass(frozen=True)
class Measure:
    """One number of a run as tables print it."""

    name: str
    """As table files name it."""
    title: str
    """As a table's head names it, unit included."""
    path: tuple[str, ...]
    """Where it stands in run.json."""
    higher_is_better: bool
    digits: int
    """Decimals in print; CSV files hold every digit."""
    paper: str | None = None
    """The name of the same thing in the paper's numbers."""
    factor: float = 1.0
    """From run.json's unit to the printed one, which is the paper's."""

    @property
    def arrow(self) -> str:
        """Which way is better."""
        return "↑" if self.higher_is_better else "↓"

    def read(self, record: Mapping[str, object] | None) -> float | None:
        """The number in a run's record, in the printed unit; None where the run has none."""
        value: object = record
        for key in self.path:
            value = value.get(key) if isinstance(value, Mapping) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            return None
        return float(value) * self.factor

    def spell(self, value: float, signed: bool = False) -> str:
        """The number in print."""
        text = f"{value:{'+' if signed else ''}.{self.digits}f}"
        if not any(c in "123456789" for c in text):
            text = text.replace("-", "+" if signed else "")
        return text


def _of_test(name: str, title: str, higher: bool, digits: int, paper: str | None = None, factor: float = 1.0):
    return Measure(name, title, ("metrics", "test", name), higher, digits, paper, factor)


MEASURES: dict[str, Measure] = {
    m.name: m
    for m in (
        _of_test("psnr", "PSNR (dB)", True, 2, "psnr_db"),
        _of_test("ssim", "SSIM (Gaussian)", True, 4),
        _of_test("ssim_uniform7", "SSIM (7 x 7)", True, 4, "ssim"),
        _of_test("lpips", "LPIPS x 100 (VGG)", False, 3, "lpips_x100", 100.0),
        _of_test("psnr_per_channel", "PSNR per channel (dB)", True, 2),
        _of_test("psnr_foreground", "PSNR of the foreground (dB)", True, 2),
        _of_test("silhouette_iou", "silhouette IoU", True, 4),
        _of_test("outside_hull_mass", "opacity outside the hull", False, 4),
        _of_test("chamfer_sym", "Chamfer, symmetric x 1000", False, 2, "chamfer_l2_sym_x1000", 1000.0),
        _of_test(
            "chamfer_target_to_hull",
            "Chamfer, target to hull x 1000",
            False,
            2,
            "chamfer_l2_target_to_rec_x1000",
            1000.0,
        ),
        _of_test("chamfer_hull_to_target", "Chamfer, hull to target x 1000", False, 2, None, 1000.0),
        _of_test("chamfer_floor", "Chamfer, target to itself x 1000", False, 4, None, 1000.0),
        _of_test("iou", "IoU with the object", True, 4),
        _of_test("covered", "share of the object inside", True, 4),
        Measure("gaussians", "Gaussians", ("model", "gaussians"), False, 0),
        Measure("train_min", "training (min)", ("timing", "train_s"), False, 1, "train_time_min", 1 / 60),
        Measure("hull_s", "hull (s)", ("timing", "hull_s"), False, 2),
        Measure("eval_s", "evaluation (s)", ("timing", "eval_s"), False, 1),
        Measure("step_ms", "step (ms)", ("timing", "step_ms"), False, 1),
    )
}


def find_measure(name: str, where: object = None) -> Measure:
    """The measure of a name.

    Raises:
        ConfigError: for an unknown name, with the nearest and all available ones.
    """
    if name in MEASURES:
        return MEASURES[name]
    raise unknown_name(f"there is no metric {name!r}", name, MEASURES, where=where)
