"""The spread of healthy pieces of recordings: of the next one, of one whose fit tells less, of a warmer motor."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri, stdtrit

from motor_env.motor.parameters import FloatArray

PRIOR_WEIGHT = 4.0
NORMAL_DOF = 1e6


def the_next(logs: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Mean, covariance and degrees of freedom of the next healthy one, of several.

    The spread between few is hardly known. A prior stands in: an inverse-Wishart, worth 4 of them (Gelman et al. 2013,
    ch. 3.6). The next one then follows a multivariate Student t with n - 1 + 4 degrees of freedom and the scale
    (1 + 1/n) S, never the sample's own sigma.

    Args:
        logs: of those seen, shape (n, p).
        prior: covariance that is believed beforehand, shape (p, p).
    """
    n, centre = len(logs), logs.mean(axis=0)
    scatter, freedom = (logs - centre).T @ (logs - centre), n - 1 + PRIOR_WEIGHT
    return centre, (scatter + PRIOR_WEIGHT * prior) / freedom * (1.0 + 1.0 / n), freedom


def next_sd(values: FloatArray, prior_sd: float) -> float:
    """Scale of the next value's Student t, from values that scatter."""
    return math.sqrt(the_next(values[:, None], np.eye(1) * prior_sd**2)[1][0, 0])


def beyond(healthy: FloatArray, error: FloatArray) -> FloatArray:
    """What the own error of a fit is beyond the spread of the healthy ones, which holds theirs, shape (n, n)."""
    root = np.linalg.cholesky(healthy)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ error @ inverse.T)
    more = root @ axes * np.sqrt(np.maximum(sizes - 1.0, 0.0))
    return np.asarray(more @ more.T, dtype=np.float64)


def warmer(covariance: FloatArray, warmth: FloatArray, rate: float, freedom: float) -> FloatArray:
    """A covariance of Student's t with the known normal spread of the temperature added.

    The quantile of a sum of t and normal lies below the root of the sum of their squared quantiles. So the normal part
    counts in the ratio of the two quantiles, at the share of one test.

    Args:
        covariance: at one temperature, shape (n, n).
        warmth: how the quantities move for one standard deviation of the temperature, shape (n,).
        rate: of one test.
        freedom: degrees of freedom of the covariance.
    """
    ratio = float(ndtri(rate) / stdtrit(freedom, rate))
    return np.asarray(covariance + np.outer(ratio * warmth, ratio * warmth), dtype=np.float64)
