"""Reports as commands make them: what a run was, drawn and put on a page."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visdom_plugin.compute.waiting import phase

SMALL_PX, SWIFT_PX = 100, 400
"""Longest sides of pictures for which the quick schedules are made: up to the second they take a minute or two."""

if TYPE_CHECKING:
    from visdom_plugin.hull.hull import Hull
    from visdom_plugin.scene import Scene
    from visdom_plugin.training.evaluate import Renderer


@phase("writing the report")
def report_finished(
    record: dict[str, Any],
    method: Renderer,
    hull: Hull | None,
    *,
    scene: Scene,
    run_dir: Path,
    device: str,
    check: Callable[[Scene], list[dict[str, Any]]],
) -> None:
    """Draws and writes the page of a run that is there in memory: `<run>/report.html`.

    Args:
        check: what is wrong with a scene's data, see `Finished.findings`.
    """
    import torch

    from visdom_plugin.report.gather import Finished, gather
    from visdom_plugin.report.page import NAME, write_page

    gather(
        Finished(
            record=record,
            renderer=method,
            scene=scene,
            hull=hull,
            device=torch.device(device),
            path=run_dir,
            command=repeat_command(record),
            findings=check(scene),
        )
    )
    write_page(run_dir / NAME, [run_dir])


def repeat_command(record: dict[str, Any]) -> str:
    """The command line that trains such a run again.

    Settings that no option can express, such as a whole hull where the variant has none, are left to run.json.
    """
    from visdom_plugin import registry
    from visdom_plugin.training.runs.config_io import as_plain

    words = _training_words(record["method"], record["data"])
    if record["seed"]:
        words += ["--seed", str(record["seed"])]
    if record.get("budget"):
        words += ["--budget", record["budget"]]
    preset = registry.find(record["method"])
    default = as_plain(getattr(preset, record.get("budget") or "quick"))
    words += _changes("method", default, record["config"])
    return shlex.join(words)


def training_command(
    scene: Path | None, reading: dict[str, Any], longest_px: int, *, k: int | None = None
) -> str:
    """The command line that trains a first splat on a scene that a command has looked at.

    Args:
        scene: its folder as the user named it; None for the built-in one.
        reading: how it was read, see `options.read_options`.
        longest_px: the longest side of its pictures as they were read; twice `SWIFT_PX` and more are made smaller.
        k: of the visible domain, where it is not the usual one.
    """
    factor = swift_factor(reading["downscale"], longest_px)
    plain = reading | {"path": scene and str(scene), "downscale": factor}
    return shlex.join(_training_words("visdom-gs", plain) + ([] if k is None else ["--k", str(k)]))


def swift_factor(downscale: float, longest_px: int) -> float:
    """What to pass for `--downscale`, so that pictures read with that factor are less than twice `SWIFT_PX`."""
    factor = downscale * 2 ** max(0, (longest_px // SWIFT_PX).bit_length() - 1)
    return int(factor) if factor == int(factor) else factor


def _training_words(method: str, data: dict[str, Any]) -> list[str]:
    """As far as they name the method, the scene, and how it is read."""
    from visdom_plugin.cli.options import READING, Common
    from visdom_plugin.training.runs.config_io import as_plain

    words = ["visdom-train", f"method:{method}"]
    if data.get("path"):
        words += ["--data", data["path"]]
    plain = as_plain(Common())
    for name in READING:
        value = data.get(name, plain.get(name))
        if value != plain.get(name) and value is not None:
            prefix = "data." if name in ("missing_masks", "mask_source") else ""
            words += _flag(prefix + name, value)
    return words


def _changes(name: str, before: Any, after: Any) -> list[str]:
    if isinstance(before, dict) and isinstance(after, dict):
        return [
            w for key in after if key in before for w in _changes(f"{name}.{key}", before[key], after[key])
        ]
    return [] if before == after or isinstance(after, dict) else _flag(name, after)


def _flag(name: str, value: Any) -> list[str]:
    option = name.replace("_", "-")
    if isinstance(value, bool):
        head, _, last = option.rpartition(".")
        said = last if value else f"no-{last}"
        return [f"--{head}.{said}" if head else f"--{said}"]
    if isinstance(value, list):
        return [f"--{option}", *map(str, value)]
    return [f"--{option}", "None" if value is None else str(value)]
