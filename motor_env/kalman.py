"""The Kalman filter (paper, Table 1): the only one in the package. Its model is a belief, never the truth.

Arrays have a time axis before the last one here: innovations are (..., n_samples, n_channels). What the paper
calls R is `measurement_covariance`, its Q `process_covariance`, its H `observation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from motor_env.model import N_STATES, DiscreteModel, Input, discretize
from motor_env.parameters import FloatArray, MotorParameters, SensorParameters, require

DEFAULT_PROCESS_NOISE_STD = (1e-5, 1e-3)
"""Process noise of the belief in [A, rad/s] an interval. The paper prints none. It is small on purpose: process noise
absorbs a fault (with Q = diag(1e-4, 0.1) the innovation hardly shows a bearing fault of 10 %)."""


@dataclass(frozen=True, slots=True)
class KalmanFilter:
    """What the filter believes: one motor's model, sensor, noise and starting point.

    Attributes:
        model: discrete model of the healthy motor.
        observation: C, shape (n_channels, 2).
        process_covariance: Q, shape (2, 2).
        measurement_covariance: covariance of the measurement noise (the paper's R), shape (n_channels, n_channels).
        initial_state: state before the first interval, shape (2,).
        initial_covariance: its covariance, shape (2, 2).
    """

    model: DiscreteModel
    observation: FloatArray
    process_covariance: FloatArray
    measurement_covariance: FloatArray
    initial_state: FloatArray
    initial_covariance: FloatArray

    @classmethod
    def from_parameters(
        cls,
        parameters: MotorParameters,
        sensor: SensorParameters,
        dt_s: float,
        *,
        process_noise_std: tuple[float, float] = DEFAULT_PROCESS_NOISE_STD,
        initial_state: ArrayLike = (0.0, 0.0),
        initial_std: tuple[float, float] = (0.0, 0.0),
    ) -> Self:
        """Filter for a motor that is believed to be `parameters`, starting from rest unless told otherwise.

        Raises:
            ValueError: a batch of motors, or a sensor without noise (a filter needs a measurement variance > 0).
        """
        require(
            parameters.batch_shape == (),
            f"parameters must be of one motor, got a batch {parameters.batch_shape}",
        )
        require(
            bool((sensor.noise_std > 0.0).all()), f"noise of each channel must be > 0, got {sensor.noise_std}"
        )
        return cls(
            model=discretize(parameters, dt_s),
            observation=sensor.observation,
            process_covariance=np.diag(np.square(process_noise_std)),
            measurement_covariance=np.diag(np.square(sensor.noise_std)),
            initial_state=np.asarray(initial_state, dtype=np.float64),
            initial_covariance=np.diag(np.square(initial_std)),
        )


class FilterResult(NamedTuple):
    """What the filter makes of measurements; the covariances are common to all cases.

    Attributes:
        innovation: z - C x-, shape (..., n_samples, n_channels).
        innovation_covariance: S, shape (n_samples, n_channels, n_channels).
        whitened: innovation times the inverse of S's Cholesky factor, white and standard normal while the belief
            holds, shape (..., n_samples, n_channels).
        nis: normalised innovation squared (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4), shape (..., n_samples).
        log_likelihood: of all samples, shape (...).
        state: estimate after the update, shape (..., n_samples, 2).
        covariance: its covariance P, shape (n_samples, 2, 2).
        gain: Kalman gain, shape (n_samples, 2, n_channels).
    """

    innovation: FloatArray
    innovation_covariance: FloatArray
    whitened: FloatArray
    nis: FloatArray
    log_likelihood: FloatArray
    state: FloatArray
    covariance: FloatArray
    gain: FloatArray


def predict(
    kalman: KalmanFilter, state: FloatArray, covariance: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Time update (paper, Table 1): x- = A x + B u, P- = A P A' + Q."""
    transition = kalman.model.transition
    predicted: FloatArray = transition @ state + kalman.model.gain @ inputs
    spread: FloatArray = transition @ covariance @ transition.T + kalman.process_covariance
    return predicted, spread


def gain_and_covariance(
    kalman: KalmanFilter, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gain K, innovation covariance S and updated covariance for a predicted covariance (paper, Table 1).

    The covariance is updated in the Joseph form, (I - K C) P (I - K C)' + K R K', which stays symmetric and positive
    where the paper's (I - K C) P loses both to rounding (Bucy & Joseph 1968).
    """
    observation, noise = kalman.observation, kalman.measurement_covariance
    innovation_covariance = observation @ covariance @ observation.T + noise
    gain = np.linalg.solve(innovation_covariance, observation @ covariance).T
    left = np.eye(N_STATES) - gain @ observation
    return gain, innovation_covariance, left @ covariance @ left.T + gain @ noise @ gain.T


def update(
    kalman: KalmanFilter, state: FloatArray, covariance: FloatArray, measurement: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Measurement update (paper, Table 1): state, covariance, innovation and its covariance."""
    gain, innovation_covariance, updated = gain_and_covariance(kalman, covariance)
    innovation = measurement - kalman.observation @ state
    return state + gain @ innovation, updated, innovation, innovation_covariance


class Schedule(NamedTuple):
    """Gains and covariances of every sample: they depend on the belief and not on the data."""

    gain: FloatArray
    innovation_covariance: FloatArray
    covariance: FloatArray


def schedule(kalman: KalmanFilter, n_samples: int) -> Schedule:
    """Gain, innovation covariance and covariance after the update of each of `n_samples` samples."""
    n_channels = len(kalman.observation)
    gains = np.empty((n_samples, N_STATES, n_channels))
    innovation_covariances = np.empty((n_samples, n_channels, n_channels))
    covariances = np.empty((n_samples, N_STATES, N_STATES))
    covariance = kalman.initial_covariance
    transition = kalman.model.transition
    for k in range(n_samples):
        covariance = transition @ covariance @ transition.T + kalman.process_covariance
        gains[k], innovation_covariances[k], covariance = gain_and_covariance(kalman, covariance)
        covariances[k] = covariance
    return Schedule(gains, innovation_covariances, covariances)


@njit(cache=True)
def _filter_states(
    transition: FloatArray,
    gain: FloatArray,
    observation: FloatArray,
    kalman_gain: FloatArray,
    initial_state: FloatArray,
    inputs: FloatArray,
    measurements: FloatArray,
    innovation: FloatArray,
    state: FloatArray,
) -> None:
    n_channels = observation.shape[0]
    for n in range(measurements.shape[0]):
        u = inputs[n if inputs.shape[0] > 1 else 0]
        x0, x1 = initial_state[0], initial_state[1]
        for k in range(measurements.shape[1]):
            p0 = transition[0, 0] * x0 + transition[0, 1] * x1 + gain[0, 0] * u[k, 0] + gain[0, 1] * u[k, 1]
            p1 = transition[1, 0] * x0 + transition[1, 1] * x1 + gain[1, 0] * u[k, 0] + gain[1, 1] * u[k, 1]
            x0, x1 = p0, p1
            for m in range(n_channels):
                e = measurements[n, k, m] - observation[m, 0] * p0 - observation[m, 1] * p1
                innovation[n, k, m] = e
                x0 += kalman_gain[k, 0, m] * e
                x1 += kalman_gain[k, 1, m] * e
            state[n, k, 0], state[n, k, 1] = x0, x1


def run_filter(
    kalman: KalmanFilter, measurements: ArrayLike, voltage_v: ArrayLike, load_torque_n_m: ArrayLike = 0.0
) -> FilterResult:
    """Filter one or many measured transients.

    Args:
        kalman: the belief.
        measurements: shape (n_channels, n_samples) or (n_cases, n_channels, n_samples).
        voltage_v: believed voltage in each interval, shape (n_samples,) or (n_cases, n_samples).
        load_torque_n_m: believed load, scalar or the shape of `voltage_v`.

    Raises:
        ValueError: shapes do not fit, or a measurement is not finite.
    """
    measured = np.asarray(measurements, dtype=np.float64)
    n_channels = len(kalman.observation)
    require(
        measured.ndim in (2, 3) and measured.shape[-2] == n_channels,
        f"measurements must have shape (..., {n_channels}, n_samples), got {measured.shape}",
    )
    require(bool(np.isfinite(measured).all()), "measurements must be finite, got a value that is not")
    n_samples = measured.shape[-1]
    voltage = np.asarray(voltage_v, dtype=np.float64)
    require(
        voltage.ndim in (1, 2) and voltage.shape[-1] == n_samples,
        f"voltage_v must have shape (..., {n_samples}), got {voltage.shape}",
    )
    batch = measured.shape[:-2]
    series = np.ascontiguousarray(np.moveaxis(measured, -1, -2)).reshape(-1, n_samples, n_channels)
    inputs = np.empty((*voltage.shape, len(Input)))
    inputs[..., Input.VOLTAGE] = voltage
    inputs[..., Input.LOAD_TORQUE] = load_torque_n_m
    inputs = inputs.reshape(-1, n_samples, len(Input))
    require(
        len(inputs) in (1, len(series)), f"voltage_v must have 1 or {len(series)} rows, got {len(inputs)}"
    )
    plan = schedule(kalman, n_samples)
    innovation = np.empty_like(series)
    state = np.empty((len(series), n_samples, N_STATES))
    _filter_states(
        kalman.model.transition,
        np.ascontiguousarray(kalman.model.gain),
        kalman.observation,
        plan.gain,
        kalman.initial_state,
        inputs,
        series,
        innovation,
        state,
    )
    factor = np.linalg.cholesky(plan.innovation_covariance)
    whitened = np.linalg.solve(factor, innovation[..., None])[..., 0]
    nis = np.square(whitened).sum(axis=-1)
    log_determinant = 2.0 * np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum()
    log_likelihood = -0.5 * (
        nis.sum(axis=-1) + log_determinant + n_samples * n_channels * np.log(2.0 * np.pi)
    )
    return FilterResult(
        innovation=innovation.reshape(*batch, n_samples, n_channels),
        innovation_covariance=plan.innovation_covariance,
        whitened=whitened.reshape(*batch, n_samples, n_channels),
        nis=nis.reshape(*batch, n_samples),
        log_likelihood=log_likelihood.reshape(batch),
        state=state.reshape(*batch, n_samples, N_STATES),
        covariance=plan.covariance,
        gain=plan.gain,
    )
