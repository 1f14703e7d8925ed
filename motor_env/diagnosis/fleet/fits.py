"""Fit the records of a fleet with one model: the terms that most of them want, and what they share.

The first fit of each record chooses its terms by itself. The medians of their values begin the second fit. Of a motor
at work that is the fit of a window: R, K, J and the drag are the motor's own, all else is the fleet's. Dry friction and
a constant load look alike in a short record, so the torque needed while turning is one quantity.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.errors import InputError, require_extra
from motor_env.common.files import end_with_parent
from motor_env.diagnosis.estimation import parameter_index as places
from motor_env.diagnosis.estimation.operation_fit import WindowFit, fit_window
from motor_env.diagnosis.estimation.preprocessing import from_recordings
from motor_env.diagnosis.estimation.starts.start_fit import StartFit as Identified
from motor_env.diagnosis.estimation.starts.start_identification import NUISANCES, identify
from motor_env.diagnosis.fleet.initial_fit import (
    REASONS,
    FitCache,
    InitialFit,
    Reading,
    classify_record,
    fit_record,
)
from motor_env.diagnosis.operation.windows import over_speed
from motor_env.diagnosis.readers.recording import describe_reading as understood
from motor_env.diagnosis.verdict.hypotheses import Fitted, FittedWindow
from motor_env.motor.healthy import Windows

_LOADS = ("load_constant", "load_square", "load_walk")
_DRY = (0.0, 0.35, 0.7, 1.0)  # shares of dry friction that are tried
_MOST_TRIED = 12  # records
_NOT_COMMON = [places.HEATING, places.COOLING, places.WALK, places.LOAD, places.SQUARE]


@dataclass(frozen=True, slots=True)
class FleetFits:
    """Records of a fleet, fitted with one model.

    Attributes:
        by_file: their fits.
        quantities: that they tell.
        windows: how they were fitted, of motors at work; None for starts.
        failures: why each other record has no fit, by its file.
        reading: how they were read; its regime is start or operation.
        read: how their columns were understood, in words.
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
        files: recordings, one motor each; a start, or a log of the motor at work.
        reading: how they are read.
        each: what maps over files, see `processes`.
        kept: file that keeps the first fits, so that a stopped run goes on.
        progress: told each file, twice.

    Raises:
        InputError: no record can be used, or the file of kept fits is another's.
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
    for path, again in zip(good, each(job, list(good)), strict=True):
        if isinstance(again, str):
            failures[path] = again
        else:
            by_file[path] = again
        progress(path)
    read = tuple(understood((path, notes) for path, (_, notes) in zip(files, looks, strict=True)))
    return FleetFits(by_file, quantities, windows, failures, reading, read)


def _majority_terms(initial_fits: Sequence[InitialFit]) -> list[str]:
    """List the terms that more than half of the records want."""
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
) -> Identified | str:
    try:
        return identify(reading.start(path), model, typical=typical)
    except REASONS as error:
        return str(error)


def _common_log_model(initial_fits: dict[Path, InitialFit], reading: Reading) -> Windows:
    """Choose what logs share, and which part of the drag is dry friction by the least misfit of some."""
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
    some = list(initial_fits)[:: -(-len(initial_fits) // _MOST_TRIED)]
    tried = []
    for share in _DRY:
        known = known.copy()
        known[[places.B, places.COULOMB]] = (1.0 - share) * drag / speed, share * drag
        tried.append(replace(windows, physical=known))
    fits = [[_fit_window(reading, candidate, path) for path in some] for candidate in tried]
    misfits = [sum(math.inf if isinstance(fit, str) else fit.misfit for fit in each) for each in fits]
    return tried[int(np.argmin(misfits))]


def _drag(first: InitialFit) -> float:
    """Divide the drag by the speed."""
    return float(first.values[places.B] + first.values[places.COULOMB] / first.speed_rad_s)


def _fit_window(reading: Reading, windows: Windows, path: Path) -> WindowFit | str:
    """Fit a log with what all share, or say why not."""
    try:
        record = replace(from_recordings([reading.log(path)]), hold=windows.hold)
        return fit_window(record, windows.physical, windows.terms)
    except REASONS as error:
        return str(error)


def fit_log(reading: Reading, windows: Windows, path: Path) -> FittedWindow | str:
    """Fit a log, with the drag over the speed."""
    fit = _fit_window(reading, windows, path)
    return fit if isinstance(fit, str) else over_speed(fit, windows.physical, windows.speed_rad_s)


Map = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""As the built-in `map`."""


@contextmanager
def processes(workers: int, scheduler: str | None = None) -> Iterator[Map]:
    """Offer what maps a function over files: here, in processes, or on the workers of a Dask cluster.

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
