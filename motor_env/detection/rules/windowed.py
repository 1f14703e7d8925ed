"""Rules over a window: M of N, sum of the NIS, and the generalised likelihood ratio with an unknown onset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from motor_env.common.arrays import instance, numbers, whole
from motor_env.detection.rules import kernels
from motor_env.detection.rules.base import ExactRule, Rule
from motor_env.detection.rules.cusum import first_channel
from motor_env.detection.run_length import HitChain, RunLaw
from motor_env.motor.compiled import njit
from motor_env.motor.parameters import FloatArray, require


@dataclass(frozen=True, slots=True)
class MOfN(ExactRule):
    """Alarm when at least M of the last N samples have a NIS above the threshold.

    The statistic is the M-th largest NIS of the last N (Schwartz 1956). The threshold is exact (Brook & Evans 1972).

    Attributes:
        needed: M.
        among: N.
    """

    needed: int = 3
    among: int = 5
    method: ClassVar[str] = "exact: chi-square and Markov chain of the last hits"

    def __post_init__(self) -> None:
        checked = HitChain(0.5, self.needed, self.among)
        object.__setattr__(self, "needed", checked.needed)
        object.__setattr__(self, "among", checked.among)

    def start(self, n_streams: int) -> FloatArray:
        """Return a ring of the last N squares, empty, and the oldest's index."""
        return np.zeros((n_streams, self.among + 1))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the M-th largest of the last N squares."""
        squares: FloatArray = kernels.square(whitened)
        return squares if self.among == 1 else kernels.m_of_n(squares, self.needed, state)

    @property
    def lowest(self) -> tuple[float, float]:
        """Return 0, as no square is below it, and a first step."""
        return 0.0, 1.0

    def run_law(self, threshold: float, shift: float = 0.0, n_channels: int = 1) -> RunLaw:
        """Return the law by the chain of the last hits, for innovations whose mean has the length `shift`."""
        if not shift:
            return HitChain(float(chdtrc(n_channels, max(threshold, 0.0))), self.needed, self.among)
        from scipy.stats import ncx2  # it takes long to import, and the tail of this law stands nowhere else

        return HitChain(float(ncx2.sf(max(threshold, 0.0), n_channels, shift**2)), self.needed, self.among)


def nis_rule() -> MOfN:
    """Return the rule that alarms at one NIS above the threshold (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4)."""
    return MOfN(1, 1)


def in_a_row(count: int) -> MOfN:
    """Return the rule of `count` NIS in a row above a threshold (paper, Figure 1: confirmation; Feller 1968)."""
    return MOfN(count, count)


@njit(cache=True)
def glr(
    series: FloatArray,
    ages: NDArray[np.int64],
    shape: FloatArray,
    bonus: FloatArray,
    two_sided: bool,
    state: FloatArray,
    out: FloatArray,
) -> None:
    """Compute the largest x|x| (or x^2) + bonus over the ages; x = sum(shape * sample) / sqrt(sum(shape^2)).

    The state holds the last samples (their running sums for a step: `shape` is empty), their number, and that of all
    samples so far. A full state keeps only the samples still needed.
    """
    longest, room = ages[-1], state.shape[1] - 2
    of_steps = len(shape) == 0
    energy = np.cumsum(shape * shape)
    best, total = np.empty(room), np.empty(room)
    for n in range(series.shape[0]):
        recent = state[n]
        stored, n_past = int(recent[room]), int(recent[room + 1])
        begin = 0
        while begin < series.shape[1]:
            if stored == room:
                base = recent[room - longest - 1] if of_steps else 0.0
                for i in range(longest + 1):
                    recent[i] = recent[room - longest - 1 + i] - base
                stored = longest + 1
            count = min(series.shape[1] - begin, room - stored)
            for i in range(count):
                value = series[n, begin + i]
                value = 0.0 if np.isnan(value) else value
                recent[stored + i] = recent[stored + i - 1] + value if of_steps else value
            best[:count] = -np.inf
            if of_steps and count == 1:  # in service: the slices of a block would cost more than the sums
                best[0] = glr_of_one(recent, stored, n_past, ages, bonus, two_sided)
            else:
                glr_of_block(
                    recent, stored, n_past, count, ages, shape, energy, bonus, two_sided, total, best
                )
            out[n, begin : begin + count] = best[:count]
            stored, n_past, begin = stored + count, n_past + count, begin + count
        recent[room], recent[room + 1] = stored, n_past


@njit(cache=True)
def glr_of_block(
    recent: FloatArray,
    stored: int,
    n_past: int,
    count: int,
    ages: NDArray[np.int64],
    shape: FloatArray,
    energy: FloatArray,
    bonus: FloatArray,
    two_sided: bool,
    total: FloatArray,
    best: FloatArray,
) -> None:
    """Raise the best statistics of the `count` samples from index `stored` on, age by age."""
    last = stored + count
    for j in range(len(ages)):
        age = ages[j]
        first = max(0, age - n_past - 1)
        if first >= count:
            break
        if len(shape) == 0:
            difference(recent[stored + first : last], recent[stored + first - age : last - age], total)
            weight = 1.0 / age
        elif energy[age - 1] > 0.0:
            for i in range(first, count):
                total[i - first] = np.dot(shape[:age], recent[stored + i + 1 - age : stored + i + 1])
            weight = 1.0 / energy[age - 1]
        else:
            continue
        raise_best(total, weight, bonus[j], two_sided, best[first:count])


@njit(cache=True)
def glr_of_one(
    sums: FloatArray, stored: int, n_past: int, ages: NDArray[np.int64], bonus: FloatArray, two_sided: bool
) -> float:
    """Return the statistic of a step after one more sample."""
    best = -np.inf
    for j in range(len(ages)):
        age = ages[j]
        if age > n_past + 1:
            break
        total = sums[stored] - sums[stored - age]
        value = total * (total if two_sided else abs(total)) * (1.0 / age) + bonus[j]
        best = value if value > best else best
    return best


# Each a plain loop over contiguous values, so that it vectorises.


@njit(cache=True)
def difference(later: FloatArray, earlier: FloatArray, total: FloatArray) -> None:
    """Compute differences of running sums."""
    for i in range(len(later)):
        total[i] = later[i] - earlier[i]


@njit(cache=True)
def raise_best(total: FloatArray, weight: float, bonus: float, two_sided: bool, best: FloatArray) -> None:
    """Raise the best to weighted squares where they are larger; one-sided ones keep their sign."""
    for i in range(len(best)):
        size = abs(total[i])
        value, stored = size * (size if two_sided else total[i]) * weight + bonus, best[i]
        best[i] = value if value > stored else stored


_LONGEST = 1_000_000
_AGE_RATIO = 1.15
_LEAST_BUFFER = 512  # samples that the GLR holds beside the longest age, so that it seldom has to move them


@dataclass(frozen=True, slots=True)
class WindowedNis(Rule):
    """Sum of the NIS over the last w samples (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4).

    Chi-square at one sample, with w degrees of freedom a channel; over a run, its threshold is simulated.

    Attributes:
        window: w.
    """

    window: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "window", whole("window", self.window, 1, _LONGEST))

    def start(self, n_streams: int) -> FloatArray:
        """Return a ring of the last w squares, the oldest's index, and their sum."""
        return np.zeros((n_streams, self.window + 2))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the sum of the last w squares."""
        total: FloatArray = kernels.windowed_sum(kernels.square(whitened), state)
        return total


@dataclass(frozen=True, slots=True)
class Glr(Rule):
    """Generalised likelihood ratio of a fault of unknown size and age m.

    The statistic is the largest of x|x| + 2 ln m over the ages m, x = sum_i s_i r_i / sqrt(sum_i s_i^2), i = 1 .. m
    samples since the onset, s the fault's signature in the whitened innovation (Willsky & Jones 1976). 2 ln m evens
    out the ages' false alarms (Dumbgen & Spokoiny 2001).

    Attributes:
        shortest: least age, in samples.
        longest: greatest age.
        two_sided: whether both signs of the fault count (|x|^2 for x|x|).
        signature: s, shape (n,); beyond its end it keeps its last value. None: a step.
    """

    shortest: int = 1
    longest: int = 1000
    two_sided: bool = False
    signature: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("shortest", "longest"):
            object.__setattr__(self, name, whole(name, getattr(self, name), -_LONGEST, _LONGEST))
        require(
            1 <= self.shortest <= self.longest,
            f"shortest and longest must satisfy 1 <= shortest <= longest, got {self.shortest} and {self.longest}",
        )
        instance("two_sided", self.two_sided, (bool, np.bool_))
        if self.signature is not None:
            signature = numbers("signature", self.signature, ("n",))
            require(bool(np.square(signature).any()), "signature must not be empty or all zero")
            object.__setattr__(self, "signature", tuple(signature.tolist()))

    @property
    def ages(self) -> NDArray[np.int64]:
        """Return the ages, a nearly geometric grid (Lai 1995)."""
        count = 1 + int(np.ceil(np.log(self.longest / self.shortest) / np.log(_AGE_RATIO)))
        grid = np.round(np.geomspace(self.shortest, self.longest, count))
        return np.unique(grid.astype(np.int64))

    def _shape(self) -> FloatArray:
        if self.signature is None:
            return np.zeros(0)
        given = np.asarray(self.signature, dtype=np.float64)[: self.longest]
        return np.concatenate([given, np.full(self.longest - len(given), given[-1])])

    def start(self, n_streams: int) -> FloatArray:
        """Return the last samples (running sums for a step), their number, and that of all samples so far."""
        held = self.longest + 1 + max(self.longest + 1, _LEAST_BUFFER)
        state = np.zeros((n_streams, held + 2))
        state[:, -2] = 1.0  # the sum of no sample
        return state

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the largest value over the ages up to now; minus infinity before there is one."""
        answer, ages = np.empty(whitened.shape[:2]), self.ages
        glr(first_channel(whitened), ages, self._shape(), 2.0 * np.log(ages), self.two_sided, state, answer)
        return answer
