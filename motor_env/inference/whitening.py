"""Whitening of residuals of a motor known only up to its tolerances, and the matched test on them.

A residual that is white with unit variance for the nominal motor is, to first order, r = G z + e for a motor whose
nuisance coordinates are z ~ N(0, 1): its covariance is 1 + G G'. Recursive least squares (Plackett 1950) whitens it
causally.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import ndtr

from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import KalmanFilter
from motor_env.inference.posterior import class_coordinates
from motor_env.inference.sensitivities import jacobian
from motor_env.motor.compiled import njit
from motor_env.motor.faults import Fault, apply_fault
from motor_env.motor.parameters import FloatArray, MotorParameters, require
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.simulate import simulate_states


@njit(cache=True)
def _gains(slopes: FloatArray, gain: FloatArray, scale: FloatArray) -> None:
    """Compute gain and root variance of each sample's recursive least-squares step from N(0, 1)."""
    size = slopes.shape[1]
    covariance = np.eye(size)
    for k in range(slopes.shape[0]):
        ahead = covariance @ slopes[k]
        variance = 1.0 + np.dot(slopes[k], ahead)
        gain[k] = ahead / variance
        scale[k] = np.sqrt(variance)
        for i in range(size):
            for j in range(size):
                covariance[i, j] -= ahead[i] * ahead[j] / variance


@njit(cache=True)
def _whiten(
    residual: FloatArray, slopes: FloatArray, gain: FloatArray, scale: FloatArray, out: FloatArray
) -> None:
    size = slopes.shape[1]
    for n in range(residual.shape[0]):
        mean = np.zeros(size)
        for k in range(residual.shape[1]):
            error = residual[n, k]
            for j in range(size):
                error -= slopes[k, j] * mean[j]
            for j in range(size):
                mean[j] += gain[k, j] * error
            out[n, k] = error / scale[k]


@dataclass(frozen=True, slots=True)
class MarginalWhitener:
    """Removes the nuisances' effect from residuals and leaves them white with unit variance.

    Recursive least squares (Plackett 1950); the nuisances are considered states (Schmidt 1966).

    Attributes:
        slopes: G, the residual's change per standard deviation of each nuisance, shape (n_samples * n_channels,
            n_nuisances), sample by sample.
        gain: recursive least-squares gain of each sample, of the same shape.
        scale: standard deviation of each residual given the earlier ones, shape (n_samples * n_channels,).
    """

    slopes: FloatArray
    gain: FloatArray
    scale: FloatArray

    @classmethod
    def from_slopes(cls, slopes: ArrayLike) -> Self:
        """Return the whitener of G, shape (n_samples, n_channels, n_nuisances) or (n_values, n_nuisances)."""
        values = np.asarray(slopes, dtype=np.float64)
        flat = np.ascontiguousarray(values.reshape(int(np.prod(values.shape[:-1])), values.shape[-1]))
        gain, scale = np.empty_like(flat), np.empty(len(flat))
        _gains(flat, gain, scale)
        return cls(flat, gain, scale)

    def whiten(self, residual: ArrayLike) -> FloatArray:
        """Whiten residuals of shape (..., n_samples, n_channels), as `FilterResult.whitened`; NaN stays NaN.

        Raises:
            ValueError: the last two axes do not hold as many values as the slopes.
        """
        values = np.asarray(residual, dtype=np.float64)
        n_values = len(self.slopes)
        n_held = int(np.prod(values.shape[-2:]))
        require(
            values.ndim >= 2 and n_held == n_values,
            f"residual must hold {n_values} values a case, got {n_held}",
        )
        flat = np.ascontiguousarray(values.reshape(-1, n_values))
        out = np.empty_like(flat)
        missing = np.isnan(flat)
        if not missing.any():
            _whiten(flat, self.slopes, self.gain, self.scale, out)
            return out.reshape(values.shape)
        gain, scale = np.empty_like(self.gain), np.empty_like(self.scale)
        for row, absent, white in zip(flat, missing, out, strict=True):
            slopes = np.where(absent[:, None], 0.0, self.slopes)  # what was not measured depends on nothing
            _gains(slopes, gain, scale)
            _whiten(np.nan_to_num(row)[None], slopes, gain, scale, white[None])
            white[absent] = np.nan
        return out.reshape(values.shape)


def innovation_slopes(recipe: Recipe, belief: KalmanFilter) -> FloatArray:
    """Compute the change of the whitened innovations per standard deviation of each nuisance.

    The innovations' covariance is 1 + G G' (Kay 1993, ch. 10).

    Returns:
        G, shape (n_samples, n_channels, n_nuisances), for nuisances that have a spread.
    """
    voltage = recipe.nominal_voltage_v
    coordinates = class_coordinates(recipe, FaultClass())
    response, slopes = jacobian(coordinates, voltage, recipe.sensor, recipe.timing.dt_s)
    measured = np.concatenate([response[None], response + np.moveaxis(slopes, -1, 0)])
    whitened = run_filter(belief, measured, voltage).whitened
    return np.moveaxis(whitened[1:] - whitened[:1], 0, -1)


class StatisticLaw(NamedTuple):
    """Distribution of a test's statistic over motors and noise: a mixture of normals of one width.

    Attributes:
        means: values without noise at the quadrature's nodes.
        weights: of the nodes, summing to 1.
        std: of the statistic for one motor, from the measurement noise.
    """

    means: FloatArray
    weights: FloatArray
    std: float

    def above(self, threshold: float) -> float:
        """Return the probability of a statistic above the threshold."""
        return float(self.weights @ ndtr((self.means - threshold) / self.std))

    def beyond(self, threshold: float) -> float:
        """Return the probability of a magnitude above the threshold."""
        return self.above(threshold) + float(self.weights @ ndtr((-threshold - self.means) / self.std))


@dataclass(frozen=True, slots=True)
class MatchedTest:
    """The most powerful test of a known fault under unknown nuisances (Neyman & Pearson 1933).

    The statistic projects white residuals on the fault's signature; for healthy motors it is standard normal to first
    order in the tolerances. Thresholds and powers come from `law`, exact to the quadrature's error.

    Attributes:
        recipe: nominal motor, tolerances, sensor, timing.
        fault: the tested fault.
        belief: the filter of the nominal motor.
        whitener: for its whitened innovations.
        signature: effect of the fault on the white residual, shape (n_samples, n_channels).
    """

    recipe: Recipe
    fault: Fault
    belief: KalmanFilter
    whitener: MarginalWhitener
    signature: FloatArray

    @classmethod
    def from_recipe(cls, recipe: Recipe, fault: Fault) -> Self:
        """Return the test of a fault for motors of a recipe.

        Args:
            recipe: distribution of healthy motors.
            fault: of the motor, present from the beginning.

        Raises:
            ValueError: the fault has an onset in mid-run, or no effect on the motor.
        """
        require(fault.is_constant, f"onset_s must be that of a fault always there, got {fault.onset_s:g}")
        faulty = apply_fault(recipe.motor, fault)
        require(faulty != recipe.motor, f"fault must change the motor, got {fault.kind} of {fault.severity}")
        belief = KalmanFilter.from_parameters(
            recipe.motor, recipe.sensor, recipe.timing.dt_s, process_noise_std=(0.0, 0.0)
        )
        whitener = MarginalWhitener.from_slopes(innovation_slopes(recipe, belief))
        voltage = recipe.nominal_voltage_v
        whitened = [
            whitener.whiten(noise_free_innovations(recipe, belief, motor, voltage))
            for motor in (recipe.motor, faulty)
        ]
        return cls(recipe, fault, belief, whitener, whitened[1] - whitened[0])

    @property
    def separation(self) -> float:
        """d': distance of healthy and faulty, in standard deviations of the statistic, to first order."""
        return float(np.linalg.norm(self.signature))

    def statistic(self, measurements: ArrayLike) -> FloatArray:
        """Return the statistic, shape (n_cases,): mean near 0 for healthy motors, `separation` for faulty ones.

        Args:
            measurements: shape (n_cases, n_channels, n_samples).
        """
        voltage = self.recipe.nominal_voltage_v
        return self._project(run_filter(self.belief, measurements, voltage).whitened)

    def _project(self, innovations: FloatArray) -> FloatArray:
        direction = self.signature / self.separation
        statistic: FloatArray = np.tensordot(self.whitener.whiten(innovations), direction, axes=2)
        return statistic

    def law(self, *, faulty: bool = False) -> StatisticLaw:
        """Return the statistic's distribution over the recipe's motors, healthy or with the fault.

        A polynomial along the direction of the statistic's steepest change, Gauss-Hermite nodes across it.
        """
        slopes = np.moveaxis(self.whitener.slopes.reshape(*self.signature.shape, -1), -1, 0)
        gradient = self._project(slopes) if len(slopes) else np.zeros(0)
        std = float(np.sqrt(1.0 - gradient @ gradient))
        fault_class = FaultClass(self.fault.kind, float(self.fault.severity)) if faulty else FaultClass()
        coordinates = class_coordinates(self.recipe, fault_class)
        values, weights = _quadrature(gradient)
        motors, supply = coordinates.motors(values)
        nominal = self.recipe.nominal_voltage_v
        innovations = noise_free_innovations(self.recipe, self.belief, motors, supply[:, None] * nominal)
        means: FloatArray = self._project(innovations).reshape(-1, len(_ALONG))
        if not gradient.any():
            return StatisticLaw(means[:, 0], weights, std)
        fitted = np.polynomial.chebyshev.chebfit(_ALONG / _REACH, means.T, deg=_DEGREE)
        dense = np.asarray(np.polynomial.chebyshev.chebval(_DENSE / _REACH, fitted), dtype=np.float64)
        along = np.exp(-0.5 * np.square(_DENSE))
        return StatisticLaw(dense.ravel(), np.outer(weights, along / along.sum()).ravel(), std)

    def threshold_for(self, false_alarm_rate: float, *, two_sided: bool = False) -> float:
        """Return the threshold on the statistic (or its magnitude) for a false-alarm rate a transient."""
        require(0.0 < false_alarm_rate < 1.0, f"false_alarm_rate must be in (0, 1), got {false_alarm_rate:g}")
        law = self.law()
        rate = law.beyond if two_sided else law.above
        lowest = 0.0 if two_sided else float(law.means.min()) - 40.0 * law.std
        highest = float(np.abs(law.means).max()) + 40.0 * law.std
        return float(brentq(lambda threshold: rate(threshold) - false_alarm_rate, lowest, highest))

    def power(self, false_alarm_rate: float, *, two_sided: bool = False) -> float:
        """Return the share of the recipe's faulty motors with an alarm at that false-alarm rate."""
        threshold = self.threshold_for(false_alarm_rate, two_sided=two_sided)
        law = self.law(faulty=True)
        return law.beyond(threshold) if two_sided else law.above(threshold)


_REACH = 6.0
_ALONG = np.linspace(-_REACH, _REACH, 17)
_DENSE = np.linspace(-_REACH, _REACH, 2401)
_DEGREE = 8
_ACROSS = 3  # Gauss-Hermite nodes of each direction across: exact to the fifth power of a tolerance


def _quadrature(gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return nodes, shape (n_across * n_along, size), and the weights of the nodes across, (n_across,)."""
    size = len(gradient)
    if not gradient.any():
        return np.zeros((len(_ALONG), size)), np.ones(1)
    # A basis whose first axis is the gradient.
    basis, _ = np.linalg.qr(np.column_stack([gradient, np.eye(size)]))
    nodes, weights = np.polynomial.hermite_e.hermegauss(_ACROSS)
    grid = np.stack(np.meshgrid(*[nodes] * (size - 1), indexing="ij"), axis=-1).reshape(-1, size - 1)
    share: FloatArray = np.stack(np.meshgrid(*[weights / weights.sum()] * (size - 1), indexing="ij")).reshape(
        size - 1, -1
    )
    rotated = np.empty((len(grid), len(_ALONG), size))
    rotated[..., 0] = _ALONG
    rotated[..., 1:] = grid[:, None, :]
    return rotated.reshape(-1, size) @ basis.T, share.prod(axis=0)


def noise_free_innovations(
    recipe: Recipe, belief: KalmanFilter, motors: MotorParameters, voltage_v: FloatArray
) -> FloatArray:
    """Return whitened innovations of motors without noise, shape (n_motors, n_samples, n_channels)."""
    states = simulate_states(motors, voltage_v, recipe.timing.dt_s)
    nominal = recipe.nominal_voltage_v
    return run_filter(belief, recipe.sensor.observation @ np.moveaxis(states, -1, -2), nominal).whitened
