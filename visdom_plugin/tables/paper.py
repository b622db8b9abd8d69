"""The paper's numbers, to stand beside ours: reads the CSV files in `paper_numbers/` and finds a cell's entry.

They are those of the TeX source of arXiv 2606.20531. `project_page.csv` holds what the project page
(tarun738.github.io/visdom, commit 11fc402 of its repository) prints otherwise.

Columns: table, dataset, views, method, variant, metric, value. `views` is a number of cameras, "mean" (over the
numbers of cameras, as printed) or "all".
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources

from visdom_plugin.errors import ConfigError, unknown_name

KEYS = ("dataset", "views", "method", "variant", "metric")
GIVEN = ("dataset", "views", "method", "variant")
"""What a row or a column of a table may say about its place in the paper."""
_PAGE = "project_page.csv"
_GAIN = {"psnr_db": ("psnr_gain_db", "vd_dilate_r0")}
"""A metric whose gains are printed in place of values, over the values of this variant."""


@dataclass(frozen=True)
class Numbers:
    """One table of the paper."""

    name: str
    values: Mapping[tuple[str, ...], float]
    """By the fields `KEYS`."""
    page: Mapping[tuple[str, ...], float] = field(default_factory=dict)
    """What the project page prints in place of some of them."""

    def find(self, **query: object) -> float | None:
        """The number with these fields (all of `KEYS`); None where the paper prints none.

        Where the paper prints a gain over another variant, the sum of both.
        """
        key = tuple(str(query.get(name)) for name in KEYS)
        if key in self.values or key[-1] not in _GAIN:
            return self.values.get(key)
        gain, base = _GAIN[key[-1]]
        more, less = self.values.get((*key[:-1], gain)), self.values.get((*key[:3], base, key[-1]))
        return None if more is None or less is None else more + less

    def check(self, given: Mapping[str, object] | None, where: object) -> None:
        """Refuses fields and values that this table of the paper does not have.

        Raises:
            ConfigError: with the nearest and all valid ones.
        """
        for name, value in (given or {}).items():
            if name not in GIVEN:
                what = f"the paper's tables have no field {name!r}"
                raise unknown_name(what, name, GIVEN, where=where)
            place = KEYS.index(name)
            known = list(dict.fromkeys(key[place] for key in self.values))
            if str(value) not in known:
                what = f"the paper's table {self.name!r} has no {name} {value!r}"
                raise unknown_name(what, value, known, where=where)


def list_papers() -> list[str]:
    """Names of the paper's tables that are shipped."""
    files = (f.name for f in _folder().iterdir())
    return sorted(name[:-4] for name in files if name.endswith(".csv") and name != _PAGE)


@cache
def load_numbers(name: str) -> Numbers:
    """The paper's table of a name, or several with "+" between them.

    Raises:
        ConfigError: for an unknown name, and for tables that print two values for one place.
    """
    known = list_papers()
    names = [part.strip() for part in name.split("+")]
    if len(names) > 1:
        values: dict[tuple[str, ...], float] = {}
        page: dict[tuple[str, ...], float] = {}
        for part in map(load_numbers, names):
            page |= part.page
            for key, value in part.values.items():
                if values.setdefault(key, value) != value:
                    raise ConfigError(f"the paper's tables {name} contradict each other: {', '.join(key)}")
        return Numbers(name, values, page)
    if name not in known:
        raise unknown_name(f"the paper's numbers have no table {name!r}", name, known)
    text, other = ((_folder() / file).read_text(encoding="utf-8") for file in (f"{name}.csv", _PAGE))
    head, *lines = other.splitlines(keepends=True)
    of_table = head + "".join(line for line in lines if line.startswith(f"{name},"))
    return Numbers(name, read_numbers(text, name), read_numbers(of_table, _PAGE))


def read_numbers(text: str, where: object) -> dict[tuple[str, ...], float]:
    """The values of a CSV text.

    Raises:
        ConfigError: for a missing column, a value that is no number, and two values for one place.
    """
    values: dict[tuple[str, ...], float] = {}
    for i, line in enumerate(csv.DictReader(io.StringIO(text)), start=2):
        try:
            key, value = tuple(line[name].strip() for name in KEYS), float(line["value"])
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"line {i} is not a number of the paper: {error!r}",
                where=where,
                todo=f"give the columns {', '.join(KEYS)}, value",
            ) from error
        if values.setdefault(key, value) != value:
            raise ConfigError(f"line {i} contradicts an earlier one: {', '.join(key)}", where=where)
    return values


def find_number(
    numbers: Numbers | None,
    row: Mapping[str, object] | None,
    column: Mapping[str, object] | None,
    views: int | str,
    metric: str | None,
) -> float | None:
    """The paper's number for one cell; None where there is none, or no place is named.

    Args:
        row, column: what they say about their place; the row's word counts where both say the same.
        views: number of training views, or "mean"; replaced by what row or column say.
        metric: the paper's name of the measure.
    """
    if numbers is None or row is None or column is None or metric is None:
        return None
    return numbers.find(**{"views": views, **column, **row, "metric": metric})


def _folder():
    return resources.files("visdom_plugin.tables") / "paper_numbers"
