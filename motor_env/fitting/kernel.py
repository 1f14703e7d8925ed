"""Kalman filter of a motor at work, compiled: exact steps of the linear part, dry friction and brush drop with events.

State: [current, speed, load torque, shown current, shown speed]; the last ones only where a model has them. Between
two samples the linear motor is solved exactly (`motor_env.motor.model`) for a voltage that is a straight line. Coulomb
friction and the brush drop are constant inputs as long as motion and current keep their signs; an interval in which one
of them changes is cut into parts in which both brake to zero and never beyond it.
"""

from __future__ import annotations

import math

import numpy as np

from motor_env.motor.compiled import njit
from motor_env.motor.model import exponential_and_phis
from motor_env.motor.parameters import COPPER_PER_KELVIN, FRICTION_PER_KELVIN, MAGNET_PER_KELVIN, FloatArray

(R, L, K, J, B, COULOMB, DROP, LOAD, SQUARE, OFFSET_I, OFFSET_W, HEATING, COOLING, LAG_I, LAG_W, DELAY) = (
    range(16)
)
"""Places in the vector of physical values, SI."""
(NOISE_I, NOISE_W, NOISE_V, WALK) = range(16, 20)
"""Places of the noise: standard deviations of a sample of current, speed and voltage; of the load in a second."""
DRAG = 20
"""Place of a factor on the friction, where it is fitted as a whole; 0 for none."""
(KNEE, STRIBECK, SLIDING) = range(21, 24)
"""Places of the current at which the brush drop sets in, of the share that dry friction is larger at low speed, and of
the speed at which it sets in."""
N_VALUES = 24
BEGIN, OPEN = 1.0, 2.0
"""Marks of a sample: the first of a recording; an open circuit."""
_PARTS = 16
_COLDEST_K, _GRID_K, _GRID = -20.0, 10.0, 22
_WILD = 6.0
_SATURATED = 5.0  # knees: beyond them brush drop and dry friction hardly change
_SLOW = 0.02  # of the largest speed: where dry friction is larger
_inlined = njit(error_model="numpy", forceinline=True)  # a call with arrays costs as much as a step


@_inlined
def _discretize(p: FloatArray, warm_k: float, dt_s: float, out: FloatArray) -> None:
    """Rows current and speed; columns current, speed, voltage before, its rise over the interval, torque."""
    resistance = p[R] * (1.0 + COPPER_PER_KELVIN * warm_k)
    constant = p[K] * (1.0 + MAGNET_PER_KELVIN * warm_k)
    drag = p[B] * (1.0 + FRICTION_PER_KELVIN * warm_k)
    whole, held, rising = exponential_and_phis(
        -resistance / p[L] * dt_s, -constant / p[L] * dt_s, constant / p[J] * dt_s, -drag / p[J] * dt_s
    )
    by_volt, by_torque = dt_s / p[L], -dt_s / p[J]
    for r in range(2):
        out[r, 0], out[r, 1] = whole[2 * r], whole[2 * r + 1]
        out[r, 2], out[r, 3] = held[2 * r] * by_volt, rising[2 * r] * by_volt
        out[r, 4] = held[2 * r + 1] * by_torque


@_inlined
def _tables(p: FloatArray, dt_s: float) -> FloatArray:
    """Discrete models of an interval and of a part of it, over the winding's temperature.

    Shape (2, temperatures, 2, 5); one temperature alone where nothing warms.
    """
    count = _GRID if p[HEATING] > 0.0 else 1
    out = np.empty((2, count, 2, 5))
    for part in range(2):
        for g in range(count):
            warm_k = _COLDEST_K + g * _GRID_K if count > 1 else 0.0
            _discretize(p, warm_k, dt_s / _PARTS if part else dt_s, out[part, g])
    return out


@_inlined
def _at(table: FloatArray, warm_k: float, out: FloatArray) -> None:
    """The discrete model at one temperature, between two of the table."""
    if table.shape[0] == 1:
        for r in range(2):
            for c in range(5):
                out[r, c] = table[0, r, c]
        return
    place = min(max((warm_k - _COLDEST_K) / _GRID_K, 0.0), table.shape[0] - 1.001)
    low = int(place)
    share = place - low
    for r in range(2):
        for c in range(5):
            out[r, c] = (1.0 - share) * table[low, r, c] + share * table[low + 1, r, c]


@_inlined
def _dry(p: FloatArray, dry: float, w: float, slow: float) -> float:
    """Dry friction at a speed (Stribeck 1902)."""
    return dry * (1.0 + p[STRIBECK] * math.exp(-((w / slow) ** 2))) if p[STRIBECK] > 0.0 else dry


@_inlined
def _mean_square(before: float, after: float) -> float:
    """Mean of w |w| while w goes in a straight line."""
    if abs(after - before) <= 1e-6 * (abs(after) + abs(before)):
        return before * abs(before)
    return (abs(after) ** 3 - abs(before) ** 3) / (3.0 * (after - before))


@_inlined
def _smooth_step(
    m: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray, dry: float, f: FloatArray
) -> bool:
    """One interval in which nothing changes sign; False, with `x` as it was, where something does."""
    i, w = x[0], x[1]
    turning, carrying = math.copysign(1.0, w), math.copysign(1.0, i)
    before = u[0] - carrying * p[DROP]
    if p[KNEE] > 0.0:
        before = u[0] - p[DROP] * i / math.hypot(i, p[KNEE])
    sliding = w / math.hypot(w, p[SLIDING]) if p[SLIDING] > 0.0 else turning
    load = _dry(p, dry, w, u[3]) * sliding + u[2]
    torque = load + p[SQUARE] * w * abs(w)
    new_i = m[0, 0] * i + m[0, 1] * w + m[0, 2] * before + m[0, 3] * (u[1] - u[0])
    new_w = m[1, 0] * i + m[1, 1] * w + m[1, 2] * before + m[1, 3] * (u[1] - u[0])
    if p[SQUARE] > 0.0:
        for _ in range(2):
            torque = load + p[SQUARE] * _mean_square(w, new_w + m[1, 4] * torque)
    new_i += m[0, 4] * torque
    new_w += m[1, 4] * torque
    if (dry > 0.0 and min(new_w * turning, abs(w)) <= _SATURATED * p[SLIDING]) or (
        p[DROP] > 0.0 and min(new_i * carrying, abs(i)) <= _SATURATED * p[KNEE]
    ):
        return False
    for r in range(2):
        f[r, 0], f[r, 1] = m[r, 0], m[r, 1] + m[r, 4] * 2.0 * p[SQUARE] * abs(w)
        f[r, 2], f[r, 3] = m[r, 4], m[r, 2]
    x[0], x[1] = new_i, new_w
    return True


@_inlined
def _turned(before: float, free: float, reach: float) -> float:
    """Value after an interval, given that without the opposing input, which changes it by `reach` and turns at zero."""
    sign = math.copysign(1.0, before if before != 0.0 else free)
    kept = free - sign * reach
    if kept * sign >= 0.0:
        return kept
    if before == 0.0:
        return 0.0
    left = abs(kept) / (abs(kept) + abs(before))
    turned = kept + 2.0 * sign * reach * left
    return 0.0 if turned * sign > 0.0 else turned


@_inlined
def _kneed(free: float, reach: float, knee: float) -> float:
    """Solution i of i + reach i / hypot(i, knee) = free, by Newton's method, which stays on one side of it."""
    size = abs(free)
    i = max(size - reach, 0.0)
    for _ in range(20):
        root = math.hypot(i, knee)
        step = (size - i - reach * i / root) / (1.0 + reach * knee * knee / root**3)
        i += step
        if step < 1e-9 * size:
            break
    return math.copysign(i, free)


@_inlined
def _opposed(before: float, free: float, reach: float, knee: float) -> float:
    """The same for an input that sets in at a knee."""
    opposed: float = _turned(before, free, reach)
    if knee > 0.0 and min(abs(before), abs(opposed)) < _SATURATED * knee:
        opposed = _kneed(free, reach, knee)
    return opposed


@_inlined
def _braked_step(
    m: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray, dry: float, f: FloatArray
) -> None:
    """One interval in equal parts; friction and drop turn where speed and current cross zero, or hold them there."""
    f[:] = 0.0
    f[0, 0] = f[1, 1] = 1.0
    rise = (u[1] - u[0]) / _PARTS
    for part in range(_PARTS):
        i, w = x[0], x[1]
        before, torque = u[0] + part * rise, u[2] + p[SQUARE] * w * abs(w)
        free_i = m[0, 0] * i + m[0, 1] * w + m[0, 2] * before + m[0, 3] * rise + m[0, 4] * torque
        free_w = m[1, 0] * i + m[1, 1] * w + m[1, 2] * before + m[1, 3] * rise + m[1, 4] * torque
        new_i = free_i
        if p[DROP] > 0.0:
            new_i = _opposed(i, free_i, m[0, 2] * p[DROP], p[KNEE])
            free_w -= m[1, 2] * (free_i - new_i) / m[0, 2]
        new_w = free_w
        if dry > 0.0:
            new_w = _opposed(w, free_w, -m[1, 4] * _dry(p, dry, w, u[3]), p[SLIDING])
            new_i += m[0, 4] * (free_w - new_w) / -m[1, 4]
        for c in range(4):
            top, bottom = f[0, c], f[1, c]
            extra_i = m[0, 4] if c == 2 else (m[0, 2] if c == 3 else 0.0)
            extra_w = m[1, 4] if c == 2 else (m[1, 2] if c == 3 else 0.0)
            f[0, c] = 0.0 if new_i == 0.0 else m[0, 0] * top + m[0, 1] * bottom + extra_i
            f[1, c] = 0.0 if new_w == 0.0 else m[1, 0] * top + m[1, 1] * bottom + extra_w
        x[0], x[1] = new_i, new_w


@_inlined
def _coasting_step(
    x: FloatArray, u: FloatArray, p: FloatArray, dry: float, dt_s: float, f: FloatArray
) -> None:
    """One interval with an open circuit, in equal parts: no current, the speed falls by friction and load."""
    f[:] = 0.0
    f[1, 1] = 1.0
    part_s = dt_s / _PARTS
    decay = math.exp(-p[B] * part_s / p[J])
    reach = (1.0 - decay) / p[B] if p[B] * part_s > 1e-9 * p[J] else part_s / p[J]
    x[0] = 0.0
    for _ in range(_PARTS):
        w = x[1]
        free = decay * w - reach * (u[2] + p[SQUARE] * w * abs(w))
        x[1] = _opposed(w, free, reach * _dry(p, dry, w, u[3]), p[SLIDING]) if dry > 0.0 else free
        slope = 0.0 if x[1] == 0.0 else decay - reach * 2.0 * p[SQUARE] * abs(w)
        f[1, 1], f[1, 2] = slope * f[1, 1], slope * f[1, 2] - reach * (x[1] != 0.0)


@_inlined
def _lags(p: FloatArray, dt_s: float) -> FloatArray:
    """Weights of the shown value before, the true one before and the true one now; exact for a straight line.

    Shape (2, 3): current, speed.
    """
    weights = np.zeros((2, 3))
    for channel in range(2):
        lag_s = p[LAG_I + channel]
        if lag_s <= 0.0:
            weights[channel, 2] = 1.0
            continue
        decay = math.exp(-dt_s / lag_s)
        mean = (1.0 - decay) * lag_s / dt_s
        weights[channel, 0], weights[channel, 1], weights[channel, 2] = decay, mean - decay, 1.0 - mean
    return weights


@_inlined
def _spread(cov: FloatArray, f: FloatArray, p: FloatArray, dt_s: float, lags: FloatArray) -> None:
    """Covariance after an interval, in place: P = F P F' + Q. The lower triangle is left as it was."""
    a, b, c, d, e, h = f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2]
    noise_i, noise_w = p[NOISE_V] * f[0, 3], p[NOISE_V] * f[1, 3]
    ii, iw, ww = cov[0, 0], cov[0, 1], cov[1, 1]
    if cov.shape[0] == 2:
        cov[0, 0] = a * a * ii + 2.0 * a * b * iw + b * b * ww + noise_i * noise_i
        cov[0, 1] = a * d * ii + (a * e + b * d) * iw + b * e * ww + noise_i * noise_w
        cov[1, 1] = d * d * ii + 2.0 * d * e * iw + e * e * ww + noise_w * noise_w
        return
    il, wl, ll = cov[0, 2], cov[1, 2], cov[2, 2]
    # Of the new current and speed with the old current, speed and load.
    i_i, i_w, i_l = a * ii + b * iw + c * il, a * iw + b * ww + c * wl, a * il + b * wl + c * ll
    w_i, w_w, w_l = d * ii + e * iw + h * il, d * iw + e * ww + h * wl, d * il + e * wl + h * ll
    cov[0, 0] = a * i_i + b * i_w + c * i_l + noise_i * noise_i
    cov[0, 1] = d * i_i + e * i_w + h * i_l + noise_i * noise_w
    cov[1, 1] = d * w_i + e * w_w + h * w_l + noise_w * noise_w
    cov[0, 2], cov[1, 2], cov[2, 2] = i_l, w_l, ll + p[WALK] ** 2 * dt_s
    if cov.shape[0] == 3:
        return
    # What is shown: z' = y + now x', y = kept z + before x, for the current (s) and the speed (t).
    s_kept, s_before, s_now = lags[0, 0], lags[0, 1], lags[0, 2]
    t_kept, t_before, t_now = lags[1, 0], lags[1, 1], lags[1, 2]
    si, sw, sl = (
        s_kept * cov[0, 3] + s_before * ii,
        s_kept * cov[1, 3] + s_before * iw,
        s_kept * cov[2, 3] + s_before * il,
    )
    ti, tw, tl = (
        t_kept * cov[0, 4] + t_before * iw,
        t_kept * cov[1, 4] + t_before * ww,
        t_kept * cov[2, 4] + t_before * wl,
    )
    ss = s_kept * (s_kept * cov[3, 3] + s_before * cov[0, 3]) + s_before * si
    st = t_kept * (s_kept * cov[3, 4] + s_before * cov[0, 4]) + t_before * sw
    tt = t_kept * (t_kept * cov[4, 4] + t_before * cov[1, 4]) + t_before * tw
    s_i, s_w = a * si + b * sw + c * sl, d * si + e * sw + h * sl
    t_i, t_w = a * ti + b * tw + c * tl, d * ti + e * tw + h * tl
    cov[0, 3], cov[1, 3], cov[2, 3] = s_i + s_now * cov[0, 0], s_w + s_now * cov[0, 1], sl + s_now * i_l
    cov[0, 4], cov[1, 4], cov[2, 4] = t_i + t_now * cov[0, 1], t_w + t_now * cov[1, 1], tl + t_now * w_l
    cov[3, 3] = ss + 2.0 * s_now * s_i + s_now * s_now * cov[0, 0]
    cov[3, 4] = st + t_now * s_w + s_now * t_i + s_now * t_now * cov[0, 1]
    cov[4, 4] = tt + 2.0 * t_now * t_w + t_now * t_now * cov[1, 1]


@_inlined
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


@_inlined
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
        readings: current and speed, shape (n, 2).
        seen: 1 where a channel was recorded, shape (2,).
        marks: BEGIN at the first sample of a recording, OPEN where the circuit is open, else 0; shape (n,).
        learn: weigh readings in; without it the model runs freely, with the given load alone.
        out: whitened innovations, predicted readings, load, temperature, shape (n, 6).

    Returns:
        Sum of the logarithms of the innovations' variances.
    """
    n = 5 if p[LAG_I] > 0.0 or p[LAG_W] > 0.0 else (3 if p[WALK] > 0.0 else 2)
    lags, tables = _lags(p, dt_s), _tables(p, dt_s)
    whole, parts = tables[0], tables[1]
    m, x, cov, f, u = np.empty((2, 5)), np.zeros(5), np.zeros((n, n)), np.zeros((2, 4)), np.zeros(4)
    row, shown = np.zeros(n), np.zeros((2, 2))
    logs, warm_k = 0.0, 0.0
    place_i, place_w = (3, 4) if n == 5 else (0, 1)
    reach = 1e-9 + max(abs(np.max(voltage)), abs(np.min(voltage)))
    u[3] = _SLOW * reach / p[K]
    for k in range(voltage.shape[0]):
        shown_i, shown_w = readings[k, 0] - p[OFFSET_I], readings[k, 1] - p[OFFSET_W]
        if marks[k] == BEGIN:
            warm_k = 0.0
            after = min(k + 1, voltage.shape[0] - 1)
            shown[0, 0], shown[0, 1] = shown_i, shown_w
            shown[1, 0], shown[1, 1] = readings[after, 0] - p[OFFSET_I], readings[after, 1] - p[OFFSET_W]
            _begin(p, x, cov, shown, voltage[after, 0], reach, seen, dt_s)
            out[k] = 0.0
            out[k, 2], out[k, 3] = x[place_i] + p[OFFSET_I], x[place_w] + p[OFFSET_W]
            continue
        u[0], u[1], u[2] = voltage[k, 0], voltage[k, 1], p[LOAD] + (x[2] if learn else out[k, 4])
        if p[HEATING] > 0.0:
            power = p[R] * (1.0 + COPPER_PER_KELVIN * warm_k) * x[0] ** 2
            warm_k += dt_s * (p[HEATING] * power - p[COOLING] * warm_k)
        dry = p[COULOMB] * (1.0 + FRICTION_PER_KELVIN * warm_k)
        i, w = x[0], x[1]
        _at(whole, warm_k, m)
        if (marks[k] != OPEN or marks[k - 1] != OPEN) and not _smooth_step(m, x, u, p, dry, f):
            _at(parts, warm_k, m)
            _braked_step(m, x, u, p, dry, f)
        if marks[k] == OPEN:
            if marks[k - 1] == OPEN or x[0] * i < 0.0:  # a diode lets no current turn
                x[1] = w
                _coasting_step(x, u, p, dry, dt_s, f)
            x[0], f[0] = 0.0, 0.0
        x[3] = lags[0, 0] * x[3] + lags[0, 1] * i + lags[0, 2] * x[0]
        x[4] = lags[1, 0] * x[4] + lags[1, 1] * w + lags[1, 2] * x[1]
        if learn:
            _spread(cov, f, p, dt_s, lags)
        out[k, 0] = out[k, 1] = 0.0
        out[k, 2], out[k, 3] = x[place_i] + p[OFFSET_I], x[place_w] + p[OFFSET_W]
        if seen[0] > 0.0:
            out[k, 0], log = _update(x, cov, place_i, shown_i, p[NOISE_I], learn, row)
            logs += log
        if seen[1] > 0.0:
            out[k, 1], log = _update(x, cov, place_w, shown_w, p[NOISE_W], learn, row)
            logs += log
        if learn:
            out[k, 4] = x[2]
        out[k, 5] = warm_k
    return logs
