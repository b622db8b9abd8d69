"""Protocols of a table's numbers: different ones are refused in one table, unless the table allows it.

Before the first job, settings are compared: budget and downscale, and of rows with a visible-domain hook (of all
rows, in a hull table) K and the kind of hull. When runs are finished, their records are: evaluation background,
definition of the metrics, schema, and which views a scene's training and test views are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from visdom_plugin.errors import ConfigError
from visdom_plugin.tables.results import Results

Fact = tuple[str, object, str]
"""Name, value, and whose it is, e.g. ("hull.k", 3, "row 'INGP'")."""


def facts_of_settings(config: Mapping[str, Any], kind: str) -> dict[str, object]:
    """Facts of one row's resolved settings (plain data); those that do not apply are left out."""
    if kind == "hull":
        hull = config.get("hull", config)
    else:
        vd = config.get("vd") or {}
        hull = config.get("hull") if vd.get("enabled") else None
    if not hull or "kind" not in hull:
        return {}
    facts = {"hull.kind": hull["kind"]}
    if hull["kind"] == "visdom":
        facts["hull.k"] = hull.get("k")
    return facts


def facts_of_record(record: Mapping[str, Any]) -> dict[str, object]:
    """Facts of one run.json. Runs that do not note a fact count as one more value, never as agreeing."""
    protocol = (record.get("metrics") or {}).get("protocol") or {}
    return {
        "schema": record.get("schema"),
        "evaluation.background": protocol.get("background"),
        "metrics.definition": protocol.get("definition"),
    }


def refuse_mixture(
    facts: Iterable[Fact], varies: Iterable[str], where: str, scope: str = "the table"
) -> None:
    """Raises ConfigError where one fact has two values and `varies` does not name it."""
    allowed = set(varies)
    seen: dict[str, tuple[object, str]] = {}
    for name, value, owner in facts:
        first, first_owner = seen.setdefault(name, (value, owner))
        if first != value and name not in allowed:
            raise ConfigError(
                f"{scope} mixes protocols: {name} is {_spell(first)} for {first_owner} "
                f"and {_spell(value)} for {owner}",
                where=where,
                todo=f"make them equal, or say that they may differ: varies: [{name}]",
            )


def check_records(results: Results) -> None:
    """Compares what finished runs say of themselves.

    Raises:
        ConfigError: when evaluation, metrics, schema, or the views of one scene differ between runs.
    """
    spec = results.spec
    every: list[Fact] = []
    views: dict[tuple[int, str, int], list[Fact]] = {}
    for job, outcome in results.outcomes.items():
        if outcome.record is None:
            continue
        owner = f"row {spec.rows[job.row].label!r} ({job.run_dir})"
        every += [(name, value, owner) for name, value in facts_of_record(outcome.record).items()]
        data = outcome.record.get("data") or {}
        names = {"train": data.get("train"), "test": data.get("test"), "downscale": data.get("downscale")}
        views.setdefault((job.column, job.scene, job.views), []).append(("views", names, owner))
    refuse_mixture(every, spec.varies, spec.source)
    for (column, scene, _), facts in views.items():
        scope = f"scene {scene!r} of column {spec.columns[column].label!r}"
        refuse_mixture(facts, spec.varies, spec.source, scope)


def _spell(value: object) -> str:
    text = "not noted" if value is None else repr(value)
    return text if len(text) <= 160 else text[:157] + "..."
