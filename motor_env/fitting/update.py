"""The Kalman filter's state: where it begins, how its covariance spreads, how a reading is weighed in; compiled."""

from __future__ import annotations

import math

from motor_env.fitting.places import (
    COULOMB,
    DROP,
    LAG_W,
    LOAD,
    NOISE_I,
    NOISE_T,
    NOISE_W,
    SQUARE,
    WALK,
    B,
    K,
    L,
    R,
)
from motor_env.motor.compiled import compiled_part, inlined
from motor_env.motor.parameters import FloatArray

_WILD = 6.0
_STEADY_STEPS = 12


@inlined
def lag_of(p: FloatArray, dt_s: float) -> tuple[float, float, float]:
    """Weights of the shown speed before, the true one before and the true one now; exact for a straight line."""
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
    """Covariance of `n` states after an interval, in place: P = F P F' + Q. Only the upper triangle is used."""
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


@inlined
def update(
    x: FloatArray,
    cov: FloatArray,
    n: int,
    place: int,
    shown: float,
    noise: float,
    learn: bool,
    row: FloatArray,
) -> tuple[float, float]:
    """Weigh one reading into `n` states; whitened innovation and its variance."""
    error, variance = shown - x[place], cov[place, place] + noise * noise
    inverse = 1.0 / variance
    white = error * math.sqrt(inverse)
    if learn:
        weight = error * inverse
        if abs(white) > _WILD:
            weight *= _WILD / abs(white)
        for r in range(n):
            row[r] = cov[min(r, place), max(r, place)]
        for r in range(n):
            x[r] += weight * row[r]
            share = row[r] * inverse
            for c in range(r, n):
                cov[r, c] -= share * row[c]
    return white, variance


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
    """State at the first sample of a recording: as shown; what is not seen from the balance of the voltages.

    `shown` is what this sample and the next show, shape (2, 2), `volts` the voltage between them. Where a reading is
    missing the recording begins again at the next sample; until then any number will do.
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
