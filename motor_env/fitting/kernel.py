"""Kalman filter of a recorded motor, compiled, on the steps of `motor_env.fitting.steps`.

State: [current, speed, load torque, shown current, shown speed]; the last ones only where a model has them. Where the
state is known at the first sample and nothing disturbs the motor, the filter's covariance is none: its innovations are
the errors of the model that runs freely.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from motor_env.fitting.places import (
    AFTER,
    COOLING,
    COULOMB,
    DROP,
    HEATING,
    LAG_I,
    LAG_W,
    LOAD,
    NOISE_I,
    NOISE_V,
    NOISE_W,
    OFFSET_I,
    OFFSET_W,
    SQUARE,
    WALK,
    B,
    K,
    L,
    R,
)
from motor_env.fitting.steps import (
    FINE,
    at,
    braked_step,
    coasting_step,
    inlined,
    product,
    smooth_step,
    tables,
)
from motor_env.motor.compiled import njit
from motor_env.motor.parameters import COPPER_PER_KELVIN, FRICTION_PER_KELVIN, FloatArray

BEGIN, OPEN, REST, STEADY, SWITCH = 1.0, 2.0, 3.0, 4.0, 5.0
"""Marks of a sample: the first of a recording; an open circuit; the first, of a motor that stands without current, or
runs steadily under the first voltage; switched on after standing, so long before the sample as the value AFTER says."""
_WILD = 6.0
_STEADY_STEPS = 12
_SLOW = 0.02  # of the largest speed: where dry friction is larger


@inlined
def _lag(p: FloatArray, dt_s: float) -> tuple[float, float, float]:
    """Weights of the shown speed before, the true one before and the true one now; exact for a straight line."""
    lag_s = p[LAG_W]
    if lag_s <= 0.0:
        return 0.0, 0.0, 1.0
    decay = math.exp(-dt_s / lag_s)
    mean = (1.0 - decay) * lag_s / dt_s
    return decay, mean - decay, 1.0 - mean


@inlined
def _spread(
    cov: FloatArray,
    f: FloatArray,
    p: FloatArray,
    dt_s: float,
    lag: tuple[float, float, float],
    work: FloatArray,
) -> None:
    """Covariance after an interval, in place: P = F P F' + Q. Only the upper triangle is used."""
    a, b, c, d, e, h = f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2]
    noise_i, noise_w = p[NOISE_V] * f[0, 3], p[NOISE_V] * f[1, 3]
    ii, iw, ww = cov[0, 0], cov[0, 1], cov[1, 1]
    if cov.shape[0] == 2:
        cov[0, 0] = a * a * ii + 2.0 * a * b * iw + b * b * ww + noise_i * noise_i
        cov[0, 1] = a * d * ii + (a * e + b * d) * iw + b * e * ww + noise_i * noise_w
        cov[1, 1] = d * d * ii + 2.0 * d * e * iw + e * e * ww + noise_w * noise_w
        return
    if cov.shape[0] == 3:
        il, wl, ll = cov[0, 2], cov[1, 2], cov[2, 2]
        # Of the new current and speed with the old current, speed and load.
        i_i, i_w, i_l = a * ii + b * iw + c * il, a * iw + b * ww + c * wl, a * il + b * wl + c * ll
        w_i, w_w, w_l = d * ii + e * iw + h * il, d * iw + e * ww + h * wl, d * il + e * wl + h * ll
        cov[0, 0] = a * i_i + b * i_w + c * i_l + noise_i * noise_i
        cov[0, 1] = d * i_i + e * i_w + h * i_l + noise_i * noise_w
        cov[1, 1] = d * w_i + e * w_w + h * w_l + noise_w * noise_w
        cov[0, 2], cov[1, 2], cov[2, 2] = i_l, w_l, ll + p[WALK] ** 2 * dt_s
        return
    whole, half, by_volt = work[0], work[1], work[2, 0]
    for c in range(3):
        whole[0, c], whole[1, c], whole[3, c], whole[4, c] = f[0, c], f[1, c], f[2, c], lag[2] * f[1, c]
    whole[4, 1] += lag[1]
    whole[2, 2], whole[3, 3], whole[4, 4] = 1.0, f[2, 4], lag[0]
    by_volt[0], by_volt[1], by_volt[3], by_volt[4] = f[0, 3], f[1, 3], f[2, 3], lag[2] * f[1, 3]
    for r in range(5):
        for k in range(r):
            cov[r, k] = cov[k, r]
    product(whole, cov, half)
    for r in range(5):
        for k in range(r, 5):
            total = p[NOISE_V] ** 2 * by_volt[r] * by_volt[k]
            for n in range(5):
                total += half[r, n] * whole[k, n]
            cov[r, k] = total
    cov[2, 2] += p[WALK] ** 2 * dt_s


@inlined
def _update(
    x: FloatArray, cov: FloatArray, place: int, shown: float, noise: float, learn: bool, row: FloatArray
) -> tuple[float, float]:
    """Weigh in one reading; whitened innovation and the logarithm of its variance."""
    n = cov.shape[0]
    error, variance = shown - x[place], cov[place, place] + noise * noise
    white = error / math.sqrt(variance)
    if learn:
        weight = min(1.0, _WILD / max(abs(white), 1e-12)) * error / variance
        for r in range(n):
            row[r] = cov[min(r, place), max(r, place)]
        for r in range(n):
            x[r] += weight * row[r]
            share = row[r] / variance
            for c in range(r, n):
                cov[r, c] -= share * row[c]
    return white, math.log(variance)


@inlined
def _begin(
    p: FloatArray,
    x: FloatArray,
    cov: FloatArray,
    shown: FloatArray,
    volts: float,
    reach: float,
    seen: FloatArray,
    dt_s: float,
) -> None:
    """State at the first sample of a recording: as shown; what is not seen from the balance of the voltages.

    `shown` is what this sample and the next show, shape (2, 2), `volts` the voltage between them.
    """
    n, i, next_i = cov.shape[0], shown[0, 0], shown[1, 0]
    x[:] = 0.0
    inner = p[R] * 0.5 * (i + next_i) + p[L] * (next_i - i) / dt_s
    x[1] = shown[0, 1] if seen[1] > 0.0 else min(max(volts - inner, -reach), reach) / p[K]
    x[0] = i if seen[0] > 0.0 else (volts - p[K] * x[1]) / p[R]
    x[3], x[4] = x[0], x[1]
    sd_w = p[NOISE_W] if seen[1] > 0.0 else math.hypot(0.3 * reach, p[L] / dt_s * p[NOISE_I]) / p[K]
    sd_i = p[NOISE_I] if seen[0] > 0.0 else 0.3 * reach / p[R]
    cov[:] = 0.0
    cov[0, 0], cov[1, 1] = sd_i**2, sd_w**2
    if n == 5:
        cov[3, 3] = cov[0, 3] = sd_i**2
        cov[4, 4] = cov[1, 4] = sd_w**2
    if n > 2 and p[WALK] > 0.0:
        cov[2, 2] = (p[K] * 0.1 * reach / p[R]) ** 2


@inlined
def _steady(p: FloatArray, volts: float, x: FloatArray) -> None:
    """Current and speed of a motor that runs steadily (V = R i + K w + drop, K i = B w + fan + load), or is held."""
    turning = math.copysign(1.0, volts)
    driving, load = volts - turning * min(p[DROP], abs(volts)), p[LOAD] + turning * p[COULOMB]
    pull, speed = p[K] * driving - p[R] * load, 0.0
    slope, fan = p[K] ** 2 + p[R] * p[B], p[R] * p[SQUARE]
    for _ in range(_STEADY_STEPS):  # Newton's method: slope w + fan w |w| = pull
        speed -= (slope * speed + fan * speed * abs(speed) - pull) / (slope + 2.0 * fan * abs(speed))
    x[1] = speed if speed * turning > 0.0 else 0.0
    x[0] = (driving - p[K] * x[1]) / p[R]
    x[3], x[4] = x[0], x[1]


@inlined
def _advance(
    of: FloatArray,
    lag: tuple[float, float, float],
    warm_k: float,
    m: FloatArray,
    x: FloatArray,
    u: FloatArray,
    p: FloatArray,
    dry: float,
    mark: float,
    before: float,
    dt_s: float,
    f: FloatArray,
) -> None:
    """State after an interval, and its slopes; the interval ends at a sample of one mark, and begins at another's."""
    i, w = x[0], x[1]
    at(of[0], warm_k, m)
    parts = smooth_step(m, x, u, p, dry, f) if mark != OPEN or before != OPEN else 0
    if parts > 0:
        at(of[1 if parts == FINE else 2], warm_k, m)
        braked_step(m, x, u, p, dry, f, parts)
    if mark == OPEN:
        if before == OPEN or x[0] * i < 0.0:  # a diode lets no current turn
            x[1] = w
            coasting_step(x, u, p, dry, dt_s, f)
        x[0] = 0.0
        for c in range(5):
            f[0, c] = 0.0
    if p[LAG_I] <= 0.0:
        x[3] = x[0]
        for c in range(5):
            f[2, c] = f[0, c]
    elif mark == OPEN and before == OPEN:
        x[3] *= m[2, 5]
        for c in range(5):
            f[2, c] = m[2, 5] if c == 4 else 0.0
    x[4] = lag[0] * x[4] + lag[1] * w + lag[2] * x[1]


@njit(cache=True, error_model="numpy")
def predict(
    p: FloatArray,
    dt_s: float,
    voltage: FloatArray,
    readings: FloatArray,
    seen: FloatArray,
    marks: FloatArray,
    learn: bool,
    out: FloatArray,
) -> float:
    """Run the filter over a record.

    Args:
        p: physical values and noise, shape (N_VALUES,).
        dt_s: sampling interval.
        voltage: before and after the interval that ends at each sample, shape (n, 2).
        readings: current and speed, shape (n, 2); NaN where there is none.
        seen: 1 where a channel was recorded, shape (2,).
        marks: see BEGIN; 0 for all other samples, shape (n,).
        learn: weigh readings in; without it the model runs freely, with the given load alone.
        out: whitened innovations, predicted readings, load, temperature, shape (n, 6).

    Returns:
        Sum of the logarithms of the innovations' variances.
    """
    n = 5 if p[LAG_I] > 0.0 or p[LAG_W] > 0.0 else (3 if p[WALK] > 0.0 else 2)
    usual, lag = tables(p, dt_s), _lag(p, dt_s)
    m, x, cov, f, u = np.zeros((3, 6)), np.zeros(5), np.zeros((n, n)), np.zeros((3, 5)), np.zeros(4)
    row, shown, work = np.zeros(n), np.zeros((2, 2)), np.zeros((3, 5, 5))
    logs, warm_k = 0.0, 0.0
    place_i, place_w = (3, 4) if n == 5 else (0, 1)
    reach = 1e-9 + max(abs(np.max(voltage)), abs(np.min(voltage)))
    u[3] = _SLOW * reach / p[K]
    is_known = marks[0] >= REST and p[NOISE_V] == 0.0 and p[WALK] == 0.0
    for k in range(voltage.shape[0]):
        mark = marks[k]
        shown_i, shown_w = readings[k, 0] - p[OFFSET_I], readings[k, 1] - p[OFFSET_W]
        if mark == BEGIN:
            warm_k = 0.0
            after = min(k + 1, voltage.shape[0] - 1)
            shown[0, 0], shown[0, 1] = shown_i, shown_w
            shown[1, 0], shown[1, 1] = readings[after, 0] - p[OFFSET_I], readings[after, 1] - p[OFFSET_W]
            _begin(p, x, cov, shown, voltage[after, 0], reach, seen, dt_s)
            out[k] = 0.0
            out[k, 2], out[k, 3] = x[place_i] + p[OFFSET_I], x[place_w] + p[OFFSET_W]
            continue
        if mark >= REST:
            warm_k, x[:], cov[:] = 0.0, 0.0, 0.0
        if mark == STEADY:
            _steady(p, voltage[k, 1], x)
        elif mark != REST:
            u[0], u[1], u[2] = voltage[k, 0], voltage[k, 1], p[LOAD] + (x[2] if learn else out[k, 4])
            if p[HEATING] > 0.0:
                power = p[R] * (1.0 + COPPER_PER_KELVIN * warm_k) * x[0] ** 2
                warm_k += dt_s * (p[HEATING] * power - p[COOLING] * warm_k)
            dry = p[COULOMB] * (1.0 + FRICTION_PER_KELVIN * warm_k)
            of, slow = (tables(p, p[AFTER]), _lag(p, p[AFTER])) if mark == SWITCH else (usual, lag)
            _advance(of, slow, warm_k, m, x, u, p, dry, mark, marks[k - 1], dt_s, f)
            if learn and not is_known:
                _spread(cov, f, p, dt_s, slow, work)
        out[k, 0] = out[k, 1] = 0.0
        out[k, 2], out[k, 3] = x[place_i] + p[OFFSET_I], x[place_w] + p[OFFSET_W]
        if seen[0] > 0.0 and shown_i == shown_i:
            out[k, 0], log = _update(x, cov, place_i, shown_i, p[NOISE_I], learn and not is_known, row)
            logs += log
        if seen[1] > 0.0 and shown_w == shown_w:
            out[k, 1], log = _update(x, cov, place_w, shown_w, p[NOISE_W], learn and not is_known, row)
            logs += log
        if learn:
            out[k, 4] = x[2]
        out[k, 5] = warm_k
    return logs


@njit(cache=True, error_model="numpy")
def predict_each(
    p: FloatArray,
    dt_s: float,
    voltage: FloatArray,
    marks: FloatArray,
    which: NDArray[np.intp],
    readings: FloatArray,
    seen: FloatArray,
    learn: bool,
    out: FloatArray,
) -> FloatArray:
    """Run the filter for each row of `p`, under voltage and marks number `which` of some; see `predict`."""
    logs = np.empty(len(p))
    for n in range(len(p)):
        k = which[n]
        logs[n] = predict(p[n], dt_s, voltage[k], readings, seen, marks[k], learn, out[n])
    return logs
