"""Starts of a simple motor, compiled: no disturbance, no heating, no gear, no Stribeck curve.

The numbers are those of `ekf`, whose filter has nothing to learn here. Starts are fitted so in a third of the time, and
need no more than this compiled.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from motor_env.diagnosis.estimation.ekf import REST, STEADY, SWITCH, lag_of, steady
from motor_env.diagnosis.estimation.integrator import FINE, braked_step, discretize_each, smooth_step
from motor_env.diagnosis.estimation.parameter_index import (
    AFTER,
    COULOMB,
    GEAR,
    HEATING,
    LAG_I,
    LOAD,
    NOISE_I,
    NOISE_T,
    NOISE_V,
    NOISE_W,
    OFFSET_I,
    OFFSET_W,
    STRIBECK,
    WALK,
)
from motor_env.motor.compiled import compiled, inlined
from motor_env.motor.parameters import FloatArray

_BEYOND = np.array([STRIBECK, GEAR, HEATING, NOISE_V, NOISE_T, WALK])


def are_simple(p: FloatArray, marks: FloatArray) -> bool:
    """Return whether all rows are simple motors, shape (m, N_VALUES), and all marks a start's, shape (supplies, n)."""
    first, others = marks[:, 0], marks[:, 1:]
    is_start = bool((first >= REST).all()) and not ((others != 0.0) & (others != SWITCH)).any()
    return is_start and not p[:, _BEYOND].any()


def room() -> tuple[FloatArray, ...]:
    """Return arrays in which `run_each` works."""
    return tuple(np.zeros(shape) for shape in ((2, 3, 1, 3, 6), (5,), (4,), (3, 5), (3, 6, 6)))


@inlined
def _advance(
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
    parts = smooth_step(of[0, 0], x, u, p, p[COULOMB], f)
    if parts > 0:
        braked_step(of[1 if parts == FINE else (2 if parts > 1 else 0), 0], x, u, p, p[COULOMB], f, parts)
    if p[LAG_I] <= 0.0:
        x[3] = x[0]
    x[4] = lag[0] * x[4] + lag[1] * w + lag[2] * x[1]


@compiled
def run_each(
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
    """Do what `ekf.predict_each` does, with its arguments, for simple starts."""
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
                    _advance(models[1], slow, x, u, of, f)
                else:
                    _advance(models[0], lag, x, u, of, f)
            table[k, 2], table[k, 3] = x[3] + of[OFFSET_I], x[4] + of[OFFSET_W]
            table[k, 0], table[k, 1] = readings[k, 0] - table[k, 2], readings[k, 1] - table[k, 3]
            for c in range(2):
                if seen[c] > 0.0 and readings[k, c] == readings[k, c]:
                    table[k, c] *= weights[c]
                    total += log_i if c == 0 else log_w
                else:
                    table[k, c] = 0.0
        logs[row] = total
