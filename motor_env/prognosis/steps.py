"""Wear in steps: a compound Poisson process, seen through noisy estimates.

    x(t) = x0 + sum of the steps until t,  steps at `rate`,  each Gamma(4) with mean `size`, towards the limit
    y_i  = x(t_i) + e_i,  var e_i = se_i^2 + scatter^2

The level stands on a grid. Between estimates its density is convolved with that of the steps, whose characteristic
function is exp(rate t (phi - 1)); at an estimate it is multiplied by the likelihood. Steps never lead back, so the
limit has been reached by t just where x(t) lies beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, ndtr

from motor_env.motor.parameters import FloatArray

_RATES = np.geomspace(0.5, 8.0, 5)  # steps in the time observed
_SIZES = np.array([0.2, 0.4])  # mean, in distances to the limit
_SHAPE = 4.0  # of the steps' gamma distribution: their standard deviation is half their mean
_BELOW, _ABOVE, _POINTS = 0.6, 1.4, 128  # the grid of levels, in distances from the beginning
# A cyclic convolution brings round what leaves the grid; densities are kept times exp(-damping * place).
_DAMP = np.exp(-20.0 * np.arange(_POINTS) / _POINTS)


@dataclass(frozen=True, slots=True)
class Steps:
    """Levels at the last estimate by the law of steps; the upward direction is to the limit.

    Attributes:
        density: of rate and size, and level, damped; undamped it sums to 1, shape (k, points).
        exponent: rate (phi - 1) of each rate and size, shape (k, points + 1).
        grid: levels, shape (points,).
        pace: mean wear a unit of time, of each rate and size, shape (k,).
        variance: of the wear a unit of time, shape (k,).
        limit_error: standard deviation of the limit.
    """

    density: FloatArray
    exponent: NDArray[np.complex128]
    grid: FloatArray
    pace: FloatArray
    variance: FloatArray
    limit_error: float

    @property
    def mean_pace(self) -> float:
        """Posterior mean of the wear a unit of time."""
        return float((self.density / _DAMP).sum(axis=1) @ self.pace)

    def probability_beyond(self, limit: float, after: FloatArray) -> FloatArray:
        """Probability that the level lies beyond a limit after each of some times, in the shape of `after`."""
        moved = _convolved(self.density, np.exp(after[:, None, None] * self.exponent)).sum(axis=1)
        width = self.grid[1] - self.grid[0]
        within = ndtr((limit - self.grid) / np.hypot(self.limit_error, 0.3 * width))
        return np.asarray(np.clip(1.0 - moved / _DAMP @ within, 0.0, 1.0))

    def moments(self, ahead: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and mean square of the level at times after the last estimate."""
        share = self.density / _DAMP
        each, first, second = share.sum(axis=1), share @ self.grid, share @ self.grid**2
        mean = first.sum() + ahead * (each @ self.pace)
        square = second.sum() + ahead * (2.0 * first @ self.pace + each @ self.variance)
        return mean, square + ahead**2 * (each @ self.pace**2)


def _convolved(density: FloatArray, factor: NDArray[np.complex128]) -> FloatArray:
    return np.maximum(np.fft.irfft(np.fft.rfft(density, 2 * _POINTS) * factor)[..., :_POINTS], 0.0)


def fit_steps(
    times: FloatArray,
    estimate: FloatArray,
    variance: FloatArray,
    scatter: tuple[FloatArray, FloatArray],
    *,
    beginning: float,
    distance: float,
    level_std: float,
    limit_errors: float,
) -> tuple[float, Steps]:
    """Fit the law of steps to estimates whose direction to the limit is upward.

    Args:
        times: rising, shape (n,).
        estimate: shape (n,).
        variance: of each estimate, shape (n,).
        scatter: standard deviations beyond the errors, and their prior probabilities.
        beginning: level at the beginning.
        distance: from there to the limit.
        level_std: prior standard deviation of the first level about the first estimate.
        limit_errors: standard deviation of the limit, in those of an estimate.

    Returns:
        The logarithm of the law's evidence, and the law.
    """
    grid = beginning + distance * np.linspace(-_BELOW, _ABOVE, _POINTS)
    width = grid[1] - grid[0]
    rate, size = np.reshape(
        np.meshgrid(_RATES / (times[-1] - times[0]), _SIZES * distance, indexing="ij"), (2, -1)
    )
    edges = np.maximum(np.arange(_POINTS + 1) - 0.5, 0.0) * width
    sizes = np.diff(gammainc(_SHAPE, _SHAPE * edges / size[:, None]), axis=1)
    exponent = rate[:, None] * (np.fft.rfft(sizes * _DAMP, 2 * _POINTS) - 1.0)
    start = (
        np.exp(-0.5 * ((grid - estimate[0]) / level_std) ** 2) * width / (level_std * np.sqrt(2.0 * np.pi))
    )
    shape = (len(scatter[0]), len(rate), _POINTS)
    density = np.broadcast_to(scatter[1][:, None, None] / len(rate) * start * _DAMP, shape)
    log_evidence, factor, before = 0.0, np.ones(1, complex), 0.0
    for i, step in enumerate(np.diff(times, prepend=times[0])):
        if step > 0.0:
            factor = factor if step == before else np.exp(step * exponent)
            before, density = step, _convolved(density, factor)
        # A level lies anywhere within a point's width.
        spread = np.sqrt(variance[i] + scatter[0] ** 2 + width**2 / 12.0)[:, None]
        z = (estimate[i] - grid) / spread
        likelihood = np.exp(-0.5 * z**2) / (spread * np.sqrt(2.0 * np.pi))
        density = density * likelihood[:, None]
        total = max(float((density / _DAMP).sum()), 1e-290)
        log_evidence, density = log_evidence + float(np.log(total)), density / total
    by_scatter = (density / _DAMP).sum(axis=(1, 2))
    error = limit_errors * float(np.sqrt(np.median(variance) + by_scatter @ scatter[0] ** 2))
    mean_square = size**2 * (1.0 + 1.0 / _SHAPE)
    return log_evidence, Steps(density.sum(axis=0), exponent, grid, rate * size, rate * mean_square, error)
