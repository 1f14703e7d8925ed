"""From files to trends: the steps of `motor-env trend`."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from motor_env.console import printable
from motor_env.diagnosis.files import why_not
from motor_env.diagnosis.learning import fit_healthy
from motor_env.errors import InputError
from motor_env.fitting.starts import Identified, identify
from motor_env.prognosis.estimates import SECONDS_PER_DAY, Series, build_series, date_of, read_estimates
from motor_env.prognosis.page import leading, page, status
from motor_env.prognosis.trend import Trend, judge
from motor_env.prognosis.wear import RemainingLife
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, read_recording
from motor_env.recordings.start import prepare

TEMPERATURE = "temperature_c"
"""Column of a table of estimates that is no quantity: they are compared at one temperature."""
DateSource = Literal["name", "modified"]
"""Where the date of a recording comes from: its name, or the file's own date."""


def load_series(
    paths: Sequence[Path],
    *,
    voltage_v: float | None = None,
    columns: Sequence[ColumnChoice] = (),
    date: DateSource = "name",
    progress: Callable[[Path], None] = lambda path: None,
) -> tuple[list[Series], list[str]]:
    """Series from one table of estimates, or from a folder (or a list) of dated recordings.

    Returns:
        The series, and a sentence for every recording that could not be used.

    Raises:
        InputError: nothing can be used.
    """
    if not paths:
        raise InputError("give a table of estimates, or a folder of dated recordings")
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise InputError(f"{missing[0]}: no such file or folder")
    if len(paths) == 1 and paths[0].is_file() and _is_table(paths[0]):
        return read_estimates(paths[0]), []
    files: list[Path] = []
    for path in paths:
        files += sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    files = [file for file in files if not file.name.startswith(".")]
    return _from_recordings(files, voltage_v, columns, date, progress)


def _is_table(path: Path) -> bool:
    """A table of estimates has a column named time or date, or is JSON; a recording has `time_s` and a current."""
    if path.suffix.lower() == ".json":
        return True
    with path.open("rb") as file:
        head = file.readline(4096).decode("utf-8", errors="replace").lower()
    return "current" not in head


def _from_recordings(
    files: Sequence[Path],
    voltage_v: float | None,
    columns: Sequence[ColumnChoice],
    date: DateSource,
    progress: Callable[[Path], None],
) -> tuple[list[Series], list[str]]:
    notes: list[str] = []
    dated: list[tuple[float, Path]] = []
    for file in files:
        when = date_of(file.name)
        if date == "modified":
            when = datetime.fromtimestamp(file.stat().st_mtime, tz=UTC)
        if when is None:
            notes.append(f"{file.name}: its name holds no date such as 2026-01-31 (or use --date modified)")
        else:
            dated.append((when.timestamp() / SECONDS_PER_DAY, file))
    readable = _read(sorted(dated), columns, notes)
    fits = _fits(readable, voltage_v, notes, progress)
    if not fits:
        raise InputError(
            f"no recording can be used; the first reason: {notes[0] if notes else 'there are none'}"
        )
    estimates: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for day, fit in fits:
        for name, value, error in zip(fit.quantity_names, fit.values, fit.standard_errors, strict=True):
            estimates[name].append((day, float(value), float(error)))
    return build_series(estimates, "days", dated=True), notes


def _read(
    dated: Sequence[tuple[float, Path]], columns: Sequence[ColumnChoice], notes: list[str]
) -> list[tuple[float, Recording]]:
    recordings = []
    for when, file in dated:
        try:
            recordings.append((when, read_recording(file, columns)))
        except (ValueError, ArithmeticError, LookupError) as error:
            notes.append(why_not(file, error, "read")[0])
    return recordings


def _fits(
    recordings: Sequence[tuple[float, Recording]],
    voltage_v: float | None,
    notes: list[str],
    progress: Callable[[Path], None],
) -> list[tuple[float, Identified]]:
    """Fit every recording with one model, the one that the first three prefer: a change of model would be a jump."""
    model: tuple[str, ...] | None = None
    fits = []
    for number, (when, recording) in enumerate(recordings):
        progress(recording.path)
        try:
            if model is None:
                first = [entry for _, entry in recordings[number : number + 3]]
                model = fit_healthy(first, voltage_v=voltage_v)[0].model
            fits.append((when, identify(prepare(recording, voltage_v), model)))
        except (ValueError, ArithmeticError, LookupError) as error:  # UnusableError, or numerics that give up
            notes.append(f"{recording.path.name}: {error}")
    return fits


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
        said = {status(trend) for trend in self.trends}
        return next(word for word in ("reached", "trending", "unknown", "steady") if word in said)

    def to_json(self) -> list[dict[str, Any]]:
        """One object a quantity."""
        return [as_json(trend) for trend in self.trends]

    def text(self) -> str:
        """A line a quantity."""
        width = max(len(trend.series.name) for trend in self.trends)
        return "\n".join(f"{trend.series.name:<{width}}  {trend.sentence}" for trend in self.trends)

    def page(self) -> str:
        """A self-contained HTML page with a picture a quantity."""
        return page(self.trends, self.notes)


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
    series, notes = load_series(several, voltage_v=voltage_v, columns=columns, date=date, progress=progress)
    temperature = next((one for one in series if one.name == TEMPERATURE), None)
    series = [one for one in series if one is not temperature]
    names, wanted = {one.name for one in series}, limits or {}
    if unknown := [name for name in wanted if name not in names]:
        raise InputError(f"--limit names {unknown[0]!r}; the quantities are {', '.join(sorted(names))}")
    judged = (judge(one, wanted.get(one.name), level, reference_count, temperature) for one in series)
    return Trends(tuple(judged), tuple(printable(note) for note in notes))


def as_json(trend: Trend) -> dict[str, Any]:
    """One object a quantity; infinite times are null."""
    series, chosen = trend.series, leading(trend)
    return {
        "quantity": series.name,
        "state": status(trend),
        "sentence": trend.sentence,
        "reference": trend.reference,
        "last_estimate": float(series.estimate[-1]),
        "estimates": len(series.time),
        "time_unit": series.unit,
        "first_date": None if series.start is None else series.start.isoformat(),
        "limits": [
            {
                "limit": forecast.limit,
                "factor": forecast.factor,
                "probability_of_trend": forecast.wear.probability_trend,
                "trends": forecast.trends,
                "reached": forecast.reached,
                "probability_reached": forecast.life.probability_reached,
                "drift_per_time_unit": forecast.wear.mean_drift * trend.reference,
                "remaining_life": _life(forecast.life)
                if forecast is chosen and not forecast.reached and not forecast.withheld
                else None,
                "withheld": forecast.withheld or None,
            }
            for forecast in trend.forecasts
        ],
    }


def _life(life: RemainingLife) -> dict[str, float | None]:
    names = ("low", "median", "high", "level")
    return {name: value if math.isfinite(value) else None for name, value in zip(names, life, strict=False)}
