"""The statistic of a rule, sample by sample, and what a threshold on it is asked for.

The batch, the stream and the simulations of a rule all run its `Statistic`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from motor_env.common.arrays import number, numbers, whole
from motor_env.detection.run_length import RunLaw
from motor_env.motor.parameters import FloatArray, require

_MOST = 1e30  # samples: at any rate longer than anything runs
LONGEST = 10**9
"""Samples of a transient: a day at 10 kHz."""


class Threshold(NamedTuple):
    """Threshold of a rule for a wanted false-alarm rate, with how it was found.

    Attributes:
        value: the rule alarms where its statistic is larger.
        standard_error: 0 where the threshold is exact, else that of the calibrating simulation.
        method: how it was found.
    """

    value: float
    standard_error: float
    method: str


@dataclass(frozen=True, slots=True)
class Request:
    """What a threshold is asked for: an average run length, or a probability within some samples."""

    arl0: float | None
    probability: float | None
    n_samples: int

    @classmethod
    def checked(
        cls, arl0: float | None, false_alarm_probability: float | None, n_samples: int | None
    ) -> Request:
        """The request, refused in one sentence unless exactly one of the two is given and sensible."""
        require(
            (arl0 is None) != (false_alarm_probability is None),
            "give one of arl0 and false_alarm_probability, got " + ("none" if arl0 is None else "both"),
        )
        if arl0 is not None:
            return cls(number("arl0", arl0, above=1.0, most=_MOST), None, 0)
        probability = number("false_alarm_probability", false_alarm_probability, least=1.0 / _MOST, below=1.0)
        require(
            n_samples is not None, "false_alarm_probability needs the transient's n_samples >= 1, got None"
        )
        return cls(None, probability, whole("n_samples", n_samples, 1, LONGEST))

    def solve(self, law: Callable[[float], RunLaw], *, low: float, step: float) -> float:
        """Threshold that meets the request.

        Args:
            law: of the samples to an alarm, for a threshold; a higher one never alarms earlier.
            low: threshold that is surely too low.
            step: first step upwards from there; the steps grow by a half each.

        Raises:
            ValueError: the rule gives fewer false alarms at any threshold, or needs one that its equation cannot be
                solved for.
        """

        def excess(threshold: float) -> float:
            if self.arl0 is not None:
                return float(np.log(law(threshold).average_run_length()) - np.log(self.arl0))
            probability = law(threshold).alarm_probability(self.n_samples)
            return float(np.log(self.probability or 0.0) - np.log(max(probability, 1e-300)))

        require(
            excess(low) < 0.0, "even at its lowest threshold this rule gives fewer false alarms than that"
        )
        high = low + step
        while excess(high) < 0.0:
            low, high, step = high, high + 1.5 * step, 1.5 * step
        return float(brentq(excess, low, high, xtol=1e-10, rtol=1e-12))


class Statistic(ABC):
    """A running statistic of whitened innovations, and the exact threshold on it where theory gives one."""

    __slots__ = ()

    def start(self, n_streams: int) -> FloatArray:
        """State before the first sample, shape (n_streams, width): one number, 0, unless a rule says otherwise."""
        return np.zeros((n_streams, 1))

    @abstractmethod
    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Statistic after each sample, shape (n_streams, n_samples); the state is carried on in place.

        Args:
            state: as `start` gives it.
            whitened: shape (n_streams, n_samples, n_channels). A channel that is NaN was not measured: the rule takes
                no notice of it.
        """

    def exact_threshold(self, request: Request, n_channels: int) -> Threshold | None:
        """Threshold by theory, None where there is none and it has to be simulated."""
        return None

    def statistic(self, whitened: ArrayLike) -> FloatArray:
        """Statistic after each sample.

        Args:
            whitened: shape (..., n_samples, n_channels), as in `FilterResult.whitened`.

        Returns:
            Shape (..., n_samples).
        """
        values = numbers("whitened", whitened, ("...", "n_samples", "n_channels"), missing=True)
        flat = values.reshape(-1, *values.shape[-2:])
        return self.scan(self.start(len(flat)), flat).reshape(values.shape[:-1])
