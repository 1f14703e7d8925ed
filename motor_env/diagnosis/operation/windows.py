"""Fits of a motor at work, window by window, compared with a healthy motor.

All windows share the terms of the joint healthy fit, and its brush drop, inductance and ratio of dry to viscous
friction. Each has its own R, K, J and drag. A slowly varying load is a further unknown if reversals separate it from
friction; otherwise it is part of the drag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from motor_env.common.errors import InputError
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import WindowFit, fit_window, per_log
from motor_env.diagnosis.estimation.preprocessing import block_means, from_recordings, missing_blocks
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.readers.recording import Recording, UnusableError, cut
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference, add_normal_spread, reference_of_pieces
from motor_env.diagnosis.verdict.hypotheses import EXPONENTS, NAMES, FittedWindow, alarm_share
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.diagnosis.verdict.sensor_diagnosis import ChannelRecord, check_coupling, find_failure
from motor_env.motor import identifiable
from motor_env.motor.healthy import Healthy, OperatingCondition, Windows
from motor_env.motor.parameters import FloatArray

ALIKE, FAR = 0.12, 3.0
"""Largest `condition_distance` of windows under one condition; multiple beyond which no fault is reported."""
NEEDED = "windows of a running motor are judged only if voltage, current and speed were recorded"
_LEVELS, _HALVINGS = np.linspace(0.05, 0.95, 10), range(3, 10)


def needed_columns(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Return voltage and speed.

    Raises:
        UnusableError: one of them is missing.
    """
    if recording.voltage_v is None or recording.speed_rad_s is None:
        raise UnusableError(NEEDED)
    return recording.voltage_v, recording.speed_rad_s


def rms_volts(recording: Recording) -> float:
    """Return the effective voltage."""
    return float(np.sqrt(np.mean(np.square(needed_columns(recording)[0]))))


def condition_features(part: Recording) -> FloatArray:
    """Describe an operating condition by quantiles and moves of voltage, current and speed, shape (3, 17).

    The 7 moves are root mean squares of the change within an eighth of the recording, a sixteenth, ... a 512th.
    """
    volts, speed = needed_columns(part)
    columns = np.array([volts, part.current_a, speed])
    lags = [max(len(volts) >> times, 1) for times in _HALVINGS]
    moves = [np.sqrt(np.mean(np.square(columns[:, lag:] - columns[:, :-lag]), axis=1)) for lag in lags]
    return np.concatenate([np.quantile(columns, _LEVELS, axis=1), moves]).T


def condition_distance(features: FloatArray, others: FloatArray) -> FloatArray:
    """Return the distance of a window's condition from others, shape (n,).

    A controller commands voltage, speed or current, and a fault does not change the commanded column. So the nearest
    column counts: the larger of the mean distances of its quantiles (Wasserstein) and moves, over the quantiles' root
    mean square.

    Args:
        features: of the window, shape (3, 17).
        others: of the others, shape (n, 3, 17).
    """
    levels, offset = len(_LEVELS), np.abs(others - features)
    sizes = np.sqrt(np.mean(np.square(others[..., :levels]), axis=2))
    distances = np.maximum(offset[..., :levels].mean(axis=2), offset[..., levels:].mean(axis=2))
    return np.asarray(np.min(distances / np.maximum(sizes, np.finfo(float).tiny), axis=1), dtype=np.float64)


def nearest(features: FloatArray, conditions: Sequence[OperatingCondition]) -> tuple[int, float]:
    """Return index and distance of the condition with the nearest window."""
    distances = [float(condition_distance(features, each.moved).min()) for each in conditions]
    place = int(np.argmin(distances))
    return place, distances[place]


def group_by_condition(features: FloatArray, times: float) -> tuple[NDArray[np.intp], float]:
    """Group windows by condition: return each one's group, shape (n,), and the linking distance.

    Args:
        features: of the windows, shape (n, 3, 17).
        times: linking distance over the largest one between nearest neighbours.
    """
    distances = np.array([condition_distance(window, features) for window in features])
    others = distances + np.diag(np.full(len(features), np.inf))
    alike = times * max(ALIKE, float(others.min(axis=1).max()))
    _, condition = connected_components(distances <= alike, directed=False)
    return np.asarray(condition, dtype=np.intp), alike


def condition_offsets(conditions: Sequence[OperatingCondition]) -> FloatArray:
    """Subtract the median of the other conditions from log R, K, J and B of each, shape (n_conditions, 4).

    It is 0 for a condition with most of the windows.
    """
    offset = np.zeros((max(len(conditions), 1), 4))
    logs, counts = [np.log(each.values) for each in conditions], [len(each.pieces) for each in conditions]
    for k, log in enumerate(logs):
        if 2 * counts[k] <= sum(counts):
            offset[k] = log - np.median(logs[:k] + logs[k + 1 :], axis=0)
    return offset


MOST_SAMPLES = 6_000
MANY, MOST_JUDGED = 40, 20
_TOGETHER = 50  # windows that are screened at once
_REGIME = 2.0
_SAME_STEP = 1.1  # times the commissioned interval
CONDITION_SPREAD = np.array([0.035, 0.018, 0.035, 0.4])
"""Standard deviation of log R, K, J and B between conditions, from unmodelled effects (stiction, gear, brushes)."""
DRIVEN_OTHERWISE = "this operating condition was not commissioned"
WARMTH = identifiable.warmth_direction(EXPONENTS)


def viscous(physical: FloatArray, speed_rad_s: float) -> float:
    """Return the drag over the speed, at a speed."""
    dry, fan = physical[index.COULOMB] / speed_rad_s, physical[index.SQUARE] * speed_rad_s
    return float(max(physical[index.B] + dry + fan, 1e-300))


def averaged(recording: Recording, window_s: float) -> Recording:
    """Average neighbours of windows with more than MOST_SAMPLES."""
    factor = math.ceil(window_s / recording.dt_s / MOST_SAMPLES - 1e-6)
    if factor <= 1:
        return recording
    columns = (recording.time_s, recording.current_a, *needed_columns(recording))
    time_s, current_a, voltage_v, speed_rad_s = (block_means(column, factor) for column in columns)
    missing = missing_blocks(recording, factor)
    return Recording(recording.path, time_s, current_a, voltage_v, speed_rad_s, missing=missing)


def windows_of(recording: Recording, window_s: float) -> list[Recording]:
    """Cut a recording into windows of equal length, without the remainder."""
    recording = averaged(recording, window_s)
    length = round(window_s / recording.dt_s)
    count = len(recording.time_s) // length
    return [cut(recording, slice(n * length, (n + 1) * length)) for n in range(count)]


def with_drag_over_speed(fit: WindowFit, physical: FloatArray, speed_rad_s: float) -> FittedWindow:
    """Convert a window's factor on the drag to the drag over the speed."""
    drag = math.log(viscous(physical, speed_rad_s))
    logs = fit.logs + np.array([0.0, 0.0, 0.0, drag])
    return FittedWindow(logs, fit.covariance, fit.whitened)


@dataclass(frozen=True, slots=True)
class WindowJudge:
    """Judge windows of a motor at work against the healthy motor.

    Attributes:
        windows: how healthy windows were recorded and fitted.
        reference: distribution of R, K, J and B of a healthy window.
        references: under each commissioned condition.
    """

    windows: Windows
    reference: Reference
    references: tuple[Reference, ...] = ()

    def physical(self) -> FloatArray:
        """Return the physical values of the healthy motor."""
        known = self.windows.physical.copy()
        values = np.exp(self.reference.log_values)
        known[[index.R, index.K, index.J]] = values[:3]
        known[index.DRAG] = values[3] / viscous(self.windows.physical, self.windows.speed_rad_s)
        return known

    def fitted(self, record: Record) -> FittedWindow:
        """Fit a window."""
        windows = self.windows
        record = replace(record, hold=windows.hold)
        fit = fit_window(record, self.physical(), windows.terms, one_way=windows.one_way)
        return with_drag_over_speed(fit, windows.physical, windows.speed_rad_s)

    def condition_of(self, recording: Recording) -> tuple[int, float]:
        """Return index and relative distance of the condition nearest to the last window; above 1 it is new."""
        if not self.windows.drives:
            return 0, 0.0
        last = cut(recording, slice(-round(self.windows.window_s / recording.dt_s), None))
        place, distance = nearest(condition_features(last), self.windows.drives)
        return place, distance / self.windows.alike

    def under(self, place: int) -> WindowJudge:
        """Return the judge of windows under one condition."""
        if len(self.references) < 2:
            return self
        return replace(self, reference=self.references[place])

    def condition_spread(self, place: int, fit: FittedWindow) -> FloatArray:
        """Return the standard deviation of log R, K, J and B under another condition, shape (4,).

        R, K and J do not depend on the condition, so their differences between conditions measure the model's error.

        Args:
            place: index of the nearest condition.
            fit: of the window.
        """
        offset = condition_offsets(self.windows.drives)[place]
        times = float(np.sqrt(np.mean(np.square(offset / CONDITION_SPREAD)[:-1])))
        spread = CONDITION_SPREAD * max(times, 1.0)
        spread[-1] *= max(per_log(math.exp(fit.log_values[-1] - self.reference.log_values[-1])), 1.0)
        return spread

    def judge(
        self, recording: Recording, rate: float, is_alarm: Callable[[FittedWindow], bool] | None = None
    ) -> tuple[list[Judgement], int]:
        """Judge each window; return also the number of windows. Together they alarm at the rate (Bonferroni).

        Of more than MANY windows MOST_JUDGED are judged, half of them for their largest misfit.

        Args:
            recording: of a motor at work.
            rate: of false alarms.
            is_alarm: decides on a window's fit; by default each window is judged by itself.

        Raises:
            UnusableError: outside the commissioned regime, or shorter than a window.
        """
        sampled = averaged(recording, self.windows.window_s)
        # Whether a voltage's steps between two samples came late or early shows in J.
        most = _SAME_STEP if recording.averaged == 1 else _REGIME
        if not 1.0 / most <= sampled.dt_s / self.windows.dt_s <= most:
            raise UnusableError(
                f"outside the commissioned regime: another sampling interval, {sampled.dt_s:.4g} s where it was"
                f" {self.windows.dt_s:.4g} s"
            )
        parts = windows_of(sampled, self.windows.window_s)
        if not parts:
            raise UnusableError(f"the record is shorter than a window of {self.windows.window_s:g} s")
        volts = rms_volts(recording)
        low, high = self.windows.rms_volts or (volts, volts)
        if not low / _REGIME <= volts <= high * _REGIME:
            raise UnusableError(
                f"outside the commissioned regime: {volts:.3g} V effective, commissioned {low:.3g} to {high:.3g} V"
            )
        chosen = range(len(parts)) if len(parts) <= MANY else self._choose_windows(sampled, parts)
        each = ((parts[n], self._judge_window(parts[n], rate / len(parts), is_alarm)) for n in chosen)
        judged = [check_coupling(one, part=part).on(part) for part, one in each]
        return judged if len(self.references) < 2 else _require_half_of_windows(judged), len(parts)

    def _choose_windows(self, recording: Recording, parts: Sequence[Recording]) -> list[int]:
        values, length = self.physical(), len(parts[0].time_s)
        values[index.KNEE] = 0.0  # a third of the time, and the same change of all windows
        misfits = np.zeros(len(parts))
        for first in range(0, len(parts), _TOGETHER):
            some = slice(first, min(first + _TOGETHER, len(parts)))
            stretch = cut(recording, slice(some.start * length, some.stop * length))
            with suppress(UnusableError):  # as at rest
                record = from_recordings([stretch], most=len(stretch.time_s))
                squares = replace(record, hold=self.windows.hold).predict(values)[0][:, :2] ** 2
                misfits[some] = squares.reshape(-1, 2 * length).mean(axis=1)
        evenly = np.linspace(0, len(parts) - 1, MOST_JUDGED // 2).round().astype(int)
        return sorted({*evenly.tolist(), *np.argsort(misfits)[-MOST_JUDGED // 2 :].tolist()})

    def failed_sensor(self, part: Recording) -> Judgement | None:
        """Judge a failed sensor in a part of a log; None without one."""
        volts, speed = needed_columns(part)
        if not volts.any():
            return None
        return find_failure(ChannelRecord(part.dt_s, volts, part.current_a, speed), self.physical())

    def _judge_window(
        self, part: Recording, rate: float, is_alarm: Callable[[FittedWindow], bool] | None
    ) -> Judgement:
        failed = self.failed_sensor(part)
        if failed is not None:
            return failed
        place, distance = self.condition_of(part)
        judge = self.under(place)
        try:
            record = from_recordings([part])
            # Begun at the mean of distant conditions, a fit may end in a local optimum between them.
            fit = judge.fitted(record)
        except UnusableError as error:
            return Judgement(Verdict.UNUSABLE, (str(error),))
        reference = judge.reference if distance <= 1.0 else self.reference
        judged = decide(fit, reference, rate, alarm=None if is_alarm is None else is_alarm(fit))
        if judged.verdict is Verdict.UNUSABLE or distance <= 1.0:
            return judged
        if not judged.verdict.is_fault:
            return replace(judged, reasons=(*judged.reasons, DRIVEN_OTHERWISE))
        own, share = self.reference.log_covariance, alarm_share(rate, EXPONENTS)
        condition = np.diag(np.square(self.condition_spread(place, fit)))
        spread = add_normal_spread(own, condition, share, self.reference.degrees_of_freedom)
        allowed = decide(fit, replace(self.reference, log_covariance=spread), rate)
        if allowed.verdict.is_fault and distance <= FAR:
            return replace(allowed, reasons=(*allowed.reasons, DRIVEN_OTHERWISE))
        return _as_unusable(allowed, judged.reasons[0])


def _as_unusable(judged: Judgement, reason: str) -> Judgement:
    """Judge a window under another condition unusable; the reason includes the verdict under the commissioned one."""
    why = f"{DRIVEN_OTHERWISE}: commission it, too; under a commissioned one the verdict would be that"
    return replace(judged.as_other(f"{why} {reason}"), verdict=Verdict.UNUSABLE, confidence=None)


def _require_half_of_windows(judged: list[Judgement]) -> list[Judgement]:
    """Keep faults under unknown conditions only if half of these windows show one.

    A fault moves all of them, the model's error only a few.
    """
    otherwise = [any(why.startswith(DRIVEN_OTHERWISE) for why in window.reasons) for window in judged]
    faults = [
        is_other and window.verdict.is_fault for window, is_other in zip(judged, otherwise, strict=True)
    ]
    if 2 * sum(faults) >= sum(otherwise):
        return judged
    each = zip(judged, faults, strict=True)
    return [_as_unusable(window, window.reasons[0]) if is_fault else window for window, is_fault in each]


def judge_of(healthy: Healthy, motor: str = "this motor", temperature_c: float | None = None) -> WindowJudge:
    """Make the judge of a motor learned from windows.

    Raises:
        UnusableError: no healthy windows, or they do not determine R, K, J and B.
        InputError: a wrong number of physical values.
    """

    def reference_of(some: Healthy) -> Reference | None:
        return reference_of_pieces(some, NAMES, motor, are_starts=False, temperature_c=temperature_c)

    reference = reference_of(healthy)
    if healthy.windows is None or reference is None or reference.names != NAMES:
        raise UnusableError(f"the healthy recordings of {motor} do not give {', '.join(NAMES)} of windows")
    if len(healthy.windows.physical) != index.N_VALUES:
        raise InputError(
            f"{motor}: healthy.windows.physical must have {index.N_VALUES} values,"
            f" got {len(healthy.windows.physical)}"
        )
    references = [reference_of(healthy.under(condition)) for condition in healthy.windows.drives]
    return WindowJudge(healthy.windows, reference, tuple(each for each in references if each is not None))
