"""Counter-based random streams: the numbers of case n depend on (seed, stream, n) alone.

Philox4x32-10 (Salmon, Moraes, Dror & Shaw 2011) is a bijection of its 128-bit counter for each 64-bit key.
The key is the seed; the counter holds the case (64 bits), the stream (32 bits) and the block (32 bits). So no two
cases, streams or blocks of a seed share a counter, and results do not depend on the number of workers or shards.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from motor_env.parameters import FloatArray, require

_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint32(0x9E3779B9)
_WEYL_1 = np.uint32(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_HALF_WORD = np.uint64(32)
_ROUNDS = 10


class Stream(IntEnum):
    """What a stream is for. A new use takes a new number; the old ones keep theirs."""

    CLASS = 0
    MOTOR = 1
    SUPPLY = 2
    MEASUREMENT = 3
    PROCESS = 4
    ONSET = 5
    SENSOR = 6
    SPLIT = 7
    WEAR = 8
    WEAR_CROSSING = 9


@njit(cache=True)
def philox(
    c0: np.uint32, c1: np.uint32, c2: np.uint32, c3: np.uint32, k0: np.uint32, k1: np.uint32
) -> tuple[np.uint32, np.uint32, np.uint32, np.uint32]:
    """Philox4x32-10: four random 32-bit words for a counter of four words and a key of two (Salmon et al. 2011)."""
    for _ in range(_ROUNDS):
        product_0 = _MULTIPLIER_0 * np.uint64(c0)
        product_1 = _MULTIPLIER_1 * np.uint64(c2)
        c0 = np.uint32(np.uint32(product_1 >> _HALF_WORD) ^ c1 ^ k0)
        c1 = np.uint32(product_1 & _LOW)
        c2 = np.uint32(np.uint32(product_0 >> _HALF_WORD) ^ c3 ^ k1)
        c3 = np.uint32(product_0 & _LOW)
        k0 = np.uint32(k0 + _WEYL_0)
        k1 = np.uint32(k1 + _WEYL_1)
    return c0, c1, c2, c3


@njit(cache=True)
def _fill_uniforms(seed: np.uint64, stream: np.uint32, cases: NDArray[np.uint64], out: FloatArray) -> None:
    """Uniforms in the open interval (0, 1), four to a block."""
    k0, k1 = np.uint32(seed & _LOW), np.uint32(seed >> _HALF_WORD)
    count = out.shape[1]
    for n in range(out.shape[0]):
        case_low, case_high = np.uint32(cases[n] & _LOW), np.uint32(cases[n] >> _HALF_WORD)
        for block in range((count + 3) // 4):
            words = philox(np.uint32(block), stream, case_low, case_high, k0, k1)
            for j in range(4):
                if 4 * block + j < count:
                    out[n, 4 * block + j] = (float(words[j]) + 0.5) * 2.0**-32


@njit(cache=True)
def _fill_normals(seed: np.uint64, stream: np.uint32, cases: NDArray[np.uint64], out: FloatArray) -> None:
    """Standard normals, four to a block (Box & Muller 1958)."""
    k0, k1 = np.uint32(seed & _LOW), np.uint32(seed >> _HALF_WORD)
    count = out.shape[1]
    for n in range(out.shape[0]):
        case_low, case_high = np.uint32(cases[n] & _LOW), np.uint32(cases[n] >> _HALF_WORD)
        for block in range((count + 3) // 4):
            words = philox(np.uint32(block), stream, case_low, case_high, k0, k1)
            for pair in range(2):
                radius = np.sqrt(-2.0 * np.log((float(words[2 * pair]) + 0.5) * 2.0**-32))
                angle = 2.0 * np.pi * (float(words[2 * pair + 1]) + 0.5) * 2.0**-32
                index = 4 * block + 2 * pair
                if index < count:
                    out[n, index] = radius * np.cos(angle)
                if index + 1 < count:
                    out[n, index + 1] = radius * np.sin(angle)


def _checked(seed: int, cases: ArrayLike) -> tuple[np.uint64, NDArray[np.uint64]]:
    require(0 <= seed < 2**64, f"seed must be in 0 .. 2^64 - 1, got {seed}")
    array = np.asarray(cases)
    require(
        array.size == 0 or int(array.min()) >= 0,
        f"cases must be >= 0, got {array.min() if array.size else 0}",
    )
    return np.uint64(seed), np.ascontiguousarray(array, dtype=np.uint64)


def uniforms(seed: int, stream: Stream, cases: ArrayLike, count: int) -> FloatArray:
    """Uniform numbers in (0, 1), shape (n_cases, count): row n belongs to case `cases[n]` alone.

    Raises:
        ValueError: the seed does not fit 64 bits, or a case is negative.
    """
    checked_seed, checked_cases = _checked(seed, cases)
    out = np.empty((checked_cases.size, count))
    _fill_uniforms(checked_seed, np.uint32(stream), checked_cases, out)
    return out


def normals(seed: int, stream: Stream, cases: ArrayLike, count: int) -> FloatArray:
    """Standard normal numbers, shape (n_cases, count): row n belongs to case `cases[n]` alone.

    Raises:
        ValueError: the seed does not fit 64 bits, or a case is negative.
    """
    checked_seed, checked_cases = _checked(seed, cases)
    out = np.empty((checked_cases.size, count))
    _fill_normals(checked_seed, np.uint32(stream), checked_cases, out)
    return out
