"""How well the unknowns are known: Fisher information, residuals that are not white, and terms that were left out."""

from __future__ import annotations

import math

import numpy as np

from motor_env.fitting import places
from motor_env.fitting.fit import score_tests
from motor_env.fitting.problem import Problem, Solution
from motor_env.fitting.terms import NOISES, Term
from motor_env.motor.parameters import FloatArray

_WIDEST = 1e3
_STEPS = (1e-3, 0.1)


def information_covariance(problem: Problem, theta: FloatArray) -> FloatArray:
    """Covariance of the unknowns that are no noises (Cramer-Rao), shape (p, p), in the order of `motor_places`."""
    jacobian = secants(problem, theta)
    base = problem.residuals(theta)
    return _inverse(jacobian.T @ jacobian) * float(base @ base) / problem.count


def secants(problem: Problem, theta: FloatArray) -> FloatArray:
    """Derivatives of the residuals over steps as wide as the unknowns are uncertain, without the noises' columns."""
    chosen = motor_places(problem)
    base = problem.residuals(theta)
    jacobian = problem.columns(theta, chosen, base)
    for _ in range(2):
        sd = np.sqrt(np.diag(_inverse(jacobian.T @ jacobian)) * float(base @ base) / problem.count)
        steps = np.clip(sd, *_STEPS)
        jacobian = np.stack(
            [problem.secant(theta, n, step) for n, step in zip(chosen, steps, strict=True)], axis=1
        )
    return jacobian


def motor_places(problem: Problem) -> list[int]:
    """Places of the unknowns that are no noises."""
    return [n for n, name in enumerate(problem.names) if name not in NOISES]


def covariance(best: Solution, every: dict[str, Term]) -> FloatArray:
    """Covariance of the unknowns that are no noises, with what correlated residuals and the choice of terms add.

    The scores' autocovariance (Bartlett window; Newey & West 1987) widens, and never narrows, what white residuals
    tell. A term that was left out counts with its posterior probability (Hoeting et al. 1999), its size believed to be
    as usual: it would have moved the others by so much, and would have left them so much less certain. Other optima
    count with theirs.
    """
    problem, chosen = best.problem, motor_places(best.problem)
    base, jacobian = problem.residuals(best.theta), secants(problem, best.theta)
    variance = float(base @ base) / problem.count
    bread = _inverse(jacobian.T @ jacobian)
    ratio = _widening(problem, best.theta, jacobian, bread) / math.sqrt(variance)
    total = bread * variance * np.outer(ratio, ratio)
    for name, test in score_tests(best, every).items():
        occam = test.sd / math.hypot(test.sd, every[name].usual)
        odds = occam * math.exp(min(0.5 * test.chi_square, 50.0))
        weight, moves = odds / (1.0 + odds), test.moves[chosen]
        total += weight * (test.value**2 + test.sd**2) * np.outer(moves, moves)
    ahead = np.exp([0.5 * (best.misfit - misfit) for _, misfit in best.rivals])
    for share, (theta, _) in zip(ahead / (1.0 + ahead.sum()), best.rivals, strict=True):
        moved = (theta - best.theta)[chosen]
        total += share * np.outer(moved, moved)
    return total


def _widening(problem: Problem, theta: FloatArray, jacobian: FloatArray, bread: FloatArray) -> FloatArray:
    """Sandwich standard errors over those of unit white noise, no less than what the noise gives."""
    base = problem.residuals(theta)
    channels = int(problem.record.seen.sum())
    n = len(problem.record.voltage_v)
    scores = (jacobian[: n * channels] * base[: n * channels, None]).reshape(n, channels, -1).sum(axis=1)
    values = problem.values(theta)
    memory_s = values[places.J] * values[places.R] / values[places.K] ** 2
    lags = int(min(max(1.5 * n ** (1.0 / 3.0), 3.0 * memory_s / problem.record.dt_s), n / 20))
    middle = scores.T @ scores
    for lag in range(1, lags + 1):
        crossed = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (lags + 1)) * (crossed + crossed.T)
    sandwich = np.maximum(np.diag(bread @ middle @ bread), 0.0)
    white = float(base @ base) / problem.count * np.diag(bread)
    ratio: FloatArray = np.sqrt(np.maximum(sandwich, white) / np.maximum(np.diag(bread), 1e-300))
    return ratio


def _inverse(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix; a direction of which nothing is known gets a finite, hopeless variance."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, axes = np.linalg.eigh(information / np.outer(size, size))
    inverse = (axes / np.maximum(values, 1e-10)) @ axes.T
    out: FloatArray = inverse / np.outer(size, size)
    return np.clip(out, -(_WIDEST**2), _WIDEST**2)
