"""visdom-methods: lists the methods that can be trained here, and the libraries found."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from visdom_plugin import registry
from visdom_plugin.cli import entry


@dataclass(frozen=True)
class Options:
    """List the methods that visdom-train can train."""

    doctor: bool = False
    """Also list libraries and devices found, and plugins that were skipped."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return entry.run(_list, argv)


def _list(argv: Sequence[str]) -> None:
    import tyro

    options = tyro.cli(Options, args=argv, prog="visdom-methods")
    known = registry.installed()
    names: dict[str, list[str]] = {name: [] for name in known.presets}
    for alias, name in known.aliases.items():
        names[name].append(alias)
    width = max((len(n) for n in names), default=0) + len("method:")
    for name, aliases in names.items():
        also = f" (also method:{', method:'.join(aliases)})" if aliases else ""
        sys.stdout.write(f"{'method:' + name:<{width}}  {known.presets[name].description}{also}\n")
    if not names:
        sys.stdout.write("no methods found: pip install -e . (or pip install visdom-plugin)\n")
    if options.doctor:
        from visdom_plugin.cli.methods_doctor import examine

        sys.stdout.write("\n" + "\n".join(examine(known)) + "\n")


if __name__ == "__main__":
    sys.exit(main())
