"""The run directory: what a training run leaves on disk, and who may write to it.

    run.json  log.jsonl  checkpoints/  snapshots/  hull/{hull.npz,hull.ply,reference.npz}  renders/  export/
    report.html  report/

A directory belongs to one config, one seed and one data set. It is resumed by the same, and never resumed or
overwritten by another unless the user says so.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import shutil
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TextIO, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from visdom_plugin.atomic_files import MARK, remove_parts, write_bytes, write_json
from visdom_plugin.errors import CheckpointError, list_some
from visdom_plugin.scene import Scene, Views
from visdom_plugin.training.runs.checkpoints import list_steps
from visdom_plugin.training.runs.config_io import as_plain, differences

log = logging.getLogger(__name__)

Record: TypeAlias = dict[str, Any]
"""run.json, or an entry of it: plain data."""

SCHEMA = 1
IDENTITY = ("method", "scene", "seed", "config", "data")
"""Fields of run.json that say which run it is."""
_WHEREABOUTS = ("path", "root", "split", "train_list", "test_list")
"""What `data` says of where the data lies and how its views were chosen. That may change, as may the scene's name;
what must agree for a run to be resumed are the views' names, the hashes, and the other fields of `IDENTITY`."""
_OURS = (
    "log.jsonl",
    "checkpoints",
    "snapshots",
    "hull",
    "renders",
    "export",
    "report",
    "report.html",
    "run.json",
)
_LOCK = "run.lock"


def hash_views(views: Views) -> str:
    """SHA-256 of everything training can see of the views: pixels, masks, depths, cameras, names, and the points
    that it is to start from.

    Of views that are decoded on first use, their files are hashed in place of their pixels.
    """
    digest = hashlib.sha256()

    def add(*arrays: ArrayLike) -> None:
        for array in arrays:
            array = np.ascontiguousarray(array)
            digest.update(f"{array.dtype}{array.shape}".encode())
            digest.update(array.tobytes())

    cameras = views.cameras
    add(cameras.intrinsics.double(), cameras.world_from_camera.double(), cameras.width, cameras.height)
    if views.points is not None:
        add(*views.points)
    later = getattr(views.images, "fingerprint", None)
    if later is not None:
        digest.update(f"{later} {list(views.names)} {list(views.mask_origins)}".encode())
        return digest.hexdigest()
    for i, name in enumerate(views.names):
        digest.update(name.encode())
        add(views.images[i], views.masks[i])
        depth, ignored = views.mono_depths[i] if views.mono_depths else None, views.ignored(i)
        if depth is not None:
            add(depth)
        if ignored is not None:
            digest.update(b"ignore")
            add(ignored)
        if views.mask_origin(i) != "given":
            digest.update(views.mask_origin(i).encode())
    return digest.hexdigest()


def describe_data(scene: Scene, request: Record) -> Record:
    """The `data` entry of run.json.

    Args:
        request: how the scene was asked for, enough to load it again: path (None for the built-in scene),
            views, downscale, seed.
    """
    return as_plain(
        {
            "root": None,
            "layout": None,
            "downscale": 1,
            **scene.source,
            **request,
            "units": scene.units,
            "train": list(scene.train.names),
            "test": list(scene.test.names),
            "hashes": {
                **scene.source.get("hashes", {}),
                "train_views": hash_views(scene.train),
                "test_views": hash_views(scene.test),
            },
        }
    )


class RunDir:
    """An opened run directory. Only one process at a time holds it; `close` lets it go."""

    def __init__(self, path: Path):
        self.path = Path(path)
        self.record: Record = {}
        self._lock: TextIO | None = None
        self._is_new = False

    @classmethod
    def open(
        cls, path: Path, identity: Record, *, overwrite: bool = False, defaults: Record | None = None
    ) -> RunDir:
        """Creates the directory, or opens it when it holds the same run.

        Args:
            identity: the fields `IDENTITY`.
            overwrite: throw away the run that is there, unless it is the same one and was cut short.
            defaults: of the config: what a run meant that was written before a setting was there.

        Raises:
            CheckpointError: when the directory holds another run or foreign files, or when another process
                is writing to it.
        """
        run = cls(path)
        if run.path.exists() and not run.path.is_dir():
            raise CheckpointError("the run directory is a file", where=run.path, todo="choose another --out")
        foreign = run._foreign()
        if foreign:
            raise CheckpointError(
                f"the directory holds files that are not a run's: {list_some(foreign, 3)}",
                where=run.path,
                todo="choose an empty directory with --out; nothing was changed",
                topic="other-run",
            )
        try:
            run.path.mkdir(parents=True, exist_ok=True)
            run._take_lock()
        except OSError as error:
            raise CheckpointError(
                f"the run directory cannot be written: {error.strerror}",
                where=run.path,
                todo="choose another --out",
            ) from error
        try:
            remove_parts(run.path)
            run._is_new = not (run.path / "run.json").exists()
            if not run._is_new:
                if overwrite and not run._goes_on(identity, defaults):
                    run._clear()
                else:
                    run.record = read_record(run.path)
                    run._refuse_other(identity, defaults)
            run.record = {"schema": SCHEMA, "status": "running", **run.record, **identity}
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def open_existing(cls, path: Path) -> RunDir:
        """Opens a run directory whatever run it holds.

        Raises:
            CheckpointError: when it is none, or when another process is writing to it.
        """
        run = cls(path)
        run.record = read_record(run.path)
        run._take_lock()
        return run

    def update(self, **fields: object) -> None:
        """Changes fields of run.json."""
        self.record |= as_plain(fields)
        write_json(self.path / "run.json", self.record)

    def discard(self) -> None:
        """Removes the directory if this process made the run and saved no state; else marks the run failed."""
        if not self._is_new or list_steps(self.path / "checkpoints"):
            self.update(status="failed")
        else:
            self._clear()
            (self.path / _LOCK).unlink(missing_ok=True)
            with suppress(OSError):
                self.path.rmdir()

    def close(self) -> None:
        """Lets another process in."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def __enter__(self) -> RunDir:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def log(self, row: Record) -> None:
        """Appends one line to log.jsonl."""
        with (self.path / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def truncate_log(self, step: int) -> None:
        """Drops lines from steps that a resumed run does again, and a line cut short."""
        path = self.path / "log.jsonl"
        if not path.exists():
            return
        kept = []
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if json.loads(line)["step"] <= step:
                    kept.append(line + "\n")
            except (ValueError, KeyError, TypeError):
                continue
        write_bytes(path, "".join(kept).encode())

    def _foreign(self) -> list[str]:
        if not self.path.is_dir() or (self.path / "run.json").exists():
            return []
        return sorted(p.name for p in self.path.iterdir() if p.name != _LOCK and not p.name.startswith(MARK))

    def _take_lock(self) -> None:
        if os.name != "posix":
            return
        import fcntl

        lock = (self.path / _LOCK).open("a+")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            owner = lock.read().strip()
            lock.close()
            raise CheckpointError(
                "another process is training into this run directory"
                + (f" (process {owner})" if owner else ""),
                where=self.path,
                todo="wait for it, stop it, or choose another --out",
                topic="busy-run",
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        self._lock = lock

    def _clear(self) -> None:
        # run.json goes last: until then the directory still says that it is a run.
        for name in _OURS:
            target = self.path / name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)

    def _goes_on(self, identity: Record, defaults: Record | None) -> bool:
        """Whether the directory holds this very run, interrupted or killed."""
        try:
            record = read_record(self.path)
        except CheckpointError:
            return False
        same = not differences(_decisive(record, defaults), _decisive(identity))
        if not same or record.get("status") not in ("interrupted", "running"):
            return False
        log.info("the run directory holds this run, cut short: it goes on (--overwrite is for other runs)")
        return True

    def _refuse_other(self, identity: Record, defaults: Record | None) -> None:
        decisive = _decisive(self.record, defaults)
        if differences(decisive, _decisive(identity)):
            there, now = ({name: record.get(name) for name in IDENTITY} for record in (self.record, identity))
            there["config"] = decisive["config"]
            lines = differences(there, now)
            # What the data hash to follows from how they are read.
            lines = [line for line in lines if not line.startswith("data.hashes.")] or lines
            more = f"\n    and {len(lines) - 8} more" if len(lines) > 8 else ""
            raise CheckpointError(
                "the run directory holds another run (there -> now):\n    " + "\n    ".join(lines[:8]) + more,
                where=self.path,
                todo=f"--out {free_name(self.path)} keeps both, --overwrite replaces what is there",
                topic="other-run",
            )


def free_name(path: Path) -> Path:
    """A name beside a run directory that nothing has yet: 0-2 for 0."""
    number = 2
    while (free := path.with_name(f"{path.name}-{number}")).exists():
        number += 1
    return free


def _decisive(record: Record, defaults: Record | None = None) -> Record:
    """What must agree in two records of one run."""
    if defaults is not None:
        record = record | {"config": _filled(record.get("config"), defaults)}
    data = record.get("data")
    if isinstance(data, dict):
        # An option that nobody gave may be new since the record was written.
        data = {name: v for name, v in data.items() if name not in _WHEREABOUTS and v not in (None, False)}
    return {name: record.get(name) for name in IDENTITY if name != "scene"} | {"data": data}


def _filled(config: object, defaults: object) -> object:
    """A config as plain data, with the defaults of settings that it lacks."""
    if not isinstance(config, dict) or not isinstance(defaults, dict):
        return config
    return defaults | {name: _filled(value, defaults.get(name)) for name, value in config.items()}


def read_record(path: Path) -> Record:
    """run.json of a run directory.

    Raises:
        CheckpointError: when the directory is no run, or its run.json is damaged or of a newer version.
    """
    path = Path(path)
    if not (path / "run.json").is_file():
        inside = sorted(p.parent for p in path.glob("**/run.json"))[:3] if path.is_dir() else []
        raise CheckpointError(
            "this is not a run directory: it has no run.json" if path.exists() else "there is no such folder",
            where=path,
            cause=f"one level too high: {', '.join(map(str, inside))}" if inside else None,
            todo="give the directory that visdom-train named at its end, runs/<scene>/<views>/<method>/<seed>",
        )
    try:
        record = json.loads((path / "run.json").read_text(encoding="utf-8"))
        schema = record["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"run.json cannot be read: {error}", where=path / "run.json", todo="train again with --overwrite"
        ) from error
    if schema != SCHEMA:
        raise CheckpointError(
            f"run.json has schema {schema}, this version reads {SCHEMA}",
            where=path / "run.json",
            todo="use the version of visdom-plugin that wrote it",
        )
    return record


def find_versions() -> dict[str, str | None]:
    """Versions of what the numbers depend on."""
    found: dict[str, str | None] = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("visdom-plugin", "torch", "numpy", "numba", "gsplat"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found
