"""Run lengths of decision rules: exact Markov chains and integral equations.

Everything here is for independent standard normal input, which whitened innovations are while the belief holds
(Kailath 1968). A rule's state is a Markov chain; one sample takes the function `f(state)` of "what is expected from
here on" to `kernel f`. The average run length solves (1 - kernel) L = 1; the probability of no alarm within
n samples is kernel^n 1 (Brook & Evans 1972). For a continuous state the kernel is an integral, at Gauss-Legendre nodes
(Nystrom's method; Goel & Wu 1971, Crowder 1987).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from motor_env.motor.parameters import FloatArray, require

LONGEST_WINDOW = 14
"""Longest window N of the M-of-N chain, which has 2^(N - 1) states."""

LONGEST_RUN = 1e12
"""Longest average run length that the equations resolve."""

_SETTLED = 1e-14  # relative change from sample to sample of what no longer changes
_NODES_PER_STD = 4.0
_LEAST_NODES = 40
_MOST_NODES = 3000


class RunLaw(Protocol):
    """Law of the samples to a rule's alarm."""

    def average_run_length(self) -> float:
        """Expected samples to the alarm, from the start."""

    def alarm_probability(self, n_samples: int) -> float:
        """Probability of an alarm within `n_samples`."""


@dataclass(frozen=True, slots=True)
class Chain:
    """Transitions of a rule that has not alarmed yet (Brook & Evans 1972).

    The alarm's probabilities stand beside the kernel: they may be far smaller than the rounding of 1 - kernel 1.

    Attributes:
        kernel: weights from each state to each state, shape (n_states, n_states); rows sum to less than 1.
        alarm: probability of an alarm at the next sample from each state, shape (n_states,).
        start: index of the state in which a rule begins.
    """

    kernel: FloatArray
    alarm: FloatArray
    start: int = 0

    def average_run_length(self) -> float:
        """Expected samples to the alarm, from the start (Brook & Evans 1972); infinite where rounding hides it."""
        size = len(self.kernel)
        length = float(np.linalg.solve(np.eye(size) - self.kernel, np.ones(size))[self.start])
        # Beyond 1e12 samples, 1 - kernel is singular to working precision.
        return length if 1.0 - 1e-9 <= length < LONGEST_RUN else np.inf

    def alarm_pmf(self, n_samples: int) -> FloatArray:
        """Probability that the alarm comes at sample 1, 2, ..., `n_samples`, shape (n_samples,)."""
        ahead, answer = self.alarm, np.empty(n_samples)
        for k in range(n_samples):
            answer[k] = ahead[self.start]
            ahead = self.kernel @ ahead
        return answer

    def alarm_probability(self, n_samples: int) -> float:
        """Probability of an alarm within `n_samples`, by doubling; a sum of positive terms, so small ones are right."""
        total, left = np.zeros(len(self.kernel)), n_samples
        power, within = self.kernel, self.alarm
        while left:
            if left & 1:
                total = within + power @ total
            left >>= 1
            if left:
                within = within + power @ within
                power = power @ power
        return float(total[self.start])


@dataclass(frozen=True, slots=True)
class TwoSided:
    """The first alarm of two mirrored CUSUMs.

    When one of them alarms first, the other stands at 0, so its run begins anew there (van Dobben de Bruyn 1968).

    Attributes:
        up: chain of the one that looks for a rise.
        down: chain of the other.
    """

    up: Chain
    down: Chain

    def average_run_length(self) -> float:
        """1 / ARL is the sum over the sides."""
        rate = 1.0 / self.up.average_run_length() + 1.0 / self.down.average_run_length()
        return 1.0 / rate if rate > 0.0 else np.inf

    def alarm_pmf(self, n_samples: int) -> FloatArray:
        """Probability that the first alarm comes at each sample, shape (n_samples,): u = f - d * f, d = g - u * g.

        f and g are the probabilities of the sides alone, u and d those that the side is the first.
        """
        f = self.up.alarm_pmf(n_samples)
        g = f if self.down is self.up else self.down.alarm_pmf(n_samples)
        u, d = np.empty(n_samples), np.empty(n_samples)
        for k in range(n_samples):
            u[k] = f[k] - d[:k][::-1] @ f[:k]
            d[k] = g[k] - u[:k][::-1] @ g[:k]
        return u + d

    def alarm_probability(self, n_samples: int) -> float:
        """Probability of an alarm of either within `n_samples`."""
        return float(self.alarm_pmf(n_samples).sum())


@dataclass(frozen=True, slots=True)
class HitChain:
    """Exact chain of "at least M hits among the last N samples", hits being independent (Brook & Evans 1972).

    The state is the last N - 1 hits as bits; with M = N the number of hits in a row, whose average run length is
    (1 - p^k) / (p^k (1 - p)) (Feller 1968, ch. XIII.7). 3 of 5 at p = 0.05 has 1608. Its memory is short, so its
    probabilities settle within some N samples: they are iterated, and no matrix of 2^N columns is solved.

    Attributes:
        probability: of a hit.
        needed: M.
        among: N, at most `LONGEST_WINDOW`.

    Raises:
        ValueError: not 1 <= M <= N <= `LONGEST_WINDOW`, or the probability is not one.
    """

    probability: float
    needed: int
    among: int

    def __post_init__(self) -> None:
        require(
            1 <= self.needed <= self.among <= LONGEST_WINDOW,
            f"needed and among must satisfy 1 <= M <= N <= {LONGEST_WINDOW}, got {self.needed} and {self.among}",
        )
        require(0.0 <= self.probability <= 1.0, f"probability must lie in 0 .. 1, got {self.probability:g}")

    def _hits(self) -> NDArray[np.int64]:
        """Hits that each state holds."""
        if self.needed == self.among:
            return np.arange(self.needed)
        hits = np.zeros(1, dtype=np.int64)
        for _ in range(self.among - 1):
            hits = np.concatenate([hits, hits + 1])
        return hits

    def _advance(self, weights: FloatArray, hits: NDArray[np.int64]) -> tuple[float, FloatArray]:
        """Weight of the alarm at the next sample, and the weights of the states where there is none."""
        p, last = self.probability, hits + 1 >= self.needed
        alarm = p * float(weights[last].sum())
        going = p * np.where(last, 0.0, weights)
        if self.needed == self.among:
            return alarm, np.concatenate([[(1.0 - p) * weights.sum()], going[:-1]])
        after, half = np.empty_like(weights), len(weights) // 2  # the oldest hit, the highest bit, drops out
        after[0::2] = (1.0 - p) * (weights[:half] + weights[half:])
        after[1::2] = going[:half] + going[half:]
        return alarm, after

    def average_run_length(self) -> float:
        """Expected samples to the alarm: 1 over the alarms a sample of a rule that begins anew after each one."""
        if self.probability == 0.0:
            return np.inf
        # With nearly sure hits the states would go round in a circle; a share that stays damps it.
        kept = 0.5 if self.probability > 0.5 else 0.0
        hits = self._hits()
        weights, rate, settled = np.eye(1, len(hits))[0], 0.0, 0
        while settled < self.among:
            alarm, after = self._advance(weights, hits)
            after[0] += alarm
            settled = settled + 1 if _is_settled(rate, alarm) else 0
            weights, rate = kept * weights + (1.0 - kept) * after, alarm
        return 1.0 / rate

    def alarm_probability(self, n_samples: int) -> float:
        """Probability of an alarm within `n_samples`: the alarm's hazard, which settles, summed up."""
        hits = self._hits()
        weights, log_silent, hazard, settled = np.eye(1, len(hits))[0], 0.0, 0.0, 0
        for k in range(n_samples):
            alarm, after = self._advance(weights, hits)
            if alarm >= 1.0:
                return 1.0
            if settled >= self.among:
                log_silent += (n_samples - k) * np.log1p(-alarm)
                break
            log_silent += np.log1p(-alarm)
            settled = settled + 1 if _is_settled(hazard, alarm) else 0
            weights, hazard = after / (1.0 - alarm), alarm
        return float(-np.expm1(log_silent))


def _is_settled(before: float, now: float) -> bool:
    """Whether a rate of alarms no longer changes; before the first alarm is possible it is 0, and not settled."""
    return now > 0.0 and abs(now - before) <= _SETTLED * now


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
    return Chain(kernel, ndtr(mean - threshold))


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
        return Chain(np.zeros((1, 1)), np.ones(1))
    nodes, weights = _nodes(lowest, log_threshold, (log_threshold - lowest) / looked_for)
    mean = drift + np.concatenate([[0.0], np.logaddexp(0.0, nodes)])
    kernel = np.zeros((len(mean), len(mean)))
    z = (nodes[None, :] - mean[:, None]) / looked_for
    kernel[:, 1:] = _density(z) * weights / looked_for
    return Chain(kernel, ndtr((mean - log_threshold) / looked_for))


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
    return Chain(kernel, np.append(ndtr((mean - upper) / looked_for), 0.0))


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
