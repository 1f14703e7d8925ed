"""What healthy windows of a motor at work teach about its next window."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.healthy_motor import the_next
from motor_env.diagnosis.running.windows import (
    NAMES,
    NEEDED,
    from_healthy,
    is_closed,
    rms_volts,
    spread_of,
    windows_of,
)
from motor_env.motor.data_sheet import WindowReference
from motor_env.motor.parameters import FloatArray
from motor_env.operation import kernel
from motor_env.operation.identify import Operation, identify_operation
from motor_env.operation.record import MOST, Record, from_recordings
from motor_env.operation.window import fit_window
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording

FEWEST_WINDOWS = 4
MOST_LEARNED = 40
SPREAD_PRIOR = 0.01
TEMPERATURE_K = 15.0
_LOAD = ("load_constant", "load_walk")
_TOLD = 0.1  # standard deviation of the drag beside an unknown load, as a share, up to which windows tell the two apart
_NOISES = [kernel.NOISE_I, kernel.NOISE_W, kernel.NOISE_V, kernel.WALK]
_MOST_HALVINGS = 6  # of a window, for looks at its parts
_FEWEST_OF_A_LOOK = 8  # samples
_SHORTEST_LOOK_S = 0.2  # so that there are 20 looks a second at most, which take a tenth of a core


def learn_windows(
    recordings: Sequence[Recording], window_s: float, *, steady: bool = False
) -> WindowReference:
    """What windows of a healthy motor at work teach about its next window.

    The spread is that of windows beyond their own errors, with a prior of 1 % on every quantity worth 4 windows.

    Args:
        recordings: of the healthy motor at work.
        window_s: length of a window.
        steady: nothing but a fault moves the motor, as on a test bench: no prior spread, no other temperature, the
            load and the sensors' offsets as in the recordings.

    Raises:
        UnusableError: no current and speed, too few windows, or no motor explains them.
    """
    parts = [part for recording in recordings for part in windows_of(recording, window_s)]
    if len(parts) < FEWEST_WINDOWS:
        raise UnusableError(f"{len(parts)} windows of {window_s:g} s; at least {FEWEST_WINDOWS} are needed")
    samples = sum(len(recording.time_s) for recording in recordings)
    chosen = recordings
    if samples > MOST:
        every = math.ceil(sum(len(part.time_s) for part in parts) / MOST)
        chosen = parts[:: min(every, len(parts) // FEWEST_WINDOWS)]
    joint = identify_operation(chosen, most=max(MOST, sum(len(one.time_s) for one in chosen)))
    if not joint.record.seen.all():
        raise UnusableError(NEEDED)
    known, wanted, hold = _known(joint), joint.solution.names, joint.record.hold
    if steady:
        wanted = tuple(name for name in wanted if not name.startswith("offset"))
    records = [replace(from_recordings([part]), hold=hold) for part in parts]
    with_load = tuple(dict.fromkeys((*wanted, *_LOAD)))
    fits = [fit_window(record, known, wanted if steady else with_load) for record in records]
    if not steady and math.sqrt(np.median([fit.covariance[-1, -1] for fit in fits])) < _TOLD:
        wanted = with_load
    # A window's noise is less than that of all windows in one fit: it is where the fit of the next one begins.
    known[_NOISES] = np.median([fit.values[_NOISES] for fit in fits], axis=0)
    fits = [fit_window(record, known, wanted) for record in records]
    logs, errors = np.array([fit.logs for fit in fits]), np.mean([fit.covariance for fit in fits], axis=0)
    prior = np.eye(len(NAMES)) * (0.0 if steady else SPREAD_PRIOR) ** 2 + errors
    centre, covariance, freedom = the_next(logs, prior)
    volts = [rms_volts(part) for part in parts]
    reference = WindowReference(
        windows=len(fits),
        window_s=window_s,
        degrees_of_freedom=freedom,
        values=np.exp(centre),
        log_covariance=covariance,
        terms=wanted,
        physical=known,
        hold=hold,
        dt_s=parts[0].dt_s,
        rms_volts=(min(volts), max(volts)),
        temperature_k=0.0 if steady else TEMPERATURE_K,
        peaks=tuple(np.max([record.peaks for record in records], axis=0).tolist()),
    )
    ratios = list(logs - centre)
    believed = _squares(ratios, [spread_of(fit.covariance, reference) for fit in fits])
    taught = _squares(ratios, [covariance] * len(fits))
    reference = replace(reference, window_excess=sum(believed) / sum(taught))
    return replace(reference, excess=tuple(_excess(records, ratios, reference)))


def _squares(ratios: Sequence[FloatArray], spreads: Sequence[FloatArray]) -> list[float]:
    """Squared distances per dimension."""
    pairs = zip(ratios, spreads, strict=True)
    return [float(off @ np.linalg.solve(spread, off)) / len(NAMES) for off, spread in pairs]


def _excess(
    records: Sequence[Record], ratios: Sequence[FloatArray], reference: WindowReference
) -> Iterator[float]:
    """By how much parts of windows scatter more than is believed of them: halves, quarters, and so on."""
    some = slice(None, None, math.ceil(len(records) / MOST_LEARNED))
    samples = min(len(record.voltage_v) for record in records)
    shares = (2.0**_MOST_HALVINGS, samples / _FEWEST_OF_A_LOOK, reference.window_s / _SHORTEST_LOOK_S)
    for k in range(1, int(math.log2(max(min(shares), 1.0))) + 1):
        length, squares = samples >> k, []
        for record, at in zip(records[some], ratios[some], strict=True):
            parts = [record.part(n * length, length) for n in range(2**k)]
            found = from_healthy(parts, reference, at)
            closed = [one for part, one in zip(parts, found, strict=True) if is_closed(part)]
            squares += _squares(*zip(*closed, strict=True)) if closed else []
        yield max(float(np.mean(squares or 1.0)), 1.0)


def _known(joint: Operation) -> FloatArray:
    """Physical values of the joint fit, without warmth: each window is taken at its own temperature."""
    known = joint.solution.values
    known[[kernel.HEATING, kernel.COOLING]] = 0.0
    return known
