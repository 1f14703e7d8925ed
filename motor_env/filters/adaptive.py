"""Kalman filters that estimate their own noise, or parameters of the motor beside its state.

A fault looks like noise to an adaptive filter (Sage & Husa 1969; Mehra 1970): see docs/filters.md.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from motor_env.common.arrays import instance, is_one_of, number, numbers, shown, whole
from motor_env.filters.kalman import (
    KalmanFilter,
    checked_series,
    measurement_update,
    require_belief,
    require_noise,
    sample_named,
    score,
)
from motor_env.motor.model import N_STATES, Input, discretize
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray, MotorParameters, SensorParameters, require

MEMORY = 200.0
"""Samples over which noise is estimated, which gives a variance to 10 % (sqrt(2 / n))."""


class AdaptiveResult(NamedTuple):
    """Innovations, states and the estimated noise.

    Attributes:
        innovation: z - C x-, shape (n_cases, n_samples, n_channels).
        whitened: by the innovation covariance of that sample.
        nis: shape (n_cases, n_samples).
        log_likelihood: shape (n_cases,).
        state: after the update, shape (n_cases, n_samples, 2).
        measurement_covariance: after each sample, shape (n_cases, n_samples, n_channels, n_channels).
        process_variance: after each sample, shape (n_cases, n_samples, 2).
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
    """Update the measurement covariance by exponential forgetting (Sage & Husa 1969).

    It moves towards r r' + C P C', which is positive (Mohamed & Schwarz 1999).

    Args:
        noise: the old one, shape (n_cases, n_channels, n_channels).
        residual: r = z - C x after the update, shape (n_cases, n_channels).
        explained: C P C' after the update, the shape of `noise`.
        memory: samples; a new one weighs 2 / (memory + 1).
    """
    sample: FloatArray = residual[:, :, None] * residual[:, None, :] + explained
    sample = np.where(np.isnan(sample), noise, sample)  # what is missing tells nothing
    return noise + 2.0 / (memory + 1.0) * (sample - noise)


def adaptive_filter(
    kalman: KalmanFilter, measurements: ArrayLike, voltage_v: ArrayLike, *, memory: float = MEMORY
) -> AdaptiveResult:
    """Filter with noise estimated by exponential forgetting (Sage & Husa 1969).

    The measurement covariance follows `adapted_noise`; the process variances move towards the diagonal of K e e' K' + P
    - A P A', not below 0. One channel does not always tell the two apart (Mehra 1970).

    Args:
        kalman: for one motor, with the initial noise.
        measurements: shape (n_cases, n_channels, n_samples), finite.
        voltage_v: shape (n_samples,).
        memory: samples; a new one weighs 2 / (memory + 1).

    Raises:
        ValueError: shapes do not fit, a sample is not finite, the estimate overflows, or a memory is below 1.
    """
    require_belief(kalman)
    a, c = kalman.model.transition, kalman.observation
    require(a.ndim == 2, "adaptive_filter needs a filter of one motor, got a batch")
    measured, voltage = checked_series(measurements, voltage_v, len(c))
    memory = number("memory", memory, least=1.0)
    n_cases = len(measured)
    state, covariance = np.tile(kalman.initial_state, (n_cases, 1)), kalman.initial_covariance
    noise = np.tile(kalman.measurement_covariance, (n_cases, 1, 1))
    process = np.tile(np.diag(kalman.process_covariance), (n_cases, 1))
    samples = []
    with sample_named(measured, voltage) as places:
        for k in places:
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


_COULOMB = "coulomb"

FREE = (*QUANTITY_FIELDS, _COULOMB)
"""Names of what may be estimated: factors on parameters, and dry friction in units of `coulomb_unit_n_m`."""

_STEP = 1e-4


class JointKind(StrEnum):
    """Kind of a joint filter: extended or unscented."""

    EXTENDED = "extended"
    UNSCENTED = "unscented"


class JointResult(NamedTuple):
    """Estimated parameters after each sample.

    Attributes:
        names: of the parameters.
        theta: logarithms of the factors, `coulomb` as it is; shape (n_cases, n_samples, n_parameters).
        covariance: of theta, shape (n_cases, n_samples, n_parameters, n_parameters).
        innovation: shape (n_cases, n_samples, n_channels).
        nis: shape (n_cases, n_samples).
    """

    names: tuple[str, ...]
    theta: FloatArray
    covariance: FloatArray
    innovation: FloatArray
    nis: FloatArray

    @property
    def statistic(self) -> FloatArray:
        """Theta' P^-1 theta after each sample (Wald 1943), (n_cases, n_samples): distance from the assumed motor."""
        solved = np.linalg.solve(self.covariance, self.theta[..., None])[..., 0]
        distance: FloatArray = np.sum(self.theta * solved, axis=-1)
        return distance


def coulomb_unit_n_m(motor: MotorParameters, voltage_v: ArrayLike) -> float:
    """Return the motor's viscous torque at the speed that balances the highest voltage: B V / Kb (paper, eq. (2))."""
    speed = np.max(np.abs(np.asarray(voltage_v))) / motor.back_emf_constant_v_s_per_rad
    return float(motor.viscous_friction_n_m_s_per_rad * speed)


class _Motion(NamedTuple):
    motor: MotorParameters
    names: tuple[str, ...]
    dt_s: float
    coulomb_unit_n_m: float

    def ahead(self, points: FloatArray, voltage: float) -> tuple[FloatArray, FloatArray]:
        """Predict current and speed one sample ahead for each row of [current, speed, theta], and their slope.

        Dry friction is Tc w / sqrt(w^2 + 1 (rad/s)^2), as in the simulation, held over the step.
        """
        theta, speed = points[:, N_STATES:], points[:, 1]
        factors = {
            field: np.exp(theta[:, j])
            for j, name in enumerate(self.names)
            for field in QUANTITY_FIELDS.get(name, ())
        }
        model = discretize(self.motor.scaled(**factors), self.dt_s)
        state = (model.transition @ points[:, :N_STATES, None])[..., 0] + model.gain[..., 0] * voltage
        slope = np.broadcast_to(model.transition, (len(points), 2, 2))
        if _COULOMB in self.names:
            torque = self.coulomb_unit_n_m * theta[:, self.names.index(_COULOMB)]
            load = np.broadcast_to(model.gain[..., 1], state.shape)
            state = state + load * (torque * speed / np.hypot(speed, 1.0))[:, None]
            slope = slope.copy()
            slope[:, :, 1] += load * (torque / np.hypot(speed, 1.0) ** 3)[:, None]
        return state, slope


def _extended(
    motion: _Motion, mean: FloatArray, covariance: FloatArray, voltage: float
) -> tuple[FloatArray, FloatArray]:
    n, size = mean.shape
    unit = np.eye(size)[2:]
    steps = _STEP * np.concatenate([np.zeros((1, size)), unit, -unit])[:, None]
    state, slope = motion.ahead((mean + steps).reshape(-1, size), voltage)
    state = state.reshape(len(steps), n, 2)
    jacobian = np.broadcast_to(np.eye(size), (n, size, size)).copy()
    jacobian[:, :2, :2] = slope[:n]
    jacobian[:, :2, 2:] = np.moveaxis((state[1 : size - 1] - state[size - 1 :]) / (2.0 * _STEP), 0, -1)
    spread = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    return np.concatenate([state[0], mean[:, 2:]], axis=1), spread


def _unscented(
    motion: _Motion, mean: FloatArray, covariance: FloatArray, voltage: float
) -> tuple[FloatArray, FloatArray]:
    size = mean.shape[1]
    root = np.swapaxes(np.linalg.cholesky(size * covariance), 1, 2)  # rows are directions
    points = np.concatenate([mean[:, None] + root, mean[:, None] - root], axis=1)
    flat = points.reshape(-1, size)
    moved = np.concatenate([motion.ahead(flat, voltage)[0], flat[:, 2:]], axis=1).reshape(points.shape)
    centre: FloatArray = moved.mean(axis=1)
    off = moved - centre[:, None]
    spread: FloatArray = np.einsum("npi,npj->nij", off, off) / (2 * size)
    return centre, spread


def joint_filter(
    motor: MotorParameters,
    sensor: SensorParameters,
    dt_s: float,
    measurements: ArrayLike,
    voltage_v: ArrayLike,
    *,
    names: tuple[str, ...] = ("resistance", "friction"),
    prior_std: float = 0.3,
    process_noise_std: tuple[float, float] = (1e-5, 1e-3),
    kind: JointKind = JointKind.EXTENDED,
    memory: float | None = None,
) -> JointResult:
    """Run a joint filter over transients (extended: Ljung 1979; unscented: Julier & Uhlmann 1997).

    Args:
        motor: assumed motor, where theta is 0.
        sensor: channels and noise.
        dt_s: sampling interval.
        measurements: shape (n_cases, n_channels, n_samples); NaN is missing and updates nothing.
        voltage_v: shape (n_samples,).
        names: estimated ones, of `FREE`.
        prior_std: of each theta before the first sample.
        process_noise_std: in [A, rad/s] an interval.
        kind: which filter.
        memory: samples over which it adapts the measurement noise (Sage & Husa 1969); None keeps the sensor's.

    Raises:
        ValueError: unknown names or kind, shapes do not fit, a number is out of range, or the estimate overflows.
    """
    instance("motor", motor, MotorParameters)
    require(motor.batch_shape == (), "joint_filter needs one motor, got a batch")
    require_noise(sensor)
    instance("names", names, (tuple, list))
    given: tuple[Any, ...] = names
    unknown = [shown(name) for name in given if not is_one_of(name, FREE)]
    require(
        len(names) > 0 and not unknown and len(set(names)) == len(names),
        f"names must be of {', '.join(FREE)}, each once, got {', '.join(unknown or names) or 'none'}",
    )
    require(is_one_of(kind, JointKind), f"kind must be one of {', '.join(JointKind)}, got {shown(kind)}")
    prior_std = number("prior_std", prior_std, above=0.0)
    process_std = numbers("process_noise_std", process_noise_std, (N_STATES,), least=0.0)
    memory = None if memory is None else number("memory", memory, least=1.0)
    c = np.concatenate([sensor.observation, np.zeros((len(sensor.channels), len(names)))], axis=1)
    measured, voltage = checked_series(measurements, voltage_v, len(c), missing=True)
    n_cases = len(measured)
    size = N_STATES + len(names)
    # The unscented filter needs a covariance with a root: a start that is known to a microampere will do.
    start = np.square(np.array([1e-6, 1e-4, *[prior_std] * len(names)]))
    mean, covariance = np.zeros((n_cases, size)), np.tile(np.diag(start), (n_cases, 1, 1))
    process: FloatArray = np.diag(np.square(np.array([*process_std, *[0.0] * len(names)])))
    noise: FloatArray = np.tile(np.diag(np.square(sensor.noise_std)), (n_cases, 1, 1))
    motion = _Motion(motor, tuple(names), dt_s, coulomb_unit_n_m(motor, voltage))
    ahead = _extended if kind == JointKind.EXTENDED else _unscented
    samples = []
    discretize(motor, dt_s)  # what is wrong with these two is said of them, and not of a sample
    with sample_named(measured, voltage) as places:
        for k in places:
            mean, covariance = ahead(motion, mean, covariance, float(voltage[k]))
            step = measurement_update(
                mean, covariance + process, measured[:, :, k], observation=c, noise=noise
            )
            mean, covariance = step.state, step.covariance
            if memory is not None:
                noise = adapted_noise(noise, measured[:, :, k] - mean @ c.T, c @ covariance @ c.T, memory)
            theta = mean[:, N_STATES:], covariance[:, N_STATES:, N_STATES:]
            samples.append((*theta, step.innovation, step.innovation_covariance))
    thetas, covariances, innovations, spreads = (
        np.stack(each, axis=1) for each in zip(*samples, strict=True)
    )
    return JointResult(tuple(names), thetas, covariances, innovations, score(innovations, spreads).nis)


def parameter_test_threshold(n_parameters: int, false_alarm_probability: float) -> float:
    """Return the chi-square threshold on `JointResult.statistic` at one chosen sample (Wald 1943).

    Exact for normal estimates whose prior is wide.
    """
    probability = number("false_alarm_probability", false_alarm_probability, above=0.0, below=1.0)
    return float(chdtri(whole("n_parameters", n_parameters, 1), probability))
