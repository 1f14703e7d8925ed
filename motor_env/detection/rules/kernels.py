"""Compiled scans of the rules: one pass over each stream; its state changes in place.

`series` has shape (n_streams, n_samples), NaN where nothing was measured; `squares` likewise, 0 there; `out` is the
statistic after each sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.parameters import FloatArray

LARGEST_ODDS = 1e250


@njit(cache=True)
def square(whitened: FloatArray) -> FloatArray:
    """Compute the normalised innovation squared; a missing channel adds nothing."""
    out = np.empty(whitened.shape[:2])
    for n in range(whitened.shape[0]):
        for k in range(whitened.shape[1]):
            total = 0.0
            for c in range(whitened.shape[2]):
                value = whitened[n, k, c]
                if not np.isnan(value):
                    total += value * value
            out[n, k] = total
    return out


@njit(cache=True)
def cusum(series: FloatArray, half: float, sums: FloatArray) -> FloatArray:
    """Compute S <- max(0, S +- r - d/2); one column of `sums` for each sign (Page 1954)."""
    out = np.empty(series.shape)
    two_sided = sums.shape[1] == 2
    for n in range(series.shape[0]):
        up = sums[n, 0]
        down = sums[n, 1] if two_sided else 0.0
        for k in range(series.shape[1]):
            value = series[n, k]
            if not np.isnan(value):
                up = max(up + value - half, 0.0)
                if two_sided:
                    down = max(down - value - half, 0.0)
            out[n, k] = max(up, down)
        sums[n, 0] = up
        if two_sided:
            sums[n, 1] = down
    return out


@njit(cache=True)
def sprt(series: FloatArray, shift: float, lower: float, restart: bool, ratios: FloatArray) -> FloatArray:
    """Compute the log-likelihood ratio; minus infinity once accepted, or 0 at a restart (Wald 1945)."""
    out = np.empty(series.shape)
    accepted = 0.0 if restart else -np.inf
    for n in range(series.shape[0]):
        ratio = ratios[n, 0]
        for k in range(series.shape[1]):
            value = series[n, k]
            if not np.isnan(value):
                ratio += shift * (value - 0.5 * shift)
                if ratio <= lower:
                    ratio = accepted
            out[n, k] = ratio
        ratios[n, 0] = ratio
    return out


def mixture(series: FloatArray, shifts: FloatArray, weights: FloatArray, odds: FloatArray) -> FloatArray:
    """Compute the log of the summed odds O_j <- (O_j + w_j) L_j, L_j the likelihood ratio of d_j (Shiryaev 1963)."""
    total = np.zeros(series.shape)
    for j, (shift, weight) in enumerate(zip(shifts, weights, strict=True)):
        _add_odds(np.exp(shift * (series - 0.5 * shift)), weight, odds[:, j], total)
    with np.errstate(divide="ignore"):  # before the first sample that was measured there are no odds
        logarithm: FloatArray = np.log(total)
    return logarithm


@njit(cache=True)
def _add_odds(ratios: FloatArray, weight: float, odds: FloatArray, total: FloatArray) -> None:
    for n in range(ratios.shape[0]):
        odd = odds[n]
        for k in range(ratios.shape[1]):
            if not np.isnan(ratios[n, k]):
                odd = min((odd + weight) * ratios[n, k], LARGEST_ODDS)  # cannot overflow
            total[n, k] += odd
        odds[n] = odd


@njit(cache=True)
def m_of_n(squares: FloatArray, needed: int, recent: FloatArray) -> FloatArray:
    """Compute the M-th largest of the last N (Schwartz 1956); `recent` is a ring of them and the oldest's index."""
    out = np.empty(squares.shape)
    among = recent.shape[1] - 1
    largest = np.empty(needed)
    for n in range(squares.shape[0]):
        oldest = int(recent[n, among])
        for k in range(squares.shape[1]):
            recent[n, oldest] = squares[n, k]
            oldest = oldest + 1 if oldest + 1 < among else 0
            largest[:] = -1.0  # the M largest so far, in falling order
            for j in range(among):
                value = recent[n, j]
                for i in range(needed):
                    before = largest[i]
                    largest[i] = (
                        value if value > before else before
                    )  # no branch: it would be guessed wrong half the time
                    value = before if value > before else value
            out[n, k] = largest[needed - 1]
        recent[n, among] = oldest
    return out


@njit(cache=True)
def windowed_sum(squares: FloatArray, recent: FloatArray) -> FloatArray:
    """Compute the sum of the last w; `recent` is a ring of them, the oldest's index, and the sum."""
    out = np.empty(squares.shape)
    window = recent.shape[1] - 2
    for n in range(squares.shape[0]):
        oldest, total = int(recent[n, window]), recent[n, window + 1]
        for k in range(squares.shape[1]):
            total += squares[n, k] - recent[n, oldest]
            recent[n, oldest] = squares[n, k]
            oldest += 1
            if oldest == window:  # rounding does not pile up
                oldest, total = 0, recent[n, :window].sum()
            out[n, k] = total
        recent[n, window], recent[n, window + 1] = oldest, total
    return out


@njit(cache=True)
def first_passages(
    statistic: FloatArray, begin: int, levels: FloatArray, passed: NDArray[np.int64], out: NDArray[np.int64]
) -> None:
    """Count samples to the first value above each of rising levels; `passed` counts the levels already passed."""
    for n in range(statistic.shape[0]):
        k = 0
        while k < statistic.shape[1] and passed[n] < len(levels):
            if statistic[n, k] > levels[passed[n]]:
                out[n, passed[n]] = begin + k + 1
                passed[n] += 1
            else:
                k += 1
