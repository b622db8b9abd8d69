"""Small tables of fake methods, and a driver process of them that can be killed."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from visdom_plugin.atomic_files import write_bytes
from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.results import Results
from visdom_plugin.tables.run.driver import run_plan
from visdom_plugin.tables.run.executors import Local
from visdom_plugin.tables.run.jobs import Plan, Resolved, Workshop, plan
from visdom_plugin.tables.spec import TableSpec, parse_table

ROOT = Path(__file__).resolve().parents[2]
METHODS = ("one", "two", "three+vd")


@dataclass(frozen=True)
class FakeHull:
    kind: str = "visdom"
    k: int = 3


@dataclass(frozen=True)
class FakeHook:
    enabled: bool = False


@dataclass(frozen=True)
class FakeConfig:
    steps: int = 3
    seconds: float = 0.0
    complaint: str = ""
    crash: bool = False
    dies_at: int = -1
    dies_once: bool = True
    rate: float = 0.1
    hull: FakeHull = field(default_factory=FakeHull)
    vd: FakeHook = field(default_factory=FakeHook)

    def __post_init__(self):
        if self.rate < 0:
            raise ConfigError(f"rate is {self.rate}", where="FakeConfig", todo="use 0 or more")


def resolve(kind: str, method: str, budget: str) -> Resolved | None:
    if method not in METHODS:
        return None
    return Resolved(
        method, "quick" if budget == "auto" else budget, FakeConfig(vd=FakeHook(method.endswith("vd")))
    )


def workshop(**changes: Any) -> Workshop:
    modules = {"train": "tests.tables.run.fake_train", "hull": "tests.tables.run.fake_train"}
    return Workshop(**({"resolve": resolve, "modules": modules, "hash_data": hash_data} | changes))


def hash_data(kind: str, folder: Path | None, reading: dict[str, Any], config: FakeConfig) -> str:
    """A scene of the fakes is its poses."""
    return "drawn" if folder is None else (folder / "poses.json").read_text()


def table(rows: list[dict[str, Any]] | None = None, **changes: Any) -> TableSpec:
    rows = rows or [{"label": name.title(), "method": name} for name in METHODS[:2]]
    content = {"rows": rows, "columns": [{"label": "column"}], "seeds": [0, 1], **changes}
    return parse_table(content, "small", "small.yaml")


def make(folder: Path, spec: TableSpec | None = None, **changes: Any) -> Plan:
    return plan(spec or table(), folder / "runs", workshop(**changes))


def write(folder: Path):
    """A writer: one line per job, which leaves out what depends on the folder."""

    def to_file(results: Results) -> None:
        lines = [
            f"{job.row} {job.scene} {job.views} {job.seed} {outcome.status} "
            f"{(outcome.record or {}).get('metrics', {}).get('test')} {outcome.error}"
            for job, outcome in results.outcomes.items()
        ]
        write_bytes(folder / "table.txt", "\n".join(lines).encode())

    return to_file


def long_table(seconds: float = 0.02) -> TableSpec:
    """Six runs of ten steps, one of which fails and one of which is killed once from within."""
    rows = [
        {"label": "One", "method": "one"},
        {"label": "Two", "method": "two", "settings": {"complaint": "no such thing"}},
        {"label": "Three", "method": "three+vd", "settings": {"dies_at": 4}},
    ]
    return table(rows, settings={"steps": 10, "seconds": seconds})


def table_of(folder):
    return (folder / "table.txt").read_text()


if __name__ == "__main__":
    target = Path(sys.argv[1])
    run_plan(make(target, long_table()), Local(2, threads=1), write(target))
