"""A running motor by windows of its logs: what healthy windows teach, and the verdict on each window and on a record.

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
from motor_env.operation.identify import Operation, identify_operation
from motor_env.operation.record import MOST, Record, block_means, from_recordings
from motor_env.operation.window import first_steps, fit_window
from motor_env.recordings.defects import UnusableError
from motor_env.recordings.recording import Recording, cut

FEWEST_WINDOWS = 4
MOST_SAMPLES = 6_000
MANY, MOST_JUDGED = 40, 20
_TOGETHER = 50  # windows that are screened at once
_MOST_HALVINGS = 6  # of a window, for looks at its parts
_FEWEST_OF_A_LOOK = 8  # samples
_SHORTEST_LOOK_S = 0.2  # so that there are 20 looks a second at most, which take a tenth of a core
MOST_LEARNED = 40
SPREAD_PRIOR, PRIOR_WEIGHT = 0.01, 4.0
TEMPERATURE_K = 15.0
NAMES = ("R", "K", "J", "B")
_LOAD = ("load_constant", "load_walk")
_TOLD = 0.1  # standard deviation of the drag beside an unknown load, as a share, up to which windows tell the two apart
_HOTTEST_K = 100.0
_REGIME = 2.0
_NEEDED = "windows of a running motor are judged only where voltage, current and speed tell of it"
_NOISES = [kernel.NOISE_I, kernel.NOISE_W, kernel.NOISE_V, kernel.WALK]
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
    columns = (recording.time_s, recording.current_a, *_needed(recording))
    time_s, current_a, voltage_v, speed_rad_s = (block_means(column, factor) for column in columns)
    return Recording(recording.path, time_s, current_a, voltage_v, speed_rad_s)


def _windows(recording: Recording, window_s: float) -> list[Recording]:
    """Windows of a recording of equal length, a rest at the end left out."""
    recording = averaged(recording, window_s)
    length = round(window_s / recording.dt_s)
    count = len(recording.time_s) // length
    return [cut(recording, slice(n * length, (n + 1) * length)) for n in range(count)]


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
    n, centre = len(fits), logs.mean(axis=0)
    scatter = (logs - centre).T @ (logs - centre)
    freedom = n - 1 + PRIOR_WEIGHT
    prior = np.eye(len(NAMES)) * (0.0 if steady else SPREAD_PRIOR) ** 2 + errors
    volts = [_rms(part) for part in parts]
    reference = WindowReference(
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
        temperature_k=0.0 if steady else TEMPERATURE_K,
        peaks=tuple(np.max([record.peaks for record in records], axis=0).tolist()),
    )
    ratios = list(logs - centre)
    believed = _squares(ratios, [_spread(fit.covariance, reference) for fit in fits])
    taught = _squares(ratios, [reference.log_covariance] * n)
    reference = replace(reference, window_excess=sum(believed) / sum(taught))
    return replace(reference, excess=tuple(_excess(records, ratios, reference)))


def _squares(ratios: Sequence[FloatArray], spreads: Sequence[FloatArray]) -> list[float]:
    """Squared distances per dimension."""
    pairs = zip(ratios, spreads, strict=True)
    return [float(off @ np.linalg.solve(spread, off)) / len(NAMES) for off, spread in pairs]


def _spread(error: FloatArray, reference: WindowReference) -> FloatArray:
    """Of the logarithms of a healthy window whose fit has that error."""
    healthy = reference.log_covariance
    return (healthy + beyond(healthy, error)) * reference.window_excess


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
        fit = fit_window(record, _values(reference), reference.terms)
    except UnusableError:
        return WindowVerdict(float(part.time_s[0]), "unusable", ())
    ratios, spread = fit.logs - np.log(reference.values), _spread(fit.covariance, reference)
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
