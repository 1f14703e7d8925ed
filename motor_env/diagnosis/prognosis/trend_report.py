"""Make trends of files, and format them as text, JSON and an HTML page."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np

from motor_env.common.console import printable
from motor_env.common.errors import InputError, require_several
from motor_env.common.files import LARGEST_TABLE_BYTES, read_json
from motor_env.common.pages import Axis, Chart, render, round_ticks
from motor_env.diagnosis.estimation.starts.start_identification import identify
from motor_env.diagnosis.file_verdicts import explain_failure
from motor_env.diagnosis.prognosis.trend import Forecast, Series, Trend, describe, judge
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.recording import Recording, read_recording
from motor_env.diagnosis.readers.start import prepare
from motor_env.diagnosis.readers.tables import read_text_table
from motor_env.diagnosis.verdict.healthy_spread import fit_healthy
from motor_env.motor.parameters import FloatArray

SECONDS_PER_DAY = 86_400.0
DateSource = Literal["name", "modified", "order"]
_COPIED_S = 60.0
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


_Row = tuple[str, Any, str, Any, Any, str]


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

    CSV, long: columns time, parameter, estimate, standard_error. CSV, wide: time, and for each parameter its name and
    its name with `_se`. JSON: objects with the keys of the long table. Times are ISO dates or numbers, whose unit ends
    the column's name (`time_hours`), else `starts`.

    Raises:
        InputError: a bad line, with its value.
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

    Estimates of one time are averaged by precision. Times without a unit are days since 1970; series count from the
    first.
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


_Z90 = 1.6448536269514722

_STATES = {
    "reached": "limit reached",
    "trending": "trending",
    "close": "close to a limit",
    "unknown": "not judged",
    "steady": "no trend",
}
"""Each state in words, in the order of the page."""


def _is_table(path: Path) -> bool:
    """Tell a table of estimates (time or date, or JSON) from a recording (`time_s` and a current)."""
    if path.suffix.lower() == ".json" or not path.is_file():
        return path.is_file()
    with path.open("rb") as file:
        head = file.readline(4096).decode("utf-8", errors="replace").lower()
    return "current" not in head


def _read_recordings(
    paths: Sequence[Path],
    columns: Sequence[ColumnChoice],
    date: DateSource,
    notes: list[str],
) -> list[tuple[float, Recording]]:
    """Read recordings and their days (or numbers) in the order of time; collect notes on unreadable ones."""
    files: list[Path] = []
    for path in paths:
        files += sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    dated: list[tuple[float, Path]] = []
    for number, file in enumerate((file for file in files if not file.name.startswith(".")), 1):
        day = date_of(file.name) if date == "name" else number
        if date == "modified":
            day = file.stat().st_mtime / SECONDS_PER_DAY
        if day is None:
            notes.append(f"{file.name}: its name holds no date such as 2026-01-31 (or use --date modified)")
        else:
            dated.append((day, file))
    days = [day for day, _ in dated]
    if date == "modified" and len(days) > 1 and max(days) - min(days) < _COPIED_S / SECONDS_PER_DAY:
        notes.append(
            "all files were written within a minute: their dates are those of copying; name them by their dates, or"
            " count them (--date order)"
        )
    recordings = []
    for day, file in sorted(dated):
        try:
            recordings.append((day, read_recording(file, columns)))
        except (ValueError, ArithmeticError, LookupError) as error:
            notes.append(explain_failure(file, error, "read")[0])
    return recordings


def _fit_recordings(
    recordings: Sequence[tuple[float, Recording]],
    voltage_v: float | None,
    notes: list[str],
    progress: Callable[[Path], None],
) -> list[Series]:
    """Fit every recording with the model of the first three, as another model would be a jump."""
    model: tuple[str, ...] | None = None
    estimates: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for number, (day, recording) in enumerate(recordings):
        progress(recording.path)
        try:
            if model is None:
                first = [prepare(entry, voltage_v) for _, entry in recordings[number : number + 3]]
                model = fit_healthy(first)[0].model
            fit = identify(prepare(recording, voltage_v), model)
        except (ValueError, ArithmeticError, LookupError) as error:  # UnusableError, or numerics that give up
            notes.append(f"{recording.path.name}: {error}")
        else:
            # The model's error is common to all starts of a motor; their extra scatter is learned.
            spreads = fit.values * np.sqrt(np.diag(fit.white_covariance))
            for name, value, spread in zip(fit.quantity_names, fit.values, spreads, strict=True):
                estimates[name].append((day, float(value), float(spread)))
    if not estimates:
        raise InputError(f"no recording can be used; the first reason: {[*notes, 'there are none'][0]}")
    return build_series(estimates)


@dataclass(frozen=True, slots=True)
class Trends:
    """Trends of a motor's quantities.

    Attributes:
        trends: one a quantity.
        notes: on unusable recordings.
    """

    trends: tuple[Trend, ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """Return the most urgent of `reached`, `trending`, `close`, `unknown` and `steady`."""
        return min((trend.state for trend in self.trends), key=list(_STATES).index)

    def to_json(self) -> list[dict[str, Any]]:
        """Build one object a quantity; infinite times are null."""
        return [
            {
                "quantity": trend.series.name,
                "state": trend.state,
                "sentence": trend.sentence,
                "reference": trend.reference,
                "last_estimate": float(trend.series.estimate[-1]),
                "estimates": len(trend.series.time),
                "time_unit": trend.series.unit,
                "first_date": None if trend.series.start is None else trend.series.start.isoformat(),
                "limits": [_limit_json(trend, forecast) for forecast in trend.forecasts],
            }
            for trend in self.trends
        ]

    def __repr__(self) -> str:
        return self.text()

    def text(self) -> str:
        """Write a line a quantity."""
        width = max(len(trend.series.name) for trend in self.trends)
        return "\n".join(f"{trend.series.name:<{width}}  {trend.sentence}" for trend in self.trends)

    def page(self) -> str:
        """Render a self-contained HTML page with a picture a quantity, the most urgent first."""
        rows = [
            _page_row(trend)
            for trend in sorted(self.trends, key=lambda trend: list(_STATES).index(trend.state))
        ]
        return render(
            "motor_env.diagnosis.prognosis", "trend.html.j2", title="Trends", rows=rows, notes=self.notes
        )


def _limit_json(trend: Trend, forecast: Forecast) -> dict[str, Any]:
    life = {
        name: number if math.isfinite(number) else None
        for name, number in zip(("low", "median", "high", "level"), forecast.life, strict=False)
    }
    return {
        "limit": forecast.factor * trend.reference,
        "factor": forecast.factor,
        "probability_of_trend": forecast.wear.probability_trend,
        "trends": forecast.trends,
        "reached": forecast.reached,
        "close": forecast.close,
        "probability_reached": forecast.life.probability_reached,
        "drift_per_time_unit": forecast.wear.mean_drift * trend.reference,
        "remaining_life": life if forecast is trend.leading and forecast.has_remaining_life else None,
        "withheld": forecast.withheld or None,
    }


def trend(
    paths: str | Path | Sequence[str | Path],
    limits: Mapping[str, tuple[float, ...]] | None = None,
    *,
    level: float = 0.9,
    voltage_v: float | None = None,
    columns: Sequence[ColumnChoice] = (),
    date: DateSource = "name",
    reference_count: int = 3,
    progress: Callable[[Path], None] = lambda path: None,
) -> Trends:
    """Find trends of a motor's quantities over its starts, and the remaining life.

    Args:
        paths: tables of estimates (CSV or JSON) or folders of dated recordings.
        limits: factors on the mean of the first estimates, by quantity; see `DEFAULT_LIMITS`.
        level: probability of the interval of the remaining life.
        voltage_v: level of the supply where none was recorded.
        columns: columns named by the user.
        date: source of a recording's date.
        reference_count: number of first estimates whose mean is the reference.
        progress: called with each file before its fit.

    Raises:
        InputError: bad options or files.
    """
    if not 0.0 < level < 1.0:
        raise InputError(f"level must lie between 0 and 1, got {level:g}")
    if reference_count < 1:
        raise InputError(f"reference-count must be >= 1, got {reference_count}")
    given = [paths] if isinstance(paths, str | Path) else paths
    require_several("paths", given, (str, Path))
    several = [Path(path) for path in given]
    if missing := [path for path in several if not os.path.exists(path)]:  # noqa: PTH110  # too long a name is none
        raise InputError(f"{str(missing[0])[:200]}: no such file or folder")
    notes: list[str] = []
    if len(several) == 1 and _is_table(several[0]):
        series = read_estimates(several[0])
    else:
        series = _fit_recordings(_read_recordings(several, columns, date, notes), voltage_v, notes, progress)
        if date == "order":
            series = [replace(each, unit="starts", start=None) for each in series]
    named = {estimates.name: estimates for estimates in series}
    temperature = named.pop(TEMPERATURE, None)
    if unknown := [name for name in limits or {} if name not in named]:
        raise InputError(f"--limit names {unknown[0]!r}; the quantities are {', '.join(sorted(named))}")
    return Trends(
        tuple(
            judge(estimates, (limits or {}).get(name), level, reference_count, temperature)
            for name, estimates in named.items()
        ),
        tuple(printable(note) for note in notes),
    )


def _page_row(trend: Trend) -> dict[str, str]:
    series, chosen = trend.series, trend.leading
    when = f" since {series.start:%Y-%m-%d}" if series.start else ""
    return {
        "name": series.name,
        "status": trend.state,
        "state": _STATES[trend.state],
        "life": "–"
        if chosen is None or chosen.reached or not chosen.trends
        else describe(chosen, series.unit),
        "sentence": trend.sentence,
        "basis": f"{len(series.time)} estimates{when}; mean of the first {trend.reference:.4g}",
        "chart": _draw_chart(trend),
    }


def _draw_chart(trend: Trend) -> str:
    series = trend.series
    relative = series.estimate / trend.reference
    error = _Z90 * series.standard_error / abs(trend.reference)
    factors = [forecast.factor for forecast in trend.forecasts]
    shown = np.concatenate([relative - error, relative + error, [1.0], factors])
    low, high = float(shown.min()), float(shown.max())
    room = 0.06 * max(high - low, 1e-6)
    forecast = trend.leading if trend.leading is not None and trend.leading.has_remaining_life else None
    left, last, ahead = float(series.time[0]), float(series.time[-1]), 0.0
    if forecast is not None:
        end = next(x for x in (forecast.life.high, forecast.life.median, last - left) if math.isfinite(x))
        ahead = min(1.08 * end, 3.0 * (last - left))
    right, start = max(last + ahead, left + 1e-9), series.start
    ticks = round_ticks(left, right, 6)
    chart = Chart(
        Axis(series.unit, left, right, ticks)
        if start is None
        else Axis("", left, right, ticks, lambda days: f"{start + timedelta(days=days):%Y-%m-%d}"),
        Axis("", low - room, high + room, round_ticks(low - room, high + room), _change),
        size=(860, 300),
        margins=(64, 120, 16, 38),
        label=f"{series.name} relative to the mean of the first estimates, over time",
    )
    chart.y_numbers()
    chart.x_numbers()
    chart.text((chart.right, 296), chart.x_axis.title, anchor="end")
    for factor in factors:
        chart.across("limit", factor)
        chart.text((chart.right + 8, chart.y(factor) + 4), f"limit {_change(factor)}", "limit-name")
    if forecast is not None:
        _draw_forecast(chart, forecast, last, np.linspace(0.0, ahead, 60))
    for t, value, half in zip(series.time, relative, error, strict=True):
        x = chart.x(t)
        chart.line("range", (x, chart.y(value - half)), (x, chart.y(value + half)))
        chart.dot("dot", (x, chart.y(value)), 3.2)
    return chart.svg()


def _change(factor: float) -> str:
    return f"{100.0 * (factor - 1.0):+.0f} %"


def _draw_forecast(chart: Chart, forecast: Forecast, last: float, ahead: FloatArray) -> None:
    mean, std = forecast.wear.forecast(ahead)
    time, upper, lower = last + ahead, mean + _Z90 * std, mean - _Z90 * std
    chart.shape("polygon", points=chart.points([*time, *time[::-1]], [*upper, *lower[::-1]]))
    inside = (mean >= chart.y_axis.low) & (mean <= chart.y_axis.high)
    chart.curve("forecast", time[inside], mean[inside])
    y, life = chart.y(forecast.factor), forecast.life
    chart.line("life", (chart.x(last + life.low), y), (chart.x(last + life.high), y))
    if last + life.median <= chart.x_axis.high:
        chart.dot("median", (chart.x(last + life.median), y), 6)
