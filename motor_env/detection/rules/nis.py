"""Rules on the normalised innovation squared (NIS): single, k in a row, M of N, summed over a window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.special import chdtrc

from motor_env.detection.rules import kernels
from motor_env.detection.rules.base import ExactRule
from motor_env.detection.run_length import HitChain, RunLaw
from motor_env.motor.parameters import FloatArray


@dataclass(frozen=True, slots=True)
class MOfN(ExactRule):
    """Alarm when at least M of the last N samples have a NIS above the threshold.

    The statistic is the M-th largest NIS of the last N, which is above the threshold exactly then. M = N = 1 is the
    plain NIS test, M = N = k the rule of k in a row. The threshold is exact: chi-square for a hit, Markov chain for
    the rule (Brook & Evans 1972; the rule: Schwartz 1956).

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
        """A ring of the last N squares, none so far, and the place of the oldest."""
        return np.zeros((n_streams, self.among + 1))

    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """M-th largest of the last N squares."""
        squares: FloatArray = kernels.square(whitened)
        return squares if self.among == 1 else kernels.m_of_n(squares, self.needed, state)

    @property
    def lowest(self) -> tuple[float, float]:
        """No square is below 0."""
        return 0.0, 1.0

    def run_law(self, threshold: float, shift: float = 0.0, n_channels: int = 1) -> RunLaw:
        """By the chain of the last hits, for innovations whose mean has the length `shift`."""
        if not shift:
            return HitChain(float(chdtrc(n_channels, max(threshold, 0.0))), self.needed, self.among)
        from scipy.stats import ncx2  # it takes long to import, and the tail of this law stands nowhere else

        return HitChain(float(ncx2.sf(max(threshold, 0.0), n_channels, shift**2)), self.needed, self.among)


def nis_rule() -> MOfN:
    """Rule that alarms when the NIS of one sample is above a threshold (Bar-Shalom, Li & Kirubarajan 2001, ch. 5.4)."""
    return MOfN(1, 1)


def in_a_row(count: int) -> MOfN:
    """`count` samples in a row with a NIS above the threshold (paper, Figure 1: confirmation; Feller 1968)."""
    return MOfN(count, count)
