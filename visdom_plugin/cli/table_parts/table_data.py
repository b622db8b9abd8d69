"""Hashes of the files that a table's jobs read, and the check of a column's `reading`."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datamodules.built_in import named_built_in
from visdom_plugin.cli.options import READING, Common, resolve_lists
from visdom_plugin.errors import ConfigError, SceneError, unknown_name
from visdom_plugin.hull.settings import HullSettings
from visdom_plugin.tables.spec import Settings
from visdom_plugin.training.runs.config_io import from_plain

OWN = ("views", "downscale", "seed", "data_format")
"""How a scene is read that a table says in places of their own, not in a column's `reading`."""


def tidy_reading(reading: Settings, where: str) -> Settings:
    """A column's `reading`, checked; index files by their full path.

    Raises:
        ConfigError: for names that do not belong there, and values of the wrong type.
    """
    valid = [name for name in READING if name not in OWN]
    for name in reading:
        if name not in valid:
            raise unknown_name(
                f"reading cannot hold {name!r}",
                name,
                valid,
                where=where,
                cause="a table has its own place for it" if name in OWN else None,
                todo="valid names in reading",
            )
    checked = from_plain(Common(), dict(reading), where, "reading")
    return resolve_lists({name: getattr(checked, name) for name in reading})


def require_views(settings: object, views: int) -> None:
    """Raises ConfigError where a row's hull has a K above the number of views; settings without a hull pass."""
    hull = getattr(settings, "hull", None)
    if isinstance(hull, HullSettings):
        hull.require_views(views)


class DataHasher:
    """Hashes of what jobs are made from. Each file is read once; make another when files may have changed."""

    def __init__(self) -> None:
        self._files: dict[Path, str] = {}
        self._found: dict[str, Any] = {}

    def __call__(self, kind: str, folder: Path | None, reading: Settings, settings: object) -> str:
        """A hash of the files that one job reads.

        Args:
            kind: of the table; the true surface counts for those that measure against it.
            folder: the scene's; None, or builtin:NAME, for a built-in scene.
            reading: how it is read, `views` and `downscale` among it.
            settings: the job's resolved settings.

        Raises:
            SceneError: for a scene that cannot be read.
            ConfigError: for a reading that does not fit the scene.
        """
        if _name_built_in(folder) is not None:
            from datamodules.synthetic.config import SyntheticConfig

            SyntheticConfig(train_views=int(str(reading["views"]))).check()
            found, digest = None, self._once("built-in", hash_built_in)
        else:
            assert folder is not None
            key = json.dumps([str(folder), dict(reading)], sort_keys=True)
            found = self._once(key, lambda: self._look(folder, reading))
            digest = found.digest
        if kind == "hull":
            from datamodules.fingerprint import hash_file
            from visdom_plugin.cli.hulls.measure_hull import find_target
            from visdom_plugin.training.hull_run.config import HullRunConfig

            assert isinstance(settings, HullRunConfig)

            path = find_target(folder, settings.target, found and found.frame)
            if path is not None:
                surface = self._once(f"surface {path}", lambda: hash_file(path))
                return hashlib.sha256(f"{digest} {surface}".encode()).hexdigest()
        return digest

    def _look(self, folder: Path, reading: Mapping[str, Any]) -> Any:
        from datamodules.fingerprint import take_fingerprint
        from visdom_plugin.cli.scenes import load_options

        with _hushed():
            found = take_fingerprint(folder, known=self._files, **load_options(**reading))
        if found.train != reading["views"]:
            listed = "train_list lists" if reading.get("train_list") is not None else "the scene has only"
            raise ConfigError(
                f"{listed} {found.train} training views, views says {reading['views']}",
                cause="the table would be labelled with another number of views than its runs have",
                todo=f"views: {found.train}",
            )
        return found

    def _once(self, key: str, make: Callable[[], Any]) -> Any:
        if key not in self._found:
            try:
                self._found[key] = make()
            except SceneError as error:
                self._found[key] = error
        if isinstance(self._found[key], SceneError):
            raise self._found[key]
        return self._found[key]


def _name_built_in(folder: Path | None) -> str | None:
    """`named_built_in`, for who reads a table."""
    try:
        return named_built_in(folder)
    except ConfigError as error:
        cause = "a column without `root:` names built-in scenes; that of a data root needs --root NAME=DIR"
        raise ConfigError(error.what, cause=cause, todo=error.todo, topic=error.topic) from error


def hash_built_in() -> str:
    """A hash of the code that draws the built-in scenes."""
    import datamodules

    digest = hashlib.sha256()
    for path in sorted((Path(datamodules.__file__).parent / "synthetic").rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@contextmanager
def _hushed() -> Iterator[None]:
    """What readers remark on a scene stands in the logs of its runs."""
    readers = logging.getLogger("datamodules")
    before = readers.level
    readers.setLevel(logging.ERROR)
    try:
        yield
    finally:
        readers.setLevel(before)
