"""Read estimates of a motor's quantities over time from a table, and sort them into series."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_TABLE_BYTES, read_json
from motor_env.diagnosis.readers.tables import read_text_table
from motor_env.motor.parameters import FloatArray

SECONDS_PER_DAY = 86_400.0
TEMPERATURE = "temperature_c"
"""Column of the temperature in a table of estimates."""
_MONTHS = {
    name: number
    for number, name in enumerate(
        ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"], 1
    )
}
_ISO = re.compile(
    r"(?P<year>\d{4})-(?P<month>\d{2})-(?P<day>\d{2})"
    r"(?:[T_ ]?(?P<hour>\d{2})[-:.h]?(?P<minute>\d{2})(?:[-:.m]?(?P<second>\d{2}))?)?"
)
_MONTH_FIRST = re.compile(
    rf"(?P<month>{'|'.join(_MONTHS)})-(?P<day>\d{{1,2}})-(?P<year>\d{{4}})"
    r"(?:[_T ](?P<hour>\d{2})-(?P<minute>\d{2})-(?P<second>\d{2}))?"
)
_TIME_COLUMN = re.compile(r"(time|date)(_\w+)?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Series:
    """Estimates of one quantity.

    Attributes:
        name: the quantity.
        time: rising, in `unit`, shape (n,).
        estimate: shape (n,).
        standard_error: shape (n,).
        unit: of the time: days from the first estimate, or the table's.
        start: date of time 0, where dates are known.
    """

    name: str
    time: FloatArray
    estimate: FloatArray
    standard_error: FloatArray
    unit: str = "days"
    start: datetime | None = None


_Row = tuple[str, Any, str, Any, Any, str]
"""Estimate of a file: place, time, parameter, estimate, standard error, unit of the time."""


def date_of(text: str) -> float | None:
    """Find a date, in days since 1970: 2026-01-31, 2026-01-31T11:00:14, Jan-15-2022_11-00-14."""
    match = _ISO.search(text) or _MONTH_FIRST.search(text)
    if match is None:
        return None
    fields = {name: int(_MONTHS.get(part, part)) for name, part in match.groupdict(default="0").items()}
    with suppress(ValueError):  # there is no such day
        return datetime(**fields, tzinfo=UTC).timestamp() / SECONDS_PER_DAY
    return None


def read_estimates(path: Path) -> list[Series]:
    """Read a table of estimates.

    CSV, long: columns time, parameter, estimate, standard_error. CSV, wide: time, and for each parameter a column with
    its name and one with its name and `_se`. JSON: a list of objects with the keys of the long table. Times are ISO
    dates or numbers; a number's unit is the ending of its column's name (`time_hours`), else `starts`.

    Raises:
        InputError: what cannot be read, with the line and the value.
    """
    entries: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    units: set[str | None] = set()
    for where, time, name, estimate, error, unit in (
        _json_rows(path) if path.suffix.lower() == ".json" else _csv_rows(path)
    ):
        day = date_of(time) if isinstance(time, str) else None
        units.add(unit if day is None else None)
        stamp = _number(where, "time", time) if day is None else day
        value, spread = _number(where, name, estimate), _number(where, f"{name}_se", error)
        if spread < 0.0:
            raise InputError(f"{where}: the standard error of {name} must be >= 0, got {spread:g}")
        entries[name].append((stamp, value, spread))
    if not entries.keys() - {TEMPERATURE}:
        raise InputError(f"{path}: holds no estimates")
    if len(units) > 1:
        raise InputError(f"{path}: times must all be dates or all be numbers")
    return build_series(entries, units.pop())


def _json_rows(path: Path) -> Iterator[_Row]:
    entries = read_json(path, LARGEST_TABLE_BYTES)
    if not isinstance(entries, list):
        raise InputError(f"{path}: must hold a list of estimates, got {type(entries).__name__}")
    for number, entry in enumerate(entries, 1):
        where = f"{path}, entry {number}"
        for key in ("time", "parameter", "estimate"):
            if not isinstance(entry, dict) or key not in entry:
                raise InputError(f"{where}: {key} is missing")
        yield (
            where,
            entry["time"],
            str(entry["parameter"]),
            entry["estimate"],
            entry.get("standard_error", 0.0),
            "starts",
        )


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
        raise InputError(
            f"{path}, line 1: a column named time (or date) is missing, found {', '.join(header[:8])}"
        )
    unit = time_name.partition("_")[2] or "starts"
    for line, cells in numbered[1:]:
        where = f"{path}, line {line}"
        if len(cells) != len(header):
            raise InputError(f"{where}: has {len(cells)} cells where the header has {len(header)}")
        plain = [cell.replace(",", ".") for cell in cells] if table.delimiter == ";" else cells
        row = dict(zip(header, plain, strict=True))
        time = row.pop(time_name)
        if "parameter" in row and "estimate" in row:
            yield where, time, row["parameter"], row["estimate"], row.get("standard_error", "0"), unit
        else:
            for name, value in row.items():
                if value and not name.endswith("_se"):
                    yield where, time, name, value, row.get(f"{name}_se", "0") or "0", unit


def _number(where: str, name: str, value: Any) -> float:
    with suppress(TypeError, ValueError, OverflowError):
        number = float(value)
        if math.isfinite(number) and not isinstance(value, bool):
            return number
    raise InputError(f"{where}: {name} must be a finite number, got {str(value)[:40]!r}")


def build_series(
    estimates: Mapping[str, Sequence[tuple[float, float, float]]], unit: str | None = None
) -> list[Series]:
    """Build series from (time, estimate, standard error) of each quantity, in any order.

    Estimates of the same time are averaged by precision. Times without a unit are days since 1970; series count from
    the first of all.
    """
    origin = min(entry[0] for entries in estimates.values() for entry in entries) if unit is None else 0.0
    start = datetime.fromtimestamp(origin * SECONDS_PER_DAY, tz=UTC) if unit is None else None
    out = []
    for name, entries in estimates.items():
        table = np.array(sorted(entries))
        times, index = np.unique(table[:, 0], return_inverse=True)
        weight = 1.0 / np.maximum(table[:, 2], max(1e-9 * float(np.abs(table[:, 1]).max()), 1e-150)) ** 2
        total = np.bincount(index, weight)
        estimate = np.bincount(index, weight * table[:, 1]) / total
        error = np.where(np.bincount(index, table[:, 2]) > 0.0, 1.0 / np.sqrt(total), 0.0)
        out.append(Series(name, times - origin, estimate, error, unit or "days", start))
    return out
