"""White residuals of a motor that is known only up to its tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from motor_env.common.arrays import instance, numbers, real
from motor_env.filters.batch import FilterStream, run_filter
from motor_env.filters.kalman import KalmanFilter
from motor_env.inference.posterior import class_coordinates
from motor_env.inference.whitening import MarginalWhitener, noise_free_innovations
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import FaultClass, Recipe

# Standard deviations of the noise: a direction of the tolerances that moves the residual by less is left out.
_UNSEEN = 0.01


@dataclass(frozen=True, slots=True)
class TolerantFilter:
    """Filter of a recipe's nominal motor, with a whitening that removes the effect of the tolerances.

    The tolerances are considered states (Schmidt 1966; second order: Athans et al. 1968).

    Attributes:
        belief: filter of the nominal motor.
        voltage_v: nominal voltage, shape (n_samples,).
        bias: mean effect of the tolerances on the whitened innovation, shape (n_samples, n_channels).
        whitener: whitens with S + J P J' (`motor_env.inference.whitening`).
    """

    belief: KalmanFilter
    voltage_v: FloatArray
    bias: FloatArray
    whitener: MarginalWhitener

    def __post_init__(self) -> None:
        instance("belief", self.belief, KalmanFilter)
        instance("whitener", self.whitener, MarginalWhitener)
        voltage = numbers("voltage_v", self.voltage_v, ("n_samples",))
        bias = numbers("bias", self.bias, (len(voltage), len(self.belief.observation)))
        object.__setattr__(self, "voltage_v", voltage)
        object.__setattr__(self, "bias", bias)

    @classmethod
    def from_recipe(cls, recipe: Recipe) -> Self:
        """Return the filter of the recipe's motor, supply, tolerances, sensor and timing."""
        instance("recipe", recipe, Recipe)
        recipe.require_step()
        belief = KalmanFilter.from_parameters(
            recipe.motor, recipe.sensor, recipe.timing.dt_s, process_noise_std=(0.0, 0.0)
        )
        bias, slopes = second_order(recipe, belief)
        voltage = recipe.nominal_voltage_v
        return cls(belief, voltage, bias, MarginalWhitener.from_slopes(_significant_directions(slopes)))

    def white(self, measurements: ArrayLike) -> FloatArray:
        """Return residuals, white for healthy motors of the recipe, shape (..., n_samples, n_channels).

        Args:
            measurements: whole transients, shape (..., n_channels, n_samples).
        """
        shape = ("...", len(self.belief.observation), len(self.voltage_v))
        measured = real("measurements", measurements, shape, single=True)
        innovation = run_filter(self.belief, measured, self.voltage_v).whitened
        return self.whitener.whiten(innovation - self.bias)

    def stream(self, n_streams: int = 1) -> TolerantStream:
        """Return a running copy of the filter, fed one sample at a time."""
        return TolerantStream(self, n_streams)


class TolerantStream:
    """Running tolerant filter: `update(sample)` gives what `TolerantFilter.white` gives at that sample.

    Recursive least squares (Plackett 1950) estimate each motor's tolerances.
    """

    def __init__(self, tolerant: TolerantFilter, n_streams: int) -> None:
        size = tolerant.whitener.slopes.shape[-1]
        self._filter = FilterStream(tolerant.belief, n_streams)
        self.tolerant, self.n_streams = tolerant, self._filter.n_streams
        self._slopes = tolerant.whitener.slopes.reshape(*tolerant.bias.shape, size)
        self._mean = np.zeros((n_streams, size))
        self._covariance = np.broadcast_to(np.eye(size), (n_streams, size, size)).copy()
        self._at = 0

    def update(self, measurement: ArrayLike) -> FloatArray:
        """Return the white residual of one more sample, shape (n_streams, n_channels), from measurements of that shape.

        Raises:
            ValueError: the transient is over.
        """
        end = len(self.tolerant.bias)
        require(self._at < end, f"a transient of the recipe has {end} samples, got one more")
        innovation = self._filter.update(measurement, self.tolerant.voltage_v[self._at]).whitened
        residual, white = innovation - self.tolerant.bias[self._at], np.full(innovation.shape, np.nan)
        for channel, slope in enumerate(self._slopes[self._at]):
            is_measured = ~np.isnan(residual[:, channel])
            ahead = self._covariance @ slope
            variance = 1.0 + ahead @ slope
            error = np.where(is_measured, residual[:, channel] - self._mean @ slope, 0.0)
            ahead *= (is_measured / np.sqrt(variance))[:, None]
            self._mean += ahead * (error / np.sqrt(variance))[:, None]
            self._covariance -= ahead[:, :, None] * ahead[:, None, :]
            white[is_measured, channel] = (error / np.sqrt(variance))[is_measured]
        self._at += 1
        return white


def second_order(recipe: Recipe, belief: KalmanFilter) -> tuple[FloatArray, FloatArray]:
    """Return the whitened innovation's mean over healthy motors, and its slopes, to second order.

    With tolerances z ~ N(0, 1) the innovation is r = G z + z'Hz / 2 + e. The products z_i z_j and (z_i^2 - 1) /
    sqrt(2) are uncorrelated, of unit variance, and count as further tolerances (Athans, Wishner & Bertolini 1968).

    Returns:
        Mean, shape (n_samples, n_channels); slopes, shape (n_samples, n_channels, n_slopes).
    """
    coordinates = class_coordinates(recipe, FaultClass())
    size = coordinates.size

    def response(values: FloatArray) -> FloatArray:
        motors, supply = coordinates.motors(values)
        return noise_free_innovations(recipe, belief, motors, supply[:, None] * recipe.nominal_voltage_v)

    middle = response(np.zeros((1, size)))[0]
    if size == 0:
        return middle, np.zeros((*middle.shape, 0))
    unit = np.eye(size)
    up, down = response(unit), response(-unit)
    bent = up + down - 2.0 * middle
    first, second = np.triu_indices(size, 1)
    mixed = 0.25 * (
        response(unit[first] + unit[second])
        - response(unit[first] - unit[second])
        - response(unit[second] - unit[first])
        + response(-unit[first] - unit[second])
    )
    slopes = np.concatenate([0.5 * (up - down), bent / np.sqrt(2.0), mixed])
    return middle + 0.5 * bent.sum(axis=0), np.moveaxis(slopes, 0, -1)


def _significant_directions(slopes: FloatArray) -> FloatArray:
    """Return the slopes along the principal components above the noise (Hotelling 1933)."""
    if slopes.shape[-1] == 0:
        return slopes
    left, sizes, _ = np.linalg.svd(slopes.reshape(-1, slopes.shape[-1]), full_matrices=False)
    count = int((sizes > _UNSEEN).sum())
    directions: FloatArray = (left[:, :count] * sizes[:count]).reshape(*slopes.shape[:-1], count)
    return directions
