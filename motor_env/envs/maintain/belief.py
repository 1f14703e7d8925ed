"""What is believed about the wear of a block of motors: every growth of a day, and what an estimate tells, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.envs.maintain.options import LEVELS, NOTHING
from motor_env.motor.compiled import inlined
from motor_env.motor.parameters import FloatArray

AT_ONCE = 7
"""Growths that are added in one go."""
_NEGLIGIBLE = 1e-15  # a share that rounding takes away anyway


@inlined
def _copied(
    below: int, growths: int, width: int, belief: FloatArray, before: FloatArray, after: FloatArray
) -> tuple[int, int]:
    """Lay the belief between zeros, and empty the sums; the least and the largest level that is possible at all."""
    least, most = (
        LEVELS,
        -1,
    )  # the levels that somebody's bearing may have: beyond them there are zeros to add
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
    """The belief of a rate after a day without failure, not normalised; a new bearing's severity is the least.

    `before` becomes the belief with room below and above, so that each growth is a shift of it.
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
    """The belief after a day is that before it, of each motor that does not wear."""
    for j in range(width):
        if wears[j] == 0.0:
            for i in range(j, LEVELS * width, width):
                after[i] = belief[i]


@inlined
def believe(
    growths: FloatArray,
    lowest: int,
    told: FloatArray,
    belief: FloatArray,
    room: FloatArray,
    seen: NDArray[np.uint32],
    wearing: int,
) -> None:
    """The belief of a block after the day's wear, and after what was seen: column `seen[j]` of `told`."""
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
            here, above = told[level], told[level + 1]
            for j in range(width):
                lower[j], upper[j] = worn[j] * here[seen[j]], more[j] * above[seen[j]]
                total[j] = total[j] + lower[j] + upper[j]
    for j in range(width):
        total[j] = 1.0 if seen[j] == NOTHING else 1.0 / total[j]
    for rate in range(belief.shape[0]):
        for level in range(0, LEVELS, 2):
            lower, upper = belief[rate, level], belief[rate, level + 1]
            for j in range(width):
                lower[j], upper[j] = lower[j] * total[j], upper[j] * total[j]
