"""What is believed about the wear of a block of motors: every growth of a day, and what an estimate tells, compiled."""

from __future__ import annotations

from motor_env.envs.compiling import inlined
from motor_env.envs.maintain.options import LEVELS
from motor_env.motor.parameters import FloatArray

AT_ONCE = 4
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
        begin, end = max(below + least - place - AT_ONCE + 1, 0), min(below + most - place + 1, LEVELS)
        at, sums = (place + begin) * width, after[begin * width :]  # slices: their indices begin at 0
        b0, b1, b2, b3 = before[at:], before[at + width :], before[at + 2 * width :], before[at + 3 * width :]
        for i in range((end - begin) * width):
            sums[i] = sums[i] + b0[i] * p0 + b1[i] * p1 + b2[i] * p2 + b3[i] * p3
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
def believe(growths: FloatArray, lowest: int, belief: FloatArray, room: FloatArray, wearing: int) -> None:
    """The belief of a block after the day's wear and its estimate; of a motor that stands nothing changes."""
    width = belief.shape[2]
    before, after, likelihood, marks = room[0], room[1], room[2], room[3]
    wears, stands, total = marks[:width], marks[width : 2 * width], marks[2 * width : 3 * width]
    for j in range(width):
        total[j] = 0.0
    for rate in range(belief.shape[0]):
        flat = belief[rate].reshape(LEVELS * width)
        if wearing > 0:
            _wear_belief(growths[rate], lowest, width, flat, before, after)
        for level in range(LEVELS):
            now, then = flat[level * width : (level + 1) * width], after[level * width :]
            told = likelihood[level * width :]
            for j in range(width):
                now[j] = (then[j] if wears[j] > 0.0 else now[j]) * told[j]
                total[j] += now[j]
    for j in range(width):
        total[j] = 1.0 if stands[j] > 0.0 else total[j]
    for rate in range(belief.shape[0]):
        for level in range(LEVELS):
            now = belief[rate, level]
            for j in range(width):
                now[j] /= total[j]
