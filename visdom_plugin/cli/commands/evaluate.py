"""visdom-eval: measures a run again from its last checkpoint, or a method by leaving each view out in turn."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from visdom_plugin.cli import entry
from visdom_plugin.cli.early import read_early
from visdom_plugin.cli.output.terminal import load_torch, say, show_next, show_oracle, show_result


@dataclass(frozen=True)
class Options:
    """Renders the test views of a run from its last checkpoint and measures them again.

    With --leave-one-out in place of a run it takes a method and the options of visdom-train, and measures it
    on each training view in turn, trained without that view:
    visdom-eval --leave-one-out method:3dgs-go+vd --data DIR --views 4
    """

    run: tyro.conf.Positional[Path]
    """Run directory, as visdom-train names it."""
    data: Path | None = None
    """Folder of the scene, if it has moved."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to compute on."""
    oracle: bool = False
    """Also measure the states that visdom-train --snapshots N kept, and note the one that is best on the test
    views. It is chosen by looking at the answers: it says what such a choice is worth, and is no result of the
    method."""
    quiet: bool = False
    """Print nothing but errors."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_evaluate, argv)


def _evaluate(argv: Sequence[str]) -> int:
    if read_early(argv).leave_one_out:
        from visdom_plugin.cli.evaluation import leave_one_out

        return leave_one_out.main([word for word in argv if word != "--leave-one-out"])
    options = tyro.cli(Options, args=argv, prog="visdom-eval")

    load_torch()
    from visdom_plugin.cli.runs import open_run
    from visdom_plugin.training.run import evaluate_again

    record, config, scene, method, hull, device, step = open_run(options.run, options.data, options.device)
    if record["status"] != "finished" and not options.quiet:
        say(f"the run is {record['status']}: this is its state after {step} steps")
    quiet = options.quiet
    if options.oracle:
        from visdom_plugin.cli.evaluation.select_on_test import find_snapshots, select_on_test

        # Before the views are measured, which takes a while.
        find_snapshots(options.run)
    record = evaluate_again(method, config, hull, scene, device=device, run_dir=options.run, quiet=quiet)
    if options.oracle:
        record = select_on_test(method, scene.test, device=device, run_dir=options.run)
    if not quiet:
        show_result(record, options.run)
        if options.oracle:
            show_oracle(record)
        show_next(options.run)
    return 0


if __name__ == "__main__":
    sys.exit(main())
