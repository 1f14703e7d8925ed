"""How well the unknowns are known: Fisher information, residuals that are not white, and terms that were left out."""

from __future__ import annotations

import math

import numpy as np
from scipy import fft

from motor_env.fitting import places
from motor_env.fitting.fit import candidates, score_tests
from motor_env.fitting.problem import Problem, Solution
from motor_env.fitting.terms import NOISES, Term
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.noise import difference_noise

_WIDEST = 1e3
_ANYTHING_LOG_SD = 3.0
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
    for name, test in score_tests(best, every, candidates(best)).items():
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


def coloured_covariance(
    problem: Problem, theta: FloatArray, begin: int, level_a: float
) -> tuple[FloatArray, tuple[float, ...]]:
    """Covariance of the unknowns of a start, and the number of independent samples of each channel.

    Each channel's residual is taken as a stationary series with the autocovariance that it shows up to a tenth of
    the recording (Bartlett window; Newey & West 1987), and with no less power at any frequency than its white noise. A
    coarse converter adds an error `level_a` that is the same in every sample from number `begin` on. What no sample
    tells has a standard deviation of 3 in its logarithm, a prior that is too weak to matter elsewhere, and the onset is
    known to half an interval and half the current's rise: between two samples far apart, the fit's slope at one place
    does not see their bounds.
    """
    record, values = problem.record, problem.values(theta)
    base, n, channels = problem.residuals(theta), len(record.voltage_v), int(record.seen.sum())
    jacobian = problem.jacobian(theta, base)
    white = record.predict(values)[0][:, :2][:, record.seen > 0.0]
    scale = math.sqrt(float(base @ base) / max(float(np.sum(white**2)), 1e-300))
    jacobian = jacobian / scale
    rise = values[places.L] / values[places.R] + values[places.RISE] + values[places.LAG_I]
    weak = [
        _ANYTHING_LOG_SD * (1.0 if term.is_log else max(abs(one), 1e-9))
        for term, one in zip(problem.free, theta, strict=True)
    ]
    for name in ("onset", "delay"):
        if name in problem.names:
            weak[problem.names.index(name)] = 0.5 * (1.0 + rise / record.dt_s)
    if "offset_current" in problem.names:
        weak[problem.names.index("offset_current")] = math.inf
    jacobian = np.concatenate([jacobian, np.diag(1.0 / np.array(weak))])
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-150)
    jacobian = jacobian / size
    bread = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12)
    meat = jacobian[n * channels :].T @ jacobian[n * channels :]  # the priors
    independent = []
    for channel in range(channels):
        series, part = (
            white[:, channel] - white[:, channel].mean(),
            jacobian[channel : n * channels : channels],
        )
        lags = max(n // 10, 2)
        length = fft.next_fast_len(2 * n - 1, real=True)
        spectrum = fft.rfft(series, length) * fft.rfft(series[::-1], length)
        full = fft.irfft(spectrum, length)[n - 1 : n - 1 + lags] / n
        taper = full * (1.0 - np.arange(lags) / lags)
        meat = meat + part.T @ _coloured(part, taper, difference_noise(series[begin:]))
        inflation = max(float(2.0 * np.sum(taper) - taper[0]) / max(float(taper[0]), 1e-300), 1.0)
        independent.append(n / inflation)
    level = (
        level_a / values[places.NOISE_I] * jacobian[begin * channels : n * channels : channels].sum(axis=0)
    )
    meat = meat + np.outer(level, level)
    # Rounding may leave a direction that hardly matters a negative variance.
    variances, vectors = np.linalg.eigh(0.5 * (meat + meat.T))
    spread = bread @ (vectors * np.sqrt(np.maximum(variances, 0.0)))
    return spread @ spread.T / np.outer(size, size), tuple(independent)


def _coloured(columns: FloatArray, covariance: FloatArray, noise: float) -> FloatArray:
    """Covariance matrix of a stationary series times columns.

    A spectrum from one short series scatters by a third at each frequency; what it shows below the white noise is
    chance, and would make a steady level look better known than its noise allows.

    Args:
        columns: shape (n, m).
        covariance: of samples 0, 1, ... apart, shape (lags,).
        noise: standard deviation of the white noise in it.

    Returns:
        Shape (n, m).
    """
    n, lags = len(columns), len(covariance)
    size = n + 2 * lags
    kernel = np.concatenate([covariance, np.zeros(size - 2 * lags + 1), covariance[:0:-1]])
    spectrum = np.maximum(np.fft.rfft(kernel).real, noise**2)
    out: FloatArray = np.fft.irfft(spectrum[:, None] * np.fft.rfft(columns, size, axis=0), size, axis=0)[:n]
    return out


def capped(covariance: FloatArray) -> FloatArray:
    """A covariance of logarithms with no standard deviation above 10: what is not told to e^10 is not told."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    out: FloatArray = (vectors * np.clip(values, 1e-12, 100.0)) @ vectors.T
    return out
