"""Simulation-based calibration: where the truth lies within its posterior, and how far that may be from uniform.

The rank of the truth within its posterior, from 0 to 1, is uniform if the posterior is right (Cook et al. 2006;
Talts et al. 2018). Its empirical distribution is compared with the uniform one at all points at once:
a band that a right posterior leaves with a stated probability (Säilynoja et al. 2022).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import binom

from motor_classifiers.estimators.networks.epoch_classifier import logits_in_parts
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.severity_density import weights
from motor_env.motor.parameters import FloatArray, require

_POINTS = 50  # where the distribution is compared
_AT_ONCE = 4_096


class RankCheck(NamedTuple):
    """Ranks beside the uniform distribution.

    Attributes:
        position: where they are compared, shape (n_points,).
        share: of the ranks up to there, shape (n_points,).
        low: smallest share within the band, shape (n_points,).
        high: largest share within it.
    """

    position: FloatArray
    share: FloatArray
    low: FloatArray
    high: FloatArray

    @property
    def inside(self) -> bool:
        """Whether the ranks are within the band everywhere."""
        return bool(((self.share >= self.low) & (self.share <= self.high)).all())

    @property
    def largest(self) -> float:
        """Largest distance from the uniform distribution."""
        return float(np.abs(self.share - self.position).max())


def class_ranks(probabilities: FloatArray, truth: NDArray[np.int64], uniform: FloatArray) -> FloatArray:
    """Randomised rank of the true class, the classes in the order of their columns, shape (n_cases,).

    Args:
        probabilities: shape (n_cases, n_classes).
        truth: true class of each case as a column.
        uniform: random numbers in 0 .. 1, shape (n_cases,): where in its own share a class lies.
    """
    rows = np.arange(len(truth))
    own = probabilities[rows, truth]
    ranks: FloatArray = np.cumsum(probabilities, axis=1)[rows, truth] - own * (1.0 - uniform)
    return ranks


def confidence_ranks(probabilities: FloatArray, truth: NDArray[np.int64], uniform: FloatArray) -> FloatArray:
    """Ranks of the truth with each case's classes in order of probability: sensitive to its confidence."""
    order = np.argsort(-probabilities, axis=1, kind="stable")
    place = np.argmax(order == truth[:, None], axis=1)
    return class_ranks(np.take_along_axis(probabilities, order, axis=1), place, uniform)


def rank_check(ranks: FloatArray, error: float) -> RankCheck:
    """Compare ranks with the uniform distribution; right ones leave the band with the probability `error`.

    Raises:
        ValueError: fewer than 100 ranks, or an error outside (0, 1).
    """
    require(len(ranks) >= 100, f"ranks must be 100 or more, got {len(ranks)}")
    require(0.0 < error < 1.0, f"error must be in (0, 1), got {error:g}")
    position = np.arange(1, _POINTS) / _POINTS
    low, high = _band(len(ranks), error)
    share = np.searchsorted(np.sort(ranks), position, "right") / len(ranks)
    return RankCheck(position, share, low / len(ranks), high / len(ranks))


@lru_cache(maxsize=16)
def _band(n_ranks: int, error: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Smallest and largest counts at each point, by bisection of the level of each point's interval."""

    def excess(log_level: float) -> float:
        return 1.0 - _inside(n_ranks, *_intervals(n_ranks, float(np.exp(log_level)))) - error

    # One point leaves its interval less often than some point does, and that less often than the sum of all.
    level = brentq(excess, np.log(0.2 * error / _POINTS), np.log(error), xtol=1e-3)
    return _intervals(n_ranks, float(np.exp(level)))


def _intervals(n_ranks: int, level: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    position = np.arange(1, _POINTS) / _POINTS
    low, high = (np.asarray(binom.ppf(tail, n_ranks, position)) for tail in (0.5 * level, 1.0 - 0.5 * level))
    return low.astype(np.int64), high.astype(np.int64)


def _inside(n_ranks: int, low: NDArray[np.int64], high: NDArray[np.int64]) -> float:
    """Probability that uniform ranks stay within all intervals: counts from point to point are a Markov chain."""
    counts, chance = np.zeros(1, dtype=np.int64), np.ones(1)
    for n, (smallest, largest) in enumerate(zip(low, high, strict=True)):
        following = np.arange(smallest, largest + 1)
        step = 1.0 / (_POINTS - n)  # of what lies beyond the last point
        moves = binom.pmf(following - counts[:, None], n_ranks - counts[:, None], step)
        counts, chance = following, chance @ moves
    return float(chance.sum())


def severity_shares(model: PosteriorNetwork, X: Any, kind: str) -> FloatArray:
    """Posterior of the severity of a kind on a grid over its range, shape (n_cases, n_grid)."""
    if model.severity_ is None:
        raise ValueError("a severity needs a network trained on a recipe's stream and with_severity")
    names = [str(prior.kind) for prior in model.severity_priors_]
    flat = np.asarray(X, dtype=np.float64).reshape(len(X), -1)
    outputs = logits_in_parts(model.severity_, flat, _AT_ONCE).reshape(len(flat), len(names), -1)
    return weights(torch.from_numpy(outputs[:, names.index(kind)])).numpy()


def severity_ranks(shares: FloatArray, position: FloatArray) -> FloatArray:
    """Rank of each severity, from 0 to 1 of its range, in its posterior on the grid, shape (n_cases,)."""
    grid = np.linspace(0.0, 1.0, shares.shape[1])
    cumulated = np.cumsum(shares, axis=1) - 0.5 * shares  # half of a point's share lies on either side of it
    return np.array([np.interp(at, grid, below) for at, below in zip(position, cumulated, strict=True)])


def check() -> None:
    """Assert on small cases what the figures rest on: ranks by hand, and how often uniform ones leave the band."""
    probabilities = np.array([[0.25, 0.5, 0.25], [0.125, 0.375, 0.5]])
    assert np.allclose(class_ranks(probabilities, np.array([1, 2]), np.array([0.5, 0.0])), [0.5, 0.5])
    assert np.allclose(confidence_ranks(probabilities, np.array([1, 0]), np.array([0.5, 1.0])), [0.25, 1.0])
    assert np.isclose(severity_ranks(probabilities[:1], np.array([0.25]))[0], 0.5 * (0.125 + 0.5))
    generator = np.random.default_rng(3)
    left = [not rank_check(generator.uniform(size=200), 0.2).inside for _ in range(1_000)]
    assert abs(np.mean(left) - 0.2) < 4.0 * np.sqrt(0.2 * 0.8 / 1_000)
    assert not rank_check(generator.uniform(size=200) ** 1.4, 0.001).inside
