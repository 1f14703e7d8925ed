"""Standard normals for many lanes at once, four rows at a time.

Normal number q of an episode is number q of `random_streams.normals(seed, Stream.MEASUREMENT, case)` with the case
(sub-environment << 32) | episode, so it depends on (seed, sub-environment, episode, q) alone. A sample takes one for
each channel.

A lane may stand anywhere in its episode while all lanes are refilled at the same time. Four normals come from one
counter, so the next normal of a lane may be in the middle of four. Each lane therefore keeps the four that were made
last, makes four more, and takes the four rows out of these eight, shifted by 0 to 3 places without a branch. A new
episode costs one counter, or two: what it finds in the rows that are left.
"""

from __future__ import annotations

import numpy as np

from motor_env.envs.kernel import LANES, ROWS, Block
from motor_env.envs.layout import CASE_HIGH, CASE_LOW, SEED_HIGH, SEED_LOW, WordArray, random_words
from motor_env.motor.compiled import compiled_with_arrays, inlined
from motor_env.simulation.random_streams import Stream, box_muller, philox

_STREAM = np.uint32(Stream.MEASUREMENT)


@inlined
def four_normals(group: int, words: WordArray, n: int) -> tuple[np.float32, ...]:
    """Normals 4 group .. 4 group + 3 of the episode that lane n of all runs."""
    a, b, c, d = random_words(_STREAM, group, words, n)
    n0, n1 = box_muller(a, b)
    n2, n3 = box_muller(c, d)
    return n0, n1, n2, n3


@inlined
def begin_noise(s: Block, words: WordArray, n: int, row: int, channels: int) -> tuple[np.float32, ...]:
    """What a new episode of lane n of all finds in the rows from `row` on; the first four normals of the episode.

    The first normals, one a channel, belong to the measurement of the initial state.
    """
    j = n % LANES
    first: tuple[np.float32, ...] = four_normals(0, words, n)
    beyond = channels + ROWS - row  # the first normal that the next refill gives
    second = four_normals(1, words, n) if beyond >= ROWS else first
    for place in range(row, ROWS):
        q = channels + place - row
        s.noise[place, j] = first[q] if q < ROWS else second[q - ROWS]
    for m in range(ROWS):
        s.latest[m, j] = second[m]
    return first


@compiled_with_arrays
def refill(s: Block, words: WordArray, first: int, channels: int, width: int) -> None:
    """All rows of a block anew, for its lanes up to `width`; `first` is the number of its first lane among all.

    Arrays of its own, and rows of the words one by one: else the compiler does not see that they lie side by side.
    """
    low, high = words[CASE_LOW, first : first + width], words[CASE_HIGH, first : first + width]
    k0, k1 = words[SEED_LOW, first : first + width], words[SEED_HIGH, first : first + width]
    following = np.empty(LANES, dtype=np.uint32)  # the normal with which each lane goes on
    made = np.empty((4, LANES), dtype=np.uint32)
    new = np.empty((4, LANES), dtype=np.float32)
    for j in range(width):
        following[j] = np.uint32((np.int32(s.time[j]) + 1) * channels)
    for j in range(width):
        counter = np.uint32((following[j] >> np.uint32(2)) + np.uint32(1))
        made[0, j], made[1, j], made[2, j], made[3, j] = philox(
            counter, _STREAM, low[j], high[j], k0[j], k1[j]
        )
    for j in range(width):
        new[0, j], new[1, j] = box_muller(made[0, j], made[1, j])
        new[2, j], new[3, j] = box_muller(made[2, j], made[3, j])
    for j in range(width):
        by_two = (following[j] & np.uint32(2)) != np.uint32(0)
        by_one = (following[j] & np.uint32(1)) != np.uint32(0)
        n0 = s.latest[2, j] if by_two else s.latest[0, j]
        n1 = s.latest[3, j] if by_two else s.latest[1, j]
        n2 = new[0, j] if by_two else s.latest[2, j]
        n3 = new[1, j] if by_two else s.latest[3, j]
        n4 = new[2, j] if by_two else new[0, j]
        s.noise[0, j] = n1 if by_one else n0
        s.noise[1, j] = n2 if by_one else n1
        s.noise[2, j] = n3 if by_one else n2
        s.noise[3, j] = n4 if by_one else n3
    for m in range(ROWS):
        for j in range(width):
            s.latest[m, j] = new[m, j]
