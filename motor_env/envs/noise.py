"""Standard normals made inside the compiled step: the numbers of a sample depend on (episode key, sample) alone.

The words are those of Philox2x32-10 (Salmon, Moraes, Dror & Shaw 2011), whose key and half of whose counter are the
key of the episode, which `motor_env.streams` draws from (seed, sub-environment, episode). The normals are Box and
Muller's (1958), with series for logarithm and sine in place of a library's: the same operations in the same order
whether the compiler makes one number or four at a time, so that a vector of environments equals the single one to
the bit. There is no branch and no checked division, either of which would keep the compiler from making four.
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

_TWO_52 = 2.0**52
_TWO_52_BITS = np.uint64(0x4330000000000000)
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)
_MANTISSA_LENGTH = np.uint64(52)
_EXPONENT_BIAS = 1023.0
_SQRT_HALF_BITS = np.uint64(0x3FE6A09E667F3BCD)
_FROM_SQRT_HALF_TO_ONE = np.uint64(0x3FF0000000000000 - 0x3FE6A09E667F3BCD)
_WORD = 2.0**-32
_LN_2 = math.log(2.0)
_TWO_PI = 2.0 * math.pi
_L1, _L2, _L3, _L4, _L5 = (1.0 / n for n in (3, 5, 7, 9, 11))
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = ((-1.0) ** n / math.factorial(2 * n + 1) for n in range(7))

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
def _as_float(word: Word) -> float:
    """The integer as a float: laid into the mantissa of 2^52, which then comes off."""
    laid_in: float = np.uint64(word | _TWO_52_BITS).view(np.float64)
    difference: float = laid_in - _TWO_52
    return difference


@njit(cache=True, inline="always", error_model="numpy")
def _sine(turns: float) -> float:
    """sin(2 pi turns) for |turns| <= 1/4, within 5e-9."""
    z = _TWO_PI * turns
    q = z * z
    return z * (_S0 + q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * (_S5 + q * _S6))))))


@njit(cache=True, inline="always", error_model="numpy")
def _minus_log(word: Word) -> float:
    """-ln u for u = (word + 1/2) 2^-32, by u = m 2^e, m in [sqrt(1/2), sqrt(2)), and the series of atanh."""
    bits = np.float64((_as_float(word) + 0.5) * _WORD).view(np.uint64) + _FROM_SQRT_HALF_TO_ONE
    exponent = _as_float(bits >> _MANTISSA_LENGTH) - _EXPONENT_BIAS
    m = np.uint64((bits & _MANTISSA) + _SQRT_HALF_BITS).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    return -(exponent * _LN_2 + 2.0 * s * (1.0 + q * (_L1 + q * (_L2 + q * (_L3 + q * (_L4 + q * _L5))))))


@njit(cache=True, inline="always", error_model="numpy")
def normal_pair(sample: Word, key_low: Word, key_high: Word) -> tuple[float, float]:
    """Two independent standard normals (Box & Muller 1958), at most 6.7 in size, of this sample of this episode."""
    a, b = words(sample, key_low, key_high)
    radius = np.sqrt(2.0 * _minus_log(a))
    turns = _as_float(b) * _WORD - 0.5
    quarter = abs(turns) - 0.25
    sine = _sine(0.25 - abs(quarter))
    return radius * _sine(quarter), radius * (sine if turns < 0.0 else -sine)
