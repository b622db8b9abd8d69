"""Entry of every command: errors become exit statuses, messages go to stderr."""

from __future__ import annotations

import errno
import gc
import logging
import shlex
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, TextIO

from visdom_plugin.cli.clashes import refuse_clashes
from visdom_plugin.cli.early import read_early
from visdom_plugin.cli.output.examples import examples_of, missing_subject, program_of
from visdom_plugin.compute import ahead
from visdom_plugin.compute.process import keep_freed_memory, wait_briefly
from visdom_plugin.compute.waiting import screen
from visdom_plugin.errors import ConfigError, VisDomError, say_more
from visdom_plugin.hull.wording import for_commands

USER_ERROR, INTERRUPTED = 2, 130
BUG = "this is a bug in visdom-plugin or in a plugin; please report it with:"

_OUTSIDE = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP),
}
"""Faults of the disk or of a path that was given, not of the program: full, over quota, not allowed, read-only; a
file where a folder should be or the other way round, a path that is too long or leads in circles."""


def run(command: Callable[[Sequence[str]], int | None], argv: Sequence[str] | None = None) -> int:
    """Calls a command and turns what it raises into an exit status.

    Args:
        command: takes the arguments, returns an exit status (None is 0).
        argv: arguments without the program's name, by default those of the process.

    Returns:
        2 for a user's mistake (the message is on stderr, without traceback), 130 when interrupted.
        Any other exception goes on, with a line that calls it a bug.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    early = read_early(words)
    examples = examples_of(command)
    wait_briefly()
    keep_freed_memory()
    set_up_logging(early.quiet)
    if early.version:
        print(f"visdom-plugin {version('visdom-plugin')}")
        return 0
    try:
        _check_views(early.views)
        if not words and (missing := missing_subject(command)):
            raise ConfigError(missing, todo=", or ".join(examples))
        if not early.help:
            refuse_clashes(words)
        elif examples:
            print("Examples:", *examples, sep="\n  ", end="\n\n")
        screen.turn(not early.quiet)
        ahead.prepare()
        with for_commands():
            return command(words) or 0
    except VisDomError as error:
        print(f"error: {error}\n{say_more(error.topic)}", file=sys.stderr)
        return USER_ERROR
    except SystemExit as stop:
        if stop.code == USER_ERROR and examples:  # tyro's: it has said what is wrong with the words
            print(f"for example: {examples[0]}", file=sys.stderr)
        raise
    except KeyboardInterrupt as stop:
        # By name, because importing the class would import torch.
        resumable = type(stop).__name__ == "Interrupted"
        again = "; the same command resumes" if resumable else ""
        if program := program_of(command):
            how = "go on" if resumable else "repeat"
            again = f"; {how} with: {shlex.join([program, *words])}"
        print(f"interrupted{again}", file=sys.stderr, flush=True)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader went away, as in `visdom-methods | head`.
        sys.stderr.close()
        return 0
    except OSError as error:
        if error.errno not in _OUTSIDE:
            print(BUG, file=sys.stderr)
            raise
        print(
            f"error: {error}\n  what to do: free disk space or choose another location, then repeat the command\n"
            f"{say_more('disk')}",
            file=sys.stderr,
        )
        return USER_ERROR
    except Exception:
        print(BUG, file=sys.stderr)
        raise
    finally:
        screen.turn(False)
        ahead.finish()
        if argv is None:
            gc.freeze()  # the interpreter ends, and looks at no object again: half a second with torch and numba


def _check_views(text: str | None) -> None:
    if text is not None and not text.lstrip("-").isdecimal():
        raise ConfigError(
            f"--views is {text!r}, and it takes one whole number",
            cause="several numbers of views at once" if "," in text else None,
            todo="run once for each number, or write a table with `views: [4, 6]` for visdom-table; views by name "
            "or position go to --train-list",
        )


def set_up_logging(quiet: bool = False) -> None:
    """Warnings, and with `quiet` only errors, on stderr."""
    root = logging.getLogger()
    if not root.handlers:
        handler = _Handler()
        handler.setFormatter(_Plain())
        root.addHandler(handler)
    for name in ("visdom_plugin", "datamodules", "method_configs"):
        logging.getLogger(name).setLevel(logging.ERROR if quiet else logging.INFO)


if TYPE_CHECKING:
    _StreamHandler = logging.StreamHandler[TextIO]
else:
    _StreamHandler = logging.StreamHandler


class _Handler(_StreamHandler):
    def emit(self, record: logging.LogRecord) -> None:
        screen.clear()
        super().emit(record)


class _Plain(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno < logging.WARNING else f"{record.levelname.lower()}: {text}"
