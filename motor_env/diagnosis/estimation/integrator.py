"""One interval of a recorded motor, compiled: exact steps of the linear part, dry friction and brush drop with events.

The linear motor and a current sensor's lag are solved exactly for a voltage that is a straight line. Friction and drop
are constant inputs while motion and current keep their signs; else the interval is cut into parts, in which both brake
to zero and never beyond it.
"""

from __future__ import annotations

import math

from motor_env.diagnosis.estimation.parameter_index import (
    DROP,
    KNEE,
    LAG_I,
    SLIDING,
    SQUARE,
    STRIBECK,
    B,
    J,
    K,
    L,
    R,
)
from motor_env.motor.compiled import compiled_part, inlined
from motor_env.motor.exponentials import exponential_in_kernel
from motor_env.motor.model import exponential_and_phis, load_in_kernel
from motor_env.motor.parameters import FloatArray

FINE, COARSE = 16, 4
"""Parts of an interval in which drop or friction turn, and in which they turn slowly, at a knee, or are about to."""
_SATURATED = 5.0  # knees: beyond them brush drop and dry friction hardly change
_SLIGHT = 0.1  # knees: an input hardly changes over such a change, and one part will do
_KNEE_TOLERANCE = 1e-7
_FAST = 40.0  # square of a speed over that of Stribeck's curve: beyond it the curve is flat
_SHORTEST_LAG = 1e-6  # of an interval: with a shorter one the squarings of the exponential lose digits


@compiled_part
def _discretize(p: FloatArray, dt_s: float, out: FloatArray, work: FloatArray) -> None:
    """Fill rows current, speed, shown current of a discrete model; `work` has room for three matrices of six.

    Columns: current, speed, voltage before, its rise over the interval, torque, shown current.
    """
    whole, held, rising = exponential_and_phis(
        -p[R] / p[L] * dt_s, -p[K] / p[L] * dt_s, p[K] / p[J] * dt_s, -p[B] / p[J] * dt_s
    )
    by_volt, by_torque = dt_s / p[L], -dt_s / p[J]
    for r in range(2):
        out[r, 0], out[r, 1] = whole[2 * r], whole[2 * r + 1]
        out[r, 2], out[r, 3] = held[2 * r] * by_volt, rising[2 * r] * by_volt
        out[r, 4] = held[2 * r + 1] * by_torque
    if p[LAG_I] > 0.0:
        lag_s = max(p[LAG_I], _SHORTEST_LAG * dt_s)
        motor, whole_system = work[0], work[1]
        motor[:] = 0.0
        motor[0, 0], motor[0, 1], motor[0, 2] = -p[R] / p[L], -p[K] / p[L], 1.0 / p[L]
        motor[1, 0], motor[1, 1], motor[1, 4] = p[K] / p[J], -p[B] / p[J], -1.0 / p[J]
        motor[2, 3], motor[5, 0], motor[5, 5] = 1.0 / dt_s, 1.0 / lag_s, -1.0 / lag_s
        for r in range(6):
            for c in range(6):
                motor[r, c] *= dt_s
        exponential_in_kernel(motor, whole_system, work[2])
        for c in range(6):
            out[2, c] = whole_system[5, c]


@compiled_part
def discretize_each(p: FloatArray, dt_s: float, out: FloatArray, work: FloatArray) -> None:
    """Fill the discrete models of an interval, of its fine and its coarse parts, shape (3, 3, 6)."""
    for part in range(3):
        _discretize(p, dt_s / (1 if part == 0 else (FINE if part == 1 else COARSE)), out[part], work)


@inlined
def _dry_friction(p: FloatArray, dry: float, w: float, slow: float) -> float:
    """Return dry friction at a speed (Stribeck 1902)."""
    over = (w / slow) ** 2
    return dry * (1.0 + p[STRIBECK] * math.exp(-over)) if p[STRIBECK] > 0.0 and over < _FAST else dry


@inlined
def _mean_square(before: float, after: float) -> float:
    """Return the mean of w |w| while w goes in a straight line."""
    if abs(after - before) <= 1e-6 * (abs(after) + abs(before)):
        return before * abs(before)
    return (abs(after) ** 3 - abs(before) ** 3) / (3.0 * (after - before))


@inlined
def _parts(least: float, change: float, knee: float) -> int:
    """Return in how many parts to take an interval in which a value nears zero; 0 where its knee is far away."""
    if least > _SATURATED * knee:
        return 0
    if change <= _SLIGHT * knee:
        return 1
    return FINE if change > knee and least <= knee else COARSE


@inlined
def smooth_step(m: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray, dry: float, f: FloatArray) -> int:
    """Advance an interval in which drop and friction stay; return 0, else in how many parts to take it.

    Args:
        m: discrete model.
        x: current, speed, load, shown current, shown speed.
        u: voltage before and after, load torque, speed at which dry friction is larger.
        p: physical values.
        dry: dry friction.
        f: slopes of current, speed and shown current by current, speed, load, voltage and shown current; filled.
    """
    i, w, shown = x[0], x[1], x[3]
    turning, carrying = math.copysign(1.0, w), math.copysign(1.0, i)
    before = u[0] - carrying * p[DROP]
    if p[KNEE] > 0.0:
        before = u[0] - p[DROP] * i / math.sqrt(i * i + p[KNEE] ** 2)
    sliding = w / math.sqrt(w * w + p[SLIDING] ** 2) if p[SLIDING] > 0.0 else turning
    load = _dry_friction(p, dry, w, u[3]) * sliding + u[2]
    torque = load_in_kernel(load, p[SQUARE], w)
    new_i = m[0, 0] * i + m[0, 1] * w + m[0, 2] * before + m[0, 3] * (u[1] - u[0])
    new_w = m[1, 0] * i + m[1, 1] * w + m[1, 2] * before + m[1, 3] * (u[1] - u[0])
    if p[SQUARE] > 0.0:
        for _ in range(2):
            torque = load + p[SQUARE] * _mean_square(w, new_w + m[1, 4] * torque)
    new_i += m[0, 4] * torque
    new_w += m[1, 4] * torque
    slowest, least = min(new_w * turning, abs(w)), min(new_i * carrying, abs(i))
    parts = _parts(slowest, abs(new_w - w), p[SLIDING]) if dry > 0.0 else 0
    if p[DROP] > 0.0:
        parts = max(parts, _parts(least, abs(new_i - i), p[KNEE]))
    if parts > 0:
        return parts
    for r in range(2):
        f[r, 0], f[r, 1] = m[r, 0], m[r, 1] + m[r, 4] * 2.0 * p[SQUARE] * abs(w)
        f[r, 2], f[r, 3] = m[r, 4], m[r, 2]
    if p[LAG_I] > 0.0:
        x[3] = m[2, 0] * i + m[2, 1] * w + m[2, 2] * before + m[2, 3] * (u[1] - u[0])
        x[3] += m[2, 4] * torque + m[2, 5] * shown
        f[2, 0], f[2, 1], f[2, 2], f[2, 3], f[2, 4] = m[2, 0], m[2, 1], m[2, 4], m[2, 2], m[2, 5]
    x[0], x[1] = new_i, new_w
    return 0


@inlined
def _held_at_zero(before: float, free: float, reach: float) -> float:
    """Return a value after an interval behind an opposing input, which takes `reach` and turns at zero."""
    sign = math.copysign(1.0, before if before != 0.0 else free)
    kept = free - sign * reach
    if kept * sign >= 0.0:
        return kept
    if before == 0.0:
        return 0.0
    left = abs(kept) / (abs(kept) + abs(before))
    turned = kept + 2.0 * sign * reach * left
    return 0.0 if turned * sign > 0.0 else turned


@inlined
def _solve_knee(free: float, reach: float, knee: float, near: float) -> float:
    """Solve i + reach i / hypot(i, knee) = free by Newton's method from a size near i; each step stays below."""
    size = abs(free)
    least = max(size - reach, 0.0)
    i = min(max(near, least), size)
    for _ in range(20):
        root = math.sqrt(i * i + knee * knee)
        step = (size - i - reach * i / root) / (1.0 + reach * knee * knee / (root * root * root))
        i = max(i + step, least)
        if abs(step) <= _KNEE_TOLERANCE * size:
            break
    return math.copysign(i, free)


@inlined
def _opposing_input(before: float, free: float, reach: float, knee: float) -> float:
    """Return what an input that sets in at a knee leaves of a value."""
    opposed: float = _held_at_zero(before, free, reach)
    if knee > 0.0 and min(abs(before), abs(opposed)) < _SATURATED * knee:
        opposed = _solve_knee(free, reach, knee, abs(before) if before * free > 0.0 else 0.0)
    return opposed


@compiled_part
def braked_step(
    m: FloatArray, x: FloatArray, u: FloatArray, p: FloatArray, dry: float, f: FloatArray, parts: int
) -> None:
    """Advance an interval in equal parts; friction and drop turn, or hold, where speed and current cross zero."""
    f[:] = 0.0
    f[0, 0] = f[1, 1] = f[2, 4] = 1.0
    rise = (u[1] - u[0]) / parts
    for part in range(parts):
        i, w, shown = x[0], x[1], x[3]
        before, torque = u[0] + part * rise, load_in_kernel(u[2], p[SQUARE], w)
        free_i = m[0, 0] * i + m[0, 1] * w + m[0, 2] * before + m[0, 3] * rise + m[0, 4] * torque
        free_w = m[1, 0] * i + m[1, 1] * w + m[1, 2] * before + m[1, 3] * rise + m[1, 4] * torque
        new_i = free_i
        if p[DROP] > 0.0:
            new_i = _opposing_input(i, free_i, m[0, 2] * p[DROP], p[KNEE])
            dropped = (free_i - new_i) / m[0, 2]
            before, free_w = before - dropped, free_w - m[1, 2] * dropped
        new_w = free_w
        if dry > 0.0:
            new_w = _opposing_input(w, free_w, -m[1, 4] * _dry_friction(p, dry, w, u[3]), p[SLIDING])
            friction = (free_w - new_w) / -m[1, 4]
            torque, new_i = torque + friction, new_i + m[0, 4] * friction
        if p[LAG_I] > 0.0:
            x[3] = m[2, 0] * i + m[2, 1] * w + m[2, 2] * before + m[2, 3] * rise
            x[3] += m[2, 4] * torque + m[2, 5] * shown
            for c in range(5):
                inputs = m[2, 4] if c == 2 else (m[2, 2] if c == 3 else 0.0)
                f[2, c] = m[2, 0] * f[0, c] + m[2, 1] * f[1, c] + m[2, 5] * f[2, c] + inputs
        # A knee slows how errors spread, too. It does not here: near zero the model errs most, and a filter that trusts
        # it there gives intervals that hold less often from record to record (88 instead of 91 of 100, of R).
        for c in range(4):
            top, bottom = f[0, c], f[1, c]
            extra_i = m[0, 4] if c == 2 else (m[0, 2] if c == 3 else 0.0)
            extra_w = m[1, 4] if c == 2 else (m[1, 2] if c == 3 else 0.0)
            f[0, c] = 0.0 if new_i == 0.0 else m[0, 0] * top + m[0, 1] * bottom + extra_i
            f[1, c] = 0.0 if new_w == 0.0 else m[1, 0] * top + m[1, 1] * bottom + extra_w
        x[0], x[1] = new_i, new_w


@compiled_part
def coasting_step(
    x: FloatArray, u: FloatArray, p: FloatArray, dry: float, dt_s: float, f: FloatArray
) -> None:
    """Advance an interval with an open circuit, in equal parts: only friction and load act."""
    f[:] = 0.0
    f[1, 1] = 1.0
    part_s = dt_s / FINE
    decay = math.exp(-p[B] * part_s / p[J])
    reach = (1.0 - decay) / p[B] if p[B] * part_s > 1e-9 * p[J] else part_s / p[J]
    x[0] = 0.0
    for _ in range(FINE):
        w = x[1]
        free = decay * w - reach * load_in_kernel(u[2], p[SQUARE], w)
        x[1] = (
            _opposing_input(w, free, reach * _dry_friction(p, dry, w, u[3]), p[SLIDING])
            if dry > 0.0
            else free
        )
        slope = 0.0 if x[1] == 0.0 else decay - reach * 2.0 * p[SQUARE] * abs(w)
        f[1, 1], f[1, 2] = slope * f[1, 1], slope * f[1, 2] - reach * (x[1] != 0.0)
