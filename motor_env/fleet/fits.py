"""Fits of the records of a fleet, all with one model: the terms that most of them want, and what they share.

The first fit of each record chooses its terms by itself. What most of them want is the fleet's model, and the medians
of their values are where the second fit begins. Of a motor at work the second fit is that of a window: R, K, J and the
drag are the motor's own, all else is the fleet's. There is no load in it: dry friction and a constant load stand for
each other in a short record, so that the torque which the motor needs while it turns is one quantity.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motor_env.diagnosis.diagnose import unusable_reason
from motor_env.diagnosis.running.lessons import effective_speed, known_of
from motor_env.diagnosis.running.windows import NAMES, averaged, over_speed, rms_volts
from motor_env.errors import InputError
from motor_env.fitting import places
from motor_env.fitting.identify import identify_operation
from motor_env.fitting.recorded import at_terminals, from_recordings
from motor_env.fitting.starts.choice import NUISANCES, identify_best
from motor_env.fitting.starts.identified import Identified
from motor_env.fitting.starts.identify import identify
from motor_env.fitting.window import fit_window
from motor_env.motor.healthy import Windows
from motor_env.motor.parameters import FloatArray
from motor_env.processes import end_with_parent
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.headers import ColumnChoice
from motor_env.recordings.recording import Recording, recording_of
from motor_env.recordings.regime import taken_for
from motor_env.recordings.splitting import chosen_starts
from motor_env.recordings.start import Circuit, prepare

_LOADS = ("load_constant", "load_square", "load_walk")
_DRY = (0.0, 0.35, 0.7, 1.0)  # shares of dry friction that are tried
_MOST_TRIED = 12  # records
_SHARED_NOT = [places.HEATING, places.COOLING, places.WALK, places.LOAD, places.SQUARE]


@dataclass(frozen=True, slots=True)
class Reading:
    """How the records are read.

    Attributes:
        columns: named by the user.
        regime: start, operation, or auto.
        voltage_v: level of the supply where none was recorded.
        circuit: what is known of the measuring circuit.
    """

    columns: Sequence[ColumnChoice] = ()
    regime: str = "auto"
    voltage_v: float | None = None
    circuit: Circuit | None = None


class First(NamedTuple):
    """The first fit of a record; `trouble` says why there is none.

    Attributes:
        names: of the terms.
        quantities: that it tells.
        values: physical values, or the quantities' logarithms of a start.
        hold: of the voltage.
        speed_rad_s: effective speed.
    """

    trouble: str = ""
    names: tuple[str, ...] = ()
    quantities: tuple[str, ...] = ()
    values: FloatArray | None = None
    hold: str = "held"
    speed_rad_s: float = 0.0


class Second(NamedTuple):
    """The second fit of a record.

    Attributes:
        log_values: logarithms of its quantities.
        covariance: of them.
        start: the fit, of a start.
        misfit: -2 log likelihood.
    """

    log_values: FloatArray
    covariance: FloatArray
    start: Identified | None = None
    misfit: float = 0.0


@dataclass(frozen=True, slots=True)
class FleetFits:
    """The records of a fleet that a motor explains, fitted with one model.

    Attributes:
        files: of these records.
        seconds: their fits.
        quantities: that they tell.
        windows: how they were fitted, of motors at work; None for starts.
        troubles: why each other record is not among them, by its file.
        reading: how they were read; its regime is start or operation.
    """

    files: tuple[Path, ...]
    seconds: tuple[Second, ...]
    quantities: tuple[str, ...]
    windows: Windows | None
    troubles: dict[Path, str]
    reading: Reading


def fit_fleet(
    files: Sequence[Path],
    reading: Reading,
    *,
    workers: int = 1,
    progress: Callable[[Path], None] = lambda path: None,
) -> FleetFits:
    """Fit the records of a fleet.

    Args:
        files: recordings, one motor each; a start, or a log of the motor at work.
        reading: how they are read.
        workers: processes.
        progress: told each file, twice.

    Raises:
        InputError: no record can be used, or starts stand beside logs.
    """
    with _mapping(workers) as each:
        kinds = set(each(partial(_regime, reading), files))
        # A start is a short log, too; a log is no start.
        reading = replace(reading, regime="operation" if "operation" in kinds else "start")
        firsts = dict(zip(files, _told(each(partial(_first, reading), files), files, progress), strict=True))
        troubles = {path: one.trouble for path, one in firsts.items() if one.trouble}
        good = {path: one for path, one in firsts.items() if not one.trouble}
        if not good:
            raise InputError(f"no record of the fleet can be used: {next(iter(troubles.values()))}")
        quantities = Counter(one.quantities for one in good.values()).most_common(1)[0][0]
        for path in [path for path, one in good.items() if one.quantities != quantities]:
            troubles[path] = "it was recorded with other columns than most"
            del good[path]
        if reading.regime == "start":
            windows = None
            job = partial(_second_start, reading, *_shared_by_starts(list(good.values()), quantities))
        else:
            windows = _shared_by_logs(good, reading)
            job = partial(_second_log, reading, windows)
        seconds = tuple(_told(each(job, list(good)), list(good), progress))
    return FleetFits(tuple(good), seconds, quantities, windows, troubles, reading)


class _mapping:  # noqa: N801  # a context, used as a function is
    """`map`, or that of a pool of processes."""

    def __init__(self, workers: int) -> None:
        self.pool = ProcessPoolExecutor(workers, initializer=end_with_parent) if workers > 1 else None

    def __enter__(self) -> Callable[..., Iterable[Any]]:
        return map if self.pool is None else self.pool.map

    def __exit__(self, *_: object) -> None:
        if self.pool is not None:
            self.pool.shutdown(cancel_futures=True)


def _told(found: Iterable[Any], files: Sequence[Path], progress: Callable[[Path], None]) -> list[Any]:
    every = []
    for path, one in zip(files, found, strict=True):
        progress(path)
        every.append(one)
    return every


def _regime(reading: Reading, path: Path) -> str:
    try:
        return taken_for(recording_of(path, reading.columns), reading.regime).regime
    except InputError:
        return "start"  # the first fit says why it cannot be read


def _first(reading: Reading, path: Path) -> First:
    try:
        recording = recording_of(path, reading.columns)
        if reading.regime == "start":
            (part,) = chosen_starts(recording, 1)
            fit = identify_best(prepare(part, reading.voltage_v, reading.circuit), NUISANCES)
            reason = unusable_reason(fit)
            if reason is not None:
                return First(reason)
            return First("", fit.model, fit.quantity_names, fit.log_values)
        found = identify_operation([at_terminals(recording, reading.voltage_v, reading.circuit)])
    except (UnusableError, InputError) as error:
        return First(str(error).removeprefix(f"{path}: "))
    if not found.record.seen.all() or found.r2_current is None:
        return First("the current tells no motor")
    names, hold = found.solution.names, found.record.hold
    return First("", names, NAMES, known_of(found), hold, effective_speed(found))


def _wanted(firsts: Sequence[First]) -> list[str]:
    """Terms that more than half of the records want."""
    count = Counter(name for one in firsts for name in one.names)
    return [name for name, seen in count.items() if seen > 0.5 * len(firsts)]


def _shared_by_starts(
    firsts: Sequence[First], quantities: tuple[str, ...]
) -> tuple[tuple[str, ...], dict[str, float]]:
    """The model of starts, and the typical values of their quantities."""
    wanted = _wanted(firsts)
    middle = np.exp(np.median([one.values for one in firsts], axis=0)).tolist()
    return tuple(name for name in NUISANCES if name in wanted), dict(zip(quantities, middle, strict=True))


def _second_start(reading: Reading, model: tuple[str, ...], typical: dict[str, float], path: Path) -> Second:
    (part,) = chosen_starts(recording_of(path, reading.columns), 1)
    fit = identify(prepare(part, reading.voltage_v, reading.circuit), model, typical=typical)
    return Second(fit.log_values, fit.log_covariance, fit)


def _shared_by_logs(firsts: dict[Path, First], reading: Reading) -> Windows:
    """What the logs share; which part of the drag is dry friction, by what explains some of them best."""
    every = list(firsts.values())
    known = np.median([one.values for one in every], axis=0)
    known[_SHARED_NOT] = 0.0
    speed = float(np.median([one.speed_rad_s for one in every]))
    drag = float(np.median([_drag(one) for one in every])) * speed
    hold = Counter(one.hold for one in every).most_common(1)[0][0]
    recordings = [_log(reading, path) for path in firsts]
    volts = [rms_volts(one) for one in recordings]
    shortest_s = min(len(one.time_s) * one.dt_s for one in recordings)
    peaks = np.median([from_recordings([one]).peaks for one in recordings], axis=0)
    windows = Windows(
        window_s=shortest_s,
        terms=tuple(name for name in _wanted(every) if name not in _LOADS),
        physical=known,
        hold=hold,  # type: ignore[arg-type]  # a literal that went through a counter
        dt_s=float(np.median([one.dt_s for one in recordings])),
        speed_rad_s=speed,
        rms_volts=(min(volts), max(volts)),
        peaks=tuple(peaks.tolist()),
    )
    some = list(firsts)[:: -(-len(firsts) // _MOST_TRIED)]
    tried = []
    for share in _DRY:
        known = known.copy()
        known[[places.B, places.COULOMB]] = (1.0 - share) * drag / speed, share * drag
        tried.append(replace(windows, physical=known))
    misfits = [sum(_second_log(reading, one, path).misfit for path in some) for one in tried]
    return tried[int(np.argmin(misfits))]


def _drag(first: First) -> float:
    """Drag over the speed."""
    assert first.values is not None  # noqa: S101  # it has no trouble
    return float(first.values[places.B] + first.values[places.COULOMB] / first.speed_rad_s)


def _log(reading: Reading, path: Path) -> Recording:
    recording = at_terminals(recording_of(path, reading.columns), reading.voltage_v, reading.circuit)
    return averaged(recording, len(recording.time_s) * recording.dt_s)


def _second_log(reading: Reading, windows: Windows, path: Path) -> Second:
    record = replace(from_recordings([_log(reading, path)]), hold=windows.hold)
    fit = fit_window(record, windows.physical, windows.terms)
    found = over_speed(fit, windows.physical, windows.speed_rad_s)
    return Second(found.log_values, found.log_covariance, misfit=fit.misfit)
