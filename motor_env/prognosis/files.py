"""From files to trends: the steps of `motor-env trend`."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from motor_env.console import printable
from motor_env.diagnosis.files import why_not
from motor_env.diagnosis.learning import fit_healthy
from motor_env.errors import InputError
from motor_env.identification.identify import identify
from motor_env.pages.html import render
from motor_env.prognosis.estimates import (
    SECONDS_PER_DAY,
    TEMPERATURE,
    Series,
    build_series,
    date_of,
    read_estimates,
)
from motor_env.prognosis.page import STATES, row
from motor_env.prognosis.trend import Forecast, Trend, judge
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, read_recording
from motor_env.recordings.start import prepare

DateSource = Literal["name", "modified"]
"""Where the date of a recording comes from: its name, or the file's own date."""


def _is_table(path: Path) -> bool:
    """A table of estimates has a column named time or date, or is JSON; a recording has `time_s` and a current."""
    if path.suffix.lower() == ".json" or not path.is_file():
        return path.is_file()
    with path.open("rb") as file:
        head = file.readline(4096).decode("utf-8", errors="replace").lower()
    return "current" not in head


def _readable(
    paths: Sequence[Path], columns: Sequence[ColumnChoice], date: DateSource, notes: list[str]
) -> list[tuple[float, Recording]]:
    """Recordings of a folder or a list and their days, in the order of time; notes say which cannot be read."""
    files: list[Path] = []
    for path in paths:
        files += sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    dated: list[tuple[float, Path]] = []
    for file in (file for file in files if not file.name.startswith(".")):
        day = date_of(file.name) if date == "name" else file.stat().st_mtime / SECONDS_PER_DAY
        if day is None:
            notes.append(f"{file.name}: its name holds no date such as 2026-01-31 (or use --date modified)")
        else:
            dated.append((day, file))
    recordings = []
    for day, file in sorted(dated):
        try:
            recordings.append((day, read_recording(file, columns)))
        except (ValueError, ArithmeticError, LookupError) as error:
            notes.append(why_not(file, error, "read")[0])
    return recordings


def _fitted(
    recordings: Sequence[tuple[float, Recording]],
    voltage_v: float | None,
    notes: list[str],
    progress: Callable[[Path], None],
) -> list[Series]:
    """Fit every recording with one model, the one that the first three prefer: a change of model would be a jump."""
    model: tuple[str, ...] | None = None
    estimates: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for number, (day, recording) in enumerate(recordings):
        progress(recording.path)
        try:
            if model is None:
                first = [entry for _, entry in recordings[number : number + 3]]
                model = fit_healthy(first, voltage_v=voltage_v)[0].model
            fit = identify(prepare(recording, voltage_v), model)
        except (ValueError, ArithmeticError, LookupError) as error:  # UnusableError, or numerics that give up
            notes.append(f"{recording.path.name}: {error}")
        else:
            for name, value, spread in zip(fit.quantity_names, fit.values, fit.standard_errors, strict=True):
                estimates[name].append((day, float(value), float(spread)))
    if not estimates:
        raise InputError(f"no recording can be used; the first reason: {[*notes, 'there are none'][0]}")
    return build_series(estimates)


@dataclass(frozen=True, slots=True)
class Trends:
    """Trends of a motor's quantities.

    Attributes:
        trends: one a quantity.
        notes: a sentence for every recording that could not be used.
    """

    trends: tuple[Trend, ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The most urgent of `reached`, `trending`, `unknown` (too few estimates, or no limit) and `steady`."""
        return min((trend.state for trend in self.trends), key=list(STATES).index)

    def to_json(self) -> list[dict[str, Any]]:
        """One object a quantity; infinite times are null."""
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
                "limits": [_of_limit(trend, forecast) for forecast in trend.forecasts],
            }
            for trend in self.trends
        ]

    def text(self) -> str:
        """A line a quantity."""
        width = max(len(trend.series.name) for trend in self.trends)
        return "\n".join(f"{trend.series.name:<{width}}  {trend.sentence}" for trend in self.trends)

    def page(self) -> str:
        """A self-contained HTML page with a picture a quantity, those that reach or trend to a limit first."""
        ranked = sorted(self.trends, key=lambda trend: list(STATES).index(trend.state))
        rows = [row(trend) for trend in ranked]
        return render("motor_env.prognosis", "trend.html.j2", title="Trends", rows=rows, notes=self.notes)


def _of_limit(trend: Trend, forecast: Forecast) -> dict[str, Any]:
    told = forecast is trend.leading and forecast.is_told
    numbers = zip(("low", "median", "high", "level"), forecast.life, strict=False)
    life = {name: number if math.isfinite(number) else None for name, number in numbers}
    return {
        "limit": forecast.limit,
        "factor": forecast.factor,
        "probability_of_trend": forecast.wear.probability_trend,
        "trends": forecast.trends,
        "reached": forecast.reached,
        "probability_reached": forecast.life.probability_reached,
        "drift_per_time_unit": forecast.wear.mean_drift * trend.reference,
        "remaining_life": life if told else None,
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
    """Trends of a motor's quantities over its starts, and the time to a limit where there is a trend.

    Args:
        paths: a table of estimates (CSV or JSON), a folder of dated recordings, or several of these.
        limits: factors on the mean of the first estimates, by quantity; 0.75 and 1.25 unless given, and none of L.
        level: probability that the interval of the remaining life holds.
        voltage_v: level of the supply, for recordings without a voltage.
        columns: columns named by the user.
        date: where the date of a recording comes from.
        reference_count: number of first estimates whose mean is the reference.
        progress: told each file before it is fitted.

    Raises:
        InputError: bad options or files.
    """
    if not 0.0 < level < 1.0:
        raise InputError(f"level must lie between 0 and 1, got {level:g}")
    if reference_count < 1:
        raise InputError(f"reference-count must be >= 1, got {reference_count}")
    several = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    if missing := [path for path in several if not path.exists()]:
        raise InputError(f"{missing[0]}: no such file or folder")
    notes: list[str] = []
    if len(several) == 1 and _is_table(several[0]):
        series = read_estimates(several[0])
    else:
        series = _fitted(_readable(several, columns, date, notes), voltage_v, notes, progress)
    named = {one.name: one for one in series}
    temperature = named.pop(TEMPERATURE, None)
    wanted = limits or {}
    if unknown := [name for name in wanted if name not in named]:
        raise InputError(f"--limit names {unknown[0]!r}; the quantities are {', '.join(sorted(named))}")
    judged = [
        judge(one, wanted.get(name), level, reference_count, temperature) for name, one in named.items()
    ]
    return Trends(tuple(judged), tuple(printable(note) for note in notes))
