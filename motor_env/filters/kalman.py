"""The Kalman filter (paper, Table 1): its assumptions, its update and its gains.

The paper's R is `measurement_covariance`, its Q `process_covariance`, its H `observation`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import instance, number, numbers
from motor_env.filters.kernels import fill_schedules, score_innovations
from motor_env.motor.model import N_STATES, DiscreteModel, Input, discretize
from motor_env.motor.parameters import SMALLEST, FloatArray, MotorParameters, SensorParameters, require

DEFAULT_PROCESS_NOISE_STD = (1e-5, 1e-3)
"""Assumed process noise in [A, rad/s] an interval (the paper prints none); small, since it absorbs a fault."""


@dataclass(frozen=True, slots=True)
class KalmanFilter:
    """Assumptions of the filter: a motor's model, sensor, noise and initial state.

    Attributes:
        model: discrete model of the healthy motor, or one for each case.
        observation: C, shape (n_channels, 2).
        process_covariance: Q, shape (2, 2).
        measurement_covariance: R, shape (n_channels, n_channels).
        initial_state: state before the first interval, shape (2,).
        initial_covariance: its covariance, shape (2, 2).

    Raises:
        ValueError: shapes do not fit, a number is not finite, a covariance is not symmetric and positive semi-definite,
            or measurement noise is not positive definite.
    """

    model: DiscreteModel
    observation: FloatArray
    process_covariance: FloatArray
    measurement_covariance: FloatArray
    initial_state: FloatArray
    initial_covariance: FloatArray

    def __post_init__(self) -> None:
        instance("model", self.model, DiscreteModel)
        observation = numbers("observation", self.observation, ("n_channels", "n_states"))
        channels, states = observation.shape
        transition = numbers("transition of the model", self.model.transition, ("...", states, states))
        gain = numbers("gain of the model", self.model.gain, ("...", N_STATES, len(Input)))
        require(
            transition.ndim <= 3 and gain.shape[:-2] == transition.shape[:-2],
            f"transition and gain of the model must be of as many motors, got {transition.shape} and {gain.shape}",
        )
        dt_s = number("dt_s of the model", self.model.dt_s, above=0.0)
        require(channels in (1, 2), f"observation must have 1 or 2 rows, one a channel, got {channels}")
        checked = {
            "model": DiscreteModel(transition, gain, dt_s),
            "observation": observation,
            "initial_state": numbers("initial_state", self.initial_state, (states,)),
            "measurement_covariance": _covariance(
                "measurement_covariance", self.measurement_covariance, channels, least=SMALLEST**2
            ),
        }
        for name in ("process_covariance", "initial_covariance"):
            checked[name] = _covariance(name, getattr(self, name), states)
        for name, value in checked.items():
            object.__setattr__(self, name, value)

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
        """Return a filter (Kalman 1960) that assumes `parameters`; for a batch, a model for each case.

        Args:
            parameters: the motor that the filter assumes, usually the healthy one.
            sensor: channels, and their noise: R is its square.
            dt_s: sampling interval.
            process_noise_std: standard deviations of what one interval adds to current and speed, in [A, rad/s]. Q has
                their squares on its diagonal. Large ones hide a fault (docs/howto/set-q-and-r.md).
            initial_state: current and speed before the first interval, in [A, rad/s].
            initial_std: their standard deviations.

        Raises:
            ValueError: a sensor without noise, or what `KalmanFilter` refuses.
        """
        require_noise(sensor)
        return cls(
            model=discretize(parameters, dt_s),
            observation=sensor.observation,
            process_covariance=_variances("process_noise_std", process_noise_std),
            measurement_covariance=np.diag(np.square(sensor.noise_std)),
            initial_state=numbers("initial_state", initial_state, (N_STATES,)),
            initial_covariance=_variances("initial_std", initial_std),
        )


def require_belief(kalman: KalmanFilter) -> None:
    """Raise `TypeError` or `ValueError` unless it is a filter of current and speed, as compiled loops require."""
    instance("kalman", kalman, KalmanFilter)
    states = kalman.observation.shape[1]
    if states != N_STATES:
        raise ValueError(f"kalman must have {N_STATES} states, current and speed, got {states}")


def require_noise(sensor: SensorParameters) -> None:
    """Raise `ValueError` unless each channel has noise, as a filter requires."""
    instance("sensor", sensor, SensorParameters)
    noise = sensor.noise_std.tolist()
    require(min(noise) >= SMALLEST, f"noise of each channel must be > 0 (>= {SMALLEST:g}), got {noise}")


def _variances(name: str, std: ArrayLike) -> FloatArray:
    return np.diag(np.square(numbers(name, std, (N_STATES,), least=0.0)))


def _covariance(name: str, given: ArrayLike, size: int, least: float = 0.0) -> FloatArray:
    """Return a symmetric matrix with variances of at least `least`: definite where that is > 0, else semi-definite."""
    matrix = numbers(name, given, (size, size))
    variances, smallest, word = np.diag(matrix), -1e-9, "semi-definite"
    if least > 0.0:
        smallest, word = 1e-12, "definite"
    root = np.where(variances > 0.0, np.sqrt(np.abs(variances)), 1.0)
    correlation = matrix / root / root[:, None]
    if not np.abs(correlation - correlation.T).max() <= 1e-9:
        raise ValueError(f"{name} must be symmetric, got {matrix.tolist()}")
    if variances.min() < least or np.linalg.eigvalsh(correlation)[0] < smallest:
        raise ValueError(f"{name} must be positive {word}, got {matrix.tolist()}")
    return matrix


class Updated(NamedTuple):
    """A measurement update of n cases with any number of states.

    Attributes:
        state: updated estimate, shape (n, n_states).
        covariance: its covariance, shape (n, n_states, n_states).
        innovation: z - C x-, shape (n, n_channels); NaN where a channel is missing.
        innovation_covariance: S, shape (n, n_channels, n_channels).
        correction: K times the innovation, shape (n, n_states).
    """

    state: FloatArray
    covariance: FloatArray
    innovation: FloatArray
    innovation_covariance: FloatArray
    correction: FloatArray


def gain_and_covariance(
    covariance: FloatArray, observation: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return gain K, innovation covariance S and updated covariance (paper, Table 1).

    The Joseph form (I - K C) P (I - K C)' + K R K' stays positive under rounding (Bucy & Joseph 1968).

    Args:
        covariance: predicted P-, shape (..., n_states, n_states).
        observation: C, shape (..., n_channels, n_states).
        noise: R, shape (..., n_channels, n_channels).
    """
    innovation_covariance = observation @ covariance @ np.swapaxes(observation, -1, -2) + noise
    gain = np.swapaxes(np.linalg.solve(innovation_covariance, observation @ covariance), -1, -2)
    left = np.eye(covariance.shape[-1]) - gain @ observation
    updated: FloatArray = left @ covariance @ np.swapaxes(left, -1, -2) + gain @ noise @ np.swapaxes(
        gain, -1, -2
    )
    return gain, innovation_covariance, updated


def measurement_update(
    state: FloatArray,
    covariance: FloatArray,
    measurement: FloatArray,
    *,
    observation: FloatArray,
    noise: FloatArray,
) -> Updated:
    """Update n cases by a measurement (Kalman 1960; paper, Table 1).

    Args:
        state: predicted x-, shape (n, n_states).
        covariance: predicted P-, shape (n, n_states, n_states).
        measurement: shape (n, n_channels); NaN is missing and updates nothing.
        observation: C, shape (n_channels, n_states).
        noise: R, shape (n_channels, n_channels) or (n, n_channels, n_channels).
    """
    missing = np.isnan(measurement)
    gain, innovation_covariance, updated = gain_and_covariance(
        covariance, *masked_sensor(observation, noise, missing)
    )
    innovation = measurement - state @ observation.T
    correction = (gain @ np.where(missing, 0.0, innovation)[:, :, None])[:, :, 0]
    return Updated(state + correction, updated, innovation, innovation_covariance, correction)


def masked_sensor(
    observation: FloatArray, noise: FloatArray, missing: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return C and R of each sample: a missing channel has a zero row and noise of its own (Kalman 1960).

    `missing` is (..., n_channels).
    """
    rows = np.where(missing[..., None], 0.0, observation)
    return rows, np.where(missing[..., :, None] ^ missing[..., None, :], 0.0, noise)


class Schedule(NamedTuple):
    """Gains and covariances of every sample, which do not depend on the data.

    Attributes:
        gain: Kalman gain, shape (n_samples, 2, n_channels).
        innovation_covariance: S, shape (n_samples, n_channels, n_channels).
        covariance: P after the update, shape (n_samples, 2, 2).
        held_from: sample from which on the gain is constant, or n_samples.
    """

    gain: FloatArray
    innovation_covariance: FloatArray
    covariance: FloatArray
    held_from: int


def schedule(kalman: KalmanFilter, n_samples: int) -> Schedule:
    """Return the schedule of `n_samples` samples (Kalman 1960).

    Raises:
        ValueError: the filter is for a batch of motors.
    """
    require(kalman.model.transition.ndim == 2, "schedule needs a filter of one motor, got a batch")
    rows = schedules(kalman, np.zeros((1, n_samples, len(kalman.observation)), dtype=np.bool_))
    return Schedule(rows.gain[0], rows.innovation_covariance[0], rows.covariance[0], rows.held_from)


def schedules(
    kalman: KalmanFilter, missing: NDArray[np.bool_], initial: FloatArray | None = None
) -> Schedule:
    """Return schedules (n_rows, ...) of rows of samples; `missing` is (n_rows, n_samples, n_channels).

    `initial` has a covariance for each row, (n_rows, 2, 2); a filter for n_rows motors gives each row its own.
    """
    # A channel that is not there has a zero row and unit noise, so that it has no gain and changes nothing.
    m, observation, noise = missing.shape[2], np.zeros((2, N_STATES)), np.eye(2)
    observation[:m], noise[:m, :m] = kalman.observation, kalman.measurement_covariance
    n_rows, n_samples, _ = missing.shape
    count = n_rows * n_samples
    # One block for all: arrays of some megabytes go back to the system, and zeroing their pages anew takes long.
    block = np.empty(count * (N_STATES * m + m * m + N_STATES * N_STATES))
    gain = block[: count * N_STATES * m].reshape(n_rows, n_samples, N_STATES, m)
    innovation_covariance = block[gain.size : gain.size + count * m * m].reshape(n_rows, n_samples, m, m)
    covariance = block[-count * N_STATES * N_STATES :].reshape(n_rows, n_samples, N_STATES, N_STATES)
    try:
        held_from = fill_schedules(
            kalman.model.transition.reshape(-1, N_STATES, N_STATES),
            kalman.process_covariance,
            observation,
            noise,
            kalman.initial_covariance[None] if initial is None else initial,
            np.ascontiguousarray(missing),
            gain,
            innovation_covariance,
            covariance,
        )
    except ZeroDivisionError:
        raise ValueError(
            "measurement_covariance is too small beside the others: no gain can be computed"
        ) from None
    return Schedule(gain, innovation_covariance, covariance, held_from)


def checked_series(
    measurements: ArrayLike, voltage_v: ArrayLike, n_channels: int, *, missing: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return measurements (n_cases, n_channels, n_samples), NaN where `missing`, and the voltage (n_samples,)."""
    measured = numbers("measurements", measurements, ("n_cases", n_channels, "n_samples"), missing=missing)
    return measured, numbers("voltage_v", voltage_v, measured.shape[2:])


@contextmanager
def sample_named(measured: FloatArray, voltage_v: FloatArray) -> Iterator[Iterator[int]]:
    """Yield the samples' numbers; `ValueError` names the sample at which the estimate overflows."""
    k = 0

    def count() -> Iterator[int]:
        nonlocal k
        for k in range(len(voltage_v)):  # noqa: UP028  # the loop keeps the number
            yield k

    try:
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            yield count()
    except (FloatingPointError, np.linalg.LinAlgError, OverflowError, ValueError):
        case = int(np.argmax(np.abs(np.nan_to_num(measured[:, :, k])).max(axis=1)))
        raise ValueError(
            f"the estimate left the range of numbers at sample {k}: the largest measurements there are"
            f" {measured[case, :, k].tolist()} (case {case}), the voltage is {voltage_v[k]:g}"
        ) from None


class Scores(NamedTuple):
    """Innovations of n cases, normalised.

    Attributes:
        whitened: innovation times the inverse of S's Cholesky factor, shape (n_cases, n_samples, n_channels).
        nis: normalised innovation squared, shape (n_cases, n_samples); 0 where none was measured.
        log_likelihood: shape (n_cases,).
    """

    whitened: FloatArray
    nis: FloatArray
    log_likelihood: FloatArray


def score(innovation: FloatArray, innovation_covariance: FloatArray) -> Scores:
    """Compute whitened innovations, NIS and log-likelihood (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4; Schweppe 1965).

    Args:
        innovation: of one or two channels, shape (n_cases, n_samples, n_channels); NaN is missing.
        innovation_covariance: S, shape (n_cases or 1, n_samples, n_channels, n_channels).
    """
    whitened = np.empty_like(innovation)
    nis, log_likelihood = np.empty(innovation.shape[:-1]), np.empty(len(innovation))
    score_innovations(innovation, innovation_covariance, whitened, nis, log_likelihood)
    return Scores(whitened, nis, log_likelihood)
