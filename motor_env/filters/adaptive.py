"""A Kalman filter that estimates its own noise while it runs (Sage & Husa 1969; Mehra 1970).

It repairs a belief about the noise that is wrong, and a fault looks to it like noise: see docs/filters.md for what it
does to detection.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.common.arrays import number
from motor_env.filters.kalman import (
    KalmanFilter,
    checked_series,
    measurement_update,
    require_belief,
    sample_named,
    score,
)
from motor_env.motor.model import N_STATES, Input
from motor_env.motor.parameters import FloatArray, require

MEMORY = 200.0
"""Samples over which noise is estimated: a variance from so many is known to 10 % (sqrt(2 / n)). At
10 kHz it is 20 ms, five mechanical time constants of the paper's motor."""


class AdaptiveResult(NamedTuple):
    """Innovations and states, and the noise that the filter believed in after each sample.

    Attributes:
        innovation: z - C x-, shape (n_cases, n_samples, n_channels).
        whitened: by the covariance believed at that sample.
        nis: shape (n_cases, n_samples).
        log_likelihood: shape (n_cases,).
        state: after the update, shape (n_cases, n_samples, 2).
        measurement_covariance: believed after each sample, shape (n_cases, n_samples, n_channels, n_channels).
        process_variance: believed after each sample, shape (n_cases, n_samples, 2).
    """

    innovation: FloatArray
    whitened: FloatArray
    nis: FloatArray
    log_likelihood: FloatArray
    state: FloatArray
    measurement_covariance: FloatArray
    process_variance: FloatArray


def adapted_noise(
    noise: FloatArray, residual: FloatArray, explained: FloatArray, memory: float
) -> FloatArray:
    """Measurement covariance after one more sample, by exponential forgetting (Sage & Husa 1969).

    It moves towards r r' + C P C', a sum that is positive (Mohamed & Schwarz 1999), where e e' - C P- C' is not.

    Args:
        noise: believed so far, shape (n_cases, n_channels, n_channels).
        residual: r = z - C x after the update, shape (n_cases, n_channels).
        explained: C P C' after the update, the shape of `noise`.
        memory: samples that the estimate rests on; a new one weighs 2 / (memory + 1).
    """
    sample: FloatArray = residual[:, :, None] * residual[:, None, :] + explained
    sample = np.where(np.isnan(sample), noise, sample)  # what is missing tells nothing
    return noise + 2.0 / (memory + 1.0) * (sample - noise)


def adaptive_filter(
    kalman: KalmanFilter, measurements: ArrayLike, voltage_v: ArrayLike, *, memory: float = MEMORY
) -> AdaptiveResult:
    """Filter with noise estimated by exponential forgetting (Sage & Husa 1969), starting from the belief's.

    The measurement covariance follows `adapted_noise`; the process noise, taken as independent in current and speed,
    moves towards the diagonal of K e e' K' + P - A P A', and not below 0. One channel does not always tell the two
    apart (Mehra 1970): where the gain is small, all that is left over is taken for measurement noise.

    Args:
        kalman: the belief, of one motor.
        measurements: shape (n_cases, n_channels, n_samples), finite.
        voltage_v: shape (n_samples,).
        memory: samples that an estimate rests on; a new one weighs 2 / (memory + 1).

    Raises:
        ValueError: shapes do not fit, a sample is not finite or takes the estimate out of the range of numbers, or a
            memory below 1.
    """
    require_belief(kalman)
    a, c = kalman.model.transition, kalman.observation
    require(a.ndim == 2, "adaptive_filter needs the belief of one motor, got a batch")
    measured, voltage = checked_series(measurements, voltage_v, len(c))
    memory = number("memory", memory, least=1.0)
    n_cases, _, n_samples = measured.shape
    state, covariance = np.tile(kalman.initial_state, (n_cases, 1)), kalman.initial_covariance
    noise = np.tile(kalman.measurement_covariance, (n_cases, 1, 1))
    process = np.tile(np.diag(kalman.process_covariance), (n_cases, 1))
    samples = []
    for k in range(n_samples):
        with sample_named(k, measured, voltage):
            carried = a @ covariance @ a.T
            step = measurement_update(
                state @ a.T + kalman.model.gain[:, Input.VOLTAGE] * voltage[k],
                carried + process[:, :, None] * np.eye(N_STATES),
                measured[:, :, k],
                observation=c,
                noise=noise,
            )
            state, covariance = step.state, step.covariance
            noise = adapted_noise(noise, measured[:, :, k] - state @ c.T, c @ covariance @ c.T, memory)
            moved = np.square(step.correction) + np.diagonal(covariance - carried, axis1=1, axis2=2)
            process = np.maximum(process + 2.0 / (memory + 1.0) * (moved - process), 0.0)
        samples.append((step.innovation, step.innovation_covariance, state, noise, process))
    innovation, spread, *rest = (np.stack(each, axis=1) for each in zip(*samples, strict=True))
    return AdaptiveResult(innovation, *score(innovation, spread), *rest)
