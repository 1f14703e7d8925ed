"""Thresholds by theory, or by simulation for rules whose false alarms no equation gives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from motor_env.common.arrays import number, numbers, whole
from motor_env.detection.rules.kernels import first_passages
from motor_env.detection.rules.tolerant import TolerantFilter
from motor_env.detection.run_length import RunLaw
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.random_streams import Stream, normals
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.sampling import draw, measure_draw

_MOST = 1e30  # samples: at any rate longer than anything runs
LONGEST = 10**9
"""Samples of a transient: a day at 10 kHz."""


class Threshold(NamedTuple):
    """Threshold of a rule for a wanted false-alarm rate.

    Attributes:
        value: the rule alarms where its statistic is larger.
        standard_error: that of the simulation; 0 for an exact threshold.
        method: how it was found.
    """

    value: float
    standard_error: float
    method: str


@dataclass(frozen=True, slots=True)
class Request:
    """Wanted rate of false alarms: an average run length, or a probability within some samples."""

    arl0: float | None
    probability: float | None
    n_samples: int

    @classmethod
    def checked(
        cls, arl0: float | None, false_alarm_probability: float | None, n_samples: int | None
    ) -> Request:
        """Return the request; `ValueError` unless exactly one of the two is given and sensible."""
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
        """Return the threshold that meets the request.

        Args:
            law: of the samples to an alarm, as a function of the threshold.
            low: threshold that is surely too low.
            step: first step upwards from there.

        Raises:
            ValueError: no threshold gives as many false alarms, or the equation cannot be solved.
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
    """Running statistic of whitened innovations, with an exact threshold where theory gives one."""

    __slots__ = ()

    def start(self, n_streams: int) -> FloatArray:
        """Return the state before the first sample, shape (n_streams, width): one zero unless overridden."""
        return np.zeros((n_streams, 1))

    @abstractmethod
    def scan(self, state: FloatArray, whitened: FloatArray) -> FloatArray:
        """Return the statistic after each sample, shape (n_streams, n_samples); update the state in place.

        Args:
            state: as `start` gives it.
            whitened: shape (n_streams, n_samples, n_channels). NaN is missing.
        """

    def exact_threshold(self, request: Request, n_channels: int) -> Threshold | None:
        """Return the threshold by theory; None where it has to be simulated."""
        return None

    def statistic(self, whitened: ArrayLike) -> FloatArray:
        """Return the statistic after each sample, shape (..., n_samples).

        Args:
            whitened: shape (..., n_samples, n_channels), as in `FilterResult.whitened`.
        """
        values = numbers("whitened", whitened, ("...", "n_samples", "n_channels"), missing=True)
        flat = values.reshape(-1, *values.shape[-2:])
        return self.scan(self.start(len(flat)), flat).reshape(values.shape[:-1])


IntArray = NDArray[np.int64]

CALIBRATION_SEED = 20_101

_TRANSIENTS = 100_000
_MOST_RUNS, _LEAST_RUNS, _SAMPLES = 10_000, 1_000, 3e8
_MOST_SAMPLES = 1e10  # some twenty minutes of one core
_PROBE = 3e6  # samples after which it shows how seldom alarms are, if they are some of a rule's memories
_PILOT = 400
_LEVELS = 9
_NARROW = 0.3  # how far from the wanted average run length the pilot's thresholds reach, as a logarithm
_BLOCK = 500
_AT_ONCE = 400_000  # values in one array: they stay in the cache


def threshold_of(
    rule: Statistic, request: Request, *, runs: int | None, n_channels: int, seed: int
) -> Threshold:
    """Return the exact threshold where theory gives it; else one from simulated white noise.

    For a probability: an order statistic of the runs' largest values. For an average run length: runs to their alarm
    at a range of thresholds, as its logarithm is near linear in the threshold (Siegmund 1985).

    Args:
        rule: the rule.
        request: a run length or a probability.
        runs: healthy runs to simulate; None for the default of `Rule.threshold_for`.
        n_channels: measured channels.
        seed: seed of the noise.
    """
    exact = rule.exact_threshold(request, n_channels)
    if exact is not None:
        return exact
    if request.probability is not None:
        count = runs or _TRANSIENTS
        _check_runs(request.probability, count)
        _check_effort(f"n_samples {request.n_samples}", request.n_samples, count)
        largest = largest_values(rule, request.n_samples, np.arange(count), n_channels, seed)
        method = f"simulated: {count} runs of {request.n_samples} samples"
        return _order_statistic(largest, request.probability, method)
    arl0 = float(request.arl0 or 0.0)
    count = runs or int(np.clip(_SAMPLES / arl0, _LEAST_RUNS, _MOST_RUNS))
    _check_effort(f"arl0 {arl0:g}", arl0, max(count, _PILOT))
    return _for_run_length(rule, arl0, count, n_channels, seed)


def _check_runs(probability: float, runs: int) -> None:
    require(
        10.0 / probability <= runs,
        f"runs must be >= {10.0 / probability:.6g} to calibrate a probability of {probability:g}, got {runs}",
    )


def _check_effort(request: str, samples: float, runs: int) -> None:
    require(
        samples * runs <= _MOST_SAMPLES,
        f"{request} needs {samples * runs:.0e} simulated samples for {runs} runs, more than {_MOST_SAMPLES:.0e}: "
        f"with so many runs up to {_MOST_SAMPLES / runs:.0e} can be had, with fewer runs more",
    )


def recipe_thresholds(
    rules: Sequence[Statistic],
    recipe: Recipe,
    false_alarm_probability: float,
    *,
    runs: int | None = None,
    seed: int = CALIBRATION_SEED,
) -> list[Threshold]:
    """Return thresholds of several rules from the same simulated healthy motors of a recipe.

    Monte Carlo critical values (Barnard 1963; standard error: Mosteller 1946); without tolerances the rules' own
    thresholds.

    Args:
        rules: on the residual that `TolerantFilter.from_recipe(recipe).white` gives.
        recipe: distribution of healthy motors.
        false_alarm_probability: in a transient.
        runs: healthy motors to simulate, by default 100,000; at least 10 / probability.
        seed: of the motors and their noise.
    """
    if recipe.field is None and not recipe.spread.std.any():
        n_samples, n_channels = recipe.timing.n_samples, len(recipe.sensor.channels)
        request = Request.checked(None, false_alarm_probability, n_samples)
        return [threshold_of(rule, request, runs=runs, n_channels=n_channels, seed=seed) for rule in rules]
    count = runs or _TRANSIENTS
    _check_runs(false_alarm_probability, count)
    tolerant = TolerantFilter.from_recipe(recipe)
    largest = np.empty((len(rules), count))
    batch = max(1, _AT_ONCE // tolerant.bias.size)
    for first in range(0, count, batch):
        cases = np.arange(first, min(first + batch, count))
        white = tolerant.white(healthy_measurements(recipe, seed, cases))
        for row, rule in zip(largest, rules, strict=True):
            row[cases] = rule.statistic(white).max(axis=1)
    method = f"simulated: {count} healthy motors of {recipe.name}"
    return [_order_statistic(row, false_alarm_probability, method) for row in largest]


def healthy_measurements(recipe: Recipe, seed: int, cases: ArrayLike) -> NDArray[np.float32]:
    """Return transients of healthy motors of the recipe, shape (n_cases, n_channels, n_samples)."""
    healthy = replace(recipe, classes=(FaultClass(),), healthy_starts=0)
    return measure_draw(draw(healthy, seed, cases), healthy, seed)


def largest_values(
    rule: Statistic, n_samples: int, cases: IntArray, n_channels: int, seed: int
) -> FloatArray:
    """Return the largest statistic of each of many healthy runs, shape (n_cases,)."""
    answer = np.empty(len(cases))
    batch = max(1, _AT_ONCE // (n_samples * n_channels))
    for first in range(0, len(cases), batch):
        here = cases[first : first + batch]
        state = rule.start(len(here))
        best = np.full(len(here), -np.inf)
        for begin in range(0, n_samples, _AT_ONCE):
            count = min(_AT_ONCE, n_samples - begin)
            noise = _noise(seed, here, begin // _AT_ONCE, count, n_channels)
            np.maximum(best, rule.scan(state, noise).max(axis=1), out=best)
        answer[first : first + batch] = best
    return answer


def run_lengths(
    rule: Statistic,
    levels: ArrayLike,
    runs: int,
    *,
    n_channels: int = 1,
    seed: int = CALIBRATION_SEED,
    mean: ArrayLike = 0.0,
    most_samples: float = np.inf,
) -> IntArray:
    """Return samples to the alarm of simulated runs, shape (runs, n_levels).

    Args:
        rule: the rule.
        levels: thresholds, rising, shape (n_levels,).
        runs: how many.
        n_channels: measured channels.
        seed: of the noise; run n depends on (seed, n) alone.
        mean: of the samples, scalar or shape (n,) whose last value stays; 0 while healthy.
        most_samples: of all runs together.

    Raises:
        ValueError: a number is not finite, or the runs would need more samples.
    """
    thresholds, profile = np.atleast_1d(numbers("levels", levels)), np.atleast_1d(numbers("mean", mean))
    runs, n_channels = whole("runs", runs, 1), whole("n_channels", n_channels, 1)
    lengths = np.zeros((runs, len(thresholds)), dtype=np.int64)
    batch = max(1, _AT_ONCE // (_BLOCK * n_channels))
    for first in range(0, runs, batch):
        cases = np.arange(first, min(first + batch, runs))
        passed = np.zeros(len(cases), dtype=np.int64)
        passages = np.zeros((len(cases), len(thresholds)), dtype=np.int64)
        state, block = rule.start(len(cases)), 0
        while len(cases):
            values = _noise(seed, cases, block, _BLOCK, n_channels)
            begin = block * _BLOCK
            values += profile[np.minimum(np.arange(begin, begin + _BLOCK), len(profile) - 1)][:, None]
            first_passages(rule.scan(state, values), begin, thresholds, passed, passages)
            left = passed < len(thresholds)
            if not left.all():
                lengths[cases[~left]] = passages[~left]
                cases, passed, passages, state = cases[left], passed[left], passages[left], state[left]
            block += 1
            taken, together = block * _BLOCK, min(batch, runs - first)
            alarms = together - len(cases)
            shows = taken * together >= _PROBE and taken >= 4 * state.shape[1]
            needed = taken * together * (runs / max(alarms, 1) if shows else 1)
            require(
                needed <= most_samples,
                f"threshold {thresholds.max():g} is passed too seldom to simulate {runs} runs to their alarms:"
                f" {alarms} of {together} in {taken} samples",
            )
    return lengths


def _noise(seed: int, cases: IntArray, block: int, count: int, n_channels: int) -> FloatArray:
    numbers = cases + (block << 32)  # each block is a case of its own to the streams
    return normals(seed, Stream.CALIBRATION, numbers, count * n_channels).reshape(
        len(cases), count, n_channels
    )


def _order_statistic(largest: FloatArray, probability: float, method: str) -> Threshold:
    error = np.sqrt(probability * (1.0 - probability) / len(largest))
    shares = 1.0 - np.array([probability + error, probability, probability - error])
    below, value, above = np.quantile(largest, shares, method="higher")
    return Threshold(float(value), 0.5 * float(above - below), method)


def _for_run_length(rule: Statistic, arl0: float, runs: int, n_channels: int, seed: int) -> Threshold:
    # Run lengths are near exponential (Pollak & Tartakovsky 2009): a run of L = arl0 samples stays silent with
    # probability exp(-1), and exp(-exp(-+0.3)) at thresholds for exp(+-0.3) arl0.
    pilot = largest_values(rule, max(1, int(arl0)), runs + np.arange(_PILOT), n_channels, seed)
    low, high = (float(np.quantile(pilot, np.exp(-np.exp(-side)))) for side in (-_NARROW, _NARROW))
    for _ in range(20):
        levels = np.linspace(low, high, _LEVELS)
        lengths = run_lengths(rule, levels, runs, n_channels=n_channels, seed=seed)
        average = lengths.mean(axis=0)
        if average[0] <= arl0 <= average[-1]:
            break
        step = max(high - low, 0.05 * abs(high))
        low, high = (low, high + step) if average[-1] < arl0 else (low - step, high)
    logs = np.log(average)
    value = float(np.interp(np.log(arl0), logs, levels))
    slope = float(logs[-1] - logs[0]) / (high - low)
    error = float(lengths.std(axis=0)[_LEVELS // 2] / average[_LEVELS // 2]) / np.sqrt(runs)
    return Threshold(value, float(error / slope), f"simulated: {runs} runs to their alarm")
