"""Fit the records of a fleet with one model: the terms that most of them prefer.

The first fit of each record chooses its own terms. The second begins at the medians of the first. For a motor at work
it fits a window: R, K, J and the drag are the motor's own, all else is the fleet's.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from pydantic import TypeAdapter

from motor_env.common.errors import InputError, require_extra
from motor_env.common.files import end_with_parent, read_file
from motor_env.diagnosis.diagnose import explain_unusable
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import WindowFit, fit_window, identify_operation
from motor_env.diagnosis.estimation.preprocessing import at_terminals, from_recordings
from motor_env.diagnosis.estimation.starts.start_fit import StartFit
from motor_env.diagnosis.estimation.starts.start_identification import NUISANCES, identify, identify_best
from motor_env.diagnosis.operation.window_baseline import effective_speed
from motor_env.diagnosis.operation.windows import averaged, rms_volts, with_drag_over_speed
from motor_env.diagnosis.readers.headers import ColumnChoice
from motor_env.diagnosis.readers.recording import Recording, describe_reading, recording_of
from motor_env.diagnosis.readers.regime import taken_for
from motor_env.diagnosis.readers.start import Circuit, Start, chosen_starts, prepare
from motor_env.diagnosis.verdict.hypotheses import NAMES, Fitted, FittedWindow
from motor_env.motor.healthy import Windows

REASONS = (ValueError, ArithmeticError, LookupError)
"""Errors of a fit on values far from any motor."""


@dataclass(frozen=True, slots=True)
class Reading:
    """Options for reading records.

    Attributes:
        columns: of the user.
        regime: start, operation, or auto.
        voltage_v: level of the supply where none was recorded.
        circuit: measuring circuit.
    """

    columns: Sequence[ColumnChoice] = ()
    regime: str = "auto"
    voltage_v: float | None = None
    circuit: Circuit | None = None

    @property
    def options(self) -> dict[str, Any]:
        """Return the arguments of `motor_env.diagnose`."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def start(self, path: Path) -> Start:
        """Read the first start of a file."""
        (part,) = chosen_starts(recording_of(path, self.columns), 1)
        return prepare(part, self.voltage_v, self.circuit)

    def log(self, path: Path) -> Recording:
        """Read a log; average neighbours where it is long."""
        recording = at_terminals(recording_of(path, self.columns), self.voltage_v, self.circuit)
        return averaged(recording, len(recording.time_s) * recording.dt_s)


class InitialFit(NamedTuple):
    """First fit of a record.

    Attributes:
        trouble: reason without a fit.
        names: of the terms.
        quantities: determined by the fit.
        values: physical values, or the quantities' logarithms of a start.
        hold: of the voltage.
        speed_rad_s: effective speed.
        rms_volts: effective voltage.
        duration_s, dt_s: of the record, and of its samples.
        peaks: largest voltage, current and speed.
    """

    trouble: str = ""
    names: tuple[str, ...] = ()
    quantities: tuple[str, ...] = ()
    values: tuple[float, ...] = ()
    hold: str = "held"
    speed_rad_s: float = 0.0
    rms_volts: float = 0.0
    duration_s: float = 0.0
    dt_s: float = 0.0
    peaks: tuple[float, float, float] = (1.0, 1.0, 1.0)


def classify_record(reading: Reading, path: Path) -> tuple[str, tuple[str, ...]]:
    """Classify a file as start or operation; return also how its columns were understood."""
    try:
        recording = recording_of(path, reading.columns)
        return taken_for(recording, reading.regime).regime, recording.columns
    except InputError:
        return "start", ()  # the first fit says why it cannot be read


def fit_record(reading: Reading, path: Path) -> InitialFit:
    """Fit a file by itself."""
    try:
        if reading.regime == "start":
            fit = identify_best(reading.start(path), NUISANCES)
            reason = explain_unusable(fit)
            if reason is not None:
                return InitialFit(reason)
            return InitialFit("", fit.model, fit.quantity_names, tuple(fit.log_values.tolist()))
        log = reading.log(path)
        fitted = identify_operation([log])
    except REASONS as error:
        return InitialFit(str(error).removeprefix(f"{path}: "))
    if not fitted.record.recorded.all() or fitted.r2_current is None:
        return InitialFit("the current determines no motor")
    return InitialFit(
        names=fitted.solution.names,
        quantities=NAMES,
        values=tuple(fitted.solution.values.tolist()),
        hold=fitted.record.hold,
        speed_rad_s=effective_speed(fitted),
        rms_volts=rms_volts(log),
        duration_s=len(log.time_s) * log.dt_s,
        dt_s=log.dt_s,
        peaks=fitted.record.peaks,
    )


_MARK = "motor-env fleet"
_LARGEST_BYTES = 2_000_000_000
_FIRST: TypeAdapter[InitialFit] = TypeAdapter(InitialFit)


class FitCache:
    """Cache of first fits by file, in memory and in a file of JSON lines.

    A fit is valid while its file keeps size and time, and the options stay.

    Args:
        path: of the file; None for memory alone.
        reading: options for reading.

    Raises:
        InputError: the file holds other content, or is damaged before its last line.
    """

    def __init__(self, path: Path | None, reading: Reading) -> None:
        self.path = path
        self.reading = sha256(repr(reading).encode()).hexdigest()[:16]
        self.cached: dict[str, InitialFit] = {}
        self.file: IO[str] | None = None
        if path is not None and path.exists():
            self._read(path)

    def _read(self, path: Path) -> None:
        content = bytes(read_file(path, _LARGEST_BYTES))
        *lines, last = content.split(b"\n")
        head = self._head().encode()
        # The first line may have been cut short by the end of the process, too.
        if (lines[0] if lines else head[: len(last)]) != (head if lines else last):
            raise InputError(f"{path}: holds no fits of records that were read like these; give another file")
        for number, line in enumerate(lines[1:], 2):
            try:
                row = json.loads(line)
                self.cached[str(row["record"])] = _FIRST.validate_python(row["first"])
            except (ValueError, LookupError, TypeError, RecursionError):
                raise InputError(f"{path}: line {number} is no kept fit; give another file") from None
        if last:
            os.truncate(path, len(content) - len(last))

    def _head(self) -> str:
        return json.dumps({"kept by": _MARK, "reading": self.reading})

    def __enter__(self) -> FitCache:
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.file = self.path.open("a", encoding="utf-8")
            if not self.cached and self.path.stat().st_size == 0:
                print(self._head(), file=self.file, flush=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self.file is not None:
            self.file.close()

    def __contains__(self, path: Path) -> bool:
        return _record(path) in self.cached

    def __getitem__(self, path: Path) -> InitialFit:
        return self.cached[_record(path)]

    def add(self, path: Path, first: InitialFit) -> None:
        """Keep a fit."""
        self.cached[_record(path)] = first
        if self.file is not None:
            row = {"record": _record(path), "first": first._asdict()}
            print(json.dumps(row), file=self.file, flush=True)


def _record(path: Path) -> str:
    try:
        stat = path.stat()
    except OSError:
        return str(path)
    return f"{path} {stat.st_size} {stat.st_mtime_ns}"


_LOADS = ("load_constant", "load_square", "load_walk")
_DRY = (0.0, 0.35, 0.7, 1.0)  # shares of dry friction that are tried
_MOST_TRIED = 12  # records
_NOT_COMMON = [index.WALK, index.LOAD, index.SQUARE]


@dataclass(frozen=True, slots=True)
class FleetFits:
    """Fits of a fleet's records with one model.

    Attributes:
        by_file: the fits.
        quantities: determined by them.
        windows: of logs; None for starts.
        failures: reason without a fit, by file.
        reading: with the regime start or operation.
        read: interpretation of the columns, in words.
    """

    by_file: dict[Path, Fitted]
    quantities: tuple[str, ...]
    windows: Windows | None
    failures: dict[Path, str]
    reading: Reading
    read: tuple[str, ...] = ()


def fit_fleet(
    files: Sequence[Path],
    reading: Reading,
    *,
    each: Map = map,
    kept: Path | None = None,
    progress: Callable[[Path], None] = lambda path: None,
) -> FleetFits:
    """Fit the records of a fleet.

    Args:
        files: recordings, one motor each.
        reading: options for reading.
        each: maps over files, see `processes`.
        kept: file of first fits, to continue a stopped run.
        progress: called with each file, twice.

    Raises:
        InputError: no record can be used, or `kept` is another file.
    """
    looks = list(each(partial(classify_record, reading), files))
    kinds = {kind for kind, _ in looks}
    # A start is a short log, too; a log is no start.
    reading = replace(reading, regime="operation" if "operation" in kinds else "start")
    with FitCache(kept, reading) as known:
        missing = [path for path in files if path not in known]
        for path, fit in zip(missing, each(partial(fit_record, reading), missing), strict=True):
            known.add(path, fit)
            progress(path)
    initial_fits = {path: known[path] for path in files}
    failures = {path: fit.trouble for path, fit in initial_fits.items() if fit.trouble}
    good = {path: fit for path, fit in initial_fits.items() if not fit.trouble}
    if not good:
        raise InputError(f"no record of the fleet can be used: {next(iter(failures.values()))}")
    quantities = Counter(fit.quantities for fit in good.values()).most_common(1)[0][0]
    for path in [path for path, fit in good.items() if fit.quantities != quantities]:
        failures[path] = "it was recorded with other columns than most"
        del good[path]
    job: Callable[[Path], Fitted | str]
    if reading.regime == "start":
        windows = None
        job = partial(_fit_start, reading, *_common_start_model(list(good.values()), quantities))
    else:
        windows = _common_log_model(good, reading)
        job = partial(fit_log, reading, windows)
    by_file: dict[Path, Fitted] = {}
    for path, refit in zip(good, each(job, list(good)), strict=True):
        if isinstance(refit, str):
            failures[path] = refit
        else:
            by_file[path] = refit
        progress(path)
    read = tuple(describe_reading((path, notes) for path, (_, notes) in zip(files, looks, strict=True)))
    return FleetFits(by_file, quantities, windows, failures, reading, read)


def _majority_terms(initial_fits: Sequence[InitialFit]) -> list[str]:
    count = Counter(name for fit in initial_fits for name in fit.names)
    return [name for name, wanting in count.items() if wanting > 0.5 * len(initial_fits)]


def _common_start_model(
    initial_fits: Sequence[InitialFit], quantities: tuple[str, ...]
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Choose the model of starts, and the typical values of their quantities."""
    wanted = _majority_terms(initial_fits)
    middle = np.exp(np.median([fit.values for fit in initial_fits], axis=0)).tolist()
    return tuple(name for name in NUISANCES if name in wanted), dict(zip(quantities, middle, strict=True))


def _fit_start(
    reading: Reading, model: tuple[str, ...], typical: dict[str, float], path: Path
) -> StartFit | str:
    try:
        return identify(reading.start(path), model, typical=typical)
    except REASONS as error:
        return str(error)


def _common_log_model(initial_fits: dict[Path, InitialFit], reading: Reading) -> Windows:
    """Choose the common model of logs; the share of dry friction has the least misfit."""
    initial = list(initial_fits.values())
    known = np.median([fit.values for fit in initial], axis=0)
    known[_NOT_COMMON] = 0.0
    speed = float(np.median([fit.speed_rad_s for fit in initial]))
    drag = float(np.median([_drag(fit) for fit in initial])) * speed
    hold = Counter(fit.hold for fit in initial).most_common(1)[0][0]
    windows = Windows(
        window_s=min(fit.duration_s for fit in initial),
        terms=tuple(name for name in _majority_terms(initial) if name not in _LOADS),
        physical=known,
        hold=hold,  # type: ignore[arg-type]  # a literal that went through a counter
        dt_s=float(np.median([fit.dt_s for fit in initial])),
        speed_rad_s=speed,
        rms_volts=(min(fit.rms_volts for fit in initial), max(fit.rms_volts for fit in initial)),
        peaks=tuple(np.median([fit.peaks for fit in initial], axis=0).tolist()),
    )
    sample = list(initial_fits)[:: -(-len(initial_fits) // _MOST_TRIED)]
    tried = []
    for share in _DRY:
        known = known.copy()
        known[[index.B, index.COULOMB]] = (1.0 - share) * drag / speed, share * drag
        tried.append(replace(windows, physical=known))
    fits = [[_fit_window(reading, candidate, path) for path in sample] for candidate in tried]
    misfits = [sum(math.inf if isinstance(fit, str) else fit.misfit for fit in each) for each in fits]
    return tried[int(np.argmin(misfits))]


def _drag(first: InitialFit) -> float:
    return float(first.values[index.B] + first.values[index.COULOMB] / first.speed_rad_s)


def _fit_window(reading: Reading, windows: Windows, path: Path) -> WindowFit | str:
    try:
        record = replace(from_recordings([reading.log(path)]), hold=windows.hold)
        return fit_window(record, windows.physical, windows.terms)
    except REASONS as error:
        return str(error)


def fit_log(reading: Reading, windows: Windows, path: Path) -> FittedWindow | str:
    """Fit a log, with the drag over the speed."""
    fit = _fit_window(reading, windows, path)
    return fit if isinstance(fit, str) else with_drag_over_speed(fit, windows.physical, windows.speed_rad_s)


Map = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""As the built-in `map`."""


@contextmanager
def processes(workers: int, scheduler: str | None = None) -> Iterator[Map]:
    """Yield a map over files: in this process, in others, or on a Dask cluster.

    Args:
        workers: processes, without a cluster.
        scheduler: address of the cluster's scheduler.
    """
    if scheduler is not None:
        require_extra("distributed", "dask")
        from distributed import Client

        with Client(scheduler) as client:
            yield lambda job, files: (future.result() for future in client.map(job, list(files), pure=False))
    elif workers > 1:
        pool = ProcessPoolExecutor(workers, initializer=end_with_parent)
        try:
            yield pool.map
        finally:
            pool.shutdown(cancel_futures=True)
    else:
        yield map
