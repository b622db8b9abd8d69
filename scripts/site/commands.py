"""The page of all commands and options, made from what each command's --help says."""

from __future__ import annotations

import contextlib
import io
import os
import re
from importlib import import_module
from importlib.metadata import entry_points
from unittest import mock

COMMANDS = {
    "visdom-prepare": [],
    "visdom-check": [],
    "visdom-train": [
        ["method:visdom-gs"],
        ["method:3dgs-go+vd"],
        ["method:ingp+vd"],
        ["method:zipnerf-lite+vd"],
    ],
    "visdom-eval": [["--leave-one-out", "method:ingp+vd"]],
    "visdom-view": [],
    "visdom-render": [],
    "visdom-export": [],
    "visdom-report": [],
    "visdom-hull": [],
    "visdom-table": [["ablation", "method:ingp"]],
    "visdom-methods": [],
    "visdom-convert": [],
}
"""Commands in the order of use, with words that have options of their own."""
HEAD = """# Commands

For those who look up an option: every command, with an example and all its options, as `COMMAND --help` prints
them. `{None}|X` means that an option takes X and is unset by default.
"""


def make_page() -> str:
    """The whole page."""
    parts = [HEAD]
    for name, forms in COMMANDS.items():
        said = help_of(name, [])
        parts += [f"## {name}\n", render(said)]
        known = {option for option, _ in options(said)}
        for words in forms:
            own = help_of(name, words)
            parts += [f"### {name} {' '.join(words)}\n", render(own, known)]
    return "\n".join(parts)


def help_of(name: str, words: list[str]) -> str:
    """What the command says of itself."""
    (found,) = entry_points(group="console_scripts", name=name)
    main = getattr(import_module(found.module), found.attr)
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # tyro draws other boxes for other encodings
    # Of more than 127 columns tyro makes two, whose boxes stand side by side.
    narrow = mock.patch.dict(os.environ, {"COLUMNS": "120", "NO_COLOR": "1"})
    with narrow, contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    out.flush()
    return out.buffer.getvalue().decode()


def options(said: str) -> list[tuple[str, str]]:
    """(option, description) of each row of the boxes; what a box says of itself is left out."""
    rows: list[tuple[str, str]] = []
    for line in re.findall(r"^│ (.*?) *│$", said, re.M):
        if line.startswith(" ") and rows:
            rows[-1] = (rows[-1][0], f"{rows[-1][1]} {line.strip()}".strip())
            continue
        option, _, text = line.strip().partition("  ")
        if re.fullmatch(r"-.*|\[.*\]|[A-Z]+", option):
            rows.append((option, text.strip()))
    return [(option, text.removesuffix("(default: None)").strip()) for option, text in rows]


def render(said: str, known: set[str] = frozenset()) -> str:
    """Examples, usage, description and a list of the options that are not in `known`.

    With `known` the options of a method are wanted, of which the command's examples say nothing.
    """
    examples, _, rest = said.partition("usage: ")
    usage, _, rest = rest.partition("\n\n")
    about = _escape(rest.partition("╭")[0].strip())
    about = re.sub(r"^(method:\S+): (.*)\n(\n(?=method:))?", r"- `\1`: \2\n", about, flags=re.M)
    shown = [] if known else re.findall(r"^  (\S.*)$", examples, re.M)
    block = "\n".join([*shown, *([""] if shown else []), usage.strip()])
    rows = [(o, d) for o, d in options(said) if o not in known and not o.startswith("-h")]
    listed = "\n".join(f"`{option}`\n:   {_escape(text)}\n" for option, text in rows)
    return f"```\n{block}\n```\n\n{about}\n\n{listed}"


def _escape(text: str) -> str:
    return re.sub(r"`[^`]*`|([<*_\[\]])", lambda m: m[0] if m[1] is None else f"\\{m[1]}", text)
