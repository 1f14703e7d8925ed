"""Trends of a motor's parameters over its starts: reading them, judging them against limits, saying what follows.

Estimates come from a table (CSV or JSON), or from dated recordings through `identification`. Each quantity is set
in relation to its reference, the mean of its first estimates, and judged by `degradation`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.prognosis.wear import (
    FEWEST_ESTIMATES,
    TREND_PROBABILITY,
    Degradation,
    RemainingLife,
    degradation,
)

LARGEST_TABLE_BYTES = 50_000_000
DEFAULT_LIMITS = (0.75, 1.25)
"""Limits of a quantity for which none is given, as factors on its reference: the paper's larger fault level."""

_SECONDS_PER_DAY = 86_400.0
_ISO = re.compile(r"(\d{4})-(\d{2})-(\d{2})(?:[T_ ]?(\d{2})[-:.h]?(\d{2})(?:[-:.m]?(\d{2}))?)?")
_MONTH_FIRST = re.compile(r"([A-Z][a-z]{2})-(\d{1,2})-(\d{4})(?:[_T ](\d{2})-(\d{2})-(\d{2}))?")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


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


@dataclass(frozen=True, slots=True)
class Forecast:
    """How a quantity stands to one limit.

    Attributes:
        limit: in the quantity's unit.
        factor: the limit over the reference.
        reached: whether the last level lies beyond it, with a probability of at least one half.
        trends: whether there is a drift towards it (posterior probability at least 95 %).
        wear: the fitted degradation of estimate / reference.
        life: remaining life; it means something only where `trends`.
    """

    limit: float
    factor: float
    reached: bool
    trends: bool
    wear: Degradation
    life: RemainingLife


@dataclass(frozen=True, slots=True)
class Trend:
    """One quantity judged.

    Attributes:
        series: its estimates.
        reference: mean of the first estimates.
        forecasts: one for each limit; none where there are too few estimates.
        sentence: what follows, in words.
    """

    series: Series
    reference: float
    forecasts: tuple[Forecast, ...]
    sentence: str


def judge(
    series: Series, factors: Sequence[float] = DEFAULT_LIMITS, level: float = 0.9, reference_count: int = 3
) -> Trend:
    """Judge one quantity against limits.

    Args:
        series: its estimates.
        factors: limits as factors on the reference, each different from 1.
        level: probability that the interval of the remaining life is to hold.
        reference_count: number of first estimates whose mean is the reference.

    Raises:
        InputError: the reference is 0, or a factor is not usable.
    """
    first = slice(0, min(reference_count, len(series.time)))
    reference = float(np.mean(series.estimate[first]))
    if reference == 0.0:
        raise InputError(f"{series.name}: the first estimates are 0; limits are relative to them")
    bad = [factor for factor in factors if not math.isfinite(factor) or factor == 1.0]
    if bad:
        raise InputError(f"limit of {series.name} must be a factor different from 1, got {bad[0]:g}")
    if len(series.time) < FEWEST_ESTIMATES:
        sentence = (
            f"too few estimates for a trend: {len(series.time)}, at least {FEWEST_ESTIMATES} are needed"
        )
        return Trend(series, reference, (), sentence)
    relative, error = series.estimate / reference, series.standard_error / abs(reference)
    forecasts = []
    for factor in factors:
        wear = degradation(series.time, relative, error, factor)
        life = wear.remaining_life(level)
        reached = life.probability_reached >= 0.5
        trends = wear.probability_trend >= TREND_PROBABILITY
        forecasts.append(Forecast(factor * reference, factor, reached, trends, wear, life))
    return Trend(series, reference, tuple(forecasts), _sentence(series, forecasts))


def _sentence(series: Series, forecasts: Sequence[Forecast]) -> str:
    change = float(series.estimate[-1] / np.mean(series.estimate[:3]) - 1.0)
    for forecast in forecasts:
        if forecast.reached:
            share = 100.0 * forecast.life.probability_reached
            return f"the limit at {_percent(forecast.factor - 1.0)} is reached, with a probability of {share:.0f} %"
    for forecast in forecasts:
        if forecast.trends:
            return (
                f"trends to the limit at {_percent(forecast.factor - 1.0)}, by "
                f"{_percent(forecast.wear.mean_drift, digits=2)} of the reference a {singular(series.unit)}: "
                f"{describe(forecast.life, series.unit)}"
            )
    likely = max(forecast.wear.probability_trend for forecast in forecasts)
    return (
        f"no trend: last change {_percent(change)}; probability of a drift to a limit "
        f"{100.0 * likely:.0f} %, below {100.0 * TREND_PROBABILITY:.0f} %; no remaining life is given"
    )


def describe(life: RemainingLife, unit: str) -> str:
    """The remaining life in words."""
    share = f"{100.0 * life.level:.0f} %"
    if math.isinf(life.high):
        return (
            f"not before {life.low:.3g} {unit} (lower end of the {share} interval; no upper end, "
            f"it is reached at all with {100.0 * life.probability_ever:.0f} %)"
        )
    return f"reached in {life.median:.3g} {unit} ({share} interval {life.low:.3g} to {life.high:.3g})"


def singular(unit: str) -> str:
    """The unit of one: days, day."""
    return unit.removesuffix("s")


def _percent(value: float, digits: int = 0) -> str:
    return f"{100.0 * value:+.{digits}f} %"


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
    text = _text(path)
    rows = _json_rows(path, text) if path.suffix.lower() == ".json" else _csv_rows(path, text)
    return _series(path, rows)


_Row = tuple[str, Any, str, Any, Any, str]  # where, time, parameter, estimate, standard error, unit


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST_TABLE_BYTES:
            raise InputError(f"{path}: is larger than {LARGEST_TABLE_BYTES // 1_000_000} MB")
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text (byte {error.start} is not UTF-8)") from None


def _json_rows(path: Path, text: str) -> list[_Row]:
    try:
        entries = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error})") from None
    if not isinstance(entries, list):
        raise InputError(f"{path}: must hold a list of estimates, got {type(entries).__name__}")
    rows = []
    for number, entry in enumerate(entries, 1):
        missing = (
            [key for key in ("time", "parameter", "estimate") if key not in entry]
            if isinstance(entry, dict)
            else ["time"]
        )
        if missing:
            raise InputError(f"{path}, entry {number}: {missing[0]} is missing")
        spread = entry.get("standard_error", 0.0)
        rows.append(
            (f"entry {number}", entry["time"], str(entry["parameter"]), entry["estimate"], spread, "starts")
        )
    return rows


def _csv_rows(path: Path, text: str) -> list[_Row]:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: is empty")
    delimiter = max(",;\t", key=lines[0].count)
    try:
        table = list(csv.reader(io.StringIO("\n".join(lines)), delimiter=delimiter))
    except csv.Error as error:
        raise InputError(f"{path}: is not a table ({error})") from None
    header = [cell.strip() for cell in table[0]]
    time_name = next(
        (name for name in header if re.fullmatch(r"(time|date)(_\w+)?", name, re.IGNORECASE)), None
    )
    if time_name is None:
        raise InputError(
            f"{path}, line 1: a column named time (or date) is missing, found {', '.join(header[:8])}"
        )
    unit = time_name.partition("_")[2] or "starts"
    rows: list[_Row] = []
    for number, cells in enumerate(table[1:], 2):
        if len(cells) != len(header):
            raise InputError(
                f"{path}, line {number}: has {len(cells)} cells where the header has {len(header)}"
            )
        row = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
        if delimiter == ";":
            row = {name: cell.replace(",", ".") for name, cell in row.items()}
        where = f"line {number}"
        if "parameter" in row and "estimate" in row:
            rows.append(
                (
                    where,
                    row[time_name],
                    row["parameter"],
                    row["estimate"],
                    row.get("standard_error", "0"),
                    unit,
                )
            )
            continue
        rows.extend(
            (where, row[time_name], name, row[name], row.get(f"{name}_se", "0") or "0", unit)
            for name in header
            if name != time_name and not name.endswith("_se") and row[name]
        )
    return rows


def _series(path: Path, rows: Iterable[_Row]) -> list[Series]:
    found: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    units: set[str] = set()
    dated: list[bool] = []
    for where, time, name, estimate, error, unit in rows:
        date = date_of(time) if isinstance(time, str) else None
        dated.append(date is not None)
        stamp = (
            date.timestamp() / _SECONDS_PER_DAY if date is not None else _number(path, where, "time", time)
        )
        units.add("days" if date is not None else unit)
        value, spread = _number(path, where, name, estimate), _number(path, where, f"{name}_se", error)
        if spread < 0.0:
            raise InputError(f"{path}, {where}: the standard error of {name} must be >= 0, got {spread:g}")
        found[name].append((stamp, value, spread))
    if not found:
        raise InputError(f"{path}: holds no estimates")
    if len(units) > 1 or len(set(dated)) > 1:
        raise InputError(f"{path}: times must all be dates or all be numbers")
    return build_series(found, units.pop(), dated=dated[0])


def _number(path: Path, where: str, name: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise InputError(f"{path}, {where}: {name} must be a finite number, got {str(value)[:40]!r}")
    return number


def build_series(
    found: Mapping[str, Sequence[tuple[float, float, float]]], unit: str, *, dated: bool
) -> list[Series]:
    """Series from (time, estimate, standard error) of each quantity, in any order.

    Estimates of the same time are averaged with their precisions as weights. Dates are in days since 1970; the
    series counts from the first one of all.
    """
    origin = min(entry[0] for entries in found.values() for entry in entries) if dated else 0.0
    start = datetime.fromtimestamp(origin * _SECONDS_PER_DAY, tz=UTC) if dated else None
    out = []
    for name, entries in found.items():
        table = np.array(sorted(entries))
        times, index = np.unique(table[:, 0], return_inverse=True)
        weight = 1.0 / np.maximum(table[:, 2], max(1e-9 * float(np.abs(table[:, 1]).max()), 1e-300)) ** 2
        total = np.bincount(index, weight)
        estimate = np.bincount(index, weight * table[:, 1]) / total
        error = np.where(np.bincount(index, table[:, 2]) > 0.0, 1.0 / np.sqrt(total), 0.0)
        out.append(Series(name, times - origin, estimate, error, unit, start))
    return out


def parse_limits(options: Iterable[str]) -> dict[str, tuple[float, ...]]:
    """Limits from options such as `B/J=1.5` or `R=0.9,1.1`.

    Raises:
        InputError: an option of another form.
    """
    limits: dict[str, tuple[float, ...]] = {}
    for option in options:
        name, equals, values = option.partition("=")
        try:
            factors = tuple(float(value) for value in values.split(","))
        except ValueError:
            factors = ()
        if not equals or not factors or not all(math.isfinite(f) and f != 1.0 for f in factors):
            raise InputError(
                f"--limit must look like B/J=1.5 or R=0.9,1.1 (factors on the reference), got {option!r}"
            )
        limits[name] = factors
    return limits


def judge_all(
    all_series: Iterable[Series],
    limits: Mapping[str, tuple[float, ...]],
    level: float = 0.9,
    reference_count: int = 3,
) -> list[Trend]:
    """Judge every quantity.

    Raises:
        InputError: a limit names a quantity that is not there.
    """
    listed = list(all_series)
    names = {series.name for series in listed}
    unknown = [name for name in limits if name not in names]
    if unknown:
        raise InputError(f"--limit names {unknown[0]!r}; the quantities are {', '.join(sorted(names))}")
    return [
        judge(series, limits.get(series.name, DEFAULT_LIMITS), level, reference_count) for series in listed
    ]
