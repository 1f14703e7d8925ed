"""The wear model fitted to estimates: a Kalman filter for every hypothesis of a grid, weighted by its likelihood."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from motor_env.motor.compiled import njit
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


@njit(cache=True)
def _filter_grid(
    step: FloatArray,
    estimate: FloatArray,
    variance: FloatArray,
    onset: FloatArray,
    diffusion: FloatArray,
    scatter: FloatArray,
    drift_std: FloatArray,
    level_std: float,
    log_likelihood: FloatArray,
    moments: FloatArray,
) -> None:
    """Kalman filter of [level, drift] for every grid point; `moments` takes level, drift, and their covariances."""
    for h in range(onset.shape[0]):
        level, drift = estimate[0], 0.0
        p00, p01, p11 = level_std * level_std, 0.0, drift_std[h] * drift_std[h]
        total = 0.0
        extra = scatter[h] * scatter[h]
        for i in range(estimate.shape[0]):
            if i > 0 and i > onset[h]:
                dt = step[i - 1]
                level += drift * dt
                p00 += 2.0 * dt * p01 + dt * dt * p11 + diffusion[h] * diffusion[h] * dt
                p01 += dt * p11
            s = p00 + variance[i] + extra
            error = estimate[i] - level
            total -= 0.5 * (error * error / s + math.log(2.0 * math.pi * s))
            k0, k1 = p00 / s, p01 / s
            level += k0 * error
            drift += k1 * error
            p11 -= k1 * p01
            p01 *= (variance[i] + extra) / s
            p00 *= (variance[i] + extra) / s
        log_likelihood[h] = total
        moments[h, 0], moments[h, 1] = level, drift
        moments[h, 2], moments[h, 3], moments[h, 4] = p00, p01, p11


_LEAST_ERROR = 1e-6


class _Grid(NamedTuple):
    """Hypotheses, each an array (n,): those of a drift first, then those of a steady motor (onset after the end)."""

    onset: FloatArray
    diffusion: FloatArray
    scatter: FloatArray
    drift_std: FloatArray
    log_prior: FloatArray


def degradation(
    time: ArrayLike,
    estimate: ArrayLike,
    standard_error: ArrayLike,
    limit: float,
    *,
    sign: float | None = None,
) -> Degradation:
    """Fit the wear model to a sequence of estimates.

    Args:
        time: rising, any unit, shape (n,).
        estimate: shape (n,).
        standard_error: >= 0, shape (n,).
        limit: level whose first passage counts.
        sign: +1 if the limit lies above, -1 below; if None as it lies to the first estimates.

    Raises:
        ValueError: fewer than five estimates, shapes that differ, a value that is not finite, times that do not rise,
            or a limit at the first level.
    """
    times, values, errors = _checked(time, estimate, standard_error)
    beginning = float(np.mean(values[: max(3, len(values) // 10)]))
    distance = abs(limit - beginning)
    require(distance > 0.0 and math.isfinite(limit), f"limit must differ from the first level, got {limit:g}")
    if sign is None:
        sign = 1.0 if limit > beginning else -1.0
    typical = _typical_error(values, errors)
    errors = np.maximum(errors, _LEAST_ERROR * typical)  # estimates without an error may scatter by nothing
    grid = _grid(times, typical, distance)
    n = len(grid.onset)
    log_likelihood, moments = np.empty(n), np.empty((n, 5))
    _filter_grid(
        np.diff(times),
        sign * values,
        errors**2,
        grid.onset,
        grid.diffusion,
        grid.scatter,
        grid.drift_std,
        10.0 * (distance + float(np.ptp(values))),
        log_likelihood,
        moments,
    )
    log_weight = log_likelihood + grid.log_prior
    weight = np.exp(log_weight - log_weight.max())
    drifting = grid.onset < len(times)
    probability_drift = float(weight[drifting].sum() / weight.sum())
    weight[~drifting] = 0.0
    kept = _heaviest(weight)
    weights = weight[kept] / weight[kept].sum()
    level, drift, p00, p01, p11 = moments[kept].T
    towards = float(weights @ ndtr(drift / np.sqrt(p11)))
    return Degradation(
        weights=weights,
        onset=grid.onset[kept],
        diffusion=grid.diffusion[kept],
        scatter=grid.scatter[kept],
        level=level,
        drift=drift,
        covariance=np.moveaxis(np.array([[p00, p01], [p01, p11]]), -1, 0),
        limit=float(limit),
        sign=sign,
        probability_trend=probability_drift * towards,
    )


def _grid(times: FloatArray, typical_error: float, distance: float) -> _Grid:
    """All combinations of onset, diffusion and scatter, with their prior: independent.

    Onsets are equally likely; the drift is Gaussian about 0; diffusion and scatter are half-Cauchy (Gelman 2006).
    """
    n_onsets = min(len(times) - 1, _MOST_ONSETS)
    onsets = np.unique(np.linspace(0.0, len(times) - 2.0, n_onsets).round())
    # The diffusions are even in the logarithm, which adds a factor to their density.
    log_diffusion = _normalised(np.log(_DIFFUSIONS) - np.log1p((_DIFFUSIONS / _DIFFUSION_SCALE) ** 2))
    log_scatter = _normalised(-np.log1p(_SCATTERS**2))
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


def _heaviest(weight: FloatArray) -> NDArray[np.intp]:
    """The fewest grid points that hold all but a negligible part of the weight."""
    order = np.argsort(weight)[::-1]
    share = np.cumsum(weight[order]) / weight.sum()
    return order[: int(np.searchsorted(share, 1.0 - _NEGLIGIBLE)) + 1]


def _normalised(log_prior: FloatArray) -> FloatArray:
    out: FloatArray = log_prior - np.logaddexp.reduce(log_prior)
    return out


def _typical_error(values: FloatArray, errors: FloatArray) -> float:
    """Unit of the scatter: the median standard error, or what the jumps between neighbours say where that is larger."""
    jumps = float(np.median(np.abs(np.diff(values)))) / 0.954  # of white scatter: its standard deviation
    return max(float(np.median(errors)), 0.3 * jumps, 1e-9 * float(np.ptp(values)), 1e-300)


def _checked(
    time: ArrayLike, estimate: ArrayLike, standard_error: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    times, values, errors = (np.asarray(part, dtype=np.float64) for part in (time, estimate, standard_error))
    require(
        times.ndim == 1 and times.shape == values.shape == errors.shape,
        f"time, estimate, standard_error must have one shape (n,), got {times.shape}, {values.shape}, {errors.shape}",
    )
    require(
        len(times) >= FEWEST_ESTIMATES,
        f"a trend needs at least {FEWEST_ESTIMATES} estimates, got {len(times)}",
    )
    require(
        bool(np.isfinite([times, values, errors]).all()), "time, estimate and standard_error must be finite"
    )
    require(bool((np.diff(times) > 0.0).all()), "time must rise from estimate to estimate")
    require(bool((errors >= 0.0).all()), "standard_error must be >= 0")
    return times, values, errors
