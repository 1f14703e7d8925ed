"""Sensitivity of the linear motor's measured response to its parameters.

`normal_equations` gives squares, gradient and Fisher information (Gauss 1809; Ljung 1999, ch. 10).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import instance, numbers
from motor_env.motor.compiled import njit
from motor_env.motor.model import N_STATES, Input, discretize
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray, MotorParameters, SensorParameters, require
from motor_env.simulation.simulate import simulate_states


@njit(cache=True)
def fill_sensitivities(
    transition: FloatArray,
    gain: FloatArray,
    transition_slope: FloatArray,
    gain_slope: FloatArray,
    voltage: FloatArray,
    states: FloatArray,
    slopes: FloatArray,
) -> None:
    """Compute one motor's states (2, n_samples) and their derivatives (size, 2, n_samples).

    s[k+1] = A s[k] + A' x[k] + B' u[k], from rest and without a load.
    """
    a00, a01, a10, a11 = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
    b0, b1 = gain[0, 0], gain[1, 0]
    x0, x1 = 0.0, 0.0
    for k in range(states.shape[1]):
        x0, x1 = a00 * x0 + a01 * x1 + b0 * voltage[k], a10 * x0 + a11 * x1 + b1 * voltage[k]
        states[0, k], states[1, k] = x0, x1
    for j in range(slopes.shape[0]):
        d00, d01 = transition_slope[j, 0, 0], transition_slope[j, 0, 1]
        d10, d11 = transition_slope[j, 1, 0], transition_slope[j, 1, 1]
        e0, e1 = gain_slope[j, 0, 0], gain_slope[j, 1, 0]
        x0, x1, s0, s1 = 0.0, 0.0, 0.0, 0.0
        for k in range(states.shape[1]):
            f0 = d00 * x0 + d01 * x1 + e0 * voltage[k]
            f1 = d10 * x0 + d11 * x1 + e1 * voltage[k]
            s0, s1 = a00 * s0 + a01 * s1 + f0, a10 * s0 + a11 * s1 + f1
            slopes[j, 0, k], slopes[j, 1, k] = s0, s1
            x0, x1 = states[0, k], states[1, k]


@njit(cache=True)
def fill_normal_equations(
    rows: NDArray[np.int64],
    transition: FloatArray,
    gain: FloatArray,
    transition_slope: FloatArray,
    gain_slope: FloatArray,
    voltage: FloatArray,
    measurements: FloatArray,
    observation: FloatArray,
    chi2: FloatArray,
    gradient: FloatArray,
    information: FloatArray,
) -> None:
    """Compute squares, J'r and J'J of each row; `observation` and `measurements` are divided by the noise."""
    n_channels, n_samples, size = measurements.shape[1], measurements.shape[2], gradient.shape[1]
    states, slopes = np.empty((N_STATES, n_samples)), np.empty((size, N_STATES, n_samples))
    residual = np.empty(n_samples)
    jacobian = np.empty((size, n_samples))
    for n in range(rows.shape[0]):
        row = rows[n]
        fill_sensitivities(
            transition[n], gain[n], transition_slope[n], gain_slope[n], voltage, states, slopes
        )
        chi2[n] = 0.0
        gradient[n] = 0.0
        information[n] = 0.0
        for m in range(n_channels):
            c0, c1 = observation[m, 0], observation[m, 1]
            for k in range(n_samples):
                residual[k] = measurements[row, m, k] - c0 * states[0, k] - c1 * states[1, k]
            for j in range(size):
                for k in range(n_samples):
                    jacobian[j, k] = c0 * slopes[j, 0, k] + c1 * slopes[j, 1, k]
            chi2[n] += np.dot(residual, residual)
            gradient[n] += np.dot(jacobian, residual)
            information[n] += np.dot(jacobian, jacobian.T)


_FIELDS: dict[str, tuple[str, ...]] = {"supply": (), **QUANTITY_FIELDS}

QUANTITIES = tuple(_FIELDS)
"""Quantities that a fit can free: a factor on the supply, or on a parameter; `constants` scales Kt and Kb."""

# Of a relative change: truncation and rounding of a central difference are both near 1e-10.
_DIFFERENCE = 1e-5


@dataclass(frozen=True, slots=True)
class Coordinates:
    """Coordinates z of motors around a nominal one.

    A factor is exp(scale z) where `logarithmic`, else 1 + scale z; z = 0 is the nominal motor.

    Attributes:
        nominal: the motor at z = 0.
        names: the free quantities, of `QUANTITIES`.
        scales: relative change of each per unit of its coordinate, > 0.
        logarithmic: whether factors are exponentials.
    """

    nominal: MotorParameters
    names: tuple[str, ...]
    scales: tuple[float, ...]
    logarithmic: bool = True

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in _FIELDS]
        require(
            not unknown, f"free must be among {', '.join(QUANTITIES)}, got {', '.join(map(repr, unknown))}"
        )
        require(
            len(set(self.names)) == len(self.names), f"free must be distinct, got {', '.join(self.names)}"
        )
        require(
            len(self.names) == len(self.scales) and all(scale > 0.0 for scale in self.scales),
            f"scales must be one positive number for each of {', '.join(self.names)}, got {self.scales}",
        )

    @classmethod
    def from_names(cls, nominal: MotorParameters, names: tuple[str, ...]) -> Coordinates:
        """Return the natural logarithms of factors as coordinates."""
        return cls(nominal, tuple(names), (1.0,) * len(names))

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.names)

    def factors(self, values: FloatArray) -> FloatArray:
        """Return factors on the nominal values, shape (..., size), for coordinates of that shape."""
        scaled = values * np.asarray(self.scales)
        factors: FloatArray = np.exp(scaled) if self.logarithmic else 1.0 + scaled
        return factors

    def motors(self, values: FloatArray) -> tuple[MotorParameters, FloatArray]:
        """Return motors and supply factors, both of batch shape (...), for coordinates of shape (..., size)."""
        factors = dict(zip(self.names, np.moveaxis(self.factors(values), -1, 0), strict=True))
        supply = factors.pop("supply", np.ones(values.shape[:-1]))
        by_field = {field: factor for name, factor in factors.items() for field in _FIELDS[name]}
        return self.nominal.scaled(**by_field), supply


Model = tuple[FloatArray, FloatArray]
"""A and B of x[k+1] = A x[k] + B [v[k], load[k]], supply factor included in B; shapes (n, 2, 2)."""


def model_slopes(coordinates: Coordinates, values: FloatArray, dt_s: float) -> tuple[Model, Model]:
    """Return exact discrete models at coordinates (n, size), and their derivatives, (n, size, 2, 2)."""
    steps = _DIFFERENCE / np.asarray(coordinates.scales)
    size = coordinates.size
    shifted = values[:, None, :] + np.concatenate([np.zeros((1, size)), np.diag(steps), -np.diag(steps)])
    motors, supply = coordinates.motors(shifted)
    model = discretize(motors, dt_s)
    transition = np.broadcast_to(model.transition, (*supply.shape, N_STATES, N_STATES)).copy()
    gain = np.broadcast_to(model.gain, (*supply.shape, N_STATES, len(Input))).copy()
    gain[..., Input.VOLTAGE] *= supply[..., None]
    steps = 2.0 * steps[:, None, None]
    centre = np.ascontiguousarray(transition[:, 0]), np.ascontiguousarray(gain[:, 0])
    up, down = slice(1, 1 + size), slice(1 + size, None)
    return centre, ((transition[:, up] - transition[:, down]) / steps, (gain[:, up] - gain[:, down]) / steps)


class NormalEquations(NamedTuple):
    """Terms of a Gauss-Newton step for each case.

    Attributes:
        chi2: sum of squared residuals in units of the noise, shape (n,).
        gradient: J' r, minus half the gradient of chi2, shape (n, size).
        information: J' J, the Fisher information, shape (n, size, size).
    """

    chi2: FloatArray
    gradient: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True)
class Observed:
    """Measured transients from rest in units of their noise, and their voltage.

    Attributes:
        whitened: measurements over the noise's standard deviation, shape (n_cases, n_channels, n_samples).
        voltage_v: nominal voltage, shape (n_samples,).
        dt_s: sampling interval.
        observation: C divided by the noise, shape (n_channels, 2).
        log_normaliser: log-likelihood of a transient with chi2 = 0.
    """

    whitened: FloatArray
    voltage_v: FloatArray
    dt_s: float
    observation: FloatArray
    log_normaliser: float

    @classmethod
    def from_measurements(
        cls, measurements: ArrayLike, voltage_v: ArrayLike, sensor: SensorParameters, dt_s: float
    ) -> Observed:
        """Check and whiten measurements.

        Args:
            measurements: shape (n_cases, n_channels, n_samples), or (n_channels, n_samples) for one case.
            voltage_v: nominal voltage held in each interval, shape (n_samples,).
            sensor: channels and assumed noise.
            dt_s: sampling interval.

        Raises:
            ValueError: shapes do not fit, a value is not finite, or a channel has no noise.
        """
        instance("sensor", sensor, SensorParameters)
        n_channels = len(sensor.channels)
        measured = numbers("measurements", measurements, ("...", n_channels, "n_samples"))
        measured = measured[None] if measured.ndim == 2 else measured
        require(
            measured.ndim == 3 and measured.shape[2] > 0,
            f"measurements must have shape (n_cases, {n_channels}, n_samples), got {measured.shape}",
        )
        std = sensor.noise_std
        require(bool((std > 0.0).all()), f"noise of each channel must be > 0, got {std.tolist()}")
        n_samples = measured.shape[-1]
        voltage = numbers("voltage_v", voltage_v, (n_samples,))
        return cls(
            whitened=np.ascontiguousarray(measured / std[:, None]),
            voltage_v=voltage,
            dt_s=float(dt_s),
            observation=sensor.observation / std[:, None],
            log_normaliser=-n_samples * float(np.log(std).sum() + 0.5 * n_channels * np.log(2.0 * np.pi)),
        )

    def with_variance(self, factor: float) -> Observed:
        """Return the transients with the assumed noise variance times `factor`."""
        root = float(np.sqrt(factor))
        return replace(
            self,
            whitened=self.whitened / root,
            observation=self.observation / root,
            log_normaliser=self.log_normaliser - self.n_values * float(np.log(root)),
        )

    def rows(self, chosen: slice) -> Observed:
        """Return some of the cases."""
        return replace(self, whitened=self.whitened[chosen])

    @property
    def n_cases(self) -> int:
        """Number of transients."""
        return len(self.whitened)

    @property
    def n_values(self) -> int:
        """Values in a transient: channels times samples."""
        _, n_channels, n_samples = self.whitened.shape
        return int(n_channels * n_samples)


def normal_equations(
    observed: Observed, coordinates: Coordinates, values: FloatArray, rows: NDArray[np.int64] | None = None
) -> NormalEquations:
    """Compute squares, gradient and information at coordinates (n, size), for the cases `rows` or all."""
    chosen = np.arange(observed.n_cases) if rows is None else rows
    centre, slope = model_slopes(coordinates, values, observed.dt_s)
    n, size = len(chosen), coordinates.size
    result = NormalEquations(np.empty(n), np.empty((n, size)), np.empty((n, size, size)))
    fill_normal_equations(
        chosen,
        *centre,
        *slope,
        observed.voltage_v,
        observed.whitened,
        observed.observation,
        *result,
    )
    return result


def common_equations(observed: Observed, coordinates: Coordinates, value: FloatArray) -> NormalEquations:
    """Compute `normal_equations` at one point, shape (size,), for all cases; one motor's slopes serve them all."""
    n, size, voltage = observed.n_cases, coordinates.size, observed.voltage_v
    states, slopes = _state_slopes(coordinates, value, observed.dt_s, voltage)
    moved = (observed.observation @ slopes).reshape(size, -1)
    residual = (observed.whitened - observed.observation @ states).reshape(n, -1)
    return NormalEquations(
        np.einsum("nk,nk->n", residual, residual),
        residual @ moved.T,
        np.broadcast_to(moved @ moved.T, (n, size, size)).copy(),
    )


def fitted_residuals(observed: Observed, coordinates: Coordinates, values: FloatArray) -> FloatArray:
    """Return measured less expected at coordinates (n, size), in units of the noise, as `observed.whitened`."""
    motors, supply = coordinates.motors(values)
    states = simulate_states(motors, supply[:, None] * observed.voltage_v, observed.dt_s)
    return observed.whitened - observed.observation @ states.swapaxes(1, 2)


def jacobian(
    coordinates: Coordinates, voltage_v: ArrayLike, sensor: SensorParameters, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return the nominal motor's response (n_channels, n_samples) and its derivative (..., size).

    `voltage_v` is the nominal voltage, shape (n_samples,).
    """
    voltage = np.ascontiguousarray(voltage_v, dtype=np.float64)
    states, slopes = _state_slopes(coordinates, np.zeros(coordinates.size), dt_s, voltage)
    response: FloatArray = sensor.observation @ states
    return response, np.einsum("cs,jsk->ckj", sensor.observation, slopes)


def _state_slopes(
    coordinates: Coordinates, value: FloatArray, dt_s: float, voltage_v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return states of one motor, (2, n_samples), and their slopes, (size, 2, n_samples)."""
    centre, slope = model_slopes(coordinates, value[None], dt_s)
    n_samples = len(voltage_v)
    states, slopes = np.empty((N_STATES, n_samples)), np.empty((coordinates.size, N_STATES, n_samples))
    motor = (part[0] for part in (*centre, *slope))
    fill_sensitivities(*motor, voltage_v, states, slopes)
    return states, slopes
