"""How the linear motor's measured response moves with its parameters: what every fit, bound and posterior stands on.

`normal_equations` gives, for a batch, the weighted sum of squared residuals of a measured transient, its gradient and
its Fisher information (Gauss 1809; Ljung 1999, ch. 10).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import instance, numbers
from motor_env.inference.kernels import fill_normal_equations, fill_sensitivities
from motor_env.inference.parametrisation import Coordinates, model_slopes
from motor_env.motor.model import N_STATES
from motor_env.motor.parameters import FloatArray, SensorParameters, require
from motor_env.simulation.simulate import simulate_states


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
    """Measured transients in units of their noise, all from rest, and what drove them.

    Attributes:
        whitened: measurements divided by the noise's standard deviation, shape (n_cases, n_channels, n_samples).
        voltage_v: nominal voltage of all, shape (n_samples,).
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
        """Check and whiten.

        Args:
            measurements: shape (n_cases, n_channels, n_samples), or (n_channels, n_samples) for one case.
            voltage_v: nominal voltage held in each interval, shape (n_samples,).
            sensor: channels, and the noise that is believed.
            dt_s: sampling interval.

        Raises:
            ValueError: shapes do not fit, a value is not finite, or a channel is believed to have no noise.
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
        """These transients, with the noise's variance believed to be `factor` times as large."""
        root = float(np.sqrt(factor))
        return replace(
            self,
            whitened=self.whitened / root,
            observation=self.observation / root,
            log_normaliser=self.log_normaliser - self.n_values * float(np.log(root)),
        )

    def rows(self, chosen: slice) -> Observed:
        """Some of the cases."""
        return replace(self, whitened=self.whitened[chosen])

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
    """`normal_equations` at one point, shape (size,), for all cases: one motor's slopes serve them all."""
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
    """Measured less expected at coordinates of shape (n, size), in units of the noise, shape as `observed.whitened`."""
    motors, supply = coordinates.motors(values)
    states = simulate_states(motors, supply[:, None] * observed.voltage_v, observed.dt_s)
    return observed.whitened - observed.observation @ states.swapaxes(1, 2)


def jacobian(
    coordinates: Coordinates, voltage_v: ArrayLike, sensor: SensorParameters, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Response of the nominal motor from rest, (n_channels, n_samples), and its derivative, with `size` behind that.

    Args:
        coordinates: what the derivative is taken with respect to.
        voltage_v: nominal voltage, shape (n_samples,).
        sensor: channels.
        dt_s: sampling interval.
    """
    voltage = np.ascontiguousarray(voltage_v, dtype=np.float64)
    states, slopes = _state_slopes(coordinates, np.zeros(coordinates.size), dt_s, voltage)
    response: FloatArray = sensor.observation @ states
    return response, np.einsum("cs,jsk->ckj", sensor.observation, slopes)


def _state_slopes(
    coordinates: Coordinates, value: FloatArray, dt_s: float, voltage_v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States of one motor, (2, n_samples), and their slopes, (size, 2, n_samples)."""
    centre, slope = model_slopes(coordinates, value[None], dt_s)
    n_samples = len(voltage_v)
    states, slopes = np.empty((N_STATES, n_samples)), np.empty((coordinates.size, N_STATES, n_samples))
    motor = (part[0] for part in (*centre, *slope))
    fill_sensitivities(*motor, voltage_v, states, slopes)
    return states, slopes
