"""Rules that look back over a window: summed NIS, and the generalised likelihood ratio with a scanned onset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from motor_env.parameters import FloatArray, require
from motor_env.rules.base import Rule, Threshold, Wanted
from motor_env.rules.calibration import CALIBRATION_SEED, simulated_threshold
from motor_env.rules.cusum import projected
from motor_env.rules.nis import normalised_square


class _Simulated(Rule):
    """A rule whose thresholds are simulated."""

    __slots__ = ()

    def threshold_for(
        self,
        *,
        arl0: float | None = None,
        false_alarm_probability: float | None = None,
        n_samples: int | None = None,
        n_channels: int = 1,
        runs: int | None = None,
        seed: int = CALIBRATION_SEED,
    ) -> Threshold:
        """Threshold by simulation, with its standard error; `runs` healthy runs calibrate it.

        The default is 20,000 runs for a probability and 1,000 for an average run length (standard error 3 % of it).
        """
        wanted = Wanted.checked(arl0, false_alarm_probability, n_samples)
        count = runs if runs is not None else (1_000 if wanted.arl0 is not None else 20_000)
        return simulated_threshold(self, wanted, runs=count, n_channels=n_channels, seed=seed)


@dataclass(frozen=True, slots=True)
class WindowedNis(_Simulated):
    """Sum of the NIS over the last w samples (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4).

    One look at it after w samples or more has the chi-square law with w degrees of freedom a channel (`one_look`);
    watching it all along does not, and its threshold is simulated.

    Attributes:
        window: w.
    """

    window: int

    def __post_init__(self) -> None:
        require(self.window >= 1, f"window must be >= 1, got {self.window}")

    def start(self, n_streams: int, n_channels: int) -> FloatArray:
        """The last w squares, oldest first, and their sum."""
        return np.zeros((n_streams, self.window + 1))

    def step(self, state: FloatArray, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sum of the last w squares."""
        squares = np.concatenate([state[:, 1:-1], normalised_square(whitened)[:, None]], axis=1)
        total = squares.sum(axis=1)
        return np.concatenate([squares, total[:, None]], axis=1), total

    def one_look(self, false_alarm_probability: float, n_channels: int = 1) -> Threshold:
        """Exact threshold for one look at a full window."""
        value = float(chi2.isf(false_alarm_probability, self.window * n_channels))
        return Threshold(value, 0.0, "exact: chi-square, one look")


def scanned_ages(shortest: int, longest: int, ratio: float = 1.15) -> NDArray[np.int64]:
    """Ages of an onset on a grid that is near geometric (Lai 1995), from `shortest` to `longest` samples."""
    count = 1 + int(np.ceil(np.log(longest / shortest) / np.log(ratio)))
    grid: NDArray[np.int64] = np.unique(np.round(np.geomspace(shortest, longest, count)).astype(np.int64))
    return grid


@dataclass(frozen=True, slots=True)
class Glr(_Simulated):
    """Generalised likelihood ratio of a fault of unknown size that began m samples ago, maximised over m and size.

    The statistic is max over m of (sum_i s_i r_i)^2 / sum_i s_i^2, i = 1 .. m samples since the onset, with the fault's
    signature s: the growth of the whitened innovation after an onset (Willsky & Jones 1976; window-limited on a
    geometric grid of ages: Lai 1995). Without a signature the fault is a step of the mean.

    Attributes:
        shortest: least age of an onset that is scanned, in samples.
        longest: greatest one.
        two_sided: whether both signs of the fault count; else only a positive multiple of the signature.
        signature: shape (n,) for one channel; beyond its end it keeps its last value. None: a step.
        direction: over the channels; by default the first one.
    """

    shortest: int = 1
    longest: int = 1000
    two_sided: bool = False
    signature: tuple[float, ...] | None = None
    direction: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        require(
            1 <= self.shortest <= self.longest,
            f"shortest and longest must satisfy 1 <= shortest <= longest, got {self.shortest} and {self.longest}",
        )
        if self.signature is not None:
            require(
                len(self.signature) > 0 and any(self.signature), "signature must not be empty or all zero"
            )

    @property
    def n_channels(self) -> int | None:
        """As many as the direction has entries; any number where the first channel is taken."""
        return None if self.direction is None else len(self.direction)

    @property
    def ages(self) -> NDArray[np.int64]:
        """Scanned ages."""
        return scanned_ages(self.shortest, self.longest)

    def _shape(self) -> FloatArray:
        if self.signature is None:
            return np.ones(self.longest)
        given = np.asarray(self.signature, dtype=np.float64)[: self.longest]
        return np.concatenate([given, np.full(self.longest - len(given), given[-1])])

    def start(self, n_streams: int, n_channels: int) -> FloatArray:
        """A ring of the last samples (of their running sum for a step), then samples so far; changed in place."""
        return np.zeros((n_streams, self.longest + 2))

    def step(self, state: FloatArray, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Largest ratio over the ages that fit into the samples so far; 0 before there is one."""
        answer = np.empty(len(state))
        shape = np.zeros(0) if self.signature is None else self._shape()
        _glr_step(state, projected(whitened, self.direction), self.ages, shape, self.two_sided, answer)
        return state, answer

    def statistic(self, whitened: ArrayLike) -> FloatArray:
        """Statistic after each sample, shape (..., n_samples): as the stream gives it, without its ring buffer."""
        values = np.asarray(whitened, dtype=np.float64)
        require(
            values.ndim >= 2 and self.n_channels in (None, values.shape[-1]),
            f"whitened must have shape (..., n_samples, {self.n_channels or 'n_channels'}), got {values.shape}",
        )
        along = projected(values.reshape(-1, values.shape[-1]), self.direction)
        series = np.ascontiguousarray(along.reshape(-1, values.shape[-2]))
        answer = np.empty_like(series)
        if self.signature is None:
            _glr_of_steps(series, self.ages, self.two_sided, answer)
        else:
            _glr_of_signatures(series, self.ages, self._shape(), self.two_sided, answer)
        return answer.reshape(values.shape[:-1])


@njit(cache=True)
def _glr_step(
    state: FloatArray,
    sample: FloatArray,
    ages: NDArray[np.int64],
    shape: FloatArray,
    two_sided: bool,
    answer: FloatArray,
) -> None:
    ring = state.shape[1] - 1
    of_steps = len(shape) == 0
    for n in range(state.shape[0]):
        before = int(state[n, ring]) % ring
        seen = int(state[n, ring]) + 1
        at = seen % ring
        state[n, at] = state[n, before] + sample[n] if of_steps else sample[n]
        state[n, ring] = seen
        best = 0.0
        for m in ages:
            if m > seen:
                break
            total, energy = 0.0, 0.0
            if of_steps:
                total, energy = state[n, at] - state[n, (seen - m) % ring], float(m)
            else:
                for i in range(m):
                    total += shape[i] * state[n, (seen - (m - 1 - i)) % ring]
                    energy += shape[i] * shape[i]
            if (two_sided or total > 0.0) and energy > 0.0:
                best = max(best, total * total / energy)
        answer[n] = best


@njit(cache=True)
def _glr_of_steps(series: FloatArray, ages: NDArray[np.int64], two_sided: bool, answer: FloatArray) -> None:
    length = series.shape[1]
    sums = np.zeros(length + 1)
    weight = 1.0 / ages
    for n in range(series.shape[0]):
        for k in range(length):
            sums[k + 1] = sums[k] + series[n, k]
            best = 0.0
            for j in range(len(ages)):
                m = ages[j]
                if m > k + 1:
                    break
                total = sums[k + 1] - sums[k + 1 - m]
                if two_sided or total > 0.0:
                    best = max(best, total * total * weight[j])
            answer[n, k] = best


@njit(cache=True)
def _glr_of_signatures(
    series: FloatArray, ages: NDArray[np.int64], shape: FloatArray, two_sided: bool, answer: FloatArray
) -> None:
    energy = np.cumsum(shape * shape)
    for n in range(series.shape[0]):
        for k in range(series.shape[1]):
            best = 0.0
            for m in ages:
                if m > k + 1:
                    break
                total = 0.0
                for i in range(m):
                    total += shape[i] * series[n, k + 1 - m + i]
                if (two_sided or total > 0.0) and energy[m - 1] > 0.0:
                    best = max(best, total * total / energy[m - 1])
            answer[n, k] = best
