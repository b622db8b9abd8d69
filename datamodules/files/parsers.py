"""Small data files from strangers: JSON, CSV and NumPy arrays, checked before they are believed.

Each parser takes the bytes and costs memory in proportion to them, whatever they claim.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from visdom_plugin.errors import SceneError


def damaged(
    path: Path,
    what: str,
    cause: str = "the file is truncated or damaged",
    todo: str = "copy the file again or export it again",
) -> NoReturn:
    """Raises SceneError about a file."""
    raise SceneError(what, where=path, cause=cause, todo=todo)


def parse_json(data: bytes, path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        SceneError: not UTF-8, not JSON, nested too deeply, or not an object at the top.
    """

    def integer(text: str) -> float | int:
        # Python's own conversion is quadratic in the digits, or refuses them.
        return int(text) if len(text) < 19 else float(text)

    try:
        content = json.loads(data.decode("utf-8-sig"), parse_int=integer)
    except UnicodeDecodeError:
        damaged(path, f"{path.name} is not text in UTF-8")
    except RecursionError:
        damaged(path, f"{path.name} is nested too deeply", cause="a damaged or malicious file")
    except ValueError as error:
        damaged(path, f"{path.name} is not JSON: {str(error)[:200]}")
    if not isinstance(content, dict):
        what = f"{path.name} holds a {type(content).__name__} at the top, not an object"
        damaged(
            path, what, "another program's form of the file", "write {...} at the top, with the format's keys"
        )
    return content


def number(value: Any, what: str, path: Path) -> float:
    """A finite number from JSON, as float.

    Raises:
        SceneError: for anything else.
    """
    if isinstance(value, str) and re.fullmatch(
        r"\s*[-+]?[\d.]+(e[-+]?\d+)?\s*", value, re.ASCII | re.IGNORECASE
    ):
        todo = f"write it without quotes: {value.strip():.30}"
        damaged(path, f"{what} is a text, {value[:40]!r}, not a number", "a number in quotes", todo)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        damaged(
            path, f"{what} is {_shown(value)}, not a finite number", cause="a damaged or wrongly written file"
        )
    return float(value)


def size(value: Any, what: str, path: Path) -> int:
    """A size in pixels, 1 to 1e6, from a whole number."""
    found = number(value, what, path)
    if not 1 <= found <= 1e6 or found != int(found):
        damaged(path, f"{what} is {found:g}, not a size in pixels")
    return int(found)


def text(value: Any, what: str, path: Path) -> str:
    """A string from JSON that is not empty."""
    if not isinstance(value, str) or not value:
        damaged(path, f"{what} is {_shown(value)}, not a name", cause="a damaged or wrongly written file")
    return value


def matrix(value: Any, what: str, path: Path) -> list[list[float]]:
    """A 4 x 4 or 3 x 4 matrix of finite numbers as its first three rows; the fourth must be 0 0 0 1."""
    rows = value if isinstance(value, list) else []
    if len(rows) not in (3, 4) or any(not isinstance(row, list) or len(row) != 4 for row in rows):
        damaged(path, f"{what} is no matrix of 4 x 4 or 3 x 4 numbers", cause="a wrongly written file")
    numbers = [[number(x, what, path) for x in row] for row in rows]
    if len(rows) == 4 and any(abs(a - b) > 1e-6 for a, b in zip(numbers[3], (0, 0, 0, 1), strict=True)):
        damaged(
            path, f"the last row of {what} is {numbers[3]}, not 0 0 0 1", cause="a matrix written by columns"
        )
    return numbers[:3]


def parse_csv(data: bytes, path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """The rows of a CSV file with a header, as dictionaries of text; further columns are left out.

    Raises:
        SceneError: not UTF-8, without one of the columns, or with a row of another length.
    """
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in columns if name not in header]
        if missing:
            damaged(
                path, f"{path.name} has no column {', '.join(missing)}", cause="another file of this name"
            )
        where = {name: header.index(name) for name in columns}
        rows = []
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                damaged(path, f"line {reader.line_num} has {len(row)} values, the header {len(header)}")
            rows.append({name: row[i].strip() for name, i in where.items()})
    except UnicodeDecodeError:
        damaged(path, f"{path.name} is not text in UTF-8")
    except csv.Error as error:
        damaged(path, f"{path.name} is not a table of comma separated values: {error}")
    return rows


def csv_number(row: dict[str, str], column: str, path: Path) -> float:
    """A finite number of a CSV row."""
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        damaged(path, f"{column} is {row[column][:40]!r}, not a finite number")
    return value


def parse_npy(data: bytes, path: Path) -> np.ndarray:
    """A numeric array in NumPy's .npy format; nothing is allocated before its size is compared with the bytes.

    Raises:
        SceneError: another format or type, or fewer or more bytes than the shape asks for.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read(stream)
    except Exception as error:  # NumPy raises whatever its parser of literals does
        damaged(
            path,
            f"{path.name} is not a NumPy array: {str(error)[:100]}",
            cause="a damaged file, or another file of this name",
        )
    if dtype.kind not in "fiub" or len(shape) > 8 or any(n < 0 for n in shape):
        damaged(path, f"{path.name} holds no numeric array", cause="another file of this name")
    end = stream.tell()
    if math.prod(shape) * dtype.itemsize != len(data) - end:
        damaged(path, f"{path.name} declares an array of {shape} {dtype} and holds {len(data) - end} bytes")
    return np.frombuffer(data, dtype, offset=end).reshape(shape, order="F" if fortran else "C")


def _shown(value: Any) -> str:
    kind = "nothing" if value is None else type(value).__name__
    return f"{value!r:.60}" if isinstance(value, str | float | int) else kind
