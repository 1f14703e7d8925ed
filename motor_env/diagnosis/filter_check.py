"""Innovations of the Kalman filter with the fitted motor as its belief: are they white, and of the right size?"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from motor_env.filters.consistency import Consistency, check_consistency
from motor_env.fitting import places
from motor_env.fitting.starts import Identified, record_of
from motor_env.motor.model import discretize
from motor_env.motor.parameters import FloatArray

_CONSISTENT_NIS = 1.2
_FILTER_TUNING = 3
_FEWEST_FOR_WHITENESS = 40


@dataclass(frozen=True, slots=True)
class FilterCheck:
    """What the Kalman filter makes of the current, with the fitted motor as its belief.

    Attributes:
        sensor_noise_a: standard deviation of the sensor's noise in its belief.
        model_error_a: standard deviation of the model's error, a slow disturbance of the current.
        whitened: its innovations, with that error as noise of the voltage, shape (n,); NaN where nothing is shown.
        sensor_only_nis: mean normalised innovation squared of a filter that knows of the sensor's noise alone.
        consistency: mean, size and whiteness of the innovations of that filter; None where there are too few.
    """

    sensor_noise_a: float
    model_error_a: float
    whitened: FloatArray
    sensor_only_nis: float
    consistency: Consistency | None = None

    @property
    def mean_nis(self) -> float:
        """Mean normalised innovation squared of the measured samples; 1 is consistent."""
        return _mean_square(self.whitened)


def filter_check(fit: Identified) -> FilterCheck:
    """Run the Kalman filter over the running motor, with the fitted motor as its belief.

    The residual is split in white noise and a slow model error; the error enters as noise of the voltage, so that its
    stationary variance in the current is what was found (first-order Gauss-Markov; Gelb 1974, ch. 3.8). A sensor that
    hides small currents is believed where it shows them.
    """
    start, physical = fit.start, fit.physical
    begin = (
        0 if start.voltage_v is not None else int(np.searchsorted(start.time_s, fit.onset_s, side="right"))
    )
    noise = max(fit.noise_a, 1e-9 * float(np.ptp(start.current_a)))
    slow = math.sqrt(max(float(np.var(fit.residual_a[begin + 1 :])) - noise**2, 0.0))
    record = replace(record_of(start).only(current=True, speed=False), rectified_a=None)
    hidden = np.isnan(record.readings[:, 0]) | (fit.states[:, 0] < 0.5 * physical[places.ZONE])
    record.readings[hidden, 0] = np.nan
    physical[places.ZONE] = 0.0

    def run(noise_v: float) -> FloatArray:
        physical[[places.NOISE_I, places.NOISE_V]] = noise, noise_v
        out = record.predict(physical)[0][:, 0]
        out[hidden] = np.nan
        return out[begin + 1 :]

    alone = run(0.0)
    decay_s = max(float(np.mean(fit.parameters.mechanical_time_constant_s)), start.dt_s)
    by_volt = float(discretize(fit.parameters, start.dt_s).gain[0, 0])
    noise_v = slow * math.sqrt(2.0 * start.dt_s / decay_s) / by_volt
    whitened = run(noise_v)
    for _ in range(_FILTER_TUNING):
        if _mean_square(whitened) < _CONSISTENT_NIS:
            break
        noise_v *= math.sqrt(_mean_square(whitened))
        whitened = run(noise_v)
    enough = len(alone) > _FEWEST_FOR_WHITENESS
    return FilterCheck(
        sensor_noise_a=noise,
        model_error_a=slow,
        whitened=whitened,
        sensor_only_nis=_mean_square(alone),
        consistency=check_consistency(alone[:, None]) if enough else None,
    )


def _mean_square(whitened: FloatArray) -> float:
    return float(np.nanmean(np.square(whitened)))
