"""The mass of a normal distribution in a box, by separation of variables (Genz 1992)."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from motor_env.motor.parameters import FloatArray


def mirrored(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
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
        sign, below, mass = mirrored(*ends)
        normal[:, i] = sign * ndtri_exp(np.logaddexp(below, share + mass))
        masses += mass
    return masses
