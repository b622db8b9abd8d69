"""Methods and data of a table's jobs: what the tables room needs of the registry and the data modules."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Sequence

from visdom_plugin.cli.table_parts.table_data import DataHasher, require_views, tidy_reading
from visdom_plugin.errors import ConfigError, PluginError
from visdom_plugin.specs import check_requirements
from visdom_plugin.tables.run.jobs import Resolved, Workshop
from visdom_plugin.tables.spec import list_tables, load_table

log = logging.getLogger(__name__)

MODULES = {"train": "visdom_plugin.cli.commands.train", "hull": "visdom_plugin.cli.hulls.measure_hull"}
"""Kind of table to the module that does one of its jobs."""
MISSPELT = 0.75
"""Names as alike as this (difflib's ratio) are taken for one another's misspelling."""


def make_workshop(device: str = "auto", executor: str | None = None) -> Workshop:
    """What `tables.run.jobs.plan` asks for.

    Args:
        device: of all jobs, as --device has it.
        executor: as --executor has it; on a cluster, the device may not be known yet.
    """
    return Workshop(
        resolve=lambda kind, method, budget: _resolve(kind, method, budget, device, executor),
        modules=MODULES,
        hash_data=DataHasher(),
        tidy_reading=tidy_reading,
        require_views=require_views,
        device=device,
    )


def list_not_built() -> set[str]:
    """Methods that shipped tables name and that are not built here."""
    return {method for name in list_tables() for method in load_table(name).not_built}


def _refuse_misspelt(method: str, known: Sequence[str]) -> None:
    """Tells a misspelt method from one that is not installed, whose rows stay empty.

    Raises:
        ConfigError: for a name that is nearly a known one, or an unknown variant of a known one.
    """
    not_built = list_not_built()
    if method in not_built:
        return
    by_lower = {name.lower(): name for name in (*known, *not_built)}
    base = method.lower().partition("+")[0]
    near = difflib.get_close_matches(method.lower(), by_lower, 1, MISSPELT) or [base]
    if near[0] in by_lower:
        raise ConfigError(
            f"there is no method {method!r}; did you mean {by_lower[near[0]]!r}?",
            todo="correct the name, or install the package that offers it; `visdom-methods` lists what there is",
        )


def _resolve(kind: str, method: str, budget: str, device: str, executor: str | None) -> Resolved | None:
    from visdom_plugin import registry
    from visdom_plugin.cli.options import choose_budget

    if kind == "hull":
        from visdom_plugin.training.hull_run.config import METHOD, HullRunConfig

        if method != METHOD:
            raise ConfigError(f"a hull table has no method {method!r}", todo=f"method: {METHOD}")
        return Resolved(METHOD, "full", HullRunConfig())
    if budget == "auto" and executor == "slurm" and device == "auto":
        raise ConfigError(
            "budget auto cannot be known before a job stands on its node",
            todo="--budget quick or full, or --device cpu or cuda",
        )
    budget, _ = choose_budget(budget, device)
    try:
        preset = registry.find(method)
    except ConfigError:
        known = registry.installed()
        if not known.presets:
            raise
        _refuse_misspelt(method, [*known.presets, *known.aliases])
        log.warning("not available: no installed package offers %r", method)
        return None
    config = preset.settings(budget)
    try:
        check_requirements(config)
    except PluginError as error:
        log.warning("not available: %s\n%s", preset.name, error)
        return None
    return Resolved(preset.name, budget, config)
