"""State and parameters estimated together, sample by sample: the extended and the unscented Kalman filter.

The state is [current, speed, theta], theta being logarithms of factors on parameters, which do not change. What is
measured is linear in it, so the two filters differ in the time update alone: the extended one takes the slope of the
exact discretisation (Ljung 1979), the unscented one 2 L points of it (Julier & Uhlmann 1997, with kappa = 0).
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from motor_env.model import N_STATES, discretize
from motor_env.parameters import FloatArray, MotorParameters, SensorParameters, require

_FIELDS = {
    "resistance": ("resistance_ohm",),
    "inductance": ("inductance_h",),
    "constants": ("back_emf_constant_v_s_per_rad", "torque_constant_n_m_per_a"),
    "inertia": ("inertia_kg_m2",),
    "friction": ("viscous_friction_n_m_s_per_rad",),
}

FREE = tuple(_FIELDS)
"""What may be estimated: factors on parameters; `constants` is one common factor on Kt and Kb."""

_STEP = 1e-4


class JointKind(StrEnum):
    """Which filter."""

    EXTENDED = "extended"
    UNSCENTED = "unscented"


class JointResult(NamedTuple):
    """Parameters as the samples come in.

    Attributes:
        names: estimated parameters.
        log_factor: theta after each sample, shape (n_cases, n_samples, n_parameters).
        covariance: of theta after each sample, shape (n_cases, n_samples, n_parameters, n_parameters).
        innovation: shape (n_cases, n_samples, n_channels).
        nis: shape (n_cases, n_samples).
    """

    names: tuple[str, ...]
    log_factor: FloatArray
    covariance: FloatArray
    innovation: FloatArray
    nis: FloatArray

    @property
    def statistic(self) -> FloatArray:
        """Theta' P^-1 theta after each sample, shape (n_cases, n_samples): how far from the believed motor."""
        solved = np.linalg.solve(self.covariance, self.log_factor[..., None])[..., 0]
        distance: FloatArray = np.sum(self.log_factor * solved, axis=-1)
        return distance


def _models(
    motor: MotorParameters, names: tuple[str, ...], theta: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Transition and voltage column for each row of theta, shapes (n, 2, 2) and (n, 2)."""
    factors = {field: np.exp(theta[:, j]) for j, name in enumerate(names) for field in _FIELDS[name]}
    model = discretize(motor.scaled(**factors), dt_s)
    return model.transition, model.gain[..., 0]


def _extended(
    motor: MotorParameters,
    names: tuple[str, ...],
    mean: FloatArray,
    covariance: FloatArray,
    voltage: float,
    dt_s: float,
) -> tuple[FloatArray, FloatArray]:
    n, size = mean.shape
    offsets = np.concatenate([np.zeros((1, size - 2)), _STEP * np.eye(size - 2), -_STEP * np.eye(size - 2)])
    theta = (mean[None, :, 2:] + offsets[:, None, :]).reshape(-1, size - 2)
    a, b = _models(motor, names, theta, dt_s)
    a, b = a.reshape(len(offsets), n, 2, 2), b.reshape(len(offsets), n, 2)
    ahead = np.einsum("snij,nj->sni", a, mean[:, :2]) + b * voltage
    jacobian = np.broadcast_to(np.eye(size), (n, size, size)).copy()
    jacobian[:, :2, :2] = a[0]
    slopes = (ahead[1 : size - 1] - ahead[size - 1 :]) / (2.0 * _STEP)
    jacobian[:, :2, 2:] = np.moveaxis(slopes, 0, -1)
    return np.concatenate([ahead[0], mean[:, 2:]], axis=1), jacobian @ covariance @ np.swapaxes(
        jacobian, 1, 2
    )


def _unscented(
    motor: MotorParameters,
    names: tuple[str, ...],
    mean: FloatArray,
    covariance: FloatArray,
    voltage: float,
    dt_s: float,
) -> tuple[FloatArray, FloatArray]:
    size = mean.shape[1]
    root = np.swapaxes(np.linalg.cholesky(size * covariance), 1, 2)  # rows are directions
    points = np.concatenate([mean[:, None] + root, mean[:, None] - root], axis=1)
    flat = points.reshape(-1, size)
    a, b = _models(motor, names, flat[:, 2:], dt_s)
    ahead = flat.copy()
    ahead[:, :2] = np.einsum("nij,nj->ni", a, flat[:, :2]) + b * voltage
    moved: FloatArray = ahead.reshape(points.shape)
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
) -> JointResult:
    """Joint filter over one or many transients (extended: Ljung 1979; unscented: Julier & Uhlmann 1997).

    Args:
        motor: believed motor, where theta is 0.
        sensor: channels and noise.
        dt_s: sampling interval.
        measurements: shape (n_cases, n_channels, n_samples).
        voltage_v: shape (n_samples,).
        names: what to estimate, of `FREE`.
        prior_std: of each theta before the first sample.
        process_noise_std: in [A, rad/s] an interval.
        kind: which filter.

    Raises:
        ValueError: unknown names, or shapes that do not fit.
    """
    measured, voltage = np.asarray(measurements, dtype=np.float64), np.asarray(voltage_v, dtype=np.float64)
    unknown = [name for name in names if name not in _FIELDS]
    require(
        len(names) > 0 and not unknown,
        f"names must be of {', '.join(FREE)}, got {', '.join(unknown) or 'none'}",
    )
    c = np.concatenate([sensor.observation, np.zeros((len(sensor.channels), len(names)))], axis=1)
    require(
        measured.ndim == 3 and measured.shape[1] == len(c) and voltage.shape == (measured.shape[2],),
        f"measurements must have shape (n_cases, {len(c)}, n_samples) with a voltage for each sample, "
        f"got {measured.shape} and {voltage.shape}",
    )
    n_cases, n_channels, n_samples = measured.shape
    size = N_STATES + len(names)
    # The unscented filter needs a covariance with a root: a start that is known to a microampere will do.
    start = np.square(np.array([1e-6, 1e-4, *[prior_std] * len(names)]))
    mean, covariance = np.zeros((n_cases, size)), np.tile(np.diag(start), (n_cases, 1, 1))
    process: FloatArray = np.diag(np.square(np.array([*process_noise_std, *[0.0] * len(names)])))
    noise = np.diag(np.square(sensor.noise_std))
    ahead = _extended if kind is JointKind.EXTENDED else _unscented
    thetas, spreads = (
        np.empty((n_cases, n_samples, size - 2)),
        np.empty((n_cases, n_samples, size - 2, size - 2)),
    )
    innovations, nis = np.empty((n_cases, n_samples, n_channels)), np.empty((n_cases, n_samples))
    for k in range(n_samples):
        mean, covariance = ahead(motor, names, mean, covariance, float(voltage[k]), dt_s)
        covariance = covariance + process
        s = c @ covariance @ c.T + noise
        gain = np.swapaxes(np.linalg.solve(s, c @ covariance), 1, 2)
        innovation = measured[:, :, k] - mean @ c.T
        mean = mean + (gain @ innovation[..., None])[..., 0]
        left = np.eye(size) - gain @ c
        covariance = left @ covariance @ np.swapaxes(left, 1, 2) + gain @ noise @ np.swapaxes(gain, 1, 2)
        thetas[:, k], spreads[:, k], innovations[:, k] = mean[:, 2:], covariance[:, 2:, 2:], innovation
        nis[:, k] = np.sum(innovation * np.linalg.solve(s, innovation[..., None])[..., 0], axis=-1)
    return JointResult(names, thetas, spreads, innovations, nis)


def parameter_test_threshold(n_parameters: int, false_alarm_probability: float) -> float:
    """Threshold on `JointResult.statistic` at one chosen sample: chi-square (Wald 1943).

    Exact for normal estimates whose prior is wide; watching it all along alarms more often.
    """
    return float(chi2.isf(false_alarm_probability, n_parameters))
