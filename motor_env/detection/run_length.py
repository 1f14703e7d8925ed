"""Run lengths of decision rules: exact Markov chains and integral equations.

For independent standard normal input. A rule's state is a Markov chain: the average run length solves (1 - kernel) L =
1, and no alarm within n samples has the probability kernel^n 1 (Brook & Evans 1972). For a continuous state the kernel
is an integral, at Gauss-Legendre nodes (Goel & Wu 1971, Crowder 1987).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import ndtr

from motor_env.common.arrays import whole
from motor_env.motor.parameters import FloatArray, require

LONGEST_WINDOW = 14
"""Longest window N of the M-of-N chain, which has 2^(N - 1) states."""

_SETTLED = 1e-14  # relative change from sample to sample of what no longer changes
_NEGLIGIBLE = 1e-300  # probability below which nothing is left to alarm
_MOST_TWO_SIDED = 20_000  # the sum takes their number squared
_NODES_PER_STD = 4.0
_LEAST_NODES = 40
_MOST_NODES = 3000


class RunLaw(Protocol):
    """Law of the samples to a rule's alarm."""

    def average_run_length(self) -> float:
        """Return the expected samples to the alarm."""

    def alarm_probability(self, n_samples: int) -> float:
        """Return the probability of an alarm within `n_samples`."""


@dataclass(frozen=True, slots=True)
class Chain:
    """Transitions of a rule before its alarm (Brook & Evans 1972).

    Attributes:
        kernel: weights from state to state, shape (n_states, n_states); rows sum to less than 1. The first state is
            the start.
        alarm: probability of an alarm at the next sample from each state, shape (n_states,).
    """

    kernel: FloatArray
    alarm: FloatArray

    def average_run_length(self) -> float:
        """Return the expected samples to the alarm."""
        if not self.alarm.any():
            return np.inf
        # L = c + w with w = 0 at the start. (1 - kernel) 1 is the probability of the alarm, so this multiplies c,
        # where it may be far smaller than the rounding of 1 - kernel.
        matrix = np.eye(len(self.kernel)) - self.kernel
        matrix[:, 0] = self.alarm
        return float(np.linalg.solve(matrix, np.ones(len(matrix)))[0])

    def alarm_pmf(self, n_samples: int) -> FloatArray:
        """Return the probability of the alarm at sample 1, 2, ..., `n_samples`, shape (n_samples,)."""
        ahead, answer = self.alarm, np.empty(n_samples)
        for k in range(n_samples):
            answer[k] = ahead[0]
            ahead = self.kernel @ ahead
        return answer

    def alarm_probability(self, n_samples: int) -> float:
        """Return the probability of an alarm within `n_samples`, by doubling: positive terms keep small ones right."""
        total, left = np.zeros(len(self.kernel)), n_samples
        power, within = self.kernel, self.alarm
        while left:
            if left & 1:
                total = within + power @ total
            left >>= 1
            if left:
                within = within + power @ within
                power = power @ power
        return float(total[0])


@dataclass(frozen=True, slots=True)
class TwoSided:
    """The first alarm of two mirrored CUSUMs.

    When one alarms first, the other is at 0 (van Dobben de Bruyn 1968).

    Attributes:
        up: chain of the CUSUM for a rise.
        down: chain of the CUSUM for a fall.
    """

    up: Chain
    down: Chain

    def average_run_length(self) -> float:
        """Return the expected samples to the alarm: 1 / ARL is the sum over the sides."""
        rate = 1.0 / self.up.average_run_length() + 1.0 / self.down.average_run_length()
        return 1.0 / rate if rate > 0.0 else np.inf

    def alarm_pmf(self, n_samples: int) -> FloatArray:
        """Return the probability of the first alarm at each sample, shape (n_samples,): u = f - d * f, d = g - u * g.

        f and g are the probabilities of each side alone, u and d of each side being first.
        """
        f = self.up.alarm_pmf(n_samples)
        g = f if self.down is self.up else self.down.alarm_pmf(n_samples)
        u, d = np.empty(n_samples), np.empty(n_samples)
        for k in range(n_samples):
            u[k] = f[k] - d[:k][::-1] @ f[:k]
            d[k] = g[k] - u[:k][::-1] @ g[:k]
        return u + d

    def alarm_probability(self, n_samples: int) -> float:
        """Return the probability of an alarm within `n_samples`; `ValueError` for too many to sum up."""
        require(
            n_samples <= _MOST_TWO_SIDED,
            f"n_samples must be at most {_MOST_TWO_SIDED} for a two-sided rule, got {n_samples}",
        )
        return float(self.alarm_pmf(n_samples).sum())


@dataclass(frozen=True, slots=True)
class HitChain:
    """Exact chain of "at least M hits among the last N samples", hits being independent (Brook & Evans 1972).

    The state is the last N - 1 hits as bits. With M = N the average run length is (1 - p^N) / (p^N (1 - p)) (Feller
    1968, ch. XIII.7).

    Attributes:
        probability: of a hit.
        needed: M.
        among: N, at most `LONGEST_WINDOW`.

    Raises:
        ValueError: not 1 <= M <= N <= `LONGEST_WINDOW`, or no probability.
    """

    probability: float
    needed: int
    among: int

    def __post_init__(self) -> None:
        for name in ("needed", "among"):
            object.__setattr__(self, name, whole(name, getattr(self, name), least=-LONGEST_WINDOW))
        require(
            1 <= self.needed <= self.among <= LONGEST_WINDOW,
            f"needed and among must satisfy 1 <= M <= N <= {LONGEST_WINDOW}, got {self.needed} and {self.among}",
        )
        require(0.0 <= self.probability <= 1.0, f"probability must lie in 0 .. 1, got {self.probability:g}")

    def _hazards(self, n_samples: float) -> Iterator[tuple[float, float]]:
        """Yield the probabilities of no alarm so far and of an alarm at the next sample, up to `n_samples`."""
        p, hits = self.probability, np.zeros(1, dtype=np.int64)  # hits that each state holds
        for _ in range(self.among - 1):
            hits = np.concatenate([hits, hits + 1])
        last, half = hits + 1 >= self.needed, len(hits) // 2
        weights, silent, before, settled = np.eye(1, len(hits))[0], 1.0, 0.0, 0
        for k in itertools.count(1):
            alarm = p * float(weights[last].sum())
            yield silent, alarm
            going = p * np.where(last, 0.0, weights)
            if half:  # the oldest hit, the highest bit, drops out
                after = np.empty_like(weights)
                after[0::2] = (1.0 - p) * (weights[:half] + weights[half:])
                after[1::2] = going[:half] + going[half:]
            else:
                after = (1.0 - p) * weights
            # Before the first alarm is possible its rate is 0, and not settled.
            is_possible = alarm > 0.0 or k > self.among  # later, it is too small for a float
            is_settled = is_possible and abs(alarm - before) <= _SETTLED * alarm
            settled = settled + 1 if is_settled else 0
            # Divided by their own sum and not by 1 - alarm, with which the sum's rounding would grow for ever.
            silent, before = silent * float(after.sum()), alarm
            if k >= n_samples or silent <= _NEGLIGIBLE or settled >= self.among:
                return
            weights = after / after.sum()

    def average_run_length(self) -> float:
        """Return the expected samples to the alarm: the sum of the probabilities of no alarm so far."""
        if self.probability == 0.0:
            return np.inf
        silent, alarm = np.array(list(self._hazards(np.inf))).T
        if alarm[-1] == 0.0:
            return np.inf
        return float(silent[:-1].sum() + silent[-1] / alarm[-1])

    def alarm_probability(self, n_samples: int) -> float:
        """Return the probability of an alarm within `n_samples`."""
        _, alarm = np.array(list(self._hazards(n_samples))).T
        if alarm.max() >= 1.0:
            return 1.0
        silent = np.log1p(-alarm)
        return float(-np.expm1(silent.sum() + (n_samples - len(silent)) * silent[-1]))


def cusum_chain(reference: float, threshold: float, shift: float = 0.0) -> Chain:
    """Return the chain of the CUSUM S = max(0, S + r - k), alarm above h, r normal with mean `shift`.

    Integral equation of Page (1954), solved at Gauss-Legendre nodes (Goel & Wu 1971). State 0 is the atom S = 0.

    `reference` is k, half the tested shift; `shift` is 0 while healthy.
    """
    return _normal_chain(lambda state: state + shift - reference, 0.0, threshold)


def shiryaev_roberts_chain(looked_for: float, log_threshold: float, shift: float = 0.0) -> Chain:
    """Return the chain of the Shiryaev-Roberts statistic R = (1 + R) L, alarm at log R above the threshold.

    L is the likelihood ratio of a shift `looked_for` in standard normal samples (Shiryaev 1963, Roberts 1966; integral
    equation: Moustakides, Polunchenko & Tartakovsky 2011, here for log R). State 0 is R = 0.

    `shift` is the mean of the innovation, 0 while healthy.
    """
    drift = looked_for * (shift - 0.5 * looked_for)
    lowest = drift - 9.0 * looked_for
    if log_threshold <= lowest:
        return Chain(np.zeros((1, 1)), np.ones(1))

    def mean(log_r: FloatArray) -> FloatArray:
        return np.asarray(drift + np.logaddexp(0.0, log_r))

    return _normal_chain(mean, lowest, log_threshold, start=-np.inf, std=looked_for, returns=False)


def sprt_chain(looked_for: float, lower: float, upper: float, *, restart: bool, shift: float = 0.0) -> Chain:
    """Return the chain of Wald's sequential test (Wald 1945): log-likelihood ratio between two bounds.

    Args:
        looked_for: shift d of the likelihood ratio, > 0.
        lower: bound < 0 at which "healthy" is accepted.
        upper: bound > 0 of the alarm.
        restart: whether an accepted test restarts; else it stays silent.
        shift: mean of the whitened innovation; 0 while healthy.
    """
    require(lower < 0.0 < upper, f"bounds must satisfy lower < 0 < upper, got {lower:g} and {upper:g}")
    drift = looked_for * (shift - 0.5 * looked_for)
    return _normal_chain(lambda ratio: ratio + drift, lower, upper, std=looked_for, returns=restart)


def _normal_chain(
    mean: Callable[[FloatArray], FloatArray],
    low: float,
    high: float,
    *,
    start: float = 0.0,
    std: float = 1.0,
    returns: bool = True,
) -> Chain:
    """Return the chain of a statistic, normal with a mean given by its state; alarm above `high`."""
    stds = (high - low) / std
    require(
        _LEAST_NODES + _NODES_PER_STD * stds <= _MOST_NODES + 1,
        f"threshold is {stds:.0f} standard deviations high: too high for the equation",
    )
    count = int(_LEAST_NODES + _NODES_PER_STD * max(stds, 0.0))
    unit, weights = np.polynomial.legendre.leggauss(count)
    nodes = low + 0.5 * (high - low) * (unit + 1.0)
    ahead = mean(np.concatenate([[start], nodes]))
    kernel = np.zeros((count + 1, count + 1))
    density = np.exp(-0.5 * np.square((nodes - ahead[:, None]) / std)) / (np.sqrt(2.0 * np.pi) * std)
    kernel[:, 1:] = density * 0.5 * (high - low) * weights
    if returns:
        kernel[:, 0] = ndtr((low - ahead) / std)
    return Chain(kernel, ndtr((ahead - high) / std))
