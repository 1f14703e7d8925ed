"""Compiled scan of the generalised likelihood ratio over the ages of an onset; `series` and `out` as in `kernels`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.parameters import FloatArray


@njit(cache=True)
def glr(
    series: FloatArray,
    ages: NDArray[np.int64],
    shape: FloatArray,
    bonus: FloatArray,
    two_sided: bool,
    state: FloatArray,
    out: FloatArray,
) -> None:
    """Largest x|x| + bonus over the ages, or x^2 + bonus; x = sum of shape * sample over the root of that of shape^2.

    Willsky & Jones 1976; the grid of ages: Lai 1995.
    The state holds the last samples (their running sums for a step: `shape` is empty), then how many it holds and how
    many there have been. When it is full, all but the last that are needed are dropped.
    """
    longest, room = ages[-1], state.shape[1] - 2
    of_steps = len(shape) == 0
    energy = np.cumsum(shape * shape)
    best, total = np.empty(room), np.empty(room)
    for n in range(series.shape[0]):
        recent = state[n]
        stored, n_past = int(recent[room]), int(recent[room + 1])
        begin = 0
        while begin < series.shape[1]:
            if stored == room:
                base = recent[room - longest - 1] if of_steps else 0.0
                for i in range(longest + 1):
                    recent[i] = recent[room - longest - 1 + i] - base
                stored = longest + 1
            count = min(series.shape[1] - begin, room - stored)
            for i in range(count):
                value = series[n, begin + i]
                value = 0.0 if np.isnan(value) else value
                recent[stored + i] = recent[stored + i - 1] + value if of_steps else value
            best[:count] = -np.inf
            if of_steps and count == 1:  # in service: the slices of a block would cost more than the sums
                best[0] = glr_of_one(recent, stored, n_past, ages, bonus, two_sided)
            else:
                glr_of_block(
                    recent, stored, n_past, count, ages, shape, energy, bonus, two_sided, total, best
                )
            out[n, begin : begin + count] = best[:count]
            stored, n_past, begin = stored + count, n_past + count, begin + count
        recent[room], recent[room + 1] = stored, n_past


@njit(cache=True)
def glr_of_block(
    recent: FloatArray,
    stored: int,
    n_past: int,
    count: int,
    ages: NDArray[np.int64],
    shape: FloatArray,
    energy: FloatArray,
    bonus: FloatArray,
    two_sided: bool,
    total: FloatArray,
    best: FloatArray,
) -> None:
    """Raise the best statistics of the `count` samples from place `stored` on, age by age."""
    last = stored + count
    for j in range(len(ages)):
        age = ages[j]
        first = max(0, age - n_past - 1)
        if first >= count:
            break
        if len(shape) == 0:
            difference(recent[stored + first : last], recent[stored + first - age : last - age], total)
            weight = 1.0 / age
        elif energy[age - 1] > 0.0:
            for i in range(first, count):
                total[i - first] = np.dot(shape[:age], recent[stored + i + 1 - age : stored + i + 1])
            weight = 1.0 / energy[age - 1]
        else:
            continue
        raise_best(total, weight, bonus[j], two_sided, best[first:count])


@njit(cache=True)
def glr_of_one(
    sums: FloatArray, stored: int, n_past: int, ages: NDArray[np.int64], bonus: FloatArray, two_sided: bool
) -> float:
    """The statistic of a step after one more sample."""
    best = -np.inf
    for j in range(len(ages)):
        age = ages[j]
        if age > n_past + 1:
            break
        total = sums[stored] - sums[stored - age]
        value = total * (total if two_sided else abs(total)) * (1.0 / age) + bonus[j]
        best = value if value > best else best
    return best


# Each a plain loop over contiguous values, so that it vectorises.


@njit(cache=True)
def difference(later: FloatArray, earlier: FloatArray, total: FloatArray) -> None:
    """Differences of running sums."""
    for i in range(len(later)):
        total[i] = later[i] - earlier[i]


@njit(cache=True)
def raise_best(total: FloatArray, weight: float, bonus: float, two_sided: bool, best: FloatArray) -> None:
    """Raise the best to weighted squares where they are larger; one-sided with the sign of what is squared."""
    for i in range(len(best)):
        size = abs(total[i])
        value, stored = size * (size if two_sided else total[i]) * weight + bonus, best[i]
        best[i] = value if value > stored else stored
