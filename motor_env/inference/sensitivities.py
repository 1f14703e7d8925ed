"""How the linear motor's measured response moves with its parameters: what every fit, bound and posterior stands on.

`normal_equations` gives, for a batch, the weighted sum of squared residuals of a measured transient, its gradient and
its Fisher information (Gauss 1809; Ljung 1999, ch. 10).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from motor_env.inference.parametrisation import Coordinates, discrete_models, model_slopes
from motor_env.motor.model import N_STATES
from motor_env.motor.parameters import FloatArray, SensorParameters, require

__all__ = [
    "Coordinates",
    "NormalEquations",
    "Observed",
    "common_equations",
    "fitted_residuals",
    "jacobian",
    "normal_equations",
]


@njit(cache=True)
def _states(
    transition: FloatArray,
    gain: FloatArray,
    voltage: FloatArray,
    load: FloatArray,
    initial_state: FloatArray,
    states: FloatArray,
) -> None:
    """One motor's states, (2, n_samples), by the exact recursion x[k+1] = A x[k] + B u[k]."""
    a00, a01, a10, a11 = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
    b00, b01, b10, b11 = gain[0, 0], gain[0, 1], gain[1, 0], gain[1, 1]
    x0, x1 = initial_state[0], initial_state[1]
    for k in range(states.shape[1]):
        v, t = voltage[k], load[k]
        x0, x1 = (
            a00 * x0 + a01 * x1 + b00 * v + b01 * t,
            a10 * x0 + a11 * x1 + b10 * v + b11 * t,
        )
        states[0, k], states[1, k] = x0, x1


@njit(cache=True)
def _sensitivities(
    transition: FloatArray,
    gain: FloatArray,
    transition_slope: FloatArray,
    gain_slope: FloatArray,
    voltage: FloatArray,
    load: FloatArray,
    initial_state: FloatArray,
    states: FloatArray,
    slopes: FloatArray,
) -> None:
    """One motor's states, (2, n_samples), and their derivatives, (size, 2, n_samples), by the exact recursion.

    s[k+1] = A s[k] + A' x[k] + B' u[k]; the initial state does not depend on the parameters.
    """
    _states(transition, gain, voltage, load, initial_state, states)
    a00, a01, a10, a11 = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
    for j in range(slopes.shape[0]):
        d00, d01 = transition_slope[j, 0, 0], transition_slope[j, 0, 1]
        d10, d11 = transition_slope[j, 1, 0], transition_slope[j, 1, 1]
        e00, e01 = gain_slope[j, 0, 0], gain_slope[j, 0, 1]
        e10, e11 = gain_slope[j, 1, 0], gain_slope[j, 1, 1]
        x0, x1 = initial_state[0], initial_state[1]
        s0, s1 = 0.0, 0.0
        for k in range(states.shape[1]):
            v, t = voltage[k], load[k]
            f0 = d00 * x0 + d01 * x1 + e00 * v + e01 * t
            f1 = d10 * x0 + d11 * x1 + e10 * v + e11 * t
            s0, s1 = a00 * s0 + a01 * s1 + f0, a10 * s0 + a11 * s1 + f1
            slopes[j, 0, k], slopes[j, 1, k] = s0, s1
            x0, x1 = states[0, k], states[1, k]


@njit(cache=True)
def _normal_equations(
    rows: NDArray[np.int64],
    transition: FloatArray,
    gain: FloatArray,
    transition_slope: FloatArray,
    gain_slope: FloatArray,
    voltage: FloatArray,
    load: FloatArray,
    measurements: FloatArray,
    observation: FloatArray,
    initial_state: FloatArray,
    chi2: FloatArray,
    gradient: FloatArray,
    information: FloatArray,
) -> None:
    """Weighted squares, J'r and J'J of each row; `observation` is C divided by the noise, as `measurements` are."""
    n_channels, n_samples, size = measurements.shape[1], measurements.shape[2], gradient.shape[1]
    states = np.empty((N_STATES, n_samples))
    slopes = np.empty((size, N_STATES, n_samples))
    residual = np.empty(n_samples)
    jacobian = np.empty((size, n_samples))
    for n in range(rows.shape[0]):
        row = rows[n]
        _sensitivities(
            transition[n],
            gain[n],
            transition_slope[n],
            gain_slope[n],
            voltage[row if voltage.shape[0] > 1 else 0],
            load[row if load.shape[0] > 1 else 0],
            initial_state,
            states,
            slopes,
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


@njit(cache=True)
def _residuals(
    transition: FloatArray,
    gain: FloatArray,
    voltage: FloatArray,
    load: FloatArray,
    measurements: FloatArray,
    observation: FloatArray,
    initial_state: FloatArray,
    residual: FloatArray,
) -> None:
    """Measured less expected of each case, of the shape of `measurements`; no state outlives its case."""
    states = np.empty((N_STATES, measurements.shape[2]))
    for n in range(measurements.shape[0]):
        own_voltage = voltage[n if voltage.shape[0] > 1 else 0]
        own_load = load[n if load.shape[0] > 1 else 0]
        _states(transition[n], gain[n], own_voltage, own_load, initial_state, states)
        for m in range(measurements.shape[1]):
            c0, c1 = observation[m, 0], observation[m, 1]
            for k in range(measurements.shape[2]):
                residual[n, m, k] = measurements[n, m, k] - c0 * states[0, k] - c1 * states[1, k]


class NormalEquations(NamedTuple):
    """At given coordinates, for each case: what a Gauss-Newton step needs.

    Attributes:
        chi2: sum of squared residuals in units of the noise, shape (n,).
        gradient: J' r, shape (n, size): minus half the gradient of chi2.
        information: J' J, the Fisher information, shape (n, size, size).
    """

    chi2: FloatArray
    gradient: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True)
class Observed:
    """Measured transients in units of their noise, and what drove them.

    Attributes:
        whitened: measurements divided by the noise's standard deviation, shape (n_cases, n_channels, n_samples).
        voltage_v: nominal voltage, shape (1 or n_cases, n_samples).
        dt_s: sampling interval.
        observation: C divided by the noise, shape (n_channels, 2).
        log_normaliser: log-likelihood of a transient with chi2 = 0.
        initial_state: state before the first interval, shape (2,).
        load_torque_n_m: known load, shape (1 or n_cases, n_samples).
    """

    whitened: FloatArray
    voltage_v: FloatArray
    dt_s: float
    observation: FloatArray
    log_normaliser: float
    initial_state: FloatArray
    load_torque_n_m: FloatArray

    @classmethod
    def of(
        cls,
        measurements: ArrayLike,
        voltage_v: ArrayLike,
        sensor: SensorParameters,
        dt_s: float,
        initial_state: ArrayLike = (0.0, 0.0),
        load_torque_n_m: ArrayLike = 0.0,
    ) -> Observed:
        """Check and whiten.

        Args:
            measurements: shape (n_cases, n_channels, n_samples), or (n_channels, n_samples) for one case.
            voltage_v: nominal voltage held in each interval, shape (n_samples,) or (n_cases, n_samples).
            sensor: channels, and the noise that is believed.
            dt_s: sampling interval.
            initial_state: known current and speed before the first interval.
            load_torque_n_m: known load, a scalar or the shape of `voltage_v`.

        Raises:
            ValueError: shapes do not fit, a value is not finite, or a channel is believed to have no noise.
        """
        measured = np.asarray(measurements, dtype=np.float64)
        measured = measured[None] if measured.ndim == 2 else measured
        n_channels = len(sensor.channels)
        require(
            measured.ndim == 3 and measured.shape[1] == n_channels,
            f"measurements must have shape (n_cases, {n_channels}, n_samples), got {np.shape(measurements)}",
        )
        require(bool(np.isfinite(measured).all()), "measurements must be finite, got a value that is not")
        std = sensor.noise_std
        require(bool((std > 0.0).all()), f"noise of each channel must be > 0, got {std}")
        voltage = np.atleast_2d(np.asarray(voltage_v, dtype=np.float64))
        require(
            voltage.shape[-1] == measured.shape[-1] and voltage.shape[0] in (1, len(measured)),
            f"voltage_v must have shape ({measured.shape[-1]},) or {(len(measured), measured.shape[-1])}, "
            f"got {np.shape(voltage_v)}",
        )
        load = np.broadcast_to(np.asarray(load_torque_n_m, dtype=np.float64), voltage.shape)
        for name, driving in (("voltage_v", voltage), ("load_torque_n_m", load)):
            require(bool(np.isfinite(driving).all()), f"{name} must be finite, got a value that is not")
        n_samples = measured.shape[-1]
        return cls(
            whitened=np.ascontiguousarray(measured / std[:, None]),
            voltage_v=np.ascontiguousarray(voltage),
            dt_s=float(dt_s),
            observation=sensor.observation / std[:, None],
            log_normaliser=-n_samples * float(np.log(std).sum() + 0.5 * n_channels * np.log(2.0 * np.pi)),
            initial_state=np.asarray(initial_state, dtype=np.float64),
            load_torque_n_m=np.ascontiguousarray(load),
        )

    def with_variance(self, factor: float) -> Observed:
        """The same transients, with the noise's variance believed to be `factor` times as large."""
        root = float(np.sqrt(factor))
        return replace(
            self,
            whitened=self.whitened / root,
            observation=self.observation / root,
            log_normaliser=self.log_normaliser - self.n_values * float(np.log(root)),
        )

    def rows(self, chosen: slice) -> Observed:
        """Some of the cases."""
        voltage, load = (
            series if len(series) == 1 else series[chosen]
            for series in (self.voltage_v, self.load_torque_n_m)
        )
        return replace(self, whitened=self.whitened[chosen], voltage_v=voltage, load_torque_n_m=load)

    @property
    def n_cases(self) -> int:
        """Number of transients."""
        return len(self.whitened)

    @property
    def n_values(self) -> int:
        """Numbers measured in a transient: channels times samples."""
        _, n_channels, n_samples = self.whitened.shape
        return int(n_channels * n_samples)


def normal_equations(
    observed: Observed, coordinates: Coordinates, values: FloatArray, rows: NDArray[np.int64] | None = None
) -> NormalEquations:
    """Squares, gradient and information (Gauss 1809) at coordinates of shape (n, size), for the cases `rows` or all."""
    chosen = np.arange(observed.n_cases) if rows is None else rows
    centre, slope = model_slopes(coordinates, values, observed.dt_s)
    n, size = len(chosen), coordinates.size
    result = NormalEquations(np.empty(n), np.empty((n, size)), np.empty((n, size, size)))
    _normal_equations(
        chosen,
        *centre,
        *slope,
        observed.voltage_v,
        observed.load_torque_n_m,
        observed.whitened,
        observed.observation,
        observed.initial_state,
        *result,
    )
    return result


def common_equations(observed: Observed, coordinates: Coordinates, value: FloatArray) -> NormalEquations:
    """`normal_equations` at one point, shape (size,), for all cases: one motor's slopes serve them all.

    Cases with voltages or loads of their own have none in common.
    """
    n, size = observed.n_cases, coordinates.size
    if len(observed.voltage_v) > 1 or len(observed.load_torque_n_m) > 1:
        return normal_equations(observed, coordinates, np.broadcast_to(value, (n, size)))
    centre, slope = model_slopes(coordinates, value[None], observed.dt_s)
    n_samples = observed.voltage_v.shape[1]
    states, slopes = np.empty((N_STATES, n_samples)), np.empty((size, N_STATES, n_samples))
    driving = observed.voltage_v[0], observed.load_torque_n_m[0], observed.initial_state
    _sensitivities(*(part[0] for part in (*centre, *slope)), *driving, states, slopes)
    moved = (observed.observation @ slopes).reshape(size, -1)
    residual = (observed.whitened - observed.observation @ states).reshape(n, -1)
    return NormalEquations(
        np.einsum("nk,nk->n", residual, residual),
        residual @ moved.T,
        np.broadcast_to(moved @ moved.T, (n, size, size)).copy(),
    )


def fitted_residuals(observed: Observed, coordinates: Coordinates, values: FloatArray) -> FloatArray:
    """Measured less expected at coordinates of shape (n, size), in units of the noise, shape as `observed.whitened`."""
    model = discrete_models(coordinates, values, observed.dt_s)
    left = np.empty_like(observed.whitened)
    _residuals(
        *(np.ascontiguousarray(part) for part in model),
        observed.voltage_v,
        observed.load_torque_n_m,
        observed.whitened,
        observed.observation,
        observed.initial_state,
        left,
    )
    return left


def jacobian(
    coordinates: Coordinates,
    voltage_v: ArrayLike,
    sensor: SensorParameters,
    dt_s: float,
    values: ArrayLike | None = None,
    initial_state: ArrayLike = (0.0, 0.0),
    load_torque_n_m: ArrayLike = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Response (n_channels, n_samples) of one motor and its derivative (n_channels, n_samples, size), physical units.

    Args:
        coordinates: what the derivative is taken with respect to.
        voltage_v: nominal voltage, shape (n_samples,).
        sensor: channels.
        dt_s: sampling interval.
        values: coordinates of the motor, shape (size,); the nominal motor by default.
        initial_state: known current and speed before the first interval.
        load_torque_n_m: known load, scalar or shape (n_samples,).
    """
    at = np.zeros(coordinates.size) if values is None else np.asarray(values, dtype=np.float64)
    voltage = np.ascontiguousarray(voltage_v, dtype=np.float64)
    centre, slope = model_slopes(coordinates, at[None], dt_s)
    states = np.empty((N_STATES, voltage.size))
    slopes = np.empty((coordinates.size, N_STATES, voltage.size))
    _sensitivities(
        centre.transition[0],
        centre.gain[0],
        slope.transition[0],
        slope.gain[0],
        voltage,
        np.ascontiguousarray(np.broadcast_to(np.asarray(load_torque_n_m, dtype=np.float64), voltage.shape)),
        np.asarray(initial_state, dtype=np.float64),
        states,
        slopes,
    )
    response: FloatArray = sensor.observation @ states
    return response, np.einsum("cs,jsk->ckj", sensor.observation, slopes)
