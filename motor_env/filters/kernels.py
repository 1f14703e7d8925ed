"""Compiled loops of the Kalman filter, called through `motor_env.filters.kalman`.

One channel is computed as two whose second is never measured: a zero row of C with unit noise has no gain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import inlined, njit
from motor_env.motor.parameters import FloatArray

AnyFloat = NDArray[np.float32 | np.float64]

CONVERGED = 1e-13
"""Relative change of the covariance between samples below which the gain is held."""


@njit(cache=True)
def covariance_step(
    a: FloatArray, q: FloatArray, c: FloatArray, r: FloatArray, p00: float, p01: float, p11: float
) -> tuple[float, ...]:
    """Compute one time and measurement update: gain (4), innovation covariance (3), updated covariance (3).

    The covariance has the Joseph form, (I - K C) P (I - K C)' + K R K'; the paper's (I - K C) P loses symmetry and
    positivity to rounding (Bucy & Joseph 1968).
    """
    t00, t01 = a[0, 0] * p00 + a[0, 1] * p01, a[0, 0] * p01 + a[0, 1] * p11
    t10, t11 = a[1, 0] * p00 + a[1, 1] * p01, a[1, 0] * p01 + a[1, 1] * p11
    m00 = t00 * a[0, 0] + t01 * a[0, 1] + q[0, 0]
    m01 = t00 * a[1, 0] + t01 * a[1, 1] + q[0, 1]
    m11 = t10 * a[1, 0] + t11 * a[1, 1] + q[1, 1]
    # h = P C', columns are channels
    h00, h01 = m00 * c[0, 0] + m01 * c[0, 1], m00 * c[1, 0] + m01 * c[1, 1]
    h10, h11 = m01 * c[0, 0] + m11 * c[0, 1], m01 * c[1, 0] + m11 * c[1, 1]
    s00 = c[0, 0] * h00 + c[0, 1] * h10 + r[0, 0]
    s01 = c[0, 0] * h01 + c[0, 1] * h11 + r[0, 1]
    s11 = c[1, 0] * h01 + c[1, 1] * h11 + r[1, 1]
    inverse = 1.0 / (s00 * s11 - s01 * s01)
    k00, k01 = (h00 * s11 - h01 * s01) * inverse, (h01 * s00 - h00 * s01) * inverse
    k10, k11 = (h10 * s11 - h11 * s01) * inverse, (h11 * s00 - h10 * s01) * inverse
    l00, l01 = 1.0 - k00 * c[0, 0] - k01 * c[1, 0], -k00 * c[0, 1] - k01 * c[1, 1]
    l10, l11 = -k10 * c[0, 0] - k11 * c[1, 0], 1.0 - k10 * c[0, 1] - k11 * c[1, 1]
    t00, t01 = l00 * m00 + l01 * m01, l00 * m01 + l01 * m11
    t10, t11 = l10 * m00 + l11 * m01, l10 * m01 + l11 * m11
    w00, w01 = k00 * r[0, 0] + k01 * r[0, 1], k00 * r[0, 1] + k01 * r[1, 1]
    w10, w11 = k10 * r[0, 0] + k11 * r[0, 1], k10 * r[0, 1] + k11 * r[1, 1]
    u00 = t00 * l00 + t01 * l01 + w00 * k00 + w01 * k01
    u01 = t00 * l10 + t01 * l11 + w00 * k10 + w01 * k11
    u11 = t10 * l10 + t11 * l11 + w10 * k10 + w11 * k11
    return k00, k01, k10, k11, s00, s01, s11, u00, u01, u11


# Entry by entry: numba takes seconds to compile an array that is set as a whole.
@inlined
def _leave_out(
    missing: NDArray[np.bool_], lost: int, c: FloatArray, r: FloatArray, cc: FloatArray, rr: FloatArray
) -> None:
    """Write C and R of a sample: a missing channel has a zero row and uncorrelated noise."""
    for m in range(2):
        is_lost = m < len(missing) and missing[m]
        for j in range(2):
            cc[m, j] = 0.0 if is_lost else c[m, j]
            rr[m, j] = 0.0 if lost > 0 and m != j else r[m, j]


@inlined
def _repeat(values: FloatArray, begin: int) -> None:
    for k in range(begin, values.shape[0]):
        for i in range(values.shape[1]):
            for j in range(values.shape[2]):
                values[k, i, j] = values[begin - 1, i, j]


@njit(cache=True)
def fill_schedules(
    a: FloatArray,
    q: FloatArray,
    c: FloatArray,
    r: FloatArray,
    initial: FloatArray,
    missing: NDArray[np.bool_],
    gain: FloatArray,
    innovation_covariance: FloatArray,
    covariance: FloatArray,
) -> int:
    """Compute gains and covariances of every sample of each row (paper, Table 1).

    `missing` is (n_rows, n_samples, n_channels), the results (n_rows, n_samples, ...). Without missing samples a
    converged gain is held; the result is the last row's sample from which on it is, or n_samples.
    """
    held_from = count = gain.shape[1]
    cc, rr, known = c.copy(), r.copy(), 0
    for n in range(gain.shape[0]):
        t, whole, p = a[min(n, a.shape[0] - 1)], not missing[n].any(), initial[min(n, initial.shape[0] - 1)]
        p00, p01, p11 = p[0, 0], p[0, 1], p[1, 1]
        held_from = count
        for k in range(count):
            lost = 0
            for m in range(missing.shape[2]):
                lost += (m + 1) * missing[n, k, m]
            if lost != known:
                known = lost
                _leave_out(missing[n, k], lost, c, r, cc, rr)
            k00, k01, k10, k11, s00, s01, s11, u00, u01, u11 = covariance_step(t, q, cc, rr, p00, p01, p11)
            gain[n, k, 0, 0], gain[n, k, 1, 0], innovation_covariance[n, k, 0, 0] = k00, k10, s00
            if missing.shape[2] == 2:
                gain[n, k, 0, 1], gain[n, k, 1, 1] = k01, k11
                innovation_covariance[n, k, 0, 1] = innovation_covariance[n, k, 1, 0] = s01
                innovation_covariance[n, k, 1, 1] = s11
            covariance[n, k, 0, 0], covariance[n, k, 1, 1] = u00, u11
            covariance[n, k, 0, 1] = covariance[n, k, 1, 0] = u01
            still = (
                whole
                and abs(u00 - p00) <= CONVERGED * u00
                and abs(u11 - p11) <= CONVERGED * u11
                and abs(u01 - p01) <= CONVERGED * np.sqrt(u00 * u11)
            )
            p00, p01, p11 = u00, u01, u11
            if still:
                held_from = k + 1
                break
        for values in (gain[n], innovation_covariance[n], covariance[n]):
            _repeat(values, held_from)
    return int(held_from)


# Fused multiply-adds round once where two operations round twice, and reorder nothing; they save an eighth of the time.
@njit(cache=True, fastmath={"contract"})
def filter_one_channel(
    a: AnyFloat,
    gain: AnyFloat,
    weight: AnyFloat,
    expected: FloatArray,
    measured: AnyFloat,
    innovation: AnyFloat,
    nis: AnyFloat,
) -> None:
    """Compute innovations and NIS of one channel from deviations from the expected output.

    In the coordinates of `batch.output_coordinates` (Luenberger 1967) the state is (p, q), p being the output's
    predicted deviation: e = z - expected - p, p <- a[0] p + q + g e, q <- a[1] p + a[2] q + h e. `gain` holds (g, h)
    of each sample and `weight` is 1 / S. Four cases run side by side to hide latency; a last incomplete four repeats
    its last case, so that a case's arithmetic never changes. Only the difference from the expected output is in double
    precision.
    """
    count, length = measured.shape
    number = innovation.dtype.type
    a0, a1, a2 = a[0], a[1], a[2]
    end, last = count - 1, expected.shape[0] - 1
    for n in range(0, count, 4):
        i1, i2, i3 = min(n + 1, end), min(n + 2, end), min(n + 3, end)
        m0, m1, m2, m3 = measured[n], measured[i1], measured[i2], measured[i3]
        e0, e1, e2, e3 = innovation[n], innovation[i1], innovation[i2], innovation[i3]
        s0, s1, s2, s3 = nis[n], nis[i1], nis[i2], nis[i3]
        x0, x1 = expected[min(n, last)], expected[min(i1, last)]
        x2, x3 = expected[min(i2, last)], expected[min(i3, last)]
        p0 = p1 = p2 = p3 = q0 = q1 = q2 = q3 = number(0.0)
        for k in range(length):
            g, h, w = gain[k, 0], gain[k, 1], weight[k]
            f0, f1 = number(m0[k] - x0[k]) - p0, number(m1[k] - x1[k]) - p1
            f2, f3 = number(m2[k] - x2[k]) - p2, number(m3[k] - x3[k]) - p3
            e0[k], e1[k], e2[k], e3[k] = f0, f1, f2, f3
            s0[k], s1[k], s2[k], s3[k] = f0 * f0 * w, f1 * f1 * w, f2 * f2 * w, f3 * f3 * w
            p0, q0 = (a0 * p0 + q0) + g * f0, (a1 * p0 + a2 * q0) + h * f0
            p1, q1 = (a0 * p1 + q1) + g * f1, (a1 * p1 + a2 * q1) + h * f1
            p2, q2 = (a0 * p2 + q2) + g * f2, (a1 * p2 + a2 * q2) + h * f2
            p3, q3 = (a0 * p3 + q3) + g * f3, (a1 * p3 + a2 * q3) + h * f3


@njit(cache=True)
def filter_two_channels(
    a: AnyFloat,
    c: AnyFloat,
    gain: AnyFloat,
    weight: AnyFloat,
    expected: FloatArray,
    measured: AnyFloat,
    innovation: AnyFloat,
    nis: AnyFloat,
) -> None:
    """Run the Kalman filter (paper, Table 1) for two channels, in the states themselves.

    `gain` is A K, shape (n_samples, 2, 2), `weight` S^-1, `expected` (rows, n_samples, 2).
    """
    number = innovation.dtype.type
    for n in range(measured.shape[0]):
        x = expected[min(n, expected.shape[0] - 1)]
        d0 = d1 = number(0.0)
        for k in range(measured.shape[2]):
            f0 = number(measured[n, 0, k] - x[k, 0]) - (c[0, 0] * d0 + c[0, 1] * d1)
            f1 = number(measured[n, 1, k] - x[k, 1]) - (c[1, 0] * d0 + c[1, 1] * d1)
            innovation[n, k, 0], innovation[n, k, 1] = f0, f1
            g, w = gain[k], weight[k]
            nis[n, k] = f0 * f0 * w[0, 0] + (f0 * w[0, 1] + f0 * w[1, 0]) * f1 + f1 * f1 * w[1, 1]
            d0, d1 = (
                a[0, 0] * d0 + a[0, 1] * d1 + g[0, 0] * f0 + g[0, 1] * f1,
                a[1, 0] * d0 + a[1, 1] * d1 + g[1, 0] * f0 + g[1, 1] * f1,
            )


@njit(cache=True)
def filter_states(
    a: FloatArray,
    c: FloatArray,
    gain: FloatArray,
    nominal: FloatArray,
    measured: AnyFloat,
    innovation: FloatArray,
    state: FloatArray,
) -> None:
    """Compute innovations and updated states (paper, Table 1), as deviations from the nominal: d+ = d + K e.

    `gain` is K, shape (rows, n_samples, 2, n_channels), `measured` (n, n_channels, n_samples); one row of a motor,
    gain or nominal state serves all. A missing innovation stays NaN.
    """
    for n in range(state.shape[0]):
        t, g = a[min(n, a.shape[0] - 1)], gain[min(n, gain.shape[0] - 1)]
        x = nominal[min(n, nominal.shape[0] - 1)]
        u0 = u1 = 0.0
        for k in range(state.shape[1]):
            d0, d1 = t[0, 0] * u0 + t[0, 1] * u1, t[1, 0] * u0 + t[1, 1] * u1
            u0, u1 = d0, d1
            for m in range(c.shape[0]):
                e = measured[n, m, k] - c[m, 0] * (x[k, 0] + d0) - c[m, 1] * (x[k, 1] + d1)
                innovation[n, k, m] = e
                if not np.isnan(e):
                    u0 += g[k, 0, m] * e
                    u1 += g[k, 1, m] * e
            state[n, k, 0], state[n, k, 1] = x[k, 0] + u0, x[k, 1] + u1


@njit(cache=True)
def score_innovations(
    innovation: FloatArray,
    innovation_covariance: FloatArray,
    whitened: FloatArray,
    nis: FloatArray,
    log_likelihood: FloatArray,
) -> None:
    """Compute innovations over the Cholesky factor of S, NIS and likelihood; one S for all cases, or for each.

    Where the first of two channels is missing, the second is scaled alone.
    """
    count, channels = innovation.shape[1:]
    scale, slope, log_determinant = np.empty((count, channels)), np.zeros(count), 0.0
    for n in range(innovation.shape[0]):
        if n < innovation_covariance.shape[0]:
            log_determinant = 0.0
            for k in range(count):
                s, product = innovation_covariance[n, k], 1.0
                rest = s[0, 0]
                for m in range(channels):
                    if m == 1:
                        slope[k] = s[1, 0] / s[0, 0]
                        rest = s[1, 1] - slope[k] * s[1, 0]
                    scale[k, m] = np.sqrt(rest)
                    if not np.isnan(innovation[n, k, m]):
                        product *= 2.0 * np.pi * rest
                log_determinant += np.log(product)
        total = log_determinant
        for k in range(count):
            first = square = 0.0
            for m in range(channels):
                e = innovation[n, k, m]
                w = (e - slope[k] * first) / scale[k, m]
                whitened[n, k, m] = w
                if not np.isnan(w):
                    square += w * w
                    first = e
            nis[n, k] = square
            total += square
        log_likelihood[n] = -0.5 * total
