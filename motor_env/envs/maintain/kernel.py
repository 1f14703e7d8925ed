"""A day of many motors, compiled: wear, failure, the start's estimate, and the exact belief about the wear."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import layout
from motor_env.envs.compiling import compiled, inlined
from motor_env.envs.layout import BoolArray, MarkArray, WordArray
from motor_env.envs.maintain.options import LEVELS, LOWEST_ESTIMATE, N_ESTIMATES
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, box_muller

RUN, INSPECT, REPLACE = range(3)
LEVEL, RATE, DAY, AGE, ESTIMATE, FAILED = range(6)
"""Rows of the marks: level of the wear and number of the rate (the truth); days of the episode and of the bearing; the
last estimate in levels; whether the bearing failed on the last day."""
FEATURES = ("estimate", "mean", "std", "risk", "rate", "age", "days_left")
PARTS = ("reward_failure", "reward_replacement", "reward_inspection")
_STREAM = np.uint32(Stream.WEAR)
_TO_UNIT = 2.0**-32
_NEGLIGIBLE = 1e-15  # a share that rounding takes away anyway


@inlined
def _pick(probability: FloatArray, uniform: float) -> int:
    """The number at which the cumulated probability passes the uniform one."""
    total, last = 0.0, len(probability) - 1
    for number in range(last):
        total += probability[number]
        if uniform < total:
            return number
    return last


@inlined
def _new_bearing(weights: FloatArray, uniform: float, marks: MarkArray, belief: FloatArray, n: int) -> None:
    marks[LEVEL, n], marks[AGE, n] = 0, 0
    marks[RATE, n] = _pick(weights, uniform)
    belief[n] = 0.0
    for rate in range(len(weights)):
        belief[n, rate, 0] = weights[rate]


@inlined
def _wear_belief(wear: FloatArray, lowest: int, belief: FloatArray, scratch: FloatArray) -> None:
    """The belief after a day without failure, not normalised; the severity of a new bearing is the least."""
    n_growths = wear.shape[1]
    for rate in range(wear.shape[0]):
        probability = wear[rate]
        scratch[:] = 0.0
        for level in range(LEVELS):
            mass = belief[rate, level]
            if mass > _NEGLIGIBLE:
                after = scratch[
                    level : level + n_growths
                ]  # so that the compiler sees that they lie side by side
                for growth in range(n_growths):
                    after[growth] += mass * probability[growth]
        for place in range(-lowest):
            scratch[-lowest] += scratch[place]
        for level in range(LEVELS):
            belief[rate, level] = scratch[level - lowest]


@inlined
def _normalise(belief: FloatArray) -> None:
    total = 0.0
    for rate in range(belief.shape[0]):
        for level in range(LEVELS):
            total += belief[rate, level]
    for rate in range(belief.shape[0]):
        for level in range(LEVELS):
            belief[rate, level] /= total


@inlined
def _start(estimate: FloatArray, deviation: float, marks: MarkArray, belief: FloatArray, n: int) -> None:
    """The motor starts: what the transient tells of its wear, and what is believed from then on."""
    read = round(marks[LEVEL, n] + deviation) - LOWEST_ESTIMATE
    read = min(max(read, 0), N_ESTIMATES - 1)
    marks[ESTIMATE, n] = read + LOWEST_ESTIMATE
    for rate in range(belief.shape[1]):
        for level in range(LEVELS):
            belief[n, rate, level] *= estimate[read, level]
    _normalise(belief[n])


@compiled
def observe(
    days: int,
    rates: FloatArray,
    failing: FloatArray,
    marks: MarkArray,
    belief: FloatArray,
    out: NDArray[np.float32],
) -> None:
    """The features of all motors, shape (n_features, n_motors); `rates` are shares of the mean one."""
    for n in range(marks.shape[1]):
        mean, square, risk, pace = 0.0, 0.0, 0.0, 0.0
        for rate in range(len(rates)):
            for level in range(LEVELS):
                mass = belief[n, rate, level]
                mean += mass * level
                square += mass * level * level
                risk += mass * failing[rate, level]
                pace += mass * rates[rate]
        out[0, n] = marks[ESTIMATE, n] / LEVELS
        out[1, n] = mean / LEVELS
        out[2, n] = np.sqrt(max(square - mean * mean, 0.0)) / LEVELS
        out[3, n] = min(risk, 1.0)
        out[4, n] = pace
        out[5, n] = marks[AGE, n] / days
        out[6, n] = (days - marks[DAY, n]) / days


@inlined
def _begin_episode(
    weights: FloatArray, words: WordArray, marks: MarkArray, flags: BoolArray, belief: FloatArray, n: int
) -> None:
    layout.begin_episode(words, flags, n)
    first, _, _, _ = layout.random_words(_STREAM, 0, words, n)
    _new_bearing(weights, first * _TO_UNIT, marks, belief, n)
    marks[DAY, n], marks[ESTIMATE, n], marks[FAILED, n] = 0, 0, 0


@compiled
def begin(
    mask: BoolArray,
    weights: FloatArray,
    words: WordArray,
    marks: MarkArray,
    flags: BoolArray,
    belief: FloatArray,
) -> None:
    """Begin the next episode of the motors in the mask, each with a new bearing."""
    for n in range(len(mask)):
        if mask[n]:
            _begin_episode(weights, words, marks, flags, belief, n)


@compiled
def step(
    actions: NDArray[np.int64],
    restart: bool,
    days: int,
    costs: FloatArray,
    estimate_levels: float,
    weights: FloatArray,
    wear: FloatArray,
    lowest: int,
    estimate: FloatArray,
    words: WordArray,
    marks: MarkArray,
    flags: BoolArray,
    belief: FloatArray,
    scratch: FloatArray,
    parts: FloatArray,
) -> int:
    """A day of every motor; how many episodes it ended, or -1 for an action that does not exist.

    With `restart` a motor whose episode is over begins the next one instead. `costs` and `parts` (shape (3, n)) are in
    the order of `PARTS`.
    """
    n_over = 0
    for n in range(len(actions)):
        if not 0 <= actions[n] <= REPLACE:
            return -1
    for n in range(len(actions)):
        parts[0, n], parts[1, n], parts[2, n] = 0.0, 0.0, 0.0
        flags[layout.KNOWN, n] = True
        if restart and flags[layout.TERMINATED, n]:
            _begin_episode(weights, words, marks, flags, belief, n)
            continue
        marks[DAY, n] += 1
        marks[AGE, n] += 1
        marks[FAILED, n] = 0
        growth, rate, first, second = layout.random_words(_STREAM, marks[DAY, n], words, n)
        if actions[n] == INSPECT:
            parts[2, n] = -costs[INSPECT]
            marks[ESTIMATE, n] = marks[LEVEL, n]
            for other in range(LEVELS):
                if other != marks[LEVEL, n]:
                    belief[n, :, other] = 0.0
            _normalise(belief[n])
        else:
            if actions[n] == REPLACE:
                parts[1, n] = -costs[REPLACE]
                _new_bearing(weights, rate * _TO_UNIT, marks, belief, n)
            grown = lowest + _pick(wear[marks[RATE, n]], growth * _TO_UNIT)
            marks[LEVEL, n] = max(marks[LEVEL, n] + grown, 0)
            _wear_belief(wear, lowest, belief[n], scratch)
            if marks[LEVEL, n] >= LEVELS:
                parts[0, n] = -costs[RUN]
                marks[FAILED, n] = 1
                _new_bearing(weights, rate * _TO_UNIT, marks, belief, n)
            deviation, _ = box_muller(first, second)
            _start(estimate, estimate_levels * deviation, marks, belief, n)
        flags[layout.TERMINATED, n] = marks[DAY, n] >= days
        n_over += flags[layout.TERMINATED, n]
    return n_over
