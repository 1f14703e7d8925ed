"""Rules that look back over a window: summed NIS, and the generalised likelihood ratio with a scanned onset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import instance, numbers, whole
from motor_env.detection.rules import glr_kernels, kernels
from motor_env.detection.rules.base import Rule
from motor_env.detection.rules.cusum import first_channel
from motor_env.motor.parameters import FloatArray, require

_LONGEST = 1_000_000
_AGE_RATIO = 1.15
_LEAST_BUFFER = 512  # samples that the GLR holds beside the longest age, so that it seldom has to move them


@dataclass(frozen=True, slots=True)
class WindowedNis(Rule):
    """Sum of the NIS over the last w samples (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4).

    One look at it after w samples or more has the chi-square law with w degrees of freedom a channel; watching it all
    along does not, and its threshold is simulated.

    Attributes:
        window: w.
    """

    window: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "window", whole("window", self.window, 1, _LONGEST))

    def start(self, n_streams: int) -> FloatArray:
        """A ring of the last w squares, the place of the oldest, and their sum."""
        return np.zeros((n_streams, self.window + 2))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Sum of the last w squares."""
        total: FloatArray = kernels.windowed_sum(kernels.square(whitened), state)
        return total


@dataclass(frozen=True, slots=True)
class Glr(Rule):
    """Generalised likelihood ratio of a fault of unknown size that began m samples ago, maximised over m and size.

    The statistic is the largest of x|x| + 2 ln m over the ages m, x = sum_i s_i r_i / sqrt(sum_i s_i^2), i = 1 .. m
    samples since the onset, with the fault's signature s: the growth of the whitened innovation after an onset (Willsky
    & Jones 1976; window-limited on a geometric grid of ages: Lai 1995). Without a signature the fault is a step of the
    mean. With the term 2 ln m each octave of ages gives about as many false alarms as the next (Dumbgen & Spokoiny
    2001).

    Attributes:
        shortest: least age of an onset that is scanned, in samples.
        longest: greatest one.
        two_sided: whether both signs of the fault count (|x|^2 for x|x|); else a positive multiple of the signature.
        signature: shape (n,); beyond its end it keeps its last value. None: a step.
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
        """Ages of an onset that are scanned: a grid that is near geometric (Lai 1995)."""
        count = 1 + int(np.ceil(np.log(self.longest / self.shortest) / np.log(_AGE_RATIO)))
        grid = np.round(np.geomspace(self.shortest, self.longest, count))
        return np.unique(grid.astype(np.int64))

    def _shape(self) -> FloatArray:
        if self.signature is None:
            return np.zeros(0)
        given = np.asarray(self.signature, dtype=np.float64)[: self.longest]
        return np.concatenate([given, np.full(self.longest - len(given), given[-1])])

    def start(self, n_streams: int) -> FloatArray:
        """The last samples (their running sums for a step), how many are held, and how many there have been."""
        held = self.longest + 1 + max(self.longest + 1, _LEAST_BUFFER)
        state = np.zeros((n_streams, held + 2))
        state[:, -2] = 1.0  # the sum of no sample
        return state

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Largest value over the ages that fit into the samples so far; minus infinity before there is one."""
        answer, ages = np.empty(whitened.shape[:2]), self.ages
        glr_kernels.glr(
            first_channel(whitened), ages, self._shape(), 2.0 * np.log(ages), self.two_sided, state, answer
        )
        return answer
