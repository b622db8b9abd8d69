"""Small data files from strangers: JSON, CSV and NumPy arrays, checked before they are believed.

Each parser takes the bytes and costs memory in proportion to them, whatever they claim.
"""

from __future__ import annotations

import codecs
import csv
import io
import json
import math
import re
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from visdom_plugin.errors import SceneError

_COMMAS = "a decimal comma, as programs write it where the system's language does"


def damaged(
    path: Path,
    what: str,
    cause: str = "the file is truncated or damaged",
    todo: str = "copy the file again or export it again",
) -> NoReturn:
    """Raises SceneError about a file."""
    raise SceneError(what, where=path, cause=cause, todo=todo, topic="damaged-file")


def decode_text(
    data: bytes,
    path: Path,
    cause: str = "text in another encoding, or a damaged file",
    todo: str = "save it as UTF-8, or copy it again",
) -> str:
    """The text of a file in UTF-8, or in UTF-16 where it begins with the mark of that (Windows' "Unicode").

    Raises:
        SceneError: it is neither; with the cause and what to do as they are given.
    """
    # Numbers and names begin with ASCII, of which one byte of two is zero.
    wide = {codecs.BOM_UTF16_LE: data[3:4], codecs.BOM_UTF16_BE: data[2:3]}.get(data[:2]) == b"\0"
    encoding = "utf-16" if wide else "utf-8-sig"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError:
        damaged(path, f"{path.name} is not text in UTF-8", cause, todo)


def parse_json(data: bytes, path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        SceneError: not UTF-8, not JSON, nested too deeply, or not an object at the top.
    """

    def integer(text: str) -> float | int:
        # Python's own conversion is quadratic in the digits, or refuses them.
        return int(text) if len(text) < 19 else float(text)

    text = decode_text(data, path)
    try:
        content = json.loads(text, parse_int=integer)
    except RecursionError:
        damaged(path, f"{path.name} is nested too deeply", cause="a damaged or malicious file")
    except json.JSONDecodeError as error:
        what = f"{path.name} is not JSON: {str(error)[:200]}" if text.strip() else f"{path.name} is empty"
        damaged(path, what, *_explain_json(text, error))
    if not isinstance(content, dict):
        what = f"{path.name} holds a {type(content).__name__} at the top, not an object"
        damaged(
            path, what, "another program's form of the file", "write {...} at the top, with the format's keys"
        )
    return content


def _explain_json(text: str, error: json.JSONDecodeError) -> tuple[str, str] | tuple[()]:
    """Cause and what to do of what people and other programs write that is no JSON; nothing for the rest."""
    before, rest = text[: error.pos].rstrip(), text[error.pos :].lstrip()
    if rest.startswith(("//", "/*", "#")):
        return "a comment, which JSON does not have", "remove all comments"
    if rest.startswith("'"):
        return "single quotes, as Python prints a dictionary", "write the file with json.dump"
    # Python 3.13 points at the comma, its predecessors at what follows.
    after = rest[1:].lstrip() if rest.startswith(",") else rest if before.endswith(",") else ""
    if after.startswith(("]", "}")):
        return "a comma behind the last of several entries", "remove this comma"
    if before.endswith(",") and rest[:1].isdigit() and before[-2:-1].isdigit():
        return _COMMAS, "write the number with a point"
    return ()


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
    if isinstance(value, str) and (point := _with_point(value)):
        damaged(path, f"{what} is {value.strip()!r}, not a number", _COMMAS, point)
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
        reader = csv.reader(io.StringIO(decode_text(data, path), newline=""), strict=True)
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in columns if name not in header]
        if missing:
            what, mark = (
                f"{path.name} has no column {', '.join(missing)}",
                next((m for m in ";\t" if len(header) == 1 and m in header[0]), None),
            )
            if mark is not None:
                damaged(path, what, f"values parted by {mark!r}", "save the table with commas between values")
            damaged(path, what, cause="another file of this name")
        where = {name: header.index(name) for name in columns}
        rows = []
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                damaged(path, f"line {reader.line_num} has {len(row)} values, the header {len(header)}")
            rows.append({name: row[i].strip() for name, i in where.items()})
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
        what = f"{column} is {row[column][:40]!r}, not a finite number"
        todo = _with_point(row[column])
        damaged(path, what, _COMMAS, todo) if todo else damaged(path, what)
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


def blame_commas(line: str) -> tuple[str, str] | None:
    """Cause and what to do of a line of numbers with decimal commas; None of any other line."""
    words = line.split()
    return (_COMMAS, "write all numbers with points") if any(map(_with_point, words)) else None


def _with_point(text: str) -> str | None:
    """What to do about a number with a decimal comma; None of any other text."""
    fits = re.fullmatch(r"\s*[-+]?\d+,\d+(e[-+]?\d+)?\s*", text[:60], re.ASCII | re.IGNORECASE)
    return f"write it with a point: {text.strip().replace(',', '.')}" if fits else None


def _shown(value: Any) -> str:
    kind = "nothing" if value is None else type(value).__name__
    return f"{value!r:.60}" if isinstance(value, str | float | int) else kind
