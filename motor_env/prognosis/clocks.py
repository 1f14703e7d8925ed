"""Wiener processes with drift on clocks of their own: the hypotheses of wear, and their Kalman filter.

A clock is the time since the onset, a power of it, or an exponential (Whitmore & Schenkelberg 1997).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import log_softmax

from motor_env.motor.parameters import FloatArray

_DIFFUSIONS = np.geomspace(0.01, 2.0, 9)  # in units of distance to the limit / sqrt(time observed)
_DIFFUSION_SCALE = 0.25  # above it the prior, even in the logarithm, falls
_DRIFT_SCALE = 0.7  # prior standard deviation of the drift, in distances to the limit / time since the onset
SCATTERS = np.concatenate([[0.0], np.geomspace(0.35, 8.0, 6)])
"""Scatter from start to start beyond the standard errors, in units of the typical one."""
LOG_SCATTER: FloatArray = log_softmax(-np.log1p(SCATTERS**2))
"""Log prior of each of these: half-Cauchy."""
_MOST_ONSETS = 20
_PRIOR_STEADY = 0.5
_PRIOR_FIRST = 0.5  # that wear began before the first estimate
_LAWS = {  # exponent and growth of the clock; the laws are equally likely, and so are the shapes of each
    "linear": ((1.0, 0.0),),
    "power": ((0.5, 0.0), (1.5, 0.0), (2.0, 0.0), (3.0, 0.0)),
    "exponential": ((1.0, 1.5), (1.0, 2.5), (1.0, 4.0), (1.0, 6.0)),
    "chance": (),  # diffusion alone, from the first estimate on: no trend
}
NO_GROWTH = 1e-6
"""Growth of a clock that is a power."""
PRIOR_LAW = (1.0 - _PRIOR_STEADY) / len(_LAWS)
"""Prior probability of each law."""


def clock(elapsed: FloatArray, exponent: FloatArray, growth: FloatArray) -> FloatArray:
    """What the wear's own clock shows; it runs from 0 at the onset to 1 at the last estimate, as `elapsed` does."""
    rate = np.maximum(growth, NO_GROWTH)  # the limit of no growth is the power itself
    return np.asarray(np.expm1(np.minimum(rate * elapsed**exponent, 300.0)) / np.expm1(rate))


class Grid(NamedTuple):
    """Hypotheses: c clocks times s sizes of diffusion and scatter.

    The last two clocks have no drift: chance alone, and a steady motor, whose clock stands still.

    Attributes:
        elapsed: what each clock shows at each estimate, in units of its span, shape (n, c).
        span: shape (c, 1).
        exponent: shape (c, 1).
        growth: shape (c, 1).
        drift_std: prior standard deviation of the drift, shape (c, 1).
        diffusion: shape (s,).
        scatter: shape (s,).
        log_prior: shape (c, s).
    """

    elapsed: FloatArray
    span: FloatArray
    exponent: FloatArray
    growth: FloatArray
    drift_std: FloatArray
    diffusion: FloatArray
    scatter: FloatArray
    log_prior: FloatArray


def hypotheses(times: FloatArray, typical_error: float, distance: float) -> Grid:
    """All combinations of clock, onset, diffusion and scatter, and their log priors.

    Onsets after the first estimate are equally likely; the drift is Gaussian about 0; the diffusion is even in the
    logarithm up to its scale; the scatter is half-Cauchy (Gelman 2006).
    """
    onsets = np.linspace(0.0, len(times) - 2.0, min(len(times) - 1, _MOST_ONSETS))
    onsets = np.unique(onsets.round().astype(int))
    shapes = [(*shape, 1.0 / len(law)) for law in _LAWS.values() for shape in law]
    exponent, growth, prior = np.repeat(np.array(shapes), len(onsets), axis=0).T
    span = times[-1] - np.tile(times[onsets], len(shapes))
    share = np.maximum(times[:, None] - (times[-1] - span), 0.0) / span
    shown = span * clock(share, exponent, growth)
    first = np.tile(onsets == 0, len(shapes))
    prior = prior * np.where(first, _PRIOR_FIRST, (1.0 - _PRIOR_FIRST) / max(len(onsets) - 1, 1))
    log_diffusion = log_softmax(-np.log1p((_DIFFUSIONS / _DIFFUSION_SCALE) ** 2))
    log_sizes = np.add.outer(log_diffusion, LOG_SCATTER).ravel()
    diffusion, scatter = np.reshape(np.meshgrid(_DIFFUSIONS, SCATTERS, indexing="ij"), (2, -1))
    alone = (times - times[0])[:, None]
    return Grid(
        np.hstack([shown, alone, np.zeros_like(alone)]),
        np.append(span, [1.0, 1.0])[:, None],
        np.append(exponent, [1.0, 1.0])[:, None],
        np.append(growth, [0.0, 0.0])[:, None],
        np.append(_DRIFT_SCALE * distance / span, [0.0, 0.0])[:, None],
        diffusion * distance / math.sqrt(times[-1] - times[0]),
        scatter * typical_error,
        np.log(np.append(prior * PRIOR_LAW, [PRIOR_LAW, _PRIOR_STEADY]))[:, None] + log_sizes,
    )


def filtered(
    estimate: FloatArray, variance: FloatArray, grid: Grid, level_std: float
) -> tuple[FloatArray, FloatArray]:
    """Kalman filter of [level, drift] for every hypothesis.

    Returns:
        Log-likelihood, shape (c, s); level, drift, and their covariances, shape (5, c, s).
    """
    none = np.zeros(np.shape(grid.log_prior))
    level, drift, log_likelihood = none + estimate[0], none, none
    p00, p01, p11 = none + level_std * level_std, none, none + grid.drift_std**2
    for i, step in enumerate(np.diff(grid.elapsed, axis=0, prepend=grid.elapsed[:1])):
        dt = step[:, None]
        level = level + drift * dt
        p00 = p00 + (2.0 * dt * p01 + dt * dt * p11 + grid.diffusion**2 * dt)
        p01 = p01 + dt * p11
        noise = variance[i] + grid.scatter**2
        s = p00 + noise
        error = estimate[i] - level
        log_likelihood = log_likelihood - 0.5 * (error * error / s + np.log(2.0 * math.pi * s))
        gain, drift_gain = p00 / s, p01 / s
        level, drift = level + gain * error, drift + drift_gain * error
        p00, p01, p11 = gain * noise, p01 * (noise / s), p11 - drift_gain * p01
    return log_likelihood, np.stack([level, drift, p00, p01, p11])
