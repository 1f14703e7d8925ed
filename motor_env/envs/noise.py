"""Standard normals for many lanes at once, made ahead in blocks laid out for the step.

Normal number q of an episode is number q of `random_streams.normals(seed, Stream.MEASUREMENT, case)` with the case that
`case_of` gives, so it depends on (seed, sub-environment, episode, q) alone. A sample takes one for each channel.

A lane may stand anywhere in its episode while all lanes of a block are refilled at the same time. Four normals come
from one counter, so the first that a lane needs may be in the middle of four: every lane makes one counter more, and
shifts what it has made by 0 to 3 places, without a branch.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from motor_env.simulation.random_streams import Stream, box_muller, philox

LANES = 64
ROWS = 64
"""Normals of a lane that are made ahead: a multiple of 4, and so large that the one counter more counts little."""

_STREAM = np.uint32(Stream.MEASUREMENT)
_ZERO, _ONE, _TWO = np.uint32(0), np.uint32(1), np.uint32(2)

Float32Array = NDArray[np.float32]
WordArray = NDArray[np.uint32]
SEED_LOW, SEED_HIGH, EPISODE, INDEX = range(4)  # rows of the words that name a lane's episode


def case_of(index: NDArray[np.int64], episode: NDArray[np.int64]) -> NDArray[np.int64]:
    """The case of an episode of a sub-environment, in every stream."""
    cases: NDArray[np.int64] = (index << 32) | episode
    return cases


@njit(cache=True, forceinline=True, error_model="numpy")
def four_normals(group: np.uint32, names: WordArray, j: int) -> tuple[np.float32, ...]:
    """Normals 4 group .. 4 group + 3 of the episode that lane j runs."""
    a, b, c, d = philox(
        group, _STREAM, names[EPISODE, j], names[INDEX, j], names[SEED_LOW, j], names[SEED_HIGH, j]
    )
    n0, n1 = box_muller(a, b)
    n2, n3 = box_muller(c, d)
    return n0, n1, n2, n3


@njit(cache=True, error_model="numpy")
def fill_lane(noise: Float32Array, j: int, names: WordArray, row: int, first: int) -> None:
    """Normals from number `first` on into the rows from `row` on of lane j: what a new episode finds there."""
    q = first
    while row < noise.shape[0]:
        four = four_normals(np.uint32(q >> 2), names, j)
        for place in range(q & 3, 4):
            if row < noise.shape[0]:
                noise[row, j] = four[place]
            row += 1
            q += 1


@njit(cache=True, error_model="numpy")
def refill(noise: Float32Array, names: WordArray, first: WordArray) -> None:
    """All rows of a block anew: lane j goes on with its normal number `first[j]`.

    Args:
        noise: shape (ROWS, LANES).
        names: seed (low and high word), episode and index of every lane, shape (4, LANES).
        first: shape (LANES,).
    """
    words = np.empty((4, LANES), dtype=np.uint32)
    made = np.empty((2, 4, LANES), dtype=np.float32)  # the last four normals, and those before
    group = np.empty(LANES, dtype=np.uint32)
    for j in range(LANES):
        group[j] = first[j] >> _TWO
    for turn in range(noise.shape[0] // 4 + 1):
        for j in range(LANES):
            words[0, j], words[1, j], words[2, j], words[3, j] = philox(
                np.uint32(group[j] + np.uint32(turn)),
                _STREAM,
                names[EPISODE, j],
                names[INDEX, j],
                names[SEED_LOW, j],
                names[SEED_HIGH, j],
            )
        new, old = made[turn & 1], made[(turn + 1) & 1]
        for j in range(LANES):
            new[0, j], new[1, j] = box_muller(words[0, j], words[1, j])
            new[2, j], new[3, j] = box_muller(words[2, j], words[3, j])
        if turn > 0:
            _shift(noise, 4 * (turn - 1), old, new, first)


@njit(cache=True, forceinline=True, error_model="numpy")
def _shift(noise: Float32Array, row: int, old: Float32Array, new: Float32Array, first: WordArray) -> None:
    """Four rows of noise: of eight normals those from place `first` mod 4 on."""
    for j in range(LANES):
        by_two, by_one = (first[j] & _TWO) != _ZERO, (first[j] & _ONE) != _ZERO
        n0 = old[2, j] if by_two else old[0, j]
        n1 = old[3, j] if by_two else old[1, j]
        n2 = new[0, j] if by_two else old[2, j]
        n3 = new[1, j] if by_two else old[3, j]
        n4 = new[2, j] if by_two else new[0, j]
        noise[row, j] = n1 if by_one else n0
        noise[row + 1, j] = n2 if by_one else n1
        noise[row + 2, j] = n3 if by_one else n2
        noise[row + 3, j] = n4 if by_one else n3
