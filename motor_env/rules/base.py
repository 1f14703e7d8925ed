"""What every decision rule offers: statistic, alarm, stream, threshold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from motor_env.parameters import FloatArray, require


class Threshold(NamedTuple):
    """A solved threshold.

    Attributes:
        value: the rule alarms where its statistic is larger.
        standard_error: 0 where the threshold is exact, else that of the calibrating simulation.
        method: how it was found.
    """

    value: float
    standard_error: float
    method: str


class Rule(ABC):
    """A decision rule on whitened innovations, which are white and standard normal while the belief holds.

    A rule is a value: it holds settings and no running state. `start` and `step` define it; the batch and the stream
    both call them, so they cannot disagree.
    """

    @property
    def n_channels(self) -> int | None:
        """Channels that the rule needs, or None where it takes any number."""
        return None

    @abstractmethod
    def start(self, n_streams: int, n_channels: int) -> FloatArray:
        """State before the first sample, shape (n_streams, width)."""

    @abstractmethod
    def step(self, state: FloatArray, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
        """New state, and statistic of shape (n_streams,), from samples of shape (n_streams, n_channels).

        A channel that is NaN was not measured: the rule takes no notice of it.
        """

    @abstractmethod
    def threshold_for(
        self,
        *,
        arl0: float | None = None,
        false_alarm_probability: float | None = None,
        n_samples: int | None = None,
        n_channels: int = 1,
    ) -> Threshold:
        """Threshold for a wanted rate of false alarms; give one of the two.

        Args:
            arl0: average number of samples between false alarms.
            false_alarm_probability: probability of a false alarm in a transient of `n_samples`.
            n_samples: length of the transient.
            n_channels: measured channels.

        Raises:
            ValueError: both or none is given, or the rule has no threshold of that kind.
        """

    def statistic(self, whitened: ArrayLike) -> FloatArray:
        """Statistic after each sample.

        Args:
            whitened: shape (..., n_samples, n_channels), as in `FilterResult.whitened`.

        Returns:
            Shape (..., n_samples).
        """
        values = np.asarray(whitened, dtype=np.float64)
        require(
            values.ndim >= 2 and self.n_channels in (None, values.shape[-1]),
            f"whitened must have shape (..., n_samples, {self.n_channels or 'n_channels'}), got {values.shape}",
        )
        batch, (n_samples, n_channels) = values.shape[:-2], values.shape[-2:]
        flat = values.reshape(-1, n_samples, n_channels)
        by_time = np.ascontiguousarray(np.moveaxis(flat, 1, 0))
        state = self.start(len(flat), n_channels)
        answer = np.empty((n_samples, len(flat)))
        for k in range(n_samples):
            state, answer[k] = self.step(state, by_time[k])
        return np.ascontiguousarray(answer.T).reshape(*batch, n_samples)

    def alarm_index(self, whitened: ArrayLike, threshold: float | Threshold) -> NDArray[np.int64]:
        """First sample at which the statistic is above the threshold, -1 where there is none; shape (...)."""
        limit = threshold.value if isinstance(threshold, Threshold) else threshold
        return first_above(self.statistic(whitened), limit)

    def stream(self, n_streams: int = 1, n_channels: int = 1) -> RuleStream:
        """A running copy of the rule, fed one sample at a time."""
        return RuleStream(self, n_streams, n_channels)


class RuleStream:
    """A rule in service: `update(sample)` gives what the batch gives at that sample.

    Attributes:
        rule: the rule.
        state: its running state, shape (n_streams, width).
    """

    def __init__(self, rule: Rule, n_streams: int, n_channels: int) -> None:
        require(
            rule.n_channels in (None, n_channels),
            f"n_channels must be {rule.n_channels} for this rule, got {n_channels}",
        )
        self.rule = rule
        self._shape = (n_streams, n_channels)
        self.state = rule.start(n_streams, n_channels)

    def update(self, whitened: ArrayLike) -> FloatArray:
        """Statistic after one more sample, shape (n_streams,), from shape (n_streams, n_channels)."""
        values = np.asarray(whitened, dtype=np.float64).reshape(self._shape)
        self.state, statistic = self.rule.step(self.state, values)
        return statistic

    def reset(self, streams: NDArray[np.bool_] | None = None) -> None:
        """Begin anew: all streams, or those where the mask is true."""
        fresh = self.rule.start(*self._shape)
        self.state = fresh if streams is None else np.where(streams[:, None], fresh, self.state)


def first_above(statistic: FloatArray, threshold: float) -> NDArray[np.int64]:
    """Index of the first value above the threshold along the last axis, -1 where there is none."""
    above = statistic > threshold
    index: NDArray[np.int64] = np.where(above.any(axis=-1), above.argmax(axis=-1), -1).astype(np.int64)
    return index


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a threshold is asked for: an average run length, or a probability within some samples."""

    arl0: float | None
    probability: float | None
    n_samples: int

    @classmethod
    def checked(
        cls, arl0: float | None, false_alarm_probability: float | None, n_samples: int | None
    ) -> Wanted:
        """The request, refused in one sentence unless exactly one of the two is given and sensible."""
        require(
            (arl0 is None) != (false_alarm_probability is None),
            "give one of arl0 and false_alarm_probability, got " + ("none" if arl0 is None else "both"),
        )
        if arl0 is not None:
            require(np.isfinite(arl0) and arl0 > 1.0, f"arl0 must be > 1 sample, got {arl0:g}")
            return cls(float(arl0), None, 0)
        probability = float(false_alarm_probability or 0.0)
        require(
            0.0 < probability < 1.0, f"false_alarm_probability must lie between 0 and 1, got {probability:g}"
        )
        require(
            n_samples is not None and n_samples >= 1,
            f"false_alarm_probability needs the transient's n_samples >= 1, got {n_samples}",
        )
        return cls(None, probability, int(n_samples or 0))

    def solve(
        self,
        average_run_length: Callable[[float], float],
        alarm_probability: Callable[[float, int], float],
        low: float,
        step: float,
    ) -> float:
        """Threshold that meets the request; both functions are monotonic in it.

        Args:
            average_run_length: of a threshold.
            alarm_probability: of a threshold and a number of samples.
            low: threshold that is surely too low.
            step: first step upwards from there; the steps grow by a half each.
        """

        def excess(threshold: float) -> float:
            if self.arl0 is not None:
                return float(np.log(average_run_length(threshold)) - np.log(self.arl0))
            assert self.probability is not None  # noqa: S101  # one of the two is given: see `checked`
            return float(
                np.log(self.probability) - np.log(max(alarm_probability(threshold, self.n_samples), 1e-300))
            )

        high = low + step
        while excess(high) < 0.0:
            low, high, step = high, high + 1.5 * step, 1.5 * step
        root = brentq(excess, low, high, xtol=1e-10, rtol=1e-12) if excess(low) < 0.0 else low
        return float(root)
