"""Degradation as a Wiener process with drift on a time scale of its own; the time until it first reaches a limit.

    x(t) = x0                                      before the onset
    dx   = drift dc + diffusion dW(c)              after it, c the time scale (Whitmore 1995; Si, Wang, Hu & Zhou 2011)
    y_i  = x(t_i) + e_i,  var e_i = se_i^2 + scatter^2

Given time scale, onset, diffusion and scatter, a Kalman filter of
[level, drift] is exact; these four are summed over a grid. The first passage is inverse Gaussian in the time scale, in
closed form for a Gaussian drift (Whitmore & Schenkelberg 1997), and the level is integrated by quadrature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erfcx, expit, log_softmax, logsumexp, ndtr, softmax

from motor_env.motor.parameters import FloatArray, require

_DIFFUSIONS = np.geomspace(0.01, 2.0, 9)  # in units of distance to the limit / sqrt(time observed)
_DIFFUSION_SCALE = 0.25  # above it the prior, even in the logarithm, falls
_DRIFT_SCALE = 0.7  # prior standard deviation of the drift, in distances to the limit / time since the onset
_SCATTERS = np.concatenate([[0.0], np.geomspace(0.35, 8.0, 6)])  # beyond the standard errors, in typical ones
_MOST_ONSETS = 20
_PRIOR_STEADY = 0.5
_PRIOR_FIRST = 0.5  # that wear began before the first estimate
_LAWS = {  # exponent and growth of the time scale; the laws are equally likely, and so are the shapes of each
    "linear": ((1.0, 0.0),),
    "power": ((0.5, 0.0), (1.5, 0.0), (2.0, 0.0), (3.0, 0.0)),
    "exponential": ((1.0, 1.5), (1.0, 2.5), (1.0, 4.0), (1.0, 6.0)),
    "chance": (),  # diffusion alone, from the first estimate on: no trend
}
_NO_GROWTH = 1e-6  # growth of a time scale that is a power
_PRIOR_LAW = (1.0 - _PRIOR_STEADY) / len(_LAWS)


def time_scale(elapsed: FloatArray, exponent: FloatArray, growth: FloatArray) -> FloatArray:
    """Compute a law's time scale, from 0 at the onset to 1 at the last estimate, as `elapsed`."""
    rate = np.maximum(growth, _NO_GROWTH)  # the limit of no growth is the power itself
    return np.asarray(np.expm1(np.minimum(rate * elapsed**exponent, 300.0)) / np.expm1(rate))


class Grid(NamedTuple):
    """Hypotheses: c time scales times s pairs of diffusion and scatter.

    The last two time scales have no drift: pure diffusion, and a steady motor.

    Attributes:
        elapsed: value of each time scale at each estimate, in units of its span, shape (n, c).
        span, exponent, growth: shape (c, 1).
        drift_std: prior standard deviation of the drift, shape (c, 1).
        diffusion, scatter: shape (s,).
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
    """Combine all time scales, onsets, diffusions and scatters with their log priors.

    Priors: uniform onset after the first estimate, Gaussian drift about 0, log-uniform diffusion up to its scale,
    half-Cauchy scatter (Gelman 2006).
    """
    onsets = np.linspace(0.0, len(times) - 2.0, min(len(times) - 1, _MOST_ONSETS))
    onsets = np.unique(onsets.round().astype(int))
    shapes = [(*shape, 1.0 / len(law)) for law in _LAWS.values() for shape in law]
    exponent, growth, prior = np.repeat(np.array(shapes), len(onsets), axis=0).T
    span = times[-1] - np.tile(times[onsets], len(shapes))
    share = np.maximum(times[:, None] - (times[-1] - span), 0.0) / span
    shown = span * time_scale(share, exponent, growth)
    first = np.tile(onsets == 0, len(shapes))
    prior = prior * np.where(first, _PRIOR_FIRST, (1.0 - _PRIOR_FIRST) / max(len(onsets) - 1, 1))
    log_diffusion = log_softmax(-np.log1p((_DIFFUSIONS / _DIFFUSION_SCALE) ** 2))
    log_sizes = np.add.outer(log_diffusion, log_softmax(-np.log1p(_SCATTERS**2))).ravel()
    diffusion, scatter = np.reshape(np.meshgrid(_DIFFUSIONS, _SCATTERS, indexing="ij"), (2, -1))
    alone = (times - times[0])[:, None]
    return Grid(
        np.hstack([shown, alone, np.zeros_like(alone)]),
        np.append(span, [1.0, 1.0])[:, None],
        np.append(exponent, [1.0, 1.0])[:, None],
        np.append(growth, [0.0, 0.0])[:, None],
        np.append(_DRIFT_SCALE * distance / span, [0.0, 0.0])[:, None],
        diffusion * distance / math.sqrt(times[-1] - times[0]),
        scatter * typical_error,
        np.log(np.append(prior * _PRIOR_LAW, [_PRIOR_LAW, _PRIOR_STEADY]))[:, None] + log_sizes,
    )


def run_filters(
    estimate: FloatArray, variance: FloatArray, grid: Grid, level_std: float
) -> tuple[FloatArray, FloatArray]:
    """Run a Kalman filter of [level, drift] for every hypothesis.

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


TREND_PROBABILITY = 0.95
"""Least posterior probability of a trend."""

FEWEST_ESTIMATES = 5
"""Fewest estimates that separate a trend from scatter."""

_NEGLIGIBLE = 0.01  # posterior probability of all grid points that are left out
_LEAST_ERROR = 1e-6  # of the typical one: estimates without an error may scatter by nothing
_LEVEL_NODES, _LEVEL_WEIGHTS = np.polynomial.hermite_e.hermegauss(7)
_LIFE_POINTS = 120
_MOST_PASSAGES = 300


class RemainingLife(NamedTuple):
    """Time from the last estimate until the limit is first reached, in the unit of the time axis.

    Attributes:
        low: lower end of the interval; 0 if the limit may have been reached.
        median: infinite if the limit is ever reached with a probability below 0.5.
        high: upper end; infinite if the limit may never be reached.
        level: nominal probability of the interval.
        probability_reached: that the limit has been reached.
        probability_ever: that it is ever reached.
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
    """Compute the probability that a Wiener process with Gaussian drift rises by `distance` within `life`.

    Arrays broadcast. Whitmore & Schenkelberg (1997), with exp(z^2) erfc(z) in place of two large exponents that
    cancel.
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
    """Posterior of the degradation: a weighted grid of Gaussians, directed upwards to the limit.

    Attributes:
        weights: posterior probability of each grid point, given a drift, shape (n,).
        span: time from the onset to the last estimate, shape (n,).
        exponent: of the time scale, shape (n,).
        growth: of the time scale, over `span`; 0 for a power, shape (n,).
        diffusion: a root unit of the time scale, shape (n,).
        scatter: beyond the standard errors, shape (n,).
        level: posterior mean of the level at the last estimate, shape (n,).
        drift: posterior mean of the drift, a unit of the time scale, shape (n,).
        covariance: of [level, drift], shape (n, 2, 2).
        limit: the limit.
        sign: of levels and drifts; +1 for a limit above, -1 below.
        probability_trend: posterior probability of degradation towards the limit.
        limit_variance: of the limit, shape (n,).
    """

    weights: FloatArray
    span: FloatArray
    exponent: FloatArray
    growth: FloatArray
    diffusion: FloatArray
    scatter: FloatArray
    level: FloatArray
    drift: FloatArray
    covariance: FloatArray
    limit: float
    sign: float
    probability_trend: float
    limit_variance: FloatArray

    @property
    def mean_drift(self) -> float:
        """Average the drift at the last estimate, per unit of time."""
        rate = np.maximum(self.growth, _NO_GROWTH)
        return self.sign * float(self.weights @ (self.drift * self.exponent * rate / -np.expm1(-rate)))

    @property
    def mean_level(self) -> float:
        """Average the level at the last estimate."""
        return float(self.forecast(0.0)[0])

    def _scale_ahead(self, times: FloatArray) -> FloatArray:
        """Advance the time scales to times after the last estimate, over `span`, shape (..., n)."""
        ahead = 1.0 + times[..., None] / self.span
        return self.span * (time_scale(ahead, self.exponent, self.growth) - 1.0)

    def _nodes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.intp]]:
        """Return distance, conditional drift, its variance, diffusion, weight and index of at most 300 nodes."""
        chosen, share = np.arange(len(self.weights)), self.weights
        if len(chosen) > _MOST_PASSAGES:
            even = (np.arange(_MOST_PASSAGES) + 0.5) / _MOST_PASSAGES
            chosen = np.minimum(np.searchsorted(np.cumsum(self.weights), even), len(chosen) - 1)
            share = np.full(_MOST_PASSAGES, 1.0 / _MOST_PASSAGES)
        covariance = self.covariance[chosen]
        spread = covariance[:, 0, 0] + self.limit_variance[chosen]
        deviation = np.sqrt(spread)[:, None] * _LEVEL_NODES
        slope = covariance[:, 0, 1] / spread
        variance = np.maximum(covariance[:, 1, 1] - slope * covariance[:, 0, 1], 0.0)
        return (
            (self.sign * self.limit - self.level[chosen, None] - deviation).ravel(),
            (self.drift[chosen, None] + slope[:, None] * deviation).ravel(),
            np.repeat(variance, len(_LEVEL_NODES)),
            np.repeat(self.diffusion[chosen], len(_LEVEL_NODES)),
            np.outer(share, _LEVEL_WEIGHTS / _LEVEL_WEIGHTS.sum()).ravel(),
            np.repeat(chosen, len(_LEVEL_NODES)),
        )

    def probability_beyond(self, share: float) -> float:
        """Compute the probability of a level beyond a share of the way from 1 to the limit."""
        border = self.sign * (1.0 + share * (self.limit - 1.0))
        spread = self.covariance[:, 0, 0] + share**2 * self.limit_variance
        return float(self.weights @ ndtr((self.level - border) / np.sqrt(spread)))

    def passage(self, life: FloatArray) -> FloatArray:
        """Compute the probability that the limit is reached within times after the last estimate."""
        *normal, weights, place = self._nodes()
        ahead = np.clip(self._scale_ahead(life), 1e-9 * life[-1], 1e50)[..., place]
        return np.asarray(first_passage_cdf(ahead, *normal) @ weights)

    def remaining_life(self, level: float = 0.9) -> RemainingLife:
        """Find median and central interval of the remaining life; 0 < level < 1."""
        reach = self.sign * self.limit - self.sign * self.mean_level
        pace = abs(self.mean_drift) + 1e-3 * abs(reach) / float(self.span.max())
        axis = np.geomspace(1e-4, 1e3, _LIFE_POINTS) * max(abs(reach) / pace, 1e-3 * float(self.span.max()))
        cdf = np.maximum.accumulate(self.passage(axis))
        quantiles = [0.5 - level / 2.0, 0.5, 0.5 + level / 2.0]
        low, median, high = np.exp(
            np.interp(quantiles, cdf, np.log(axis), left=-np.inf, right=np.inf)
        ).tolist()
        return RemainingLife(low, median, high, level, self.probability_beyond(1.0), float(cdf[-1]))

    def forecast(self, ahead: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Predict mean and standard deviation of the level at times after the last estimate."""
        times = np.asarray(ahead, dtype=np.float64)
        elapsed = self._scale_ahead(times)
        mean = self.level + self.drift * elapsed
        spread = (
            self.covariance[:, 0, 0]
            + 2.0 * elapsed * self.covariance[:, 0, 1]
            + elapsed**2 * self.covariance[:, 1, 1]
            + self.diffusion**2 * elapsed
        )
        centre, square = mean @ self.weights, (spread + mean**2) @ self.weights
        return self.sign * centre, np.sqrt(np.maximum(square - centre**2, 0.0))


def fit_degradation(
    time: FloatArray,
    estimate: FloatArray,
    standard_error: FloatArray,
    limit: float,
    *,
    sign: float | None = None,
    limit_errors: float = 0.0,
) -> Degradation:
    """Fit the laws of degradation to at least five estimates.

    Args:
        time: rising, any unit, shape (n,).
        estimate: shape (n,).
        standard_error: >= 0, shape (n,).
        limit: of the level.
        sign: +1 for a limit above, -1 below; None to derive it from the first estimates.
        limit_errors: standard deviation of the limit over that of one estimate.

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
    # The unit of the scatter: the median standard error, or by differences of neighbours if larger.
    jumps = float(np.median(np.abs(np.diff(estimate)))) / 0.954  # of white scatter: its standard deviation
    width = float(np.ptp(estimate))
    typical = max(float(np.median(standard_error)), 0.3 * jumps, 1e-9 * width, 1e-9 * distance)
    errors = np.maximum(standard_error, _LEAST_ERROR * typical)
    level_std, towards_limit = 10.0 * (distance + width), towards * estimate
    grid = hypotheses(time, typical, distance)
    log_likelihood, moments = run_filters(towards_limit, errors**2, grid, level_std)
    log_weight = log_likelihood + grid.log_prior
    wears = float(expit(logsumexp(log_weight[:-2]) - logsumexp(log_weight[-2:])))
    weight = softmax(log_weight[:-2].ravel())
    # The fewest hypotheses that hold all but a negligible part of the weight.
    order = np.argsort(weight)[::-1]
    kept = order[: int(np.searchsorted(np.cumsum(weight[order]), 1.0 - _NEGLIGIBLE)) + 1]
    weights = weight[kept] / weight[kept].sum()
    scales, sizes = np.divmod(kept, len(grid.scatter))
    level, drift, p00, p01, p11 = moments.reshape(5, -1)[:, kept]
    scatter = grid.scatter[sizes]
    return Degradation(
        weights=weights,
        span=grid.span[scales, 0],
        exponent=grid.exponent[scales, 0],
        growth=grid.growth[scales, 0],
        diffusion=grid.diffusion[sizes],
        scatter=scatter,
        level=level,
        drift=drift,
        covariance=np.moveaxis(np.array([[p00, p01], [p01, p11]]), -1, 0),
        limit=float(limit),
        sign=towards,
        probability_trend=wears * float(weights @ ndtr(drift / np.sqrt(p11))),
        limit_variance=limit_errors**2 * (float(np.median(errors)) ** 2 + scatter**2),
    )
