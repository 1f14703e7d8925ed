"""Matrix exponentials by the series of `motor_env.motor.model`, in kernels: of many motors, and of larger matrices."""

from __future__ import annotations

import numpy as np

from motor_env.motor.compiled import compiled_part, inlined
from motor_env.motor.model import SERIES_NORM, SERIES_ORDER, doubled, longer_series, of_series
from motor_env.motor.parameters import FloatArray

ROOM = 4
"""Rows of scratch that `exponentials_and_phis` needs."""


@inlined
def exponentials_and_phis(
    count: int, x: FloatArray, exponential: FloatArray, phi: FloatArray, room: FloatArray
) -> None:
    """Compute exp(X) and phi1(X) of the first `count` matrices, bit for bit as `exponential_and_phi`.

    Args:
        count: of matrices.
        x: entries row by row, shape (4, n); overwritten.
        exponential: written, shape (4, n).
        phi: written, shape (4, n).
        room: scratch, shape (ROOM, n).
    """
    scale, norm, shrink, doublings = room[0], room[1], room[2], room[3]
    for n in range(count):
        a, b, c, d = x[0, n], x[1, n], x[2, n], x[3, n]
        evens = np.sqrt(abs(b / c)) if b != 0.0 and c != 0.0 else 1.0
        b, c = b / evens, c * evens
        x[1, n], x[2, n], scale[n], shrink[n], doublings[n] = b, c, evens, 1.0, 0.0
        norm[n] = max(abs(a) + abs(b), abs(c) + abs(d))
    most, too_large = -1, 1
    while too_large > 0:
        most, too_large = most + 1, 0
        for n in range(count):
            again = SERIES_NORM < norm[n] < np.inf
            norm[n] *= 0.5 if again else 1.0
            shrink[n] *= 0.5 if again else 1.0
            doublings[n] += 1.0 if again else 0.0
            too_large += 1 if again else 0
    for n in range(count):
        x[0, n] *= shrink[n]
        x[1, n] *= shrink[n]
        x[2, n] *= shrink[n]
        x[3, n] *= shrink[n]
        phi[0, n], phi[1, n], phi[2, n], phi[3, n] = 1.0, 0.0, 0.0, 1.0
    for k in range(SERIES_ORDER, 0, -1):
        for n in range(count):
            now = (phi[0, n], phi[1, n], phi[2, n], phi[3, n])
            now = longer_series(k, (x[0, n], x[1, n], x[2, n], x[3, n]), now)
            phi[0, n], phi[1, n], phi[2, n], phi[3, n] = now
    for n in range(count):
        now = (phi[0, n], phi[1, n], phi[2, n], phi[3, n])
        whole = of_series((x[0, n], x[1, n], x[2, n], x[3, n]), now)
        exponential[0, n], exponential[1, n], exponential[2, n], exponential[3, n] = whole
    for k in range(most):
        for n in range(count):
            now = (phi[0, n], phi[1, n], phi[2, n], phi[3, n])
            whole = (exponential[0, n], exponential[1, n], exponential[2, n], exponential[3, n])
            twice, part = doubled(whole, now)
            goes_on = k < doublings[n]
            exponential[0, n] = twice[0] if goes_on else whole[0]
            exponential[1, n] = twice[1] if goes_on else whole[1]
            exponential[2, n] = twice[2] if goes_on else whole[2]
            exponential[3, n] = twice[3] if goes_on else whole[3]
            phi[0, n] = part[0] if goes_on else now[0]
            phi[1, n] = part[1] if goes_on else now[1]
            phi[2, n] = part[2] if goes_on else now[2]
            phi[3, n] = part[3] if goes_on else now[3]
    for n in range(count):
        exponential[1, n] *= scale[n]
        exponential[2, n] /= scale[n]
        phi[1, n] *= scale[n]
        phi[2, n] /= scale[n]


@compiled_part
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for r in range(a.shape[0]):
        for c in range(b.shape[1]):
            total = 0.0
            for n in range(a.shape[1]):
                total += a[r, n] * b[n, c]
            out[r, c] = total


@compiled_part
def exponential_in_kernel(a: FloatArray, out: FloatArray, work: FloatArray) -> None:
    """Compute exp(A) by scaling, series and squaring (Moler & Van Loan 2003, method 3); A is scaled in place."""
    n, norm, doublings = len(a), 0.0, 0
    for r in range(n):
        total = 0.0
        for c in range(n):
            out[r, c] = 1.0 if r == c else 0.0
            total += abs(a[r, c])
        norm = max(norm, total)
    while norm > SERIES_NORM:
        norm, doublings = 0.5 * norm, doublings + 1
    for k in range(SERIES_ORDER, 0, -1):
        _product(a, out, work)
        for r in range(n):
            for c in range(n):
                out[r, c] = work[r, c] / k / 2.0**doublings + (1.0 if r == c else 0.0)
    for _ in range(doublings):
        _product(out, out, work)
        for r in range(n):
            for c in range(n):
                out[r, c] = work[r, c]
