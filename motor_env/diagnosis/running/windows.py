"""A running motor by windows of its logs: the verdict on each window and on a record.

All windows are fitted with the terms that the healthy ones were identified with jointly. What windows of one motor
share is held there: brush drop, inductance, and how the drag divides into viscous and dry friction, so that regimes
agree. What may change is R, K, J and the whole drag. Where the healthy windows tell friction from a load, as those that
reverse do, a load that varies slowly is unknown in each window; elsewhere it is part of the drag.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from motor_env.diagnosis.explanations import (
    Change,
    Difference,
    alarm_share,
    compare,
    explain,
    joint_share,
)
from motor_env.diagnosis.healthy_motor import beyond, warmer
from motor_env.motor import identifiable as quantities
from motor_env.motor.data_sheet import WindowReference
from motor_env.motor.parameters import FloatArray
from motor_env.operation import kernel
from motor_env.operation.record import Record, block_means, from_recordings
from motor_env.operation.window import first_steps, fit_window
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, cut

MOST_SAMPLES = 6_000
MANY, MOST_JUDGED = 40, 20
_TOGETHER = 50  # windows that are screened at once
NAMES = ("R", "K", "J", "B")
_HOTTEST_K = 100.0
_REGIME = 2.0
NEEDED = "windows of a running motor are judged only where voltage, current and speed tell of it"
_EXPONENTS = np.array([[1.0 if name == other else 0.0 for other in quantities.PARAMETERS] for name in NAMES])
WARMTH = quantities.warmth_direction(_EXPONENTS)


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
    columns = (recording.time_s, recording.current_a, *needed_columns(recording))
    time_s, current_a, voltage_v, speed_rad_s = (block_means(column, factor) for column in columns)
    return Recording(recording.path, time_s, current_a, voltage_v, speed_rad_s)


def windows_of(recording: Recording, window_s: float) -> list[Recording]:
    """Windows of a recording of equal length, a rest at the end left out."""
    recording = averaged(recording, window_s)
    length = round(window_s / recording.dt_s)
    count = len(recording.time_s) // length
    return [cut(recording, slice(n * length, (n + 1) * length)) for n in range(count)]


def spread_of(error: FloatArray, reference: WindowReference) -> FloatArray:
    """Of the logarithms of a healthy window whose fit has that error."""
    healthy = reference.log_covariance
    return (healthy + beyond(healthy, error)) * reference.window_excess


def is_closed(part: Record) -> bool:
    """Whether the circuit seems closed throughout: a few samples without a current may only look open."""
    return kernel.OPEN not in part.marks


def from_healthy(
    parts: Sequence[Record], reference: WindowReference, at: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """How far parts of windows seem to be from the healthy motor, and its spread: logarithms of R, K, J, drag.

    Args:
        parts: of one window or several.
        reference: what healthy windows taught.
        at: where the motor is thought to be by now, shape (4,): the nearer, the better a linear step.
    """
    known, healthy = _values(reference), reference.log_covariance
    known[[kernel.R, kernel.K, kernel.J, kernel.DRAG]] = reference.values * np.exp(at)
    peaks = reference.peaks or (1.0, 1.0, 1.0)
    for step, error in first_steps(parts, known, reference.terms, peaks):
        yield at + step, healthy + beyond(healthy, error)


def judge_windows(recording: Recording, reference: WindowReference, rate: float) -> list[WindowVerdict]:
    """A verdict on each window; together they alarm in the stated share of healthy records (Bonferroni).

    Of more than MANY windows MOST_JUDGED are judged: half of them evenly spread, half those that the healthy motor
    explains worst. The rate is still shared by all.

    Raises:
        UnusableError: the record is outside the commissioned regime, or shorter than a window.
    """
    parts = windows_of(recording, reference.window_s)
    if not parts:
        raise UnusableError(f"the record is shorter than a window of {reference.window_s:g} s")
    low, high = reference.rms_volts
    volts = rms_volts(recording)
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
        fit = fit_window(record, _values(reference), reference.terms)
    except UnusableError:
        return WindowVerdict(float(part.time_s[0]), "unusable", ())
    ratios, spread = fit.logs - np.log(reference.values), spread_of(fit.covariance, reference)
    verdict, changes = decided(ratios, spread, rate, reference.degrees_of_freedom, reference.temperature_k)
    return WindowVerdict(float(part.time_s[0]), verdict, changes)


def decided(
    ratios: FloatArray, spread: FloatArray, rate: float, freedom: float, temperature_k: float
) -> tuple[str, tuple[Change, ...]]:
    """What logarithms of R, K, J and the drag over the healthy ones say at a rate of false alarms.

    Args:
        ratios: the logarithms, shape (4,).
        spread: covariance of a healthy motor's, at one temperature, shape (4, 4).
        rate: of false alarms of all tests together.
        freedom: degrees of freedom of the spread.
        temperature_k: how much warmer or colder the motor may be, one standard deviation.
    """
    share, warmth = alarm_share(rate, _EXPONENTS), temperature_k * WARMTH
    straight = _straightened(ratios, spread, temperature_k) if temperature_k else ratios
    difference = Difference(straight, warmer(spread, warmth, share, freedom), _EXPONENTS, freedom)
    faults, whole = explain(difference), difference.p_value(difference.squared_distance, len(NAMES))
    # Each test has less than the whole rate: else none of them can alarm.
    if whole < rate or max(fault.z for fault in faults) > -special.stdtrit(freedom, rate):
        share = joint_share(rate, difference.covariance, _EXPONENTS, freedom)
    limit = -float(special.stdtrit(freedom, share))
    alarms = [fault for fault in faults if fault.z > limit]
    is_alarm = bool(alarms) or whole < share
    changes = compare(NAMES, ratios, difference.covariance, freedom, limit if is_alarm else math.inf)
    if not is_alarm:
        return "healthy", changes
    fitting = [fault for fault in alarms if fault.p_left_over > rate]
    best = max(fitting, key=lambda fault: fault.z, default=None)
    return "other" if best is None else str(best.kind), changes


def _straightened(ratios: FloatArray, spread: FloatArray, temperature_k: float) -> FloatArray:
    """Logarithms that move in proportion to the temperature: the factors do, their logarithms a little less."""
    slope = np.linalg.solve(spread, WARMTH)
    kelvin = float(slope @ ratios / (slope @ WARMTH + temperature_k**-2))
    warm = WARMTH * min(max(kelvin, -_HOTTEST_K), _HOTTEST_K)
    return ratios + warm - np.log1p(warm)


def needed_columns(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Voltage and speed.

    Raises:
        UnusableError: one of them is missing.
    """
    if recording.voltage_v is None or recording.speed_rad_s is None:
        raise UnusableError(NEEDED)
    return recording.voltage_v, recording.speed_rad_s


def rms_volts(recording: Recording) -> float:
    """Effective voltage."""
    return float(np.sqrt(np.mean(np.square(needed_columns(recording)[0]))))


def _values(reference: WindowReference) -> FloatArray:
    """Physical values of a motor file, which may be older than the last of them."""
    values = np.zeros(kernel.N_VALUES)
    values[: len(reference.physical)] = reference.physical
    return values
