"""visdom-report: one page on a run, or on several side by side."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from visdom_plugin.cli import entry
from visdom_plugin.cli.options import Device
from visdom_plugin.cli.output.terminal import load_torch
from visdom_plugin.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Writes one HTML file on a run, or on several side by side: numbers, pictures, curves, data, settings.

    It needs no server and no network, and can be sent as it is. Every finished run has one already,
    <run>/report.html.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run directories, as visdom-train names them."""
    out: Path | None = None
    """File to write; by default <run>/report.html, and report.html here for several runs."""
    data: Path | None = None
    """Folder of the scene, where it has moved."""
    device: Device = "auto"
    """Where to draw what has not been drawn yet."""
    quiet: bool = False
    """Print nothing but errors."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_report, argv)


def _report(argv: Sequence[str]) -> None:
    options = tyro.cli(Options, args=list(argv), prog="visdom-report")
    if not options.runs:
        raise ConfigError("no run is named", todo="visdom-report runs/SCENE/VIEWS/METHOD/SEED")
    if options.out is not None and options.out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError("the name of a page ends in .html", where=f"--out {options.out}")

    load_torch()
    from visdom_plugin.report.page import NAME, write_page

    for run in options.runs:
        _draw_again(run, options.data, options.device)
    target = options.out or (options.runs[0] / NAME if len(options.runs) == 1 else Path(NAME))
    write_page(target, options.runs)
    if not options.quiet:
        sys.stdout.write(f"{target}\n")


def _draw_again(run: Path, data: Path | None, device: str) -> None:
    """Draws what a report needs of a run that lies on disk.

    Raises:
        CheckpointError: it is no run, has not finished, or its scene is not there.
    """
    from visdom_plugin.cli.commands.check import find_briefly
    from visdom_plugin.cli.output.reports import report_finished
    from visdom_plugin.cli.runs import open_run
    from visdom_plugin.errors import CheckpointError
    from visdom_plugin.report.page import read_gathered
    from visdom_plugin.training.runs.run_directory import read_record

    record = read_record(run)
    if record.get("status") != "finished":
        raise CheckpointError(
            f"the run has not finished: its status is {record.get('status')}",
            where=run,
            todo="let it finish; the command that began it goes on with it",
        )
    if read_gathered(run) is None:
        record, _, scene, method, hull, where, _ = open_run(run, data, device)
        report_finished(record, method, hull, scene=scene, run_dir=run, device=str(where), check=find_briefly)


if __name__ == "__main__":
    sys.exit(main())
