"""visdom-table: makes a table of methods, scenes, views and seeds from a file, and the runs behind it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import tyro

from visdom_plugin.cli.clashes import NEEDS_OF_TABLE, refuse_unread
from visdom_plugin.cli.early import read_early
from visdom_plugin.cli.entry import run
from visdom_plugin.cli.table_parts.run_table import TableOptions, change_spec, run_spec
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.spec import list_tables, load_table


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return run(_main, argv)


def _main(argv: Sequence[str]) -> int:
    if "ablation" in argv[:1] or read_early(argv).methods:
        return _ablation(argv)
    options = tyro.cli(TableOptions, args=list(argv), prog="visdom-table")
    if options.table == "ablation":
        return _ablation(argv)
    if options.table is None and options != TableOptions(quiet=options.quiet):
        todo = "visdom-table NAME and these options; without any, the shipped tables are listed"
        raise ConfigError("no table is named", todo=todo)
    if options.table is None:
        for name in list_tables():
            spec = load_table(name)
            also = f"  (editions: {', '.join(spec.editions)})" if spec.editions else ""
            sys.stdout.write(f"{name:<20} {spec.title}{also}\n")
        sys.stdout.write(f"{'ablation':<20} One method of your choice in five variants, on your scene\n")
        return 0
    refuse_unread(argv, NEEDS_OF_TABLE)
    spec = change_spec(load_table(options.table, options.edition), options)
    return run_spec(spec, options)[0]


def _ablation(argv: Sequence[str]) -> int:
    from visdom_plugin.cli.table_parts.ablation import ablation

    return ablation(argv)


if __name__ == "__main__":
    sys.exit(main())
