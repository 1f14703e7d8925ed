"""Counter-based random streams: the numbers of case n depend on (seed, stream, n) alone.

Philox4x32-10 (Salmon, Moraes, Dror & Shaw 2011) is a bijection of its 128-bit counter for each 64-bit key. The key is
the seed; the counter holds the case (64 bits), the stream (32 bits) and the block (32 bits). So results do not depend
on the number of workers.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.parameters import FloatArray, require

_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint64(0x9E3779B9)
_WEYL_1 = np.uint64(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_HALF_WORD = np.uint64(32)
_ROUNDS = 10

NORMALS_AT_ONCE = 256
"""Normals that are made at a time: they fit the first cache and fill the vector units."""

_HALF, _ONE, _MINUS_TWO = np.float32(0.5), np.float32(1.0), np.float32(-2.0)
_TO_UNIT = np.float32(2.0**-32)
_TO_ANGLE = np.float32(math.pi / 2.0 * 2.0**-30)
_EIGHTH_TURN = np.uint32(1 << 29)
_SQRT_HALF_BITS = np.uint32(0x3F3504F3)
_LN_2 = np.float32(math.log(2.0))
_L0, _L1, _L2 = np.float32(7.0376836292e-2), np.float32(-1.1514610310e-1), np.float32(1.1676998740e-1)
_L3, _L4, _L5 = np.float32(-1.2420140846e-1), np.float32(1.4249322787e-1), np.float32(-1.6668057665e-1)
_L6, _L7, _L8 = np.float32(2.0000714765e-1), np.float32(-2.4999993993e-1), np.float32(3.3333331174e-1)
_S1, _S2, _S3 = np.float32(-1.6666654611e-1), np.float32(8.3321608736e-3), np.float32(-1.9515295891e-4)
_C1, _C2, _C3 = np.float32(4.166664568e-2), np.float32(-1.388731625e-3), np.float32(2.443315711e-5)


class Stream(IntEnum):
    """Purpose of a stream. A new use takes a new number; the old ones keep theirs."""

    CLASS = 0
    MOTOR = 1
    SUPPLY = 2
    MEASUREMENT = 3
    PROCESS = 4
    ONSET = 5
    SENSOR = 6
    SPLIT = 7
    WEAR = 8
    FIELD_MOTOR = 10
    FIELD_START = 11
    SEVERITY = 12
    MISSING = 13
    CALIBRATION = 14
    PROFILE = 15
    DUTY = 16
    RECOVERY = 17


@njit(cache=True, inline="always")  # a call would keep the loop around it from vectorising
def philox(
    c0: np.uint32, c1: np.uint32, c2: np.uint32, c3: np.uint32, k0: np.uint32, k1: np.uint32
) -> tuple[np.uint32, np.uint32, np.uint32, np.uint32]:
    """Compute four random 32-bit words from a counter of four words and a key of two (Salmon et al. 2011).

    The words stay in 64 bits, of which the rounds read the lower 32: casts would halve the speed.
    """
    w0, w1, w2, w3 = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    key_0, key_1 = np.uint64(k0), np.uint64(k1)
    for _ in range(_ROUNDS):
        product_0 = _MULTIPLIER_0 * (w0 & _LOW)
        product_1 = _MULTIPLIER_1 * (w2 & _LOW)
        w0 = (product_1 >> _HALF_WORD) ^ w1 ^ key_0
        w1 = product_1
        w2 = (product_0 >> _HALF_WORD) ^ w3 ^ key_1
        w3 = product_0
        key_0 = key_0 + _WEYL_0
        key_1 = key_1 + _WEYL_1
    return np.uint32(w0 & _LOW), np.uint32(w1 & _LOW), np.uint32(w2 & _LOW), np.uint32(w3 & _LOW)


@njit(cache=True)
def _fill_uniforms(seed: np.uint64, stream: np.uint32, cases: NDArray[np.uint64], out: FloatArray) -> None:
    k0, k1 = np.uint32(seed & _LOW), np.uint32(seed >> _HALF_WORD)
    count = out.shape[1]
    for n in range(out.shape[0]):
        case_low, case_high = np.uint32(cases[n] & _LOW), np.uint32(cases[n] >> _HALF_WORD)
        for block in range((count + 3) // 4):
            words = philox(np.uint32(block), stream, case_low, case_high, k0, k1)
            for j in range(4):
                if 4 * block + j < count:
                    out[n, 4 * block + j] = (float(words[j]) + 0.5) * 2.0**-32


@njit(cache=True, inline="always")  # a call would keep the loop around it from vectorising
def box_muller(first: np.uint32, second: np.uint32) -> tuple[np.float32, np.float32]:
    """Return two standard normals from two words (Box & Muller 1958), in float32, vectorised.

    By the polynomials of Cephes (Moshier 1989), within 5e-6 of the exact transformation. The largest normal is sqrt(66
    ln 2) = 6.76.
    """
    u = (np.float32(first) + _HALF) * _TO_UNIT
    bits = np.float32(u).view(np.uint32)
    exponent = np.int32(np.uint32(bits - _SQRT_HALF_BITS)) >> np.int32(23)
    mantissa = np.uint32(bits - np.uint32(np.uint32(exponent) << np.uint32(23))).view(np.float32)
    x = mantissa - _ONE
    y = ((((((((_L0 * x + _L1) * x + _L2) * x + _L3) * x + _L4) * x + _L5) * x + _L6) * x + _L7) * x) + _L8
    logarithm = x - (_HALF * x * x - y * x * x * x) + np.float32(exponent) * _LN_2
    radius = np.sqrt(_MINUS_TWO * logarithm)
    # The angle is a number of quarter turns and a rest within an eighth of a turn.
    quarters = np.uint32(np.uint32(second + _EIGHTH_TURN) >> np.uint32(30))
    rest = (
        np.float32(np.int32(np.uint32(second - np.uint32(quarters << np.uint32(30))))) + _HALF
    ) * _TO_ANGLE
    square = rest * rest
    sine = rest + rest * square * (_S1 + square * (_S2 + square * _S3))
    cosine = _ONE - _HALF * square + square * square * (_C1 + square * (_C2 + square * _C3))
    odd = np.uint32(quarters & np.uint32(1)) != np.uint32(0)
    across, along = (sine, cosine) if odd else (cosine, sine)
    across_sign = np.uint32(np.uint32(np.uint32(quarters + np.uint32(1)) & np.uint32(2)) << np.uint32(30))
    along_sign = np.uint32(np.uint32(quarters & np.uint32(2)) << np.uint32(30))
    across = np.uint32(np.float32(across).view(np.uint32) ^ across_sign).view(np.float32)
    along = np.uint32(np.float32(along).view(np.uint32) ^ along_sign).view(np.float32)
    return radius * across, radius * along


@njit(cache=True)
def whole_blocks(count: int) -> int:
    """Return `count` rounded up to whole blocks of four."""
    return 4 * ((count + 3) // 4)


@njit(cache=True)
def fill_case(
    seed: np.uint64,
    stream: np.uint32,
    case: np.uint64,
    begin: int,
    words: NDArray[np.uint32],
    out: NDArray[np.float32],
) -> None:
    """Write standard normals `begin` .. `begin` + len(out) - 1 of a case; `begin` and len(out) are multiples of 4.

    `words` is scratch of shape (4, NORMALS_AT_ONCE / 4); `out` holds at most NORMALS_AT_ONCE.
    """
    k0, k1 = np.uint32(seed & _LOW), np.uint32(seed >> _HALF_WORD)
    case_low, case_high = np.uint32(case & _LOW), np.uint32(case >> _HALF_WORD)
    first, blocks = np.uint32(begin // 4), len(out) // 4
    for b in range(blocks):
        words[0, b], words[1, b], words[2, b], words[3, b] = philox(
            np.uint32(first + np.uint32(b)), stream, case_low, case_high, k0, k1
        )
    for b in range(blocks):
        out[4 * b], out[4 * b + 1] = box_muller(words[0, b], words[1, b])
        out[4 * b + 2], out[4 * b + 3] = box_muller(words[2, b], words[3, b])


@njit(cache=True)
def _fill_normals(seed: np.uint64, stream: np.uint32, cases: NDArray[np.uint64], out: FloatArray) -> None:
    count = out.shape[1]
    words = np.empty((4, NORMALS_AT_ONCE // 4), dtype=np.uint32)
    scratch = np.empty(NORMALS_AT_ONCE, dtype=np.float32)
    for n in range(out.shape[0]):
        for begin in range(0, count, NORMALS_AT_ONCE):
            n_new = min(NORMALS_AT_ONCE, count - begin)
            fill_case(seed, stream, cases[n], begin, words, scratch[: whole_blocks(n_new)])
            out[n, begin : begin + n_new] = scratch[:n_new]


def _filled(fill: Any, seed: int, stream: Stream, cases: ArrayLike, count: int) -> FloatArray:
    require(0 <= seed < 2**64, f"seed must be in 0 .. 2^64 - 1, got {seed}")
    array = np.asarray(cases)
    if array.min(initial=0) < 0:
        raise ValueError(f"cases must be >= 0, got {array.min()}")
    out = np.empty((array.size, count))
    fill(np.uint64(seed), np.uint32(stream), np.ascontiguousarray(array, dtype=np.uint64), out)
    return out


def uniforms(seed: int, stream: Stream, cases: ArrayLike, count: int) -> FloatArray:
    """Return uniform numbers in (0, 1), shape (n_cases, count): row n belongs to case `cases[n]` alone.

    Raises:
        ValueError: the seed does not fit 64 bits, or a case is negative.
    """
    return _filled(_fill_uniforms, seed, stream, cases, count)


def normals(seed: int, stream: Stream, cases: ArrayLike, count: int) -> FloatArray:
    """Return standard normal numbers, shape (n_cases, count): row n belongs to case `cases[n]` alone.

    Their precision is float32 (24 bits).

    Raises:
        ValueError: the seed does not fit 64 bits, or a case is negative.
    """
    return _filled(_fill_normals, seed, stream, cases, count)
