"""Estimates of a motor's quantities over time: read from a table, sorted into series."""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.tables import read_text, read_text_table

SECONDS_PER_DAY = 86_400.0
_ISO = re.compile(r"(\d{4})-(\d{2})-(\d{2})(?:[T_ ]?(\d{2})[-:.h]?(\d{2})(?:[-:.m]?(\d{2}))?)?")
_MONTH_FIRST = re.compile(r"([A-Z][a-z]{2})-(\d{1,2})-(\d{4})(?:[_T ](\d{2})-(\d{2})-(\d{2}))?")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_TIME_COLUMN = re.compile(r"(time|date)(_\w+)?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Series:
    """Estimates of one quantity.

    Attributes:
        name: the quantity.
        time: rising, in `unit`, shape (n,).
        estimate: shape (n,).
        standard_error: shape (n,).
        unit: unit of time: days (from the first estimate), or what the table calls it.
        start: date of time 0, where dates are known.
    """

    name: str
    time: FloatArray
    estimate: FloatArray
    standard_error: FloatArray
    unit: str = "days"
    start: datetime | None = None


_Row = tuple[str, Any, str, Any, Any, str]
"""One estimate as it stands in a file: place for error messages, time, parameter, estimate, standard error, unit."""


def date_of(text: str) -> datetime | None:
    """Date in a file name or a cell: 2026-01-31, 2026-01-31T11:00:14, Jan-15-2022_11-00-14; None without one."""
    iso, month_first = _ISO.search(text), _MONTH_FIRST.search(text)
    if iso:
        parts = [int(part) for part in iso.groups(default="0")]
    elif month_first and month_first.group(1) in _MONTHS:
        month, day, year, *clock = month_first.groups(default="0")
        parts = [int(year), _MONTHS.index(month) + 1, int(day), *(int(part) for part in clock)]
    else:
        return None
    try:
        return datetime(*parts, tzinfo=UTC)  # type: ignore[misc,arg-type]  # six integers by the patterns
    except ValueError:
        return None


def read_estimates(path: str | Path) -> list[Series]:
    """Read a table of estimates.

    CSV, long: columns time, parameter, estimate, standard_error. CSV, wide: time, and for each parameter a column with
    its name and one with its name and `_se`. JSON: a list of objects with the keys of the long table. Times are ISO
    dates or numbers; a number's unit is the ending of its column's name (`time_hours`), else `starts`.

    Raises:
        InputError: what cannot be read, with the line and the value.
    """
    path = Path(path)
    return _series(path, _json_rows(path) if path.suffix.lower() == ".json" else _csv_rows(path))


def _json_rows(path: Path) -> Iterator[_Row]:
    try:
        entries = json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error})") from None
    if not isinstance(entries, list):
        raise InputError(f"{path}: must hold a list of estimates, got {type(entries).__name__}")
    for number, entry in enumerate(entries, 1):
        for key in ("time", "parameter", "estimate"):
            if not isinstance(entry, dict) or key not in entry:
                raise InputError(f"{path}, entry {number}: {key} is missing")
        spread = entry.get("standard_error", 0.0)
        yield f"entry {number}", entry["time"], str(entry["parameter"]), entry["estimate"], spread, "starts"


def _csv_rows(path: Path) -> Iterator[_Row]:
    table = read_text_table(path)
    numbered = [
        (line, [cell.strip() for cell in row])
        for line, row in zip(table.lines, table.rows, strict=True)
        if not row[0].startswith("#")
    ]
    header = numbered[0][1] if numbered else []
    time_name = next((name for name in header if _TIME_COLUMN.fullmatch(name)), None)
    if time_name is None:
        found = ", ".join(header[:8])
        raise InputError(f"{path}, line 1: a column named time (or date) is missing, found {found}")
    unit = time_name.partition("_")[2] or "starts"
    for line, cells in numbered[1:]:
        if len(cells) != len(header):
            found = f"{len(cells)} cells where the header has {len(header)}"
            raise InputError(f"{path}, line {line}: has {found}")
        plain = [cell.replace(",", ".") for cell in cells] if table.delimiter == ";" else cells
        row = dict(zip(header, plain, strict=True))
        where, time = f"line {line}", row.pop(time_name)
        if "parameter" in row and "estimate" in row:
            spread = row.get("standard_error", "0")
            yield where, time, row["parameter"], row["estimate"], spread, unit
            continue
        for name, value in row.items():
            if value and not name.endswith("_se"):
                yield where, time, name, value, row.get(f"{name}_se", "0") or "0", unit


def _series(path: Path, rows: Iterable[_Row]) -> list[Series]:
    entries: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    units: set[str] = set()
    dated: list[bool] = []
    for where, time, name, estimate, error, unit in rows:
        date = date_of(time) if isinstance(time, str) else None
        dated.append(date is not None)
        stamp = date.timestamp() / SECONDS_PER_DAY if date is not None else _number(path, where, "time", time)
        units.add("days" if date is not None else unit)
        value, spread = _number(path, where, name, estimate), _number(path, where, f"{name}_se", error)
        if spread < 0.0:
            raise InputError(f"{path}, {where}: the standard error of {name} must be >= 0, got {spread:g}")
        entries[name].append((stamp, value, spread))
    if not entries:
        raise InputError(f"{path}: holds no estimates")
    if len(units) > 1 or len(set(dated)) > 1:
        raise InputError(f"{path}: times must all be dates or all be numbers")
    return build_series(entries, units.pop(), dated=dated[0])


def _number(path: Path, where: str, name: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{path}, {where}: {name} must be a finite number, got {str(value)[:40]!r}")
    return number


def build_series(
    estimates: Mapping[str, Sequence[tuple[float, float, float]]], unit: str, *, dated: bool
) -> list[Series]:
    """Series from (time, estimate, standard error) of each quantity, in any order.

    Estimates of the same time are averaged with their precisions as weights. Dates are in days since 1970; the
    series counts from the first one of all.
    """
    origin = min(entry[0] for entries in estimates.values() for entry in entries) if dated else 0.0
    start = datetime.fromtimestamp(origin * SECONDS_PER_DAY, tz=UTC) if dated else None
    out = []
    for name, entries in estimates.items():
        table = np.array(sorted(entries))
        times, index = np.unique(table[:, 0], return_inverse=True)
        weight = 1.0 / np.maximum(table[:, 2], max(1e-9 * float(np.abs(table[:, 1]).max()), 1e-300)) ** 2
        total = np.bincount(index, weight)
        estimate = np.bincount(index, weight * table[:, 1]) / total
        error = np.where(np.bincount(index, table[:, 2]) > 0.0, 1.0 / np.sqrt(total), 0.0)
        out.append(Series(name, times - origin, estimate, error, unit, start))
    return out
