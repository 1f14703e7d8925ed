"""Base of every decision rule: statistic, alarm, stream, threshold."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import flags, instance, number, numbers, whole
from motor_env.detection.rules import calibration
from motor_env.detection.rules.calibration import LONGEST, Request, Statistic, Threshold
from motor_env.detection.run_length import RunLaw
from motor_env.filters.batch import MOST_STREAMS
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import LARGEST_SEED

_MOST_CHANNELS = 1_000

_RUNS = 2_000
_SAMPLES = 3e8  # half a minute
_LARGEST_SHIFT = 1e3


def checked_shift(shift: float) -> float:
    """Return a mean of whitened innovations; `ValueError` unless it is a number of sensible size."""
    return number("shift", shift, least=-_LARGEST_SHIFT, most=_LARGEST_SHIFT)


class Rule(Statistic):
    """Decision rule on whitened innovations, standard normal while the motor is healthy (Kailath 1968).

    A rule holds settings and no running state; `start` and `scan` define both the batch and the stream.
    """

    __slots__ = ()

    def average_run_length(self, threshold: float, shift: float = 0.0) -> float:
        """Return the average samples to the alarm, for samples of one channel and of mean `shift`.

        A shift of 0 gives ARL0. Without a theory it is the mean of 2,000 simulated runs.

        Raises:
            ValueError: a number is not finite, or the threshold is too high to simulate.
        """
        threshold, shift = number("threshold", threshold), checked_shift(shift)
        lengths = calibration.run_lengths(self, threshold, _RUNS, mean=shift, most_samples=_SAMPLES)
        return float(lengths.mean())

    def threshold_for(
        self,
        *,
        arl0: float | None = None,
        false_alarm_probability: float | None = None,
        n_samples: int | None = None,
        n_channels: int = 1,
        recipe: Recipe | None = None,
        runs: int | None = None,
        seed: int = calibration.CALIBRATION_SEED,
    ) -> Threshold:
        """Return the threshold for a wanted rate of false alarms: exact where theory gives it, else simulated.

        Give `arl0`, or `false_alarm_probability` with `n_samples` or a `recipe`, whose threshold is for the residuals
        of `TolerantFilter.from_recipe(recipe)`.

        Args:
            arl0: average samples between false alarms.
            false_alarm_probability: probability of a false alarm in a transient.
            n_samples: length of the transient, unless the recipe sets it.
            n_channels: measured channels, unless the recipe sets them.
            recipe: distribution of healthy motors.
            runs: healthy runs to simulate; by default 100,000 transients, or 1,000 to 10,000 runs to an alarm.
            seed: of the simulation.

        Raises:
            ValueError: both rates or none, a recipe with `arl0`, `n_samples` or `n_channels`, no such threshold, or
                too few runs.
        """
        seed = whole("seed", seed, most=LARGEST_SEED)
        n_channels = whole("n_channels", n_channels, 1, _MOST_CHANNELS)
        runs = None if runs is None else whole("runs", runs, 1)
        if recipe is not None:
            instance("recipe", recipe, Recipe)
            require(
                arl0 is None and n_samples is None and n_channels == 1,
                "recipe goes with false_alarm_probability alone: a start has an end, a length and channels of its own",
            )
            request = Request.checked(None, false_alarm_probability, recipe.timing.n_samples)
            [threshold] = calibration.recipe_thresholds(
                [self], recipe, request.probability or 0.0, runs=runs, seed=seed
            )
            return threshold
        request = Request.checked(arl0, false_alarm_probability, n_samples)
        return calibration.threshold_of(self, request, runs=runs, n_channels=n_channels, seed=seed)

    def alarm_index(self, whitened: ArrayLike, threshold: float | Threshold) -> NDArray[np.int64]:
        """Return the first sample with the statistic above the threshold, -1 if none; shape (...).

        Args:
            whitened: shape (..., n_samples, n_channels).
            threshold: of the statistic.
        """
        limit = threshold.value if isinstance(threshold, Threshold) else threshold
        return first_above(self.statistic(whitened), number("threshold", limit))

    def stream(self, n_streams: int = 1) -> RuleStream:
        """Return a running copy of the rule, fed one sample at a time."""
        return RuleStream(self, n_streams)


class ExactRule(Rule):
    """Rule whose false alarms a Markov chain or an integral equation gives (Brook & Evans 1972)."""

    __slots__ = ()

    method: ClassVar[str] = "exact: integral equation"

    @abstractmethod
    def run_law(self, threshold: float, shift: float = 0.0, n_channels: int = 1) -> RunLaw:
        """Return the law of the samples to the alarm, for samples of mean `shift`; 0 while healthy."""

    @property
    def lowest(self) -> tuple[float, float]:
        """Return a threshold that is surely too low, and the first step upwards from there."""
        return 1e-3, 0.5

    def average_run_length(self, threshold: float, shift: float = 0.0) -> float:
        """Return the average samples to the alarm, for samples of mean `shift`: 0 gives ARL0."""
        return self.run_law(number("threshold", threshold), checked_shift(shift)).average_run_length()

    def alarm_probability(self, threshold: float, n_samples: int) -> float:
        """Return the probability of an alarm within `n_samples`, while healthy."""
        n_samples = whole("n_samples", n_samples, 1, LONGEST)
        return self.run_law(number("threshold", threshold)).alarm_probability(n_samples)

    def exact_threshold(self, request: Request, n_channels: int) -> Threshold:
        """Return the exact threshold."""
        low, step = self.lowest
        value = request.solve(lambda threshold: self.run_law(threshold, 0.0, n_channels), low=low, step=step)
        return Threshold(value, 0.0, self.method)


class RuleStream:
    """Running rule: `update(sample)` gives what the batch gives at that sample.

    Attributes:
        rule: the rule.
        state: its running state, shape (n_streams, width).
    """

    def __init__(self, rule: Rule, n_streams: int) -> None:
        try:
            self.rule, self.state = rule, rule.start(whole("n_streams", n_streams, 1, MOST_STREAMS))
        except MemoryError:
            raise ValueError(f"n_streams {n_streams} of this rule need more memory than there is") from None

    def update(self, whitened: ArrayLike) -> FloatArray:
        """Return the statistic after one more sample, shape (n_streams,), from shape (n_streams, n_channels)."""
        values, n = numbers("whitened", whitened, missing=True), len(self.state)
        if not values.size or values.size % n:
            raise ValueError(f"whitened must have shape ({n}, n_channels), got {values.shape}")
        return self.rule.scan(self.state, values.reshape(n, 1, -1))[:, 0]

    def reset(self, streams: NDArray[np.bool_] | None = None) -> None:
        """Restart all streams, or those where the mask is true."""
        fresh = self.rule.start(len(self.state))
        if streams is not None:
            chosen = flags("streams", streams, (len(fresh),))
            fresh = np.where(chosen[:, None], fresh, self.state)
        self.state = fresh


def first_above(statistic: FloatArray, threshold: float) -> NDArray[np.int64]:
    """Return the index of the first value above the threshold along the last axis, -1 if there is none."""
    above = statistic > threshold
    index: NDArray[np.int64] = np.where(above.any(axis=-1), above.argmax(axis=-1), -1).astype(np.int64)
    return index
