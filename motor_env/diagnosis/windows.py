"""A running motor by windows of its logs: what healthy windows teach, and the verdict on each window and on a record.

All windows are fitted with the terms that the healthy ones were identified with jointly. What windows of one motor
share is held there: brush drop, inductance, and how the drag divides into viscous and dry friction, so that regimes
agree. What may change is R, K, J and the whole drag. Where the healthy windows tell friction from a load, as those that
reverse do, a load that varies slowly is unknown in each window; elsewhere it is part of the drag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import stats

from motor_env.diagnosis.explanations import (
    Change,
    Difference,
    alarm_share,
    compare,
    explain,
    joint_share,
)
from motor_env.diagnosis.healthy_motor import warmer
from motor_env.motor import identifiable as quantities
from motor_env.motor.data_sheet import WindowReference
from motor_env.motor.parameters import FloatArray
from motor_env.operation import kernel
from motor_env.operation.identify import Operation, identify_operation
from motor_env.operation.problem import Problem, Solution
from motor_env.operation.record import MOST, Record, block_means, from_recordings
from motor_env.operation.terms import NOISES, terms
from motor_env.operation.uncertainty import covariance, motor_places
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, cut

FEWEST_WINDOWS = 4
MOST_SAMPLES = 6_000
MANY, MOST_JUDGED = 40, 20
_TOGETHER = 50  # windows that are screened at once
SPREAD_PRIOR, PRIOR_WEIGHT = 0.01, 4.0
NAMES = ("R", "K", "J", "B")
_FREE = ("R", "K", "J", "coulomb", "load_constant", "load_square", "offset_current", "offset_speed", *NOISES)
_LOAD = ("load_constant", "load_walk")
_TOLD = 0.1  # standard deviation of the drag beside an unknown load, as a share, up to which windows tell the two apart
_MOST_ROUNDS = 8  # of a window's fit, which begins near the healthy motor
_REGIME = 2.0
_NEEDED = "windows of a running motor are judged only where voltage, current and speed tell of it"
_NOISES = [kernel.NOISE_I, kernel.NOISE_W, kernel.NOISE_V, kernel.WALK]
_EXPONENTS = np.array([[1.0 if name == other else 0.0 for other in quantities.PARAMETERS] for name in NAMES])
_WARMTH = quantities.warmth_direction(_EXPONENTS)


@dataclass(frozen=True, slots=True)
class WindowVerdict:
    """One window: when it begins, what it says, how far R, K, J and the drag lie from the healthy ones."""

    begin_s: float
    verdict: str
    changes: tuple[Change, ...]


def averaged(recording: Recording, window_s: float) -> Recording:
    """The recording; of windows with more than MOST_SAMPLES, neighbours are averaged."""
    factor = math.ceil(window_s / recording.dt_s / MOST_SAMPLES - 1e-6)
    if factor <= 1:
        return recording
    columns = (recording.time_s, recording.current_a, *_needed(recording))
    time_s, current_a, voltage_v, speed_rad_s = (block_means(column, factor) for column in columns)
    return Recording(recording.path, time_s, current_a, voltage_v, speed_rad_s)


def _windows(recording: Recording, window_s: float) -> list[Recording]:
    """Windows of a recording of equal length, a rest at the end left out."""
    recording = averaged(recording, window_s)
    length = round(window_s / recording.dt_s)
    count = len(recording.time_s) // length
    return [cut(recording, slice(n * length, (n + 1) * length)) for n in range(count)]


def learn_windows(recordings: Sequence[Recording], window_s: float) -> WindowReference:
    """What windows of a healthy motor at work teach about its next window.

    The spread is that of windows beyond their own errors, with a prior of 1 % on every quantity worth 4 windows.

    Raises:
        UnusableError: no current and speed, too few windows, or no motor explains them.
    """
    parts = [part for recording in recordings for part in _windows(recording, window_s)]
    if len(parts) < FEWEST_WINDOWS:
        raise UnusableError(f"{len(parts)} windows of {window_s:g} s; at least {FEWEST_WINDOWS} are needed")
    samples = sum(len(recording.time_s) for recording in recordings)
    chosen = recordings
    if samples > MOST:
        every = math.ceil(sum(len(part.time_s) for part in parts) / MOST)
        chosen = parts[:: min(every, len(parts) // FEWEST_WINDOWS)]
    joint = identify_operation(chosen, most=max(MOST, sum(len(one.time_s) for one in chosen)))
    if not joint.record.seen.all():
        raise UnusableError(_NEEDED)
    known, wanted, hold = _known(joint), joint.solution.names, joint.record.hold
    records = [replace(from_recordings([part]), hold=hold) for part in parts]
    with_load = tuple(dict.fromkeys((*wanted, *_LOAD)))
    fits = [_window(record, known, with_load) for record in records]
    if math.sqrt(np.median([fit.covariance[-1, -1] for fit in fits])) < _TOLD:
        wanted = with_load
    # A window's noise is less than that of all windows in one fit: it is where the fit of the next one begins.
    known[_NOISES] = np.median([fit.values[_NOISES] for fit in fits], axis=0)
    fits = [_window(record, known, wanted) for record in records]
    logs, errors = np.array([fit.logs for fit in fits]), np.mean([fit.covariance for fit in fits], axis=0)
    n, centre = len(fits), logs.mean(axis=0)
    scatter = (logs - centre).T @ (logs - centre)
    freedom = n - 1 + PRIOR_WEIGHT
    prior = np.eye(len(NAMES)) * SPREAD_PRIOR**2 + errors
    volts = [_rms(part) for part in parts]
    return WindowReference(
        windows=n,
        window_s=window_s,
        degrees_of_freedom=freedom,
        values=np.exp(centre),
        log_covariance=(scatter + PRIOR_WEIGHT * prior) / freedom * (1.0 + 1.0 / n),
        terms=wanted,
        physical=known,
        hold=hold,
        dt_s=parts[0].dt_s,
        rms_volts=(min(volts), max(volts)),
    )


def judge_windows(recording: Recording, reference: WindowReference, rate: float) -> list[WindowVerdict]:
    """A verdict on each window; together they alarm in the stated share of healthy records (Bonferroni).

    Of more than MANY windows MOST_JUDGED are judged: half of them evenly spread, half those that the healthy motor
    explains worst. The rate is still shared by all.

    Raises:
        UnusableError: the record is outside the commissioned regime, or shorter than a window.
    """
    parts = _windows(recording, reference.window_s)
    if not parts:
        raise UnusableError(f"the record is shorter than a window of {reference.window_s:g} s")
    low, high = reference.rms_volts
    volts = _rms(recording)
    if not low / _REGIME <= volts <= high * _REGIME:
        raise UnusableError(
            f"outside the commissioned regime: {volts:.3g} V effective, commissioned {low:.3g} to {high:.3g} V"
        )
    if not 1.0 / _REGIME <= parts[0].dt_s / reference.dt_s <= _REGIME:
        raise UnusableError("outside the commissioned regime: another sampling interval")
    chosen = range(len(parts)) if len(parts) <= MANY else _chosen(recording, parts, reference)
    return [_judged(parts[n], reference, rate / len(parts)) for n in chosen]


def _chosen(recording: Recording, parts: Sequence[Recording], reference: WindowReference) -> list[int]:
    """Places of the windows that are judged, of many."""
    values, length = _values(reference), len(parts[0].time_s)
    values[kernel.KNEE] = 0.0  # it takes a third of the time, and changes all windows alike
    misfits, whole = np.zeros(len(parts)), averaged(recording, reference.window_s)
    for first in range(0, len(parts), _TOGETHER):
        some = slice(first, min(first + _TOGETHER, len(parts)))
        stretch = cut(whole, slice(some.start * length, some.stop * length))
        with suppress(UnusableError):  # as at rest
            record = replace(from_recordings([stretch], most=len(stretch.time_s)), hold=reference.hold)
            squares = record.predict(values)[0][:, :2] ** 2
            misfits[some] = squares.reshape(-1, 2 * length).mean(axis=1)
    evenly = np.linspace(0, len(parts) - 1, MOST_JUDGED // 2).round().astype(int)
    return sorted({*evenly.tolist(), *np.argsort(misfits)[-MOST_JUDGED // 2 :].tolist()})


def _judged(part: Recording, reference: WindowReference, rate: float) -> WindowVerdict:
    try:
        record = replace(from_recordings([part]), hold=reference.hold)
        fit = _window(record, _values(reference), reference.terms)
    except UnusableError:
        return WindowVerdict(float(part.time_s[0]), "unusable", ())
    ratios, freedom = fit.logs - np.log(reference.values), reference.degrees_of_freedom
    healthy = reference.log_covariance
    own = healthy + _beyond(healthy, fit.covariance)
    share = _share(rate, freedom, reference.temperature_k, healthy.tobytes())
    limit = float(stats.t.isf(share, freedom))
    difference = Difference(
        ratios, warmer(own, reference.temperature_k * _WARMTH, share, freedom), _EXPONENTS, freedom
    )
    alarms = [fault for fault in explain(difference) if fault.z > limit]
    whole = difference.p_value(difference.squared_distance, len(NAMES)) < share
    is_alarm = bool(alarms) or whole
    changes = compare(NAMES, ratios, difference.covariance, freedom, limit if is_alarm else math.inf)
    verdict = "healthy"
    if is_alarm:
        fitting = [fault for fault in alarms if fault.p_left_over > rate]
        best = max(fitting, key=lambda fault: fault.z, default=None)
        verdict = "other" if best is None else str(best.kind)
    return WindowVerdict(float(part.time_s[0]), verdict, changes)


@lru_cache(maxsize=16)
def _share(rate: float, freedom: float, temperature_k: float, healthy: bytes) -> float:
    """Rate of each test for that of all, of windows that are as well known as those of the commissioning."""
    covariance = np.frombuffer(healthy).reshape(len(NAMES), -1)
    warm = warmer(covariance, temperature_k * _WARMTH, alarm_share(rate, _EXPONENTS), freedom)
    return joint_share(rate, warm, _EXPONENTS, freedom)


def _beyond(healthy: FloatArray, error: FloatArray) -> FloatArray:
    """What the own error of a window is beyond the spread of the healthy ones, which holds theirs."""
    root = np.linalg.cholesky(healthy)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ error @ inverse.T)
    more = root @ axes * np.sqrt(np.maximum(sizes - 1.0, 0.0))
    out: FloatArray = more @ more.T
    return out


def _needed(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Voltage and speed."""
    if recording.voltage_v is None or recording.speed_rad_s is None:
        raise UnusableError(_NEEDED)
    return recording.voltage_v, recording.speed_rad_s


def _rms(recording: Recording) -> float:
    return float(np.sqrt(np.mean(np.square(_needed(recording)[0]))))


def _values(reference: WindowReference) -> FloatArray:
    """Physical values of a motor file, which may be older than the last of them."""
    values = np.zeros(kernel.N_VALUES)
    values[: len(reference.physical)] = reference.physical
    return values


def _known(joint: Operation) -> FloatArray:
    """Physical values of the joint fit, without warmth: each window is taken at its own temperature."""
    known = joint.solution.values
    known[[kernel.HEATING, kernel.COOLING]] = 0.0
    return known


class _Fit(NamedTuple):
    """Logarithms of R, K, J and the drag of one window, their covariance, and all its physical values."""

    logs: FloatArray
    covariance: FloatArray
    values: FloatArray


def _window(record: Record, known: FloatArray, wanted: Sequence[str]) -> _Fit:
    """Fit of one window.

    The drag is a factor f on the whole friction of the joint fit. Its error is that of a sum, so that of log f is taken
    over the way from 1 to f: the slope at f would count an error upwards for more than one downwards.
    """
    every = terms(record, known)
    every["drag"] = replace(every["coulomb"], name="drag", place=kernel.DRAG, unit=1.0, low=0.05, high=20.0)
    names = [name for name in _FREE if name in wanted and name != "coulomb"]
    free = (*(every[name] for name in names), every["drag"])
    begin = np.array([_begin(term.place, known, term.unit, is_log=term.is_log) for term in free])
    problem = Problem(record, known, free)
    best = Solution(problem, *problem.solve(begin, _MOST_ROUNDS))
    theta, values, spread = best.theta, best.values, covariance(best, {})
    rows = [problem.names[n] for n in motor_places(problem)]
    places = [rows.index(name) for name in ("R", "K", "J", "drag")]
    factor = theta[problem.names.index("drag")]
    way = math.log(factor) / (factor - 1.0) if factor != 1.0 else 1.0
    slope = np.diag([1.0, 1.0, 1.0, way])
    logs = np.log([values[kernel.R], values[kernel.K], values[kernel.J], factor])
    return _Fit(logs, slope @ spread[np.ix_(places, places)] @ slope, values)


def _begin(place: int, known: FloatArray, unit: float, *, is_log: bool) -> float:
    return math.log(max(known[place], 1e-300) / unit) if is_log else float(known[place]) / unit
