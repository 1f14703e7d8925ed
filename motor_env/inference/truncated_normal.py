"""A normal distribution cut to a box, by separation of variables (Genz 1992): draws, their density, and its mass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr, ndtri_exp

from motor_env.motor.parameters import FloatArray

_LOG_2PI = float(np.log(2.0 * np.pi))


def _left(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """An interval mirrored to where the normal distribution's tail keeps its digits.

    Returns:
        The sign of the mirror, the log probability of what lies left of the interval, and that of the interval.
    """
    sign = np.where(low > 0.0, -1.0, 1.0)
    below, above = (
        log_ndtr(np.minimum(sign * low, sign * high)),
        log_ndtr(np.maximum(sign * low, sign * high)),
    )
    return sign, below, above + np.log(-np.expm1(below - above))


@dataclass(frozen=True, slots=True)
class TruncatedNormal:
    """A normal distribution cut to a box, as a product of normal intervals, one coordinate given those before it.

    A draw's density is that of this product, which the distribution itself is only nearly.

    Attributes:
        order: of the coordinates; those go first whose interval is hardest to hit.
        mean: before the cut, in this order, shape (size,).
        root: Cholesky factor of the covariance before the cut, in this order.
        low: of the box in this order; may be -inf.
        high: may be inf.
    """

    order: NDArray[np.intp]
    mean: FloatArray
    root: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def cut(cls, mean: FloatArray, precision: FloatArray, low: FloatArray, high: FloatArray) -> Self:
        """From mean and inverse covariance before the cut, and the box."""
        order = np.argsort(np.minimum(mean - low, high - mean))
        covariance = np.linalg.inv(precision)
        root = np.linalg.cholesky(covariance[np.ix_(order, order)])
        return cls(order, mean[order], root, low[order], high[order])

    def draw(self, rng: np.random.Generator, n_draws: int) -> FloatArray:
        """Draws, shape (n_draws, size)."""
        size = len(self.mean)
        share, normal, values = (
            rng.random((size, n_draws)),
            np.zeros((size, n_draws)),
            np.empty((n_draws, size)),
        )
        for i, scale in enumerate(np.diagonal(self.root)):
            centre = self.mean[i] + self.root[i, :i] @ normal[:i]
            sign, below, mass = _left((self.low[i] - centre) / scale, (self.high[i] - centre) / scale)
            normal[i] = sign * ndtri_exp(np.logaddexp(below, np.log(share[i]) + mass))
            values[:, self.order[i]] = np.clip(centre + scale * normal[i], self.low[i], self.high[i])
        return values

    def log_density(self, values: FloatArray) -> FloatArray:
        """Log density of draws at values of shape (n, size)."""
        ordered = values[:, self.order]
        normal = solve_triangular(self.root, (ordered - self.mean).T, lower=True).T
        scale = np.diagonal(self.root)
        centre = ordered - scale * normal
        _, _, mass = _left((self.low - centre) / scale, (self.high - centre) / scale)
        logs: FloatArray = (-0.5 * (np.square(normal) + _LOG_2PI) - np.log(scale) - mass).sum(axis=1)
        return logs


def log_box_masses(
    mean: FloatArray, precision: FloatArray, low: FloatArray, high: FloatArray, shares: FloatArray
) -> FloatArray:
    """Logarithms whose mean exponential is the mass of a normal distribution in a box, shape (n, n_draws).

    Args:
        mean: of n distributions before the cut, shape (n, size).
        precision: their inverse covariances, shape (n, size, size).
        low: of the box, shape (size,).
        high: the same.
        shares: uniform draws in 0 .. 1, the same for all, shape (size, n_draws).
    """
    n, size = mean.shape
    order = np.argsort(np.minimum(mean - low, high - mean), axis=1)
    rows = np.arange(n)[:, None]
    covariance = np.linalg.inv(precision)[rows[..., None], order[:, :, None], order[:, None, :]]
    root, centres = np.linalg.cholesky(covariance), mean[rows, order]
    normal, masses = np.zeros((n, size, shares.shape[1])), np.zeros((n, shares.shape[1]))
    for i, share in enumerate(np.log(shares)):
        centre = centres[:, i, None] + np.einsum("nj,njm->nm", root[:, i, :i], normal[:, :i])
        scale = root[:, i, i, None]
        ends = ((end[order[:, i], None] - centre) / scale for end in (low, high))
        sign, below, mass = _left(*ends)
        normal[:, i] = sign * ndtri_exp(np.logaddexp(below, share + mass))
        masses += mass
    return masses
