"""The option `--method`, for pytest runs of this package alone: pytest loads this module at its start."""

from __future__ import annotations

import pytest

PACKAGE = "visdom_plugin", "conformance"


def pytest_load_initial_conftests(early_config, parser, args) -> None:
    """Adds the option where the arguments name this package, so that it is in nobody else's way."""
    if any(all(part in word for part in PACKAGE) for word in args):
        parser.addoption(
            "--method",
            action="append",
            dest="visdom_methods",
            metavar="NAME",
            help="method to check, as visdom-methods lists it; may be given several times",
        )


def pytest_configure(config) -> None:
    """Puts names of methods, without their variants, in place of what was given.

    Raises:
        UsageError: where none is given, or one is unknown.
    """
    if not hasattr(config.option, "visdom_methods") or config.option.help or config.option.version:
        return
    from visdom_plugin import registry
    from visdom_plugin.errors import VisDomError

    known = registry.installed()
    if not config.option.visdom_methods:
        bases = dict.fromkeys(name.partition("+")[0] for name in known.presets)
        raise pytest.UsageError(
            "say which method to check: pytest --pyargs visdom_plugin.conformance --method NAME\n"
            f"  NAME is one of: {', '.join(bases)}"
        )
    try:
        found = [
            known.find(name.removeprefix("method:").partition("+")[0])
            for name in config.option.visdom_methods
        ]
    except VisDomError as error:
        raise pytest.UsageError(str(error)) from error
    config.option.visdom_methods = [preset.name for preset in found]


def pytest_report_header(config) -> str | None:
    """Says what is checked."""
    names = getattr(config.option, "visdom_methods", None)
    return f"visdom conformance of {', '.join(names)}" if names else None
