"""A day of many motors, compiled: wear, failure, the start's estimate, and the exact belief about the wear.

The belief of a block of motors has a row for each rate of wear and level, a number for each motor, so the compiler
computes several motors with one instruction. All sums go from the lowest level up, whatever the size of a block: a
single motor's belief is the same to the bit as among many.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import layout
from motor_env.envs.layout import BoolArray, MarkArray, WordArray
from motor_env.envs.maintain.options import LEVELS, LOWEST_ESTIMATE, N_ESTIMATES, NOTHING
from motor_env.motor.compiled import compiled, inlined
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, box_muller, philox

AT_ONCE = 7
"""Growths that are added in one go."""
_NEGLIGIBLE = 1e-15  # a share that rounding takes away anyway


@inlined
def _copied(
    below: int, growths: int, width: int, belief: FloatArray, before: FloatArray, after: FloatArray
) -> tuple[int, int]:
    """Copy the belief between zeros, and clear the sums; return the least and the largest possible level."""
    least, most = LEVELS, -1
    for level in range(LEVELS):
        possible, masses = 0, belief[level * width :]
        copy, sums = before[(below + level) * width :], after[level * width :]
        for j in range(width):
            mass = masses[j] if masses[j] > _NEGLIGIBLE else 0.0
            copy[j], sums[j] = mass, 0.0
            possible += 1 if mass > 0.0 else 0
        if possible > 0:
            least, most = min(least, level), level
    above = before[(below + LEVELS) * width : (LEVELS + growths - 1) * width]
    for i in range(below * width):
        before[i] = 0.0
    for i in range(len(above)):
        above[i] = 0.0
    return least, most


@inlined
def _wear_belief(
    growths: FloatArray, lowest: int, width: int, belief: FloatArray, before: FloatArray, after: FloatArray
) -> None:
    """Belief of a rate after a day without failure, not normalised; no severity falls below 0.

    `before` becomes the belief with zeros below and above, so that each growth is a shift of it.
    """
    below, size = len(growths) - 1 + lowest, LEVELS * width
    least, most = _copied(below, len(growths), width, belief, before, after)
    for place in range(0, len(growths), AT_ONCE):
        p0, p1, p2, p3 = growths[place], growths[place + 1], growths[place + 2], growths[place + 3]
        p4, p5, p6 = growths[place + 4], growths[place + 5], growths[place + 6]
        begin, end = max(below + least - place - AT_ONCE + 1, 0), min(below + most - place + 1, LEVELS)
        at, sums = (place + begin) * width, after[begin * width :]  # slices: their indices begin at 0
        b0, b1, b2, b3 = before[at:], before[at + width :], before[at + 2 * width :], before[at + 3 * width :]
        b4, b5, b6 = before[at + 4 * width :], before[at + 5 * width :], before[at + 6 * width :]
        for i in range((end - begin) * width):
            four = sums[i] + b0[i] * p0 + b1[i] * p1 + b2[i] * p2 + b3[i] * p3
            sums[i] = four + b4[i] * p4 + b5[i] * p5 + b6[i] * p6
    new = before[below * width :]
    for place in range(least, -lowest):  # what would fall below 0, from the deepest fall up
        fallen = after[size : size + width]
        for j in range(width):
            fallen[j] = 0.0
        for level in range(place + 1):
            p = growths[len(growths) - 1 - place + level]
            for j in range(width):
                fallen[j] += new[level * width + j] * p
        for j in range(width):
            after[j] += fallen[j]


@inlined
def _stand(wears: FloatArray, width: int, belief: FloatArray, after: FloatArray) -> None:
    """Keep the belief of each motor that does not wear."""
    for j in range(width):
        if wears[j] == 0.0:
            for i in range(j, LEVELS * width, width):
                after[i] = belief[i]


@inlined
def believe(
    growths: FloatArray,
    lowest: int,
    likelihood: FloatArray,
    belief: FloatArray,
    room: FloatArray,
    observed: NDArray[np.uint32],
    wearing: int,
) -> None:
    """Update the belief of a block by the day's wear, and by its observation: column `observed[j]` of `likelihood`."""
    width = belief.shape[2]
    before, after, wears, total = room[0], room[1], room[2, :width], room[2, width : 2 * width]
    for j in range(width):
        total[j] = 0.0
    for rate in range(belief.shape[0]):
        flat = belief[rate].reshape(LEVELS * width)
        if wearing > 0:
            _wear_belief(growths[rate], lowest, width, flat, before, after)
        _stand(wears, width, flat, after)
        for level in range(0, LEVELS, 2):  # two at a time halve the reading and writing of the sums
            lower, upper = belief[rate, level], belief[rate, level + 1]
            worn, more = after[level * width :], after[(level + 1) * width :]
            here, above = likelihood[level], likelihood[level + 1]
            for j in range(width):
                lower[j], upper[j] = worn[j] * here[observed[j]], more[j] * above[observed[j]]
                total[j] = total[j] + lower[j] + upper[j]
    for j in range(width):
        total[j] = 1.0 if observed[j] == NOTHING else 1.0 / total[j]
    for rate in range(belief.shape[0]):
        for level in range(0, LEVELS, 2):
            lower, upper = belief[rate, level], belief[rate, level + 1]
            for j in range(width):
                lower[j], upper[j] = lower[j] * total[j], upper[j] * total[j]


RUN, INSPECT, REPLACE = range(3)
LEVEL, RATE, DAY, AGE, ESTIMATE, FAILED = range(6)
"""Rows of the marks: level and rate of wear (the truth); days of episode and bearing; last estimate in levels; whether
the bearing failed on the last day."""
FEATURES = ("estimate", "mean", "std", "risk", "rate", "age", "days_left")
PARTS = ("reward_failure", "reward_replacement", "reward_inspection")
MOTORS = 32
"""Motors of a block; measured: fewer or more are slower."""
COMPARED = 32
"""Cumulated probabilities that are compared in one go."""
_STREAM = np.uint32(Stream.WEAR)
_TO_UNIT = 2.0**-32
_ROUNDING = 1e-13  # of a mean square: a variance below is a difference of roundings


class Chances(NamedTuple):
    """Probabilities and costs of a task."""

    weights: FloatArray  # how often a bearing has each rate, shape (n_rates,)
    sums: FloatArray  # the same cumulated, but the last
    shares: FloatArray  # each rate as a share of the mean one
    # probability of each growth in a day, from the largest down, padded with zeros in front to a multiple of
    # `AT_ONCE`, shape (n_rates, n_growths)
    growths: FloatArray
    # cumulated from the smallest growth up, but the last, of shape (n_rates, n), padded with twos to a multiple of
    # `COMPARED`
    growth_sums: FloatArray
    failing: FloatArray  # that the bearing fails on a day that begins at a level, shape (n_rates, LEVELS)
    # a column for each observation of a day, its probability given the level: each estimate, each level that an
    # inspection finds, nothing; shape (LEVELS, NOTHING + 1)
    likelihood: FloatArray
    # smallest growth in levels, days, standard deviation of an estimate in levels, and the costs of a failure, an
    # inspection and a replacement
    numbers: FloatArray


class Motors(NamedTuple):
    """State of all motors."""

    words: WordArray  # as in `motor_env.envs.layout`, shape (4, n_motors)
    marks: MarkArray  # see the rows above, shape (6, n_motors)
    flags: BoolArray  # shape (4, n_motors)
    belief: (
        FloatArray  # probability of each rate and level, shape (n_blocks, n_rates, LEVELS, motors of a block)
    )
    room: FloatArray  # for the sums of a block, see `room_for`
    drawn: WordArray  # a day's random words of a block, shape (4, motors of a block)
    normal: NDArray[np.float32]  # a day's standard normals, shape (motors of a block,)
    observed: NDArray[
        np.uint32
    ]  # today's observation, a column of `Chances.likelihood`, shape (motors of a block,)


def room_for(n_growths: int, width: int) -> FloatArray:
    """Work space of a block of `width` motors: belief before and after the day, who wears, features."""
    lines = -(-(LEVELS + n_growths) * width // 8)
    return layout.aligned_zeros((4, 8 * lines))  # so that each part begins where a line of the cache does


@inlined
def _pick(sums: FloatArray, uniform: float) -> int:
    """The first index whose cumulated probability is above a uniform number."""
    number = 0
    for k in range(len(sums)):
        number += 1 if uniform >= sums[k] else 0
    return number


@inlined
def _new_bearing(chances: Chances, uniform: float, motors: Motors, n: int) -> None:
    marks, width = motors.marks, motors.belief.shape[3]
    belief = motors.belief[n // width]
    marks[LEVEL, n], marks[AGE, n] = 0, 0
    marks[RATE, n] = _pick(chances.sums, uniform)
    for rate in range(len(chances.weights)):
        for level in range(LEVELS):
            belief[rate, level, n % width] = 0.0
        belief[rate, 0, n % width] = chances.weights[rate]


@inlined
def _begin_episode(chances: Chances, motors: Motors, n: int) -> None:
    layout.begin_episode(motors.words, motors.flags, n)
    first, _, _, _ = layout.random_words(_STREAM, 0, motors.words, n)
    _new_bearing(chances, first * _TO_UNIT, motors, n)
    motors.marks[DAY, n], motors.marks[ESTIMATE, n], motors.marks[FAILED, n] = 0, 0, 0


@inlined
def _draw(motors: Motors, first: int, count: int) -> None:
    """Draw two words and a normal for each motor of a block.

    Rows of the words one by one, not `random_words`: else the compiler does not see that they lie side by side.
    """
    low, high = motors.words[layout.CASE_LOW, first:], motors.words[layout.CASE_HIGH, first:]
    k0, k1 = motors.words[layout.SEED_LOW, first:], motors.words[layout.SEED_HIGH, first:]
    day, m0, m1 = motors.marks[DAY, first:], motors.drawn[0], motors.drawn[1]
    m2, m3, normal = motors.drawn[2], motors.drawn[3], motors.normal
    for j in range(count):
        m0[j], m1[j], m2[j], m3[j] = philox(np.uint32(day[j] + 1), _STREAM, low[j], high[j], k0[j], k1[j])
    for j in range(count):
        normal[j] = box_muller(m2[j], m3[j])[0]


@inlined
def _live(chances: Chances, motors: Motors, n: int, action: int, parts: FloatArray) -> tuple[bool, int]:
    """Advance motor n by a day, but for its belief; return whether it wears, and its column of `likelihood`."""
    marks, width = motors.marks, motors.belief.shape[3]
    j, numbers = n % width, chances.numbers
    marks[DAY, n] += 1
    marks[AGE, n] += 1
    marks[FAILED, n] = 0
    if action == INSPECT:
        parts[2, n] = -numbers[4]
        marks[ESTIMATE, n] = marks[LEVEL, n]
        return False, N_ESTIMATES + marks[LEVEL, n]
    growth, rate = motors.drawn[0, j], motors.drawn[1, j]
    if action == REPLACE:
        parts[1, n] = -numbers[5]
        _new_bearing(chances, rate * _TO_UNIT, motors, n)
    grown = int(numbers[0]) + _pick(chances.growth_sums[marks[RATE, n]], growth * _TO_UNIT)
    marks[LEVEL, n] = max(marks[LEVEL, n] + grown, 0)
    fails = marks[LEVEL, n] >= LEVELS
    if fails:
        parts[0, n] = -numbers[3]
        marks[FAILED, n] = 1
        _new_bearing(chances, rate * _TO_UNIT, motors, n)
    read = round(marks[LEVEL, n] + numbers[2] * motors.normal[j]) - LOWEST_ESTIMATE
    read = min(max(read, 0), N_ESTIMATES - 1)
    marks[ESTIMATE, n] = read + LOWEST_ESTIMATE
    return not fails, read


@inlined
def _observe_block(
    chances: Chances, motors: Motors, first: int, count: int, out: NDArray[np.float32]
) -> None:
    width, days, marks = motors.belief.shape[3], chances.numbers[1], motors.marks
    belief, room = motors.belief[first // width], motors.room[3]
    mean, square = room[:width], room[width : 2 * width]
    risk, pace = room[2 * width : 3 * width], room[3 * width : 4 * width]
    for j in range(4 * width):
        room[j] = 0.0
    for rate in range(belief.shape[0]):
        share = chances.shares[rate]
        for level in range(0, LEVELS, 2):  # two at a time halve the reading and writing of the sums
            lower, upper = belief[rate, level], belief[rate, level + 1]
            for j in range(width):
                m0, m1 = lower[j], upper[j]
                mean[j] = mean[j] + m0 * level + m1 * (level + 1)
                square[j] = square[j] + m0 * (level * level) + m1 * ((level + 1) * (level + 1))
                pace[j] = pace[j] + (m0 + m1) * share
        for level in range(LEVELS):
            fails, masses = chances.failing[rate, level], belief[rate, level]
            for j in range(width if fails > 0.0 else 0):
                risk[j] += masses[j] * fails
    for j in range(count):
        n = first + j
        out[0, n] = marks[ESTIMATE, n] / LEVELS
        out[1, n] = mean[j] / LEVELS
        variance = square[j] - mean[j] * mean[j]
        variance = variance if variance > _ROUNDING * square[j] else 0.0
        out[2, n] = np.sqrt(variance) / LEVELS
        out[3, n] = min(risk[j], 1.0)
        out[4, n] = pace[j]
        out[5, n] = marks[AGE, n] / days
        out[6, n] = (days - marks[DAY, n]) / days


@inlined
def _unpacked(arrays: tuple[Any, ...]) -> tuple[Chances, Motors]:
    """The arrays of a compiled call by name; named tuples would cost ten times as much a call."""
    return Chances(*arrays[:8]), Motors(*arrays[8:])


@compiled
def observe(out: NDArray[np.float32], *arrays: Any) -> None:
    """Write the features of all motors, (n_features, n_motors); `arrays` are those of `Chances` and `Motors`."""
    chances, motors = _unpacked(arrays)
    width, count = motors.belief.shape[3], out.shape[1]
    for first in range(0, count, width):
        _observe_block(chances, motors, first, min(width, count - first), out)


@compiled
def begin(mask: BoolArray, *arrays: Any) -> None:
    """Begin the next episode of the motors in the mask, each with a new bearing."""
    chances, motors = _unpacked(arrays)
    for n in range(len(mask)):
        if mask[n]:
            _begin_episode(chances, motors, n)


@compiled
def step(
    actions: NDArray[np.int64],
    restart: bool,
    parts: FloatArray,
    out: NDArray[np.float32],
    *arrays: Any,
) -> int:
    """Step every motor by a day; return how many episodes ended, or -1 for an action that does not exist.

    With `restart` a motor whose episode is over begins the next one instead. `parts`, shape (3, n), is in the order of
    `PARTS`; `out` is as in `observe`.
    """
    chances, motors = _unpacked(arrays)
    n_over, width, count = 0, motors.belief.shape[3], len(actions)
    wears, numbers = motors.room[2], chances.numbers
    for n in range(count):
        if not 0 <= actions[n] <= REPLACE:
            return -1
    for first in range(0, count, width):
        here, wearing = min(width, count - first), 0
        for j in range(width):
            wears[j], motors.observed[j] = 0.0, NOTHING
        _draw(motors, first, here)
        for j in range(here):
            n = first + j
            parts[0, n], parts[1, n], parts[2, n] = 0.0, 0.0, 0.0
            if restart and motors.flags[layout.TERMINATED, n]:
                _begin_episode(chances, motors, n)
                continue
            worn, motors.observed[j] = _live(chances, motors, n, actions[n], parts)
            wears[j] = 1.0 if worn else 0.0
            wearing += 1 if worn else 0
            motors.flags[layout.TERMINATED, n] = motors.marks[DAY, n] >= numbers[1]
            n_over += motors.flags[layout.TERMINATED, n]
        believe(
            *(chances.growths, int(numbers[0]), chances.likelihood),
            *(motors.belief[first // width], motors.room, motors.observed, wearing),
        )
        _observe_block(chances, motors, first, here, out)
    return n_over
