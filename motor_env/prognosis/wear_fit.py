"""The wear model fitted to estimates: a Kalman filter for every hypothesis of a grid, weighted by its likelihood."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import log_softmax, ndtr

from motor_env.motor.parameters import FloatArray, require
from motor_env.prognosis.wear import Degradation

FEWEST_ESTIMATES = 5
"""Below this no trend can be told from scatter."""

_DIFFUSIONS = np.geomspace(0.004, 2.5, 12)  # in units of distance to the limit / sqrt(time observed)
_DIFFUSION_SCALE = 0.3  # of the half-Cauchy prior, in the same units
_DRIFT_SCALE = 0.7  # prior standard deviation of the drift, in distances to the limit / time since the onset
_SCATTERS = np.concatenate([[0.0], np.geomspace(0.35, 8.0, 6)])  # in units of the typical standard error
_MOST_ONSETS = 20
_PRIOR_STEADY = 0.5
_NEGLIGIBLE = 0.002  # posterior probability of all grid points that are left out
_LEAST_ERROR = 1e-6  # of the typical one: estimates without an error may scatter by nothing


class _Grid(NamedTuple):
    """Hypotheses, each an array (n,): those of a drift first, then those of a steady motor (onset after the end)."""

    onset: FloatArray
    diffusion: FloatArray
    scatter: FloatArray
    drift_std: FloatArray
    log_prior: FloatArray


def _filtered(
    times: FloatArray, estimate: FloatArray, variance: FloatArray, grid: _Grid, level_std: float
) -> tuple[FloatArray, FloatArray]:
    """Kalman filter of [level, drift] for every hypothesis.

    Returns:
        Log-likelihood, shape (n,); level, drift, and their covariances, shape (5, n).
    """
    none = np.zeros(len(grid.onset))
    level, drift, log_likelihood = none + estimate[0], none, none
    p00, p01, p11 = none + level_std**2, none, grid.drift_std**2
    for i, step in enumerate(np.diff(times, prepend=times[0])):
        dt = np.where(grid.onset < i, step, 0.0)
        level = level + drift * dt
        p00 = p00 + (2.0 * dt * p01 + dt * dt * p11 + grid.diffusion**2 * dt)
        p01 = p01 + dt * p11
        s = p00 + variance[i] + grid.scatter**2
        error = estimate[i] - level
        log_likelihood = log_likelihood - 0.5 * (error * error / s + np.log(2.0 * math.pi * s))
        level, drift = level + p00 / s * error, drift + p01 / s * error
        kept = (variance[i] + grid.scatter**2) / s
        p00, p01, p11 = p00 * kept, p01 * kept, p11 - p01 / s * p01
    return log_likelihood, np.stack([level, drift, p00, p01, p11])


def degradation(
    time: FloatArray,
    estimate: FloatArray,
    standard_error: FloatArray,
    limit: float,
    *,
    sign: float | None = None,
) -> Degradation:
    """Fit the wear model to a sequence of five estimates or more.

    Args:
        time: rising, any unit, shape (n,).
        estimate: shape (n,).
        standard_error: >= 0, shape (n,).
        limit: level whose first passage counts.
        sign: +1 if the limit lies above, -1 below; if None as it lies to the first estimates.

    Raises:
        ValueError: a value that is not finite, or a limit at the first level.
    """
    finite = bool(np.isfinite([time, estimate, standard_error]).all())
    require(finite, "time, estimate and standard_error must be finite")
    beginning = float(np.mean(estimate[: max(3, len(estimate) // 10)]))
    distance = abs(limit - beginning)
    require(distance > 0.0 and math.isfinite(limit), f"limit must differ from the first level, got {limit:g}")
    towards = math.copysign(1.0, limit - beginning) if sign is None else sign
    # The unit of the scatter: the median standard error, or what the jumps between neighbours say where that is larger.
    jumps = float(np.median(np.abs(np.diff(estimate)))) / 0.954  # of white scatter: its standard deviation
    width = float(np.ptp(estimate))
    typical = max(float(np.median(standard_error)), 0.3 * jumps, 1e-9 * width, 1e-9 * distance)
    errors = np.maximum(standard_error, _LEAST_ERROR * typical)
    grid = _grid(time, typical, distance)
    log_likelihood, moments = _filtered(time, towards * estimate, errors**2, grid, 10.0 * (distance + width))
    log_weight = log_likelihood + grid.log_prior
    weight = np.exp(log_weight - log_weight.max())
    drifting = grid.onset < len(time)
    probability_drift = float(weight[drifting].sum() / weight.sum())
    weight[~drifting] = 0.0
    # The fewest hypotheses that hold all but a negligible part of the weight.
    order = np.argsort(weight)[::-1]
    share = np.cumsum(weight[order]) / weight.sum()
    kept = order[: int(np.searchsorted(share, 1.0 - _NEGLIGIBLE)) + 1]
    weights = weight[kept] / weight[kept].sum()
    level, drift, p00, p01, p11 = moments[:, kept]
    return Degradation(
        weights=weights,
        onset=grid.onset[kept],
        diffusion=grid.diffusion[kept],
        scatter=grid.scatter[kept],
        level=level,
        drift=drift,
        covariance=np.moveaxis(np.array([[p00, p01], [p01, p11]]), -1, 0),
        limit=float(limit),
        sign=towards,
        probability_trend=probability_drift * float(weights @ ndtr(drift / np.sqrt(p11))),
    )


def _grid(times: FloatArray, typical_error: float, distance: float) -> _Grid:
    """All combinations of onset, diffusion and scatter, with their prior: independent.

    Onsets are equally likely; the drift is Gaussian about 0; diffusion and scatter are half-Cauchy (Gelman 2006).
    """
    n_onsets = min(len(times) - 1, _MOST_ONSETS)
    onsets = np.unique(np.linspace(0.0, len(times) - 2.0, n_onsets).round())
    # The diffusions are even in the logarithm, which adds a factor to their density.
    log_diffusion = log_softmax(np.log(_DIFFUSIONS) - np.log1p((_DIFFUSIONS / _DIFFUSION_SCALE) ** 2))
    log_scatter = log_softmax(-np.log1p(_SCATTERS**2))
    axes = np.meshgrid(onsets, _DIFFUSIONS, _SCATTERS, indexing="ij")
    onset, diffusion, scatter = (part.ravel() for part in axes)
    log_prior = np.add.outer(log_diffusion, log_scatter) + math.log((1.0 - _PRIOR_STEADY) / len(onsets))
    steady = np.zeros(len(_SCATTERS))
    since = times[-1] - times[onset.astype(int)]
    return _Grid(
        onset=np.concatenate([onset, steady + len(times)]),
        diffusion=np.concatenate([diffusion * distance / math.sqrt(times[-1] - times[0]), steady]),
        scatter=np.concatenate([scatter, _SCATTERS]) * typical_error,
        drift_std=np.concatenate([_DRIFT_SCALE * distance / since, steady]),
        log_prior=np.concatenate(
            [np.tile(log_prior.ravel(), len(onsets)), log_scatter + math.log(_PRIOR_STEADY)]
        ),
    )
