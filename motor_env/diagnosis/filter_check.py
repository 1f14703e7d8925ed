"""What the Kalman filter makes of a recording, with the fitted motor as its belief."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from motor_env.filters.batch import FilterResult, run_filter
from motor_env.filters.consistency import Consistency, check_consistency
from motor_env.filters.kalman import KalmanFilter
from motor_env.identification.identify import Identified
from motor_env.identification.start_model import between_samples, mean_rise
from motor_env.motor.parameters import FloatArray, SensorParameters

_CONSISTENT_NIS = 1.2
_FILTER_TUNING = 3
_FEWEST_FOR_WHITENESS = 40


@dataclass(frozen=True, slots=True)
class FilterCheck:
    """What the Kalman filter makes of the recording, with the fitted motor as its belief.

    Attributes:
        result: of `run_filter`, over the samples from the start on.
        sensor_noise_a: standard deviation of the sensor's noise in its belief.
        model_error_a: standard deviation of the model's error, a slow disturbance of the current.
        mean_nis: mean normalised innovation squared; 1 a channel is consistent.
        sensor_only_nis: the same for a filter that knows of the sensor's noise alone.
        consistency: mean, size and whiteness of the innovations of that filter; None where there are too few.
    """

    result: FilterResult
    sensor_noise_a: float
    model_error_a: float
    mean_nis: float
    sensor_only_nis: float
    consistency: Consistency | None = None


def filter_check(fit: Identified) -> FilterCheck:
    """Run the Kalman filter with the fitted motor as its belief.

    The residual is split in white noise and a slow model error; the error enters as process noise of the current, so
    that its stationary variance is what was found (first-order Gauss-Markov; Gelb 1974, ch. 3.8).
    """
    start = fit.start
    begin = int(np.searchsorted(start.time_s, fit.onset_s, side="right"))  # the first sample that is driven
    if start.voltage_v is not None:
        begin = 0
    shown = fit.expected[:, 0] - start.ripple_a - fit.offset_a
    visible = start.counted
    if fit.extension.dead_zone_a > 0.0:  # the filter begins where the sensor does, and skips what it hides
        visible = visible & (shown > 0.5 * fit.extension.dead_zone_a)
        begin += int(np.argmax(visible[begin:]))
    noise = max(fit.noise_a, 1e-9 * float(np.ptp(start.current_a)))
    slow = math.sqrt(max(float(np.var(fit.residual_a[begin + 1 :])) - noise**2, 0.0))
    voltage, load = _inputs(fit, begin)
    measured = np.where(visible, start.current_a - start.ripple_a - fit.offset_a, np.nan)[None, begin + 1 :]
    state = np.array([shown[begin], fit.expected[begin, 1]])
    motor = fit.parameters.scaled(
        resistance_ohm=1.0 + start.circuit.shunt_ohm / fit.parameters.resistance_ohm
    )

    def run(process: float) -> FilterResult:
        belief = KalmanFilter.from_parameters(
            motor,
            SensorParameters(current_noise_a=noise),
            start.dt_s,
            process_noise_std=(process, process * abs(state[1]) / max(abs(state[0]), 1e-9)),
            initial_state=state,
            initial_std=(max(slow, noise), 0.0),
        )
        return run_filter(belief, measured, voltage, load)

    alone = run(0.0)
    decay_s = max(float(np.mean(fit.parameters.mechanical_time_constant_s)), start.dt_s)
    process = slow * math.sqrt(2.0 * start.dt_s / decay_s)
    result = run(process)
    for _ in range(_FILTER_TUNING):
        if _mean_nis(result) < _CONSISTENT_NIS:
            break
        process *= math.sqrt(_mean_nis(result))
        result = run(process)
    return FilterCheck(
        result=result,
        sensor_noise_a=noise,
        model_error_a=slow,
        mean_nis=_mean_nis(result),
        sensor_only_nis=_mean_nis(alone),
        consistency=check_consistency(alone.whitened) if measured.size > _FEWEST_FOR_WHITENESS else None,
    )


def _inputs(fit: Identified, begin: int) -> tuple[FloatArray, FloatArray]:
    """Voltage and load torque over the intervals from sample `begin` on.

    Brushes and dry friction act against the fitted motion: known inputs of the filter.
    """
    start = fit.start
    if start.voltage_v is None:
        since = start.time_s[begin:] - fit.onset_s
        voltage = start.level_v * mean_rise(fit.extension, since[:-1], since[1:])
    else:
        voltage = between_samples(start.voltage_v[begin:], start.lateness(fit.onset_s))
    direction = np.sign(fit.expected[begin + 1 :, 1])
    return voltage - fit.extension.brush_drop_v * direction, fit.extension.coulomb_friction_n_m * direction


def _mean_nis(result: FilterResult) -> float:
    """Mean normalised innovation squared of the measured samples of the current."""
    return float(np.nanmean(np.square(result.whitened)))
