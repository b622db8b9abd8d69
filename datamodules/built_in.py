"""Names of the built-in scenes; free of heavy imports, so that command lines can list them."""

from __future__ import annotations

from pathlib import Path

from visdom_plugin.errors import unknown_name

PREFIX = "builtin:"
NAMES = {
    "watering-can": "hollow and textured, with a thin bail; what is loaded where no scene is named",
    "duck": "smooth and glossy, of few colours",
    "figure": "a person with arms and legs apart",
    "chair": "thin and open",
}
"""What `builtin:` takes, and what each is like."""
DEFAULT = "watering-can"


def on_disk(path: str | Path | None) -> Path | None:
    """The folder that `path` names; None where it is a built-in scene's.

    Raises:
        ConfigError: there is no built-in scene of that name.
    """
    return None if path is None or named_built_in(path) is not None else Path(path)


def named_built_in(path: str | Path | None) -> str | None:
    """The name of the built-in scene that `path` asks for; None where it is a folder's.

    Raises:
        ConfigError: there is none of that name.
    """
    if path is None:
        return DEFAULT
    text = str(path)
    if not text.startswith(PREFIX):
        return None
    name = text.removeprefix(PREFIX)
    if name not in NAMES:
        names = [PREFIX + known for known in NAMES]
        raise unknown_name(f"there is no built-in scene {text!r}", text, names)
    return name
