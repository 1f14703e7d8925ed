"""Wear as a Wiener process with drift, seen through noisy estimates; the time until it first reaches a limit.

    x(t) = x0                                      before the onset
    dx   = drift dt + diffusion dW                 after it (Whitmore 1995; Si, Wang, Hu & Zhou 2011)
    y_i  = x(t_i) + e_i,  var e_i = se_i^2 + scatter^2

For a given onset, diffusion and scatter, level and drift are Gaussian: a Kalman filter of [level, drift] gives them
and the likelihood exactly. Onset, diffusion and scatter are summed over a grid. The first passage of a Wiener process
is inverse Gaussian; its distribution with a Gaussian drift has a closed form (Whitmore & Schenkelberg 1997, with the
sign of a drift away from the limit kept: then the limit may never be reached), and the level's uncertainty is
integrated by quadrature. So the interval of the remaining life holds the uncertainty of every parameter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erfcx, log_softmax, ndtr, softmax

from motor_env.motor.parameters import FloatArray, require

TREND_PROBABILITY = 0.95
"""From this posterior probability on a quantity is said to trend to a limit."""

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
_LEVEL_NODES, _LEVEL_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_LIFE_POINTS = 100


class RemainingLife(NamedTuple):
    """Time from the last estimate until the limit is first reached, in the unit of the time axis.

    Attributes:
        low: lower end of the central interval; 0 where the limit may have been reached already.
        median: infinite where the limit is reached with a probability below one half.
        high: upper end, infinite where the limit may never be reached.
        level: probability that the interval is meant to hold.
        probability_reached: probability that the limit has been reached already.
        probability_ever: probability that it is reached at all.
    """

    low: float
    median: float
    high: float
    level: float
    probability_reached: float
    probability_ever: float


def first_passage_cdf(
    life: FloatArray,
    distance: FloatArray,
    drift: FloatArray,
    drift_variance: FloatArray,
    diffusion: FloatArray,
) -> FloatArray:
    """Probability that a Wiener process with Gaussian drift has come `distance` up within `life`; arrays broadcast.

    Whitmore & Schenkelberg (1997), eq. for a random drift, rewritten with exp(z^2) erfc(z): the two large exponents of
    the textbook form cancel by hand, so that a small diffusion loses no digits.
    """
    spread = drift_variance * life * life + diffusion**2 * life
    root = np.sqrt(spread)
    first = ndtr((drift * life - distance) / root)
    z = (2.0 * drift_variance * distance * life / diffusion**2 + drift * life + distance) / root
    scaled = (
        0.5
        * erfcx(np.maximum(z, 0.0) / math.sqrt(2.0))
        * np.exp(-0.5 * (distance - drift * life) ** 2 / spread)
    )
    exponent = 2.0 * distance * (drift + drift_variance * distance / diffusion**2) / diffusion**2
    plain = np.exp(np.minimum(exponent, 0.0)) * ndtr(-np.minimum(z, 0.0))
    return np.where(distance <= 0.0, 1.0, np.clip(first + np.where(z >= 0.0, scaled, plain), 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class Degradation:
    """What the estimates tell about the wear, as a weighted grid of Gaussians; the upward direction is to the limit.

    Attributes:
        weights: posterior probability of each grid point, given that there is a drift, shape (n,).
        onset: index of the last estimate before the drift, shape (n,).
        diffusion: shape (n,).
        scatter: start-to-start scatter beyond the standard errors, shape (n,).
        level: posterior mean of the level at the last estimate, shape (n,).
        drift: posterior mean of the drift, shape (n,).
        covariance: of [level, drift], shape (n, 2, 2).
        limit: the limit.
        sign: +1 for a limit above, -1 for one below; levels and drifts are multiplied by it.
        probability_trend: posterior probability that there is a drift, and that it goes to the limit.
    """

    weights: FloatArray
    onset: FloatArray
    diffusion: FloatArray
    scatter: FloatArray
    level: FloatArray
    drift: FloatArray
    covariance: FloatArray
    limit: float
    sign: float
    probability_trend: float

    @property
    def mean_drift(self) -> float:
        """Posterior mean of the drift, in the units of the estimates a unit of time."""
        return self.sign * float(self.weights @ self.drift)

    @property
    def drift_std(self) -> float:
        """Posterior standard deviation of the drift."""
        mean = float(self.weights @ self.drift)
        return math.sqrt(float(self.weights @ (self.covariance[:, 1, 1] + (self.drift - mean) ** 2)))

    def _nodes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Distance, drift given the level, its variance, diffusion and weight of every quadrature node."""
        std = np.sqrt(self.covariance[:, 0, 0])
        level = self.level[:, None] + std[:, None] * _LEVEL_NODES
        slope = self.covariance[:, 0, 1] / self.covariance[:, 0, 0]
        drift = self.drift[:, None] + slope[:, None] * (level - self.level[:, None])
        variance = np.maximum(self.covariance[:, 1, 1] - slope * self.covariance[:, 0, 1], 0.0)
        return (
            (self.sign * self.limit - level).ravel(),
            drift.ravel(),
            np.repeat(variance, len(_LEVEL_NODES)),
            np.repeat(self.diffusion, len(_LEVEL_NODES)),
            np.outer(self.weights, _LEVEL_WEIGHTS / _LEVEL_WEIGHTS.sum()).ravel(),
        )

    def life_axis(self) -> FloatArray:
        """Times that span the distribution of the remaining life, shape (100,), even in the logarithm."""
        reach = max(self.sign * self.limit - float(self.weights @ self.level), 0.0)
        reach += 3.0 * math.sqrt(float(self.weights @ self.covariance[:, 0, 0]))
        pace = max(abs(self.mean_drift), 0.05 * self.drift_std, 1e-12 * reach, 1e-300)
        return np.geomspace(1e-4, 1e3, _LIFE_POINTS) * reach / pace

    def remaining_life(self, level: float = 0.9) -> RemainingLife:
        """Median and central interval of the time until the limit is first reached; the level lies between 0 and 1."""
        axis = self.life_axis()
        *normal, weights = self._nodes()
        cdf = first_passage_cdf(np.maximum(axis, 1e-300)[:, None], *normal) @ weights
        cdf = np.maximum.accumulate(cdf)
        wanted = [0.5 - level / 2.0, 0.5, 0.5 + level / 2.0]
        low, median, high = np.exp(np.interp(wanted, cdf, np.log(axis), left=-np.inf, right=np.inf)).tolist()
        return RemainingLife(low, median, high, level, float(weights[normal[0] <= 0.0].sum()), float(cdf[-1]))

    def forecast(self, ahead: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the level at times after the last estimate, each the shape of `ahead`."""
        times = np.asarray(ahead, dtype=np.float64)[..., None]
        mean = self.level + self.drift * times
        spread = (
            self.covariance[:, 0, 0]
            + 2.0 * times * self.covariance[:, 0, 1]
            + times**2 * self.covariance[:, 1, 1]
            + self.diffusion**2 * times
        )
        centre = mean @ self.weights
        std = np.sqrt((spread + (mean - centre[..., None]) ** 2) @ self.weights)
        return self.sign * centre, std


def _grid(times: FloatArray, typical_error: float, distance: float) -> tuple[FloatArray, FloatArray]:
    """All combinations of onset, diffusion and scatter, then steady motors (onset after the end), and their log priors.

    Onsets are equally likely; the drift is Gaussian about 0; diffusion and scatter are half-Cauchy (Gelman 2006).
    """
    onsets = np.unique(np.linspace(0.0, len(times) - 2.0, min(len(times) - 1, _MOST_ONSETS)).round())
    # The diffusions are even in the logarithm, which adds a factor to their density.
    log_diffusion = log_softmax(np.log(_DIFFUSIONS) - np.log1p((_DIFFUSIONS / _DIFFUSION_SCALE) ** 2))
    log_scatter = log_softmax(-np.log1p(_SCATTERS**2))
    axes = np.meshgrid(onsets, _DIFFUSIONS, _SCATTERS, indexing="ij")
    onset, diffusion, scatter = np.reshape(axes, (3, -1))
    log_prior = np.add.outer(log_diffusion, log_scatter) + math.log((1.0 - _PRIOR_STEADY) / len(onsets))
    steady = np.zeros(len(_SCATTERS))
    since = times[-1] - times[onset.astype(int)]
    grid = [
        np.concatenate([onset, steady + len(times)]),
        np.concatenate([diffusion * distance / math.sqrt(times[-1] - times[0]), steady]),
        np.concatenate([scatter, _SCATTERS]) * typical_error,
        np.concatenate([_DRIFT_SCALE * distance / since, steady]),
    ]
    priors = [np.tile(log_prior.ravel(), len(onsets)), log_scatter + math.log(_PRIOR_STEADY)]
    return np.array(grid), np.concatenate(priors)


def _filtered(
    times: FloatArray, estimate: FloatArray, variance: FloatArray, grid: FloatArray, level_std: float
) -> tuple[FloatArray, FloatArray]:
    """Kalman filter of [level, drift] for every hypothesis: onset, diffusion, scatter, prior sd of the drift, (4, n).

    Returns:
        Log-likelihood, shape (n,); level, drift, and their covariances, shape (5, n).
    """
    onset, diffusion, scatter, drift_std = grid
    none = np.zeros(len(onset))
    level, drift, log_likelihood = none + estimate[0], none, none
    p00, p01, p11 = none + level_std * level_std, none, drift_std**2
    for i, step in enumerate(np.diff(times, prepend=times[0])):
        dt = np.where(onset < i, step, 0.0)
        level = level + drift * dt
        p00 = p00 + (2.0 * dt * p01 + dt * dt * p11 + diffusion**2 * dt)
        p01 = p01 + dt * p11
        s = p00 + variance[i] + scatter**2
        error = estimate[i] - level
        log_likelihood = log_likelihood - 0.5 * (error * error / s + np.log(2.0 * math.pi * s))
        level, drift = level + p00 / s * error, drift + p01 / s * error
        kept = (variance[i] + scatter**2) / s
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
    require(
        bool(np.isfinite([time, estimate, standard_error]).all()),
        "time, estimate and standard_error must be finite",
    )
    beginning = float(np.mean(estimate[: max(3, len(estimate) // 10)]))
    distance = abs(limit - beginning)
    require(distance > 0.0 and math.isfinite(limit), f"limit must differ from the first level, got {limit:g}")
    towards = math.copysign(1.0, limit - beginning) if sign is None else sign
    # The unit of the scatter: the median standard error, or what the jumps between neighbours say where that is larger.
    jumps = float(np.median(np.abs(np.diff(estimate)))) / 0.954  # of white scatter: its standard deviation
    width = float(np.ptp(estimate))
    typical = max(float(np.median(standard_error)), 0.3 * jumps, 1e-9 * width, 1e-9 * distance)
    errors = np.maximum(standard_error, _LEAST_ERROR * typical)
    grid, log_prior = _grid(time, typical, distance)
    log_likelihood, moments = _filtered(time, towards * estimate, errors**2, grid, 10.0 * (distance + width))
    weight = softmax(log_likelihood + log_prior)
    weight[grid[0] == len(time)] = 0.0  # steady ones
    probability_drift = float(weight.sum())
    # The fewest hypotheses that hold all but a negligible part of the weight.
    order = np.argsort(weight)[::-1]
    share = np.cumsum(weight[order]) / probability_drift
    kept = order[: int(np.searchsorted(share, 1.0 - _NEGLIGIBLE)) + 1]
    weights = weight[kept] / weight[kept].sum()
    onset, diffusion, scatter, _ = grid[:, kept]
    level, drift, p00, p01, p11 = moments[:, kept]
    return Degradation(
        weights=weights,
        onset=onset,
        diffusion=diffusion,
        scatter=scatter,
        level=level,
        drift=drift,
        covariance=np.moveaxis(np.array([[p00, p01], [p01, p11]]), -1, 0),
        limit=float(limit),
        sign=towards,
        probability_trend=probability_drift * float(weights @ ndtr(drift / np.sqrt(p11))),
    )
