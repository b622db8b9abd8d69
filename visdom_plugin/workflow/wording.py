"""Wording of errors for who calls a function: arguments in place of a command's options."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from visdom_plugin.errors import VisDomError

P = ParamSpec("P")
T = TypeVar("T")

_COMMAND = re.compile(r"`[^`]*`|\bvisdom-\w+[^\n;,]*")
_OPTION = re.compile(r"--(?:data\.|method\.)?([a-z][a-z.-]*[a-z])")


def for_callers(function: Callable[P, T]) -> Callable[P, T]:
    """A function whose errors name its arguments, where those below name the options of commands."""

    @functools.wraps(function)
    def spoken(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return function(*args, **kwargs)
        except VisDomError as error:
            parts = (error.what, None if error.where is None else str(error.where), error.cause, error.todo)
            said = [None if part is None else name_arguments(part) for part in parts]
            if said == list(parts):
                raise
            what, where, cause, todo = said
            raise type(error)(what or "", where=where, cause=cause, todo=todo, topic=error.topic) from error

    return spoken


def name_arguments(text: str) -> str:
    """`--train-list all` as `train_list all`; commands that a text quotes or spells out stay as they are."""

    def words(part: str) -> str:
        return _OPTION.sub(lambda found: found[1].replace("-", "_"), part)

    pieces, at = [], 0
    for command in _COMMAND.finditer(text):
        pieces += [words(text[at : command.start()]), command[0]]
        at = command.end()
    return "".join([*pieces, words(text[at:])])
