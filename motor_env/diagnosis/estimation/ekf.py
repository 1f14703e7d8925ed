"""Extended Kalman filter of a recorded motor, compiled, on the steps of `integrator`.

State: [current, speed, load torque, shown current, shown speed], the last ones only where a model has them. Where the
first state is known and nothing disturbs the motor, the covariance is zero: innovations are errors of a free run.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from motor_env.diagnosis.estimation.integrator import (
    FINE,
    braked_step,
    coasting_step,
    discretize_each,
    smooth_step,
)
from motor_env.diagnosis.estimation.parameter_index import (
    AFTER,
    COULOMB,
    DROP,
    GEAR,
    LAG_I,
    LAG_W,
    LOAD,
    NOISE_I,
    NOISE_T,
    NOISE_V,
    NOISE_W,
    OFFSET_I,
    OFFSET_W,
    SOURCE,
    SQUARE,
    STRIBECK,
    WALK,
    B,
    J,
    K,
    L,
    R,
)
from motor_env.motor.compiled import compiled, compiled_part, inlined
from motor_env.motor.parameters import FloatArray

BEGIN, OPEN, LOST, FOUND, REST, STEADY, SWITCH = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0
"""Marks of a sample. BEGIN: the first of a recording; OPEN: open circuit; LOST: the voltage before it is unknown;
FOUND: the state is not known yet; REST, STEADY: the first of a motor at rest, or that runs steadily under the first
voltage; SWITCH: switched on AFTER seconds before the sample.
"""
_SLOW = 0.02  # of the largest speed: where dry friction is larger
OUTLIER_SDS = 6.0  # of an innovation, beyond which it counts no more
_STEADY_STEPS = 12
_NOT_SIMPLE = np.array([STRIBECK, GEAR, SOURCE, NOISE_V, NOISE_T, WALK])


@inlined
def lag_of(p: FloatArray, dt_s: float) -> tuple[float, float, float]:
    """Return the weights of shown speed before, true speed before and now; exact for a straight line."""
    lag_s = p[LAG_W]
    if lag_s <= 0.0:
        return 0.0, 0.0, 1.0
    decay = math.exp(-dt_s / lag_s)
    mean = (1.0 - decay) * lag_s / dt_s
    return decay, mean - decay, 1.0 - mean


@inlined
def spread(
    cov: FloatArray,
    n: int,
    f: FloatArray,
    p: FloatArray,
    noise_v: float,
    dt_s: float,
    lag: tuple[float, float, float],
    work: FloatArray,
) -> None:
    """Predict the covariance of `n` states, its upper triangle, over an interval in place: P = F P F' + Q."""
    a, b, c, d, e, h = f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2]
    noise_i, noise_w = noise_v * f[0, 3], noise_v * f[1, 3]
    pull_i, pull_w = p[NOISE_T] * c, p[NOISE_T] * h
    ii, iw, ww = cov[0, 0], cov[0, 1], cov[1, 1]
    if n == 2:
        cov[0, 0] = a * a * ii + 2.0 * a * b * iw + b * b * ww + noise_i * noise_i + pull_i * pull_i
        cov[0, 1] = a * d * ii + (a * e + b * d) * iw + b * e * ww + noise_i * noise_w + pull_i * pull_w
        cov[1, 1] = d * d * ii + 2.0 * d * e * iw + e * e * ww + noise_w * noise_w + pull_w * pull_w
        return
    if n == 3:
        il, wl, ll = cov[0, 2], cov[1, 2], cov[2, 2]
        # Of the new current and speed with the old current, speed and load.
        ap_ii, ap_iw, ap_il = a * ii + b * iw + c * il, a * iw + b * ww + c * wl, a * il + b * wl + c * ll
        ap_wi, ap_ww, ap_wl = d * ii + e * iw + h * il, d * iw + e * ww + h * wl, d * il + e * wl + h * ll
        cov[0, 0] = a * ap_ii + b * ap_iw + c * ap_il + noise_i * noise_i + pull_i * pull_i
        cov[0, 1] = d * ap_ii + e * ap_iw + h * ap_il + noise_i * noise_w + pull_i * pull_w
        cov[1, 1] = d * ap_wi + e * ap_ww + h * ap_wl + noise_w * noise_w + pull_w * pull_w
        cov[0, 2], cov[1, 2], cov[2, 2] = ap_il, ap_wl, ll + p[WALK] ** 2 * dt_s
        return
    for r in range(5):
        for k in range(r):
            cov[r, k] = cov[k, r]
    half, by_volt, by_load = work[0], work[1, 0], work[1, 1]
    for q in range(5):  # of the new states with the old ones; the load stays as it is
        half[0, q] = a * cov[0, q] + b * cov[1, q] + c * cov[2, q]
        half[1, q] = d * cov[0, q] + e * cov[1, q] + h * cov[2, q]
        half[2, q] = cov[2, q]
        half[3, q] = f[2, 0] * cov[0, q] + f[2, 1] * cov[1, q] + f[2, 2] * cov[2, q] + f[2, 4] * cov[3, q]
        half[4, q] = lag[0] * cov[4, q] + lag[1] * cov[1, q] + lag[2] * half[1, q]
    by_volt[0], by_volt[1], by_volt[3], by_volt[4] = noise_i, noise_w, noise_v * f[2, 3], lag[2] * noise_w
    by_load[0], by_load[1], by_load[3], by_load[4] = pull_i, pull_w, p[NOISE_T] * f[2, 2], lag[2] * pull_w
    for r in range(5):
        now_i, now_w, now_l = half[r, 0], half[r, 1], half[r, 2]
        new_w = d * now_i + e * now_w + h * now_l
        cov[r, 0], cov[r, 1], cov[r, 2] = a * now_i + b * now_w + c * now_l, new_w, now_l
        cov[r, 3] = f[2, 0] * now_i + f[2, 1] * now_w + f[2, 2] * now_l + f[2, 4] * half[r, 3]
        cov[r, 4] = lag[0] * half[r, 4] + lag[1] * now_w + lag[2] * new_w
        for k in range(5):
            cov[r, k] += by_volt[r] * by_volt[k] + by_load[r] * by_load[k]
    cov[2, 2] += p[WALK] ** 2 * dt_s


@compiled_part
def begin(
    p: FloatArray,
    x: FloatArray,
    cov: FloatArray,
    n: int,
    shown: FloatArray,
    volts: float,
    reach: float,
    seen: FloatArray,
    dt_s: float,
) -> None:
    """Set the state at a recording's first sample as shown; the rest follows from the balance of voltages.

    `shown` is what this sample and the next show, shape (2, 2), `volts` the voltage between them.
    """
    for r in range(2):
        for c in range(2):
            if shown[r, c] != shown[r, c]:
                shown[r, c] = 0.0
    i, next_i = shown[0, 0], shown[1, 0]
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


@compiled_part
def steady(p: FloatArray, volts: float, x: FloatArray) -> None:
    """Set the state of a motor that runs steadily (V = R i + K w + drop, K i = B w + fan + load), or is held."""
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
    x: FloatArray,
    u: FloatArray,
    p: FloatArray,
    dry: float,
    mark: float,
    before: float,
    dt_s: float,
    f: FloatArray,
) -> None:
    """Advance the state over an interval and fill its slopes; `mark` is its end's, `before` its begin's."""
    i, w, m = x[0], x[1], of[0]
    if p[GEAR] > 0.0:
        # A gear loses a share of the torque that it carries: dry friction, by the mean torque without friction.
        free_w = m[1, 0] * i + m[1, 1] * w + m[1, 2] * u[0] + m[1, 3] * (u[1] - u[0])
        dry += p[GEAR] * abs(p[J] * (free_w - w) / dt_s + p[B] * w)
    parts = smooth_step(m, x, u, p, dry, f) if mark != OPEN or before != OPEN else 0
    if parts > 0:
        m = of[1 if parts == FINE else (2 if parts > 1 else 0)]
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


@inlined
def _weigh(
    x: FloatArray,
    cov: FloatArray,
    n: int,
    channel: int,
    place: int,
    shown: float,
    noise: float,
    mark: float,
    learn: bool,
    is_known: bool,
    row: FloatArray,
) -> tuple[float, float]:
    """Weigh one reading into `n` states: its whitened innovation and variance; 0 and 1 where LOST or FOUND."""
    error, variance = shown - x[place], cov[place, place] + noise * noise
    inverse = 1.0 / variance
    white = error * math.sqrt(inverse)
    if learn and not is_known:
        weight = error * inverse
        if abs(white) > OUTLIER_SDS:
            weight *= OUTLIER_SDS / abs(white)
        for r in range(n):
            row[r] = cov[min(r, place), max(r, place)]
        for r in range(n):
            x[r] += weight * row[r]
            share = row[r] * inverse
            for c in range(r, n):
                cov[r, c] -= share * row[c]
    if mark != LOST and mark != FOUND:
        return white, variance
    if not learn:
        x[channel] = x[3 + channel] = shown
    return 0.0, 1.0


@inlined
def _run(
    p: FloatArray,
    dt_s: float,
    voltage: FloatArray,
    readings: FloatArray,
    seen: FloatArray,
    marks: FloatArray,
    learn: bool,
    out: FloatArray,
    reach: float,
    usual: FloatArray,
    switched: FloatArray,
    n: int,
    room: tuple[FloatArray, ...],
) -> float:
    """Filter one row of `predict_each`."""
    x, cov, f, u, row, shown, work, _ = room
    lag, logs = lag_of(p, dt_s), 0.0
    place_i, place_w = (3, 4) if n == 5 else (0, 1)
    u[3] = _SLOW * reach / p[K]
    is_known = marks[0] >= REST and p[NOISE_V] == 0.0 and p[NOISE_T] == 0.0 and p[WALK] == 0.0
    for k in range(voltage.shape[0]):
        mark = marks[k]
        shown_i, shown_w = readings[k, 0] - p[OFFSET_I], readings[k, 1] - p[OFFSET_W]
        if mark == BEGIN:
            after = min(k + 1, voltage.shape[0] - 1)
            shown[0, 0], shown[0, 1] = shown_i, shown_w
            shown[1, 0], shown[1, 1] = readings[after, 0] - p[OFFSET_I], readings[after, 1] - p[OFFSET_W]
            begin(p, x, cov, n, shown, voltage[after, 0], reach, seen, dt_s)
            out[k] = 0.0
            out[k, 2], out[k, 3] = x[place_i] + p[OFFSET_I], x[place_w] + p[OFFSET_W]
            continue
        if mark >= REST:
            x[:], cov[:] = 0.0, 0.0
        if mark == STEADY:
            steady(p, voltage[k, 1], x)
        elif mark != REST:
            sag = p[SOURCE] * x[0]
            u[0], u[1] = voltage[k, 0] + sag, voltage[k, 1] + sag
            u[2] = p[LOAD] + out[k, 4] + (x[2] if learn else 0.0)
            of, slow = (switched, lag_of(p, p[AFTER])) if mark == SWITCH else (usual, lag)
            _advance(of, slow, x, u, p, p[COULOMB], mark, marks[k - 1], dt_s, f)
            for r in range(3):
                f[r, 0] += p[SOURCE] * f[r, 3]
            if learn and not is_known:
                # Whatever the voltage was, it was one that the motor knows.
                spread(cov, n, f, p, max(p[NOISE_V], reach) if mark == LOST else p[NOISE_V], dt_s, slow, work)
        out[k, 2], out[k, 3] = x[place_i] + p[OFFSET_I], x[place_w] + p[OFFSET_W]
        variances = 1.0
        for c in range(2):
            out[k, c] = 0.0
            shown_c, place, noise = (
                (shown_i, place_i, p[NOISE_I]) if c == 0 else (shown_w, place_w, p[NOISE_W])
            )
            if seen[c] > 0.0 and shown_c == shown_c:
                out[k, c], variance = _weigh(x, cov, n, c, place, shown_c, noise, mark, learn, is_known, row)
                variances *= variance
        logs += math.log(variances)  # one logarithm for both
        if learn:
            out[k, 4] = x[2]
    return logs


def room_to_work() -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return arrays in which `predict_each` works; numba takes a second to compile their making."""
    shapes = ((5,), (5, 5), (3, 5), (4,), (5,), (2, 2), (3, 5, 5), (3, 6, 6))
    return np.zeros((2, 3, 3, 6)), tuple(np.zeros(shape) for shape in shapes)


@compiled
def predict_each(
    p: FloatArray,
    dt_s: float,
    voltage: FloatArray,
    marks: FloatArray,
    reach: FloatArray,
    which: NDArray[np.intp],
    readings: FloatArray,
    seen: FloatArray,
    learn: bool,
    out: FloatArray,
    logs: FloatArray,
    scratch: tuple[FloatArray, tuple[FloatArray, ...]],
) -> None:
    """Run the filter over a record, for several vectors of values.

    Args:
        p: physical values and noise, shape (m, N_VALUES).
        dt_s: sampling interval.
        voltage: before and after the interval that ends at each sample, of each supply, shape (supplies, n, 2).
        marks: see BEGIN, shape (supplies, n); 0 for other samples.
        reach: the largest voltage, shape (supplies,).
        which: the supply of each vector of values, shape (m,).
        readings: current and speed, shape (n, 2); NaN where there is none.
        seen: 1 where a channel was recorded, shape (2,).
        learn: weigh readings in; without it the model runs freely.
        out: whitened innovations, predicted readings, load, shape (m, n, 5); the load known beforehand is read
            from it, and the estimated one is left there.
        logs: sums of the logarithms of the innovations' variances, shape (m,).
        scratch: of `room_to_work`.
    """
    models, room = scratch
    for row in range(len(p)):
        of, k = p[row], which[row]
        n = 5 if of[LAG_I] > 0.0 or of[LAG_W] > 0.0 else (3 if of[WALK] > 0.0 else 2)
        for switched in range(2 if of[AFTER] > 0.0 else 1):
            discretize_each(of, of[AFTER] if switched else dt_s, models[switched], room[-1])
        usual, after = models[0], models[1]
        logs[row] = _run(
            of, dt_s, voltage[k], readings, seen, marks[k], learn, out[row], reach[k], usual, after, n, room
        )


def are_simple(p: FloatArray, marks: FloatArray) -> bool:
    """Return whether all rows are simple motors, shape (m, N_VALUES), and all marks a start's, shape (supplies, n)."""
    first, others = marks[:, 0], marks[:, 1:]
    is_start = bool((first >= REST).all()) and not ((others != 0.0) & (others != SWITCH)).any()
    return is_start and not p[:, _NOT_SIMPLE].any()


def room_of_simple() -> tuple[FloatArray, ...]:
    """Return arrays in which `predict_simple_each` works."""
    return tuple(np.zeros(shape) for shape in ((2, 3, 3, 6), (5,), (4,), (3, 5), (3, 6, 6)))


@inlined
def _advance_simple(
    of: FloatArray,
    lag: tuple[float, float, float],
    x: FloatArray,
    u: FloatArray,
    p: FloatArray,
    f: FloatArray,
) -> None:
    w = x[1]
    # It stands before the switch. There, dry friction would have each interval cut into parts.
    if x[0] == w == x[3] == x[4] == u[0] == u[1] == 0.0 and abs(u[2]) <= p[COULOMB]:
        return
    parts = smooth_step(of[0], x, u, p, p[COULOMB], f)
    if parts > 0:
        braked_step(of[1 if parts == FINE else (2 if parts > 1 else 0)], x, u, p, p[COULOMB], f, parts)
    if p[LAG_I] <= 0.0:
        x[3] = x[0]
    x[4] = lag[0] * x[4] + lag[1] * w + lag[2] * x[1]


@compiled
def predict_simple_each(
    p: FloatArray,
    dt_s: float,
    voltage: FloatArray,
    marks: FloatArray,
    which: NDArray[np.intp],
    readings: FloatArray,
    seen: FloatArray,
    out: FloatArray,
    logs: FloatArray,
    room: tuple[FloatArray, ...],
) -> None:
    """Run `predict_each` in a third of the time, for simple starts: no disturbance, gear, sag or Stribeck curve."""
    models, x, u, f, work = room
    for row in range(len(p)):
        of, table, supply = p[row], out[row], which[row]
        lag = slow = lag_of(of, dt_s)
        discretize_each(of, dt_s, models[0], work)
        if of[AFTER] > 0.0:
            discretize_each(of, of[AFTER], models[1], work)
            slow = lag_of(of, of[AFTER])
        weights = 1.0 / of[NOISE_I], 1.0 / of[NOISE_W]
        log_i, log_w, total = math.log(of[NOISE_I] ** 2), math.log(of[NOISE_W] ** 2), 0.0
        for k in range(voltage.shape[1]):
            mark = marks[supply, k]
            if mark >= REST:
                x[:] = 0.0
            if mark == STEADY:
                steady(of, voltage[supply, k, 1], x)
            elif mark != REST:
                u[0], u[1], u[2] = voltage[supply, k, 0], voltage[supply, k, 1], of[LOAD] + table[k, 4]
                if mark == SWITCH:
                    _advance_simple(models[1], slow, x, u, of, f)
                else:
                    _advance_simple(models[0], lag, x, u, of, f)
            table[k, 2], table[k, 3] = x[3] + of[OFFSET_I], x[4] + of[OFFSET_W]
            table[k, 0], table[k, 1] = readings[k, 0] - table[k, 2], readings[k, 1] - table[k, 3]
            for c in range(2):
                if seen[c] > 0.0 and readings[k, c] == readings[k, c]:
                    table[k, c] *= weights[c]
                    total += log_i if c == 0 else log_w
                else:
                    table[k, c] = 0.0
        logs[row] = total
