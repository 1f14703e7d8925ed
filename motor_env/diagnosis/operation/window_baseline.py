"""Baseline of a motor at work: the distribution of its next healthy window."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.operation_fit import (
    FEWEST_STEPS,
    LOAD,
    UNSEEN_STEPS,
    OperationFit,
    WindowFit,
    fit_window,
    identify_operation,
    without_load,
)
from motor_env.diagnosis.estimation.preprocessing import MOST, from_recordings
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.uncertainty import excess_covariance
from motor_env.diagnosis.operation.sequential_monitor import checked_calibration
from motor_env.diagnosis.operation.windows import (
    FAR,
    MOST_SAMPLES,
    NEEDED,
    condition_features,
    group_by_condition,
    rms_volts,
    windows_of,
    with_drag_over_speed,
)
from motor_env.diagnosis.readers.recording import Recording, UnusableError
from motor_env.diagnosis.verdict.healthy_spread import RECORD_SPREAD, next_window, usual_condition_windows
from motor_env.diagnosis.verdict.hypotheses import NAMES, FittedWindow
from motor_env.diagnosis.verdict.sensor_diagnosis import explain_coupling
from motor_env.motor.healthy import Healthy, OperatingCondition, Windows
from motor_env.motor.parameters import FloatArray

FEWEST_WINDOWS = 4
_MOST_KEPT = 40  # windows of a condition whose features stand in the motor file
_DEFAULT_WINDOWS, _SHORTEST = 20, 400  # samples
TEMPERATURE_K = 15.0
"""Standard deviation of a healthy motor's temperature."""
_SEPARABLE_SD = 0.1
"""Largest relative standard deviation of the drag at which it is separable from an unknown load."""
_ONE_WAY = 0.9  # of the turns
_UNEXPLAINED_TORQUE = 0.05
"""White torque noise over the drag, above which the model is incomplete."""
_NOISES = slice(index.NOISE_I, index.WALK + 1)


def learn_windows(
    recordings: Sequence[Recording], window_s: float | None = None, *, steady: bool = False
) -> tuple[Healthy, list[FittedWindow]]:
    """Learn from windows of a healthy motor at work; return their statistics and fits.

    The spread is that of windows, with their errors as a prior worth 4 of them, plus that between records.

    Args:
        recordings: of the healthy motor at work.
        window_s: length of a window; by default a twentieth of all recordings.
        steady: temperature, load and offsets are constant, as on a test bench.

    Raises:
        UnusableError: no current or speed, too few windows, or no motor explains them.
    """
    for recording in recordings:
        if (reason := explain_coupling(recording)) is not None:
            raise UnusableError(f"{recording.path}: {reason}")
    if window_s is None:
        window_s = window_length_s(recordings, _DEFAULT_WINDOWS)
    parts = [part for recording in recordings for part in windows_of(recording, window_s)]
    if len(parts) < FEWEST_WINDOWS:
        raise UnusableError(f"{len(parts)} windows of {window_s:g} s; at least {FEWEST_WINDOWS} are needed")
    samples = sum(len(recording.time_s) for recording in recordings)
    chosen = recordings
    if samples > MOST:
        every = math.ceil(sum(len(part.time_s) for part in parts) / MOST)
        chosen = parts[:: min(every, len(parts) // FEWEST_WINDOWS)]
    joint = identify_operation(chosen, most=max(MOST, sum(len(part.time_s) for part in chosen)))
    if not joint.record.recorded.all():
        raise UnusableError(NEEDED)
    if joint.record.visible_step_share < FEWEST_STEPS:
        raise UnusableError(f"samples are missing at the voltage's steps: {UNSEEN_STEPS}")
    hold, speed, times = (
        joint.record.hold,
        effective_speed(joint),
        1.0 if _has_unexplained_torque(joint) else FAR,
    )
    records = [replace(from_recordings([part]), hold=hold) for part in parts]
    physical, terms, fits = choose_window_terms(records, joint, steady=steady)
    one_way = turns_one_way(joint)
    # The noise of a window is less than that of the joint fit; the next fit begins there.
    physical[_NOISES] = np.median([fit.values[_NOISES] for fit in fits], axis=0)
    fits = [fit_window(record, physical, terms, one_way=one_way) for record in records]
    volts = [rms_volts(part) for part in parts]
    healthy_fits = [with_drag_over_speed(fit, physical, speed) for fit in fits]
    centre, covariance, freedom = next_window(healthy_fits, steady=steady)
    logs = np.array([fit.log_values for fit in healthy_fits])
    deviations, alike = logs - centre, 1.0
    conditions: tuple[OperatingCondition, ...] = ()
    if not steady:
        features = np.array([condition_features(part) for part in parts])
        of, alike = group_by_condition(features, times)
        groups = [np.flatnonzero(of == n).tolist() for n in range(of.max() + 1)]
        conditions = tuple(
            _condition(group, usual_condition_windows(group, groups), features, healthy_fits)
            for group in groups
        )
        deviations = logs - np.log([conditions[n].values for n in of])
    spreads = [covariance + excess_covariance(covariance, fit.covariance) for fit in fits]
    ratios = list(logs - centre)
    warm = 0.0 if steady else TEMPERATURE_K
    windows = Windows(
        window_s=window_s,
        terms=terms,
        physical=physical,
        hold=hold,
        dt_s=parts[0].dt_s,
        speed_rad_s=speed,
        one_way=one_way,
        rms_volts=(min(volts), max(volts)),
        peaks=tuple(np.max([record.peaks for record in records], axis=0).tolist()),
        window_excess=_squares(ratios, spreads) / _squares(ratios, [covariance] * len(fits)),
        drives=conditions,
        alike=alike,
        calibration=checked_calibration(
            deviations,
            np.array([fit.log_covariance for fit in healthy_fits]),
            RECORD_SPREAD * (warm > 0.0),
            temperature_k=warm,
        ),
    )
    return Healthy(
        len(healthy_fits), freedom, NAMES, np.exp(centre), covariance, warm, windows=windows
    ), healthy_fits


def _has_unexplained_torque(joint: OperationFit) -> bool:
    """Whether the model leaves torque unexplained."""
    physical = joint.solution.values
    drag = physical[index.COULOMB] + physical[index.B] * effective_speed(joint)
    return bool(physical[index.WALK] > 0.0 or physical[index.NOISE_T] > _UNEXPLAINED_TORQUE * drag)


def turns_one_way(joint: OperationFit) -> bool:
    """Whether the motor turns one way, except for a twentieth of its turns."""
    speed = joint.expected[:, 1]
    return bool(abs(np.mean(speed)) > _ONE_WAY * np.mean(np.abs(speed)))


def choose_window_terms(
    records: Sequence[Record], joint: OperationFit, *, steady: bool = False
) -> tuple[FloatArray, tuple[str, ...], list[WindowFit]]:
    """Choose a window's terms; return the shared physical values, the terms, and the fits.

    Without reversals any braking torque counts as friction. Otherwise a load is a term if windows determine it.
    """
    physical, terms = joint.solution.values, joint.solution.names
    one_way, own = turns_one_way(joint), tuple(name for name in terms if name not in LOAD)
    if one_way and own != terms:
        physical = without_load(joint.solution, float(np.mean(joint.expected[:, 1]))).values
        terms = tuple(name for name in terms if name != "load_constant")
    if not one_way and not steady:
        with_load = (*own, *LOAD)
        fits = [fit_window(record, physical, with_load) for record in records]
        load_sd = math.sqrt(np.median([fit.covariance[-1, -1] for fit in fits]))
        if max(load_sd, np.std([fit.logs[-1] for fit in fits])) < _SEPARABLE_SD:
            return physical, with_load, fits
    if "load_walk" not in terms:
        physical[index.WALK] = 0.0
    if steady:
        terms = tuple(name for name in terms if not name.startswith(("offset", "load_constant")))
    return physical, terms, [fit_window(record, physical, terms, one_way=one_way) for record in records]


def _condition(
    pieces: Sequence[int], usual: Sequence[int], features: FloatArray, healthy_fits: Sequence[FittedWindow]
) -> OperatingCondition:
    centre, covariance, freedom = next_window(
        [healthy_fits[n] for n in pieces], steady=False, usual=[healthy_fits[n] for n in usual]
    )
    kept_features = features[pieces[:: math.ceil(len(pieces) / _MOST_KEPT)]]
    return OperatingCondition(tuple(pieces), kept_features, np.exp(centre), covariance, freedom)


def window_length_s(recordings: Sequence[Recording], parts: int, least_s: float = 0.0) -> float:
    """Choose a window's length: a part of all recordings, at most one recording."""
    dt_s = recordings[0].dt_s
    lengths_s = [len(recording.time_s) * recording.dt_s for recording in recordings]
    part_s = min(sum(lengths_s) / parts, MOST_SAMPLES * dt_s)
    return min(max(part_s, least_s, _SHORTEST * dt_s), *lengths_s)


def effective_speed(joint: OperationFit) -> float:
    """Return the root mean square of the speed."""
    return max(float(np.sqrt(np.mean(np.square(joint.expected[:, 1])))), 1e-9)


def _squares(ratios: Sequence[FloatArray], spreads: Sequence[FloatArray]) -> float:
    pairs = zip(ratios, spreads, strict=True)
    return sum(
        float(deviations @ np.linalg.solve(spread, deviations)) / len(NAMES) for deviations, spread in pairs
    )
