"""Thresholds by calibrated simulation, for rules whose run length no equation gives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.parameters import FloatArray, require
from motor_env.rules.base import Rule, Threshold, Wanted

IntArray = NDArray[np.int64]

CALIBRATION_SEED = 20_101
"""The simulation that calibrates is the same each time, so that a threshold is a number and not a draw."""

_HORIZON = 3.0


def simulated_threshold(rule: Rule, wanted: Wanted, *, runs: int, n_channels: int, seed: int) -> Threshold:
    """Threshold from simulated healthy runs, with its standard error.

    For a probability the threshold is an order statistic of the runs' largest values. For an average run length the
    runs are cut off after three of them; the mean of the exponential law that such run lengths follow (Pollak &
    Tartakovsky 2009) is then the time at risk over the number of alarms.

    Args:
        rule: the rule.
        wanted: what the threshold is for.
        runs: healthy runs to simulate.
        n_channels: measured channels.
        seed: seed of the noise.
    """
    generator = np.random.default_rng(seed)
    if wanted.probability is not None:
        return _for_probability(rule, wanted.probability, wanted.n_samples, runs, n_channels, generator)
    require(wanted.arl0 is not None, "a threshold needs arl0 or a false-alarm probability")
    arl0 = float(wanted.arl0 or 0.0)
    streams, times, values = _records(rule, int(_HORIZON * arl0), runs, n_channels, generator)
    return _for_run_length(streams, times, values, runs, int(_HORIZON * arl0), arl0)


def largest_values(rule: Rule, n_samples: int, runs: int, n_channels: int, seed: int) -> FloatArray:
    """Largest statistic of each of many healthy runs, shape (runs,)."""
    return _largest(rule, n_samples, runs, n_channels, np.random.default_rng(seed))


def _largest(
    rule: Rule, n_samples: int, runs: int, n_channels: int, generator: np.random.Generator
) -> FloatArray:
    chunk = max(1, min(runs, 2_000_000 // (n_samples * n_channels)))
    found = []
    for begin in range(0, runs, chunk):
        count = min(chunk, runs - begin)
        found.append(rule.statistic(generator.standard_normal((count, n_samples, n_channels))).max(axis=1))
    return np.concatenate(found)


def _for_probability(
    rule: Rule, probability: float, n_samples: int, runs: int, n_channels: int, generator: np.random.Generator
) -> Threshold:
    least = int(np.ceil(10.0 / probability))
    require(
        runs >= least, f"runs must be >= {least} to calibrate a probability of {probability:g}, got {runs}"
    )
    ordered = np.sort(_largest(rule, n_samples, runs, n_channels, generator))

    def quantile(share: float) -> float:
        return float(ordered[min(runs - 1, int(np.ceil((runs + 1) * (1.0 - share))) - 1)])

    error = np.sqrt(probability * (1.0 - probability) / runs)
    spread = 0.5 * (quantile(probability - error) - quantile(probability + error))
    return Threshold(quantile(probability), spread, f"simulated: {runs} runs of {n_samples} samples")


def _records(
    rule: Rule, horizon: int, runs: int, n_channels: int, generator: np.random.Generator
) -> tuple[IntArray, IntArray, FloatArray]:
    """Run, sample number and value of each new maximum of each run."""
    if type(rule).statistic is not Rule.statistic:  # the rule has a quick way for whole runs
        return _records_of_whole_runs(rule, horizon, runs, n_channels, generator)
    state = rule.start(runs, n_channels)
    best = np.full(runs, -np.inf)
    streams, times, values = [], [], []
    block = max(1, 1_000_000 // (runs * n_channels))
    for begin in range(0, horizon, block):
        noise = generator.standard_normal((min(block, horizon - begin), runs, n_channels))
        for k, sample in enumerate(noise):
            state, statistic = rule.step(state, sample)
            new = np.flatnonzero(statistic > best)
            best[new] = statistic[new]
            streams.append(new)
            times.append(np.full(new.size, begin + k + 1))
            values.append(statistic[new])
    return np.concatenate(streams), np.concatenate(times), np.concatenate(values)


def _records_of_whole_runs(
    rule: Rule, horizon: int, runs: int, n_channels: int, generator: np.random.Generator
) -> tuple[IntArray, IntArray, FloatArray]:
    streams, times, values = [], [], []
    chunk = max(1, 2_000_000 // (horizon * n_channels))
    for begin in range(0, runs, chunk):
        count = min(chunk, runs - begin)
        statistic = rule.statistic(generator.standard_normal((count, horizon, n_channels)))
        best = np.maximum.accumulate(statistic, axis=1)
        new = np.concatenate([np.ones((count, 1), dtype=bool), best[:, 1:] > best[:, :-1]], axis=1)
        stream, time = np.nonzero(new)
        streams.append(stream + begin)
        times.append(time + 1)
        values.append(statistic[new])
    return np.concatenate(streams), np.concatenate(times), np.concatenate(values)


def _for_run_length(
    streams: IntArray, times: IntArray, values: FloatArray, runs: int, horizon: int, arl0: float
) -> Threshold:
    def average(threshold: float) -> tuple[float, int]:
        over = values > threshold
        first = np.full(runs, horizon)
        np.minimum.at(first, streams[over], times[over])
        alarmed = np.unique(streams[over]).size
        return float(first.sum()) / max(alarmed, 1), alarmed

    low, high = float(np.quantile(values, 0.05)), float(values.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if average(middle)[0] < arl0 else (low, middle)
    error = 1.0 / np.sqrt(max(average(high)[1], 1))
    step = 0.05 * abs(high)
    slope = np.log(average(high + step)[0] / average(high - step)[0]) / (2.0 * step)
    return Threshold(high, float(error / slope), f"simulated: {runs} runs of up to {horizon} samples")
