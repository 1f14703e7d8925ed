"""Run lengths of decision rules: exact Markov chains and integral equations.

Everything here is for independent standard normal input, which whitened innovations are while the belief holds
(Kailath 1968). A rule's state is a Markov chain; one sample takes the function `f(state)` of "what is expected from
here on" to `kernel f`. The average run length solves (1 - kernel) L = 1; the probability of no alarm within
n samples is kernel^n 1 (Brook & Evans 1972). For a continuous state the kernel is an integral, at Gauss-Legendre nodes
(Nystrom's method; Goel & Wu 1971, Crowder 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from motor_env.motor.parameters import FloatArray, require

LONGEST_WINDOW = 14
"""Longest window N of the M-of-N chain, which has 2^(N - 1) states."""

LONGEST_RUN = 1e12
"""Longest average run length that the equations resolve."""

_NODES_PER_STD = 4.0
_LEAST_NODES = 40
_MOST_NODES = 3000


@dataclass(frozen=True, slots=True)
class Chain:
    """A rule without its alarm: where it goes from each state while it stays silent (Brook & Evans 1972).

    Attributes:
        kernel: weights from each state to each state, shape (n_states, n_states); rows sum to less than 1.
        start: index of the state in which a rule begins.
    """

    kernel: FloatArray
    start: int = 0

    def average_run_length(self) -> float:
        """Expected samples to the alarm, from the start (Brook & Evans 1972); infinite where rounding hides it."""
        size = len(self.kernel)
        length = float(np.linalg.solve(np.eye(size) - self.kernel, np.ones(size))[self.start])
        # Beyond 1e12 samples, 1 - kernel is singular to working precision.
        return length if 1.0 - 1e-9 <= length < LONGEST_RUN else np.inf

    def survival(self, n_samples: int) -> FloatArray:
        """Probability of no alarm within 0, 1, ..., `n_samples` samples, shape (n_samples + 1,)."""
        silent = np.ones(len(self.kernel))
        answer = np.empty(n_samples + 1)
        for k in range(n_samples + 1):
            answer[k] = silent[self.start]
            silent = self.kernel @ silent
        return answer

    def alarm_probability(self, n_samples: int) -> float:
        """Probability of an alarm within `n_samples`, by the power of the chain's matrix."""
        silent = np.ones(len(self.kernel))
        power, left = self.kernel, n_samples
        while left:
            if left & 1:
                silent = power @ silent
            left >>= 1
            if left:
                power = power @ power
        return 1.0 - float(silent[self.start])


def m_of_n_chain(probability: float, needed: int, among: int) -> Chain:
    """Exact chain of "at least M hits among the last N samples", hits being independent (Brook & Evans 1972).

    The state is the last N - 1 hits as bits. With M = N it is the rule of k in a row, whose average run length is
    (1 - p^k) / (p^k (1 - p)) (Feller 1968, ch. XIII.7). 3 of 5 at p = 0.05 has 1608.

    Args:
        probability: of a hit.
        needed: M.
        among: N, at most `LONGEST_WINDOW`.

    Raises:
        ValueError: not 1 <= M <= N <= `LONGEST_WINDOW`, or the probability is not one.
    """
    require(
        1 <= needed <= among <= LONGEST_WINDOW,
        f"needed and among must satisfy 1 <= M <= N <= {LONGEST_WINDOW}, got M = {needed}, N = {among}",
    )
    require(0.0 <= probability <= 1.0, f"probability must lie in 0 .. 1, got {probability:g}")
    if needed == among:  # the hits in a row are enough of a state
        kernel = np.zeros((needed, needed))
        kernel[:, 0] = 1.0 - probability
        kernel[np.arange(needed - 1), np.arange(1, needed)] = probability
        return Chain(kernel)
    size = 1 << (among - 1)
    states = np.arange(size)
    hits = np.array([bin(state).count("1") for state in states])
    kernel = np.zeros((size, size))
    np.add.at(kernel, (states, (states << 1) & (size - 1)), np.where(hits < needed, 1.0 - probability, 0.0))
    hit = ((states << 1) | 1) & (size - 1)
    np.add.at(kernel, (states, hit), np.where(hits + 1 < needed, probability, 0.0))
    return Chain(kernel)


def cusum_chain(reference: float, threshold: float, shift: float = 0.0) -> Chain:
    """Chain of the one-sided CUSUM S = max(0, S + r - k), alarm above h, for r normal with mean `shift`.

    Integral equation of Page (1954), solved at Gauss-Legendre nodes (Goel & Wu 1971). State 0 is the atom S = 0.
    For k = 0.5, h = 5 the average run length is 931.

    Args:
        reference: k, half the shift looked for.
        threshold: h.
        shift: mean of the whitened innovation; 0 while healthy.
    """
    nodes, weights = _nodes(0.0, threshold, threshold)
    start = np.concatenate([[0.0], nodes])
    mean = start + shift - reference
    kernel = np.empty((len(start), len(start)))
    kernel[:, 0] = ndtr(-mean)
    kernel[:, 1:] = _density(nodes[None, :] - mean[:, None]) * weights
    return Chain(kernel)


def shiryaev_roberts_chain(looked_for: float, log_threshold: float, shift: float = 0.0) -> Chain:
    """Chain of the Shiryaev-Roberts statistic R = (1 + R) L, alarm at log R above the threshold, from R = 0.

    L is the likelihood ratio of a shift `looked_for` in standard normal samples (Shiryaev 1963, Roberts 1966;
    integral equation: Moustakides, Polunchenko & Tartakovsky 2011, here for log R). State 0 is R = 0.

    Args:
        looked_for: shift d of the likelihood ratio, > 0.
        log_threshold: threshold on log R.
        shift: mean of the whitened innovation; 0 while healthy.
    """
    drift = looked_for * (shift - 0.5 * looked_for)
    lowest = drift - 9.0 * looked_for
    if log_threshold <= lowest:
        return Chain(np.zeros((1, 1)))
    nodes, weights = _nodes(lowest, log_threshold, (log_threshold - lowest) / looked_for)
    mean = drift + np.concatenate([[0.0], np.logaddexp(0.0, nodes)])
    kernel = np.zeros((len(mean), len(mean)))
    z = (nodes[None, :] - mean[:, None]) / looked_for
    kernel[:, 1:] = _density(z) * weights / looked_for
    return Chain(kernel)


def sprt_chain(looked_for: float, lower: float, upper: float, *, restart: bool, shift: float = 0.0) -> Chain:
    """Chain of Wald's sequential test: log-likelihood ratio between two bounds, alarm above the upper one.

    Args:
        looked_for: shift d of the likelihood ratio, > 0.
        lower: bound < 0 at which "healthy" is accepted.
        upper: bound > 0 at which the alarm is given.
        restart: whether an accepted test begins anew; else it stays silent for ever (Wald 1945).
        shift: mean of the whitened innovation; 0 while healthy.
    """
    require(lower < 0.0 < upper, f"bounds must satisfy lower < 0 < upper, got {lower:g} and {upper:g}")
    nodes, weights = _nodes(lower, upper, (upper - lower) / looked_for)
    mean = np.concatenate([[0.0], nodes]) + looked_for * (shift - 0.5 * looked_for)
    # State 0 is the start (where a restart leads); the last one has accepted and stays.
    size = len(mean) + 1
    kernel = np.zeros((size, size))
    z = (nodes[None, :] - mean[:, None]) / looked_for
    kernel[:-1, 1:-1] = _density(z) * weights / looked_for
    kernel[:-1, 0 if restart else -1] = ndtr((lower - mean) / looked_for)
    kernel[-1, 0 if restart else -1] = 1.0
    return Chain(kernel)


def two_sided(survival: FloatArray) -> FloatArray:
    """Survival of the first alarm of two mirrored CUSUMs, from the survival of one of them.

    When one of them alarms first, the other stands at 0 (van Dobben de Bruyn 1968), so its run begins anew there. With
    f and p the probabilities of an alarm at each sample of one and of both, p = 2 f - f * p: exact, and for the
    averages 1 / ARL = 2 / ARL of one.
    """
    alarm = -np.diff(survival)
    both = np.empty_like(alarm)
    for k in range(len(alarm)):
        both[k] = 2.0 * alarm[k] - alarm[:k][::-1] @ both[:k]
    return np.concatenate([[1.0], 1.0 - np.cumsum(both)])


def siegmund_average_run_length(reference: float, threshold: float, shift: float = 0.0) -> float:
    """Siegmund's approximation (1985, eq. 2.57) of the CUSUM's average run length; for checks and first guesses."""
    drift = shift - reference
    b = threshold + 1.166
    if abs(drift) < 1e-9:
        return b * b
    return float((np.exp(-2.0 * drift * b) + 2.0 * drift * b - 1.0) / (2.0 * drift * drift))


def _nodes(low: float, high: float, stds: float) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights for a range that is `stds` standard deviations of the kernel long."""
    count = int(_LEAST_NODES + _NODES_PER_STD * stds)
    require(
        count <= _MOST_NODES, f"threshold is {stds:.0f} standard deviations high: too high for the equation"
    )
    nodes, weights = np.polynomial.legendre.leggauss(count)
    half = 0.5 * (high - low)
    return low + half * (nodes + 1.0), half * weights


def _density(z: FloatArray) -> FloatArray:
    density: FloatArray = np.exp(-0.5 * np.square(z)) / np.sqrt(2.0 * np.pi)
    return density
