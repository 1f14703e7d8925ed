"""Fits of the records of a fleet, all with one model: the terms that most of them want, and what they share.

The first fit of each record chooses its terms by itself. What most of them want is the fleet's model, and the medians
of their values are where the second fit begins. Of a motor at work the second fit is that of a window: R, K, J and the
drag are the motor's own, all else is the fleet's. There is no load in it: dry friction and a constant load stand for
each other in a short record, so that the torque which the motor needs while it turns is one quantity.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from motor_env.diagnosis.hypotheses import Fitted, FittedWindow
from motor_env.diagnosis.running.windows import over_speed
from motor_env.errors import InputError
from motor_env.fitting import places
from motor_env.fitting.recorded import from_recordings
from motor_env.fitting.starts.choice import NUISANCES
from motor_env.fitting.starts.identified import Identified
from motor_env.fitting.starts.identify import identify
from motor_env.fitting.window import WindowFit, fit_window
from motor_env.fleet.first import REASONS, First, Reading, first_fit, first_look
from motor_env.fleet.kept import Kept
from motor_env.fleet.mapping import Map
from motor_env.motor.healthy import Windows
from motor_env.recordings.recording import understood

_LOADS = ("load_constant", "load_square", "load_walk")
_DRY = (0.0, 0.35, 0.7, 1.0)  # shares of dry friction that are tried
_MOST_TRIED = 12  # records
_SHARED_NOT = [places.HEATING, places.COOLING, places.WALK, places.LOAD, places.SQUARE]


@dataclass(frozen=True, slots=True)
class FleetFits:
    """The records of a fleet that a motor explains, fitted with one model.

    Attributes:
        seconds: their fits, by file.
        quantities: that they tell.
        windows: how they were fitted, of motors at work; None for starts.
        troubles: why each other record is not among them, by its file.
        reading: how they were read; its regime is start or operation.
        read: how their columns were understood, in words.
    """

    seconds: dict[Path, Fitted]
    quantities: tuple[str, ...]
    windows: Windows | None
    troubles: dict[Path, str]
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
        kept: file that keeps the first fits: a fleet that was stopped goes on where it was.
        progress: told each file, twice.

    Raises:
        InputError: no record can be used, or the file of kept fits is another's.
    """
    looks = list(each(partial(first_look, reading), files))
    kinds = {kind for kind, _ in looks}
    # A start is a short log, too; a log is no start.
    reading = replace(reading, regime="operation" if "operation" in kinds else "start")
    with Kept(kept, reading) as known:
        missing = [path for path in files if path not in known]
        for path, one in zip(missing, each(partial(first_fit, reading), missing), strict=True):
            known.add(path, one)
            progress(path)
    firsts = {path: known[path] for path in files}
    troubles = {path: one.trouble for path, one in firsts.items() if one.trouble}
    good = {path: one for path, one in firsts.items() if not one.trouble}
    if not good:
        raise InputError(f"no record of the fleet can be used: {next(iter(troubles.values()))}")
    quantities = Counter(one.quantities for one in good.values()).most_common(1)[0][0]
    for path in [path for path, one in good.items() if one.quantities != quantities]:
        troubles[path] = "it was recorded with other columns than most"
        del good[path]
    job: Callable[[Path], Fitted | str]
    if reading.regime == "start":
        windows = None
        job = partial(_second_start, reading, *_shared_by_starts(list(good.values()), quantities))
    else:
        windows = _shared_by_logs(good, reading)
        job = partial(second_log, reading, windows)
    seconds: dict[Path, Fitted] = {}
    for path, again in zip(good, each(job, list(good)), strict=True):
        if isinstance(again, str):
            troubles[path] = again
        else:
            seconds[path] = again
        progress(path)
    read = tuple(understood((path, notes) for path, (_, notes) in zip(files, looks, strict=True)))
    return FleetFits(seconds, quantities, windows, troubles, reading, read)


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


def _second_start(
    reading: Reading, model: tuple[str, ...], typical: dict[str, float], path: Path
) -> Identified | str:
    try:
        return identify(reading.start(path), model, typical=typical)
    except REASONS as error:
        return str(error)


def _shared_by_logs(firsts: dict[Path, First], reading: Reading) -> Windows:
    """What the logs share; which part of the drag is dry friction, by what explains some of them best."""
    every = list(firsts.values())
    known = np.median([one.values for one in every], axis=0)
    known[_SHARED_NOT] = 0.0
    speed = float(np.median([one.speed_rad_s for one in every]))
    drag = float(np.median([_drag(one) for one in every])) * speed
    hold = Counter(one.hold for one in every).most_common(1)[0][0]
    windows = Windows(
        window_s=min(one.duration_s for one in every),
        terms=tuple(name for name in _wanted(every) if name not in _LOADS),
        physical=known,
        hold=hold,  # type: ignore[arg-type]  # a literal that went through a counter
        dt_s=float(np.median([one.dt_s for one in every])),
        speed_rad_s=speed,
        rms_volts=(min(one.rms_volts for one in every), max(one.rms_volts for one in every)),
        peaks=tuple(np.median([one.peaks for one in every], axis=0).tolist()),
    )
    some = list(firsts)[:: -(-len(firsts) // _MOST_TRIED)]
    tried = []
    for share in _DRY:
        known = known.copy()
        known[[places.B, places.COULOMB]] = (1.0 - share) * drag / speed, share * drag
        tried.append(replace(windows, physical=known))
    fits = [[_log_fit(reading, one, path) for path in some] for one in tried]
    misfits = [sum(math.inf if isinstance(fit, str) else fit.misfit for fit in each) for each in fits]
    return tried[int(np.argmin(misfits))]


def _drag(first: First) -> float:
    """Drag over the speed."""
    return float(first.values[places.B] + first.values[places.COULOMB] / first.speed_rad_s)


def _log_fit(reading: Reading, windows: Windows, path: Path) -> WindowFit | str:
    """The fit of a log with what all share, or why there is none."""
    try:
        record = replace(from_recordings([reading.log(path)]), hold=windows.hold)
        return fit_window(record, windows.physical, windows.terms)
    except REASONS as error:
        return str(error)


def second_log(reading: Reading, windows: Windows, path: Path) -> FittedWindow | str:
    """That fit, with the drag over the speed."""
    fit = _log_fit(reading, windows, path)
    return fit if isinstance(fit, str) else over_speed(fit, windows.physical, windows.speed_rad_s)
