"""Standard normals made inside the compiled step: the numbers of a sample depend on (episode key, sample) alone.

The words are those of Philox2x32-10 (Salmon, Moraes, Dror & Shaw 2011), whose key and half of whose counter are the
key of the episode, which `motor_env.streams` draws from (seed, sub-environment, episode). The normals are Box and
Muller's (1958), with series for logarithm and sine in place of a library's: the same operations in the same order
whether the compiler makes one number or eight at a time, so that a vector of environments equals the single one to
the bit. There is no branch and no checked division, either of which would keep the compiler from making several.
They are float32 whatever the precision of the state, so that both precisions meet the same noise; uniforms have 23
bits. numba widens np.uint32 at every operation: each is cast back.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

_MULTIPLIER = np.uint64(0xD256D193)
_WEYL = np.uint64(0x9E3779B9)
_LOW = np.uint64(0xFFFFFFFF)
_HALF_WORD = np.uint64(32)
_ROUNDS = 10

_TO_23_BITS = np.uint64(9)
_MANTISSA = np.uint32(0x007FFFFF)
_MANTISSA_LENGTH = np.uint32(23)
_ONE_BITS = np.uint32(0x3F800000)
_TWO_23_BITS = np.uint32(0x4B000000)
_SQRT_HALF_BITS = np.uint32(0x3F3504F3)
_FROM_SQRT_HALF_TO_ONE = np.uint32(0x3F800000 - 0x3F3504F3)
_TWO_23 = np.float32(2.0**23)
_HALF_STEP = np.float32(2.0**-24)
_EXPONENT_BIAS = np.float32(127.0)
_ZERO, _ONE, _TWO, _HALF, _QUARTER = (np.float32(x) for x in (0.0, 1.0, 2.0, 0.5, 0.25))
_LN_2 = np.float32(math.log(2.0))
_TWO_PI = np.float32(2.0 * math.pi)
_L1, _L2, _L3, _L4 = (np.float32(1.0 / n) for n in (3, 5, 7, 9))
_S0, _S1, _S2, _S3, _S4, _S5 = (np.float32((-1.0) ** n / math.factorial(2 * n + 1)) for n in range(6))

Word = Any
"""A 32-bit word in np.uint64: numba would widen np.uint32 to it at every operation."""


@njit(cache=True, inline="always", error_model="numpy")
def words(sample: Word, key_low: Word, key_high: Word) -> tuple[Word, Word]:
    """Philox2x32-10: two random words for a counter (sample, key_high) and the key key_low."""
    c0, c1, key = sample & _LOW, key_high, key_low
    for _ in range(_ROUNDS):
        product = _MULTIPLIER * c0
        c0 = (product >> _HALF_WORD) ^ key ^ c1
        c1 = product & _LOW
        key = (key + _WEYL) & _LOW
    return c0, c1


@njit(cache=True, inline="always", error_model="numpy")
def _from_one(word: Word) -> np.float32:
    """1 + the 23 leading bits of the word as a fraction: in [1, 2)."""
    return np.uint32(np.uint32(word >> _TO_23_BITS) | _ONE_BITS).view(np.float32)


@njit(cache=True, inline="always", error_model="numpy")
def _sine(turns: np.float32) -> np.float32:
    """sin(2 pi turns) for |turns| <= 1/4, within 3e-7."""
    z = _TWO_PI * turns
    q = z * z
    return z * (_S0 + q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * _S5)))))


@njit(cache=True, inline="always", error_model="numpy")
def _minus_log(word: Word) -> np.float32:
    """-ln u for u = (k + 1/2) 2^-23, by u = m 2^e, m in [sqrt(1/2), sqrt(2)), and the series of atanh."""
    u = _from_one(word) - _ONE + _HALF_STEP
    bits = np.uint32(np.float32(u).view(np.uint32) + _FROM_SQRT_HALF_TO_ONE)
    laid_in = np.uint32(np.uint32(bits >> _MANTISSA_LENGTH) | _TWO_23_BITS).view(np.float32)
    exponent = laid_in - _TWO_23 - _EXPONENT_BIAS
    m = np.uint32(np.uint32(bits & _MANTISSA) + _SQRT_HALF_BITS).view(np.float32)
    s = (m - _ONE) / (m + _ONE)
    q = s * s
    return -(exponent * _LN_2 + _TWO * s * (_ONE + q * (_L1 + q * (_L2 + q * (_L3 + q * _L4)))))


@njit(cache=True, inline="always", error_model="numpy")
def normal_pair(sample: Word, key_low: Word, key_high: Word) -> tuple[np.float32, np.float32]:
    """Two independent standard normals (Box & Muller 1958), at most 5.8 in size, of this sample of this episode."""
    a, b = words(sample, key_low, key_high)
    radius = np.sqrt(_TWO * _minus_log(a))
    turns = _from_one(b) - _ONE - _HALF
    quarter = abs(turns) - _QUARTER
    sine = _sine(_QUARTER - abs(quarter))
    return radius * _sine(quarter), radius * (sine if turns < _ZERO else -sine)


@njit(cache=True, inline="always", error_model="numpy")
def normal(sample: Word, key_low: Word, key_high: Word) -> np.float32:
    """The first number of `normal_pair`, where the second is not needed."""
    a, b = words(sample, key_low, key_high)
    turned: np.float32 = np.sqrt(_TWO * _minus_log(a)) * _sine(abs(_from_one(b) - _ONE - _HALF) - _QUARTER)
    return turned
