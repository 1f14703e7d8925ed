"""The motor's equations, continuous and discrete.

State x = [current_a, speed_rad_s], input u = [voltage_v, load_torque_n_m]:

    L di/dt = V - R i - Kb w                 (paper, eq. (1), with Kb where the paper prints Kt)
    J dw/dt = Kt i - B w - Tload             (paper, eq. (2), with Kt where the paper prints Kb)

Timing: u[k] is held over the interval k and takes x[k] to x[k+1]; the measurement z[k] is read at the end of that
interval, of x[k+1].
"""

from __future__ import annotations

import math
from contextlib import suppress
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from motor_env.common.arrays import instance
from motor_env.motor.compiled import inlined, njit
from motor_env.motor.parameters import FloatArray, Floats, MotorParameters, require_positive


class State(IntEnum):
    """Index of each state."""

    CURRENT = 0
    SPEED = 1


class Input(IntEnum):
    """Index of each input."""

    VOLTAGE = 0
    LOAD_TORQUE = 1


N_STATES = len(State)


class ContinuousModel(NamedTuple):
    """dx/dt = `transition` x + `gain` u; shapes (..., 2, 2), the leading axes being the batch of motors."""

    transition: FloatArray
    gain: FloatArray


class DiscreteModel(NamedTuple):
    """x[k+1] = `transition` x[k] + `gain` u[k], with u held over `dt_s`; shapes (..., 2, 2)."""

    transition: FloatArray
    gain: FloatArray
    dt_s: float


def continuous_model(parameters: MotorParameters) -> ContinuousModel:
    """Return the continuous state space of the motor (paper, eqs. (1) and (2), constants in their right places)."""
    p, zero = parameters, np.zeros(parameters.batch_shape)
    inverse_l, inverse_j = 1.0 / p.inductance_h, 1.0 / p.inertia_kg_m2
    transition = _matrices(
        -p.resistance_ohm / p.inductance_h,
        -p.back_emf_constant_v_s_per_rad / p.inductance_h,
        p.torque_constant_n_m_per_a / p.inertia_kg_m2,
        -p.viscous_friction_n_m_s_per_rad / p.inertia_kg_m2,
    )
    return ContinuousModel(transition, _matrices(inverse_l, zero, zero, -inverse_j))


def _matrices(*entries: Floats) -> FloatArray:
    rows: FloatArray = np.stack(np.broadcast_arrays(*entries), axis=-1)
    return rows.reshape(*rows.shape[:-1], 2, 2)


SERIES_NORM = 0.25
SERIES_ORDER = 12  # 0.25^13 / 14! is below 1e-18: the series ends under the rounding error
Four = tuple[float, ...]
"""A 2 x 2 matrix, row by row."""


@inlined
def longer_series(k: int, x: Four, phi: Four) -> Four:
    """Add a term of Horner's scheme: 1 + X phi / (k + 1)."""
    (a, b, c, d), (p, q, r, s), f = x, phi, 1.0 / (k + 1.0)
    return 1.0 + f * (a * p + b * r), f * (a * q + b * s), f * (c * p + d * r), 1.0 + f * (c * q + d * s)


@inlined
def of_series(x: Four, phi: Four) -> Four:
    """Return exp(X) = 1 + X phi1(X)."""
    (a, b, c, d), (p, q, r, s) = x, phi
    return 1.0 + a * p + b * r, a * q + b * s, c * p + d * r, 1.0 + c * q + d * s


@inlined
def doubled(exponential: Four, phi: Four) -> tuple[Four, Four]:
    """Return exp(2X) and phi1(2X) from exp(X) and phi1(X)."""
    (e, g, h, j), (p, q, r, s) = exponential, phi
    return (e * e + g * h, g * (e + j), h * (e + j), j * j + g * h), (
        0.5 * ((e + 1.0) * p + g * r),
        0.5 * ((e + 1.0) * q + g * s),
        0.5 * (h * p + (j + 1.0) * r),
        0.5 * (h * q + (j + 1.0) * s),
    )


@inlined  # so that who does not use phi2 does not compute it
def exponential_and_phis(a: float, b: float, c: float, d: float) -> tuple[Four, Four, Four]:
    """Return exp(X), phi1(X) = X^-1 (exp(X) - 1), phi2(X) = X^-1 (phi1(X) - 1) of X = [[a, b], [c, d]], row by row.

    By series and doubling: phi1(X) = sum X^k / (k+1)!, phi2(X) = sum X^k / (k+2)!, exp(X) = 1 + X phi1(X), phi1(2X) =
    (exp(X) + 1) phi1(X) / 2, phi2(2X) = (phi1(X)^2 + 2 phi2(X)) / 4 (Higham 2008, ch. 10.7).
    """
    # The similarity diag(1, scale) evens out b and c, so that the norm is free of the units.
    scale = np.sqrt(abs(b / c)) if b != 0.0 and c != 0.0 else 1.0
    b, c = b / scale, c * scale
    norm = max(abs(a) + abs(b), abs(c) + abs(d))
    doublings, shrink = 0, 1.0
    while SERIES_NORM < norm < np.inf:
        norm, shrink = norm * 0.5, shrink * 0.5
        doublings += 1
    x = (a * shrink, b * shrink, c * shrink, d * shrink)
    p, q, r, s = 1.0, 0.0, 0.0, 1.0
    t, u, v, w = 0.0, 0.0, 0.0, 0.0
    for k in range(SERIES_ORDER, 0, -1):
        f = 1.0 / (k + 1.0)
        t, u, v, w = f * p, f * q, f * r, f * s  # phi2 in the end: phi1 = 1 + X phi2
        p, q, r, s = longer_series(k, x, (p, q, r, s))
    e, g, h, j = of_series(x, (p, q, r, s))
    for _ in range(doublings):
        t, u, v, w = (
            0.5 * t + 0.25 * (p * p + q * r),
            0.5 * u + 0.25 * q * (p + s),
            0.5 * v + 0.25 * r * (p + s),
            0.5 * w + 0.25 * (q * r + s * s),
        )
        (e, g, h, j), (p, q, r, s) = doubled((e, g, h, j), (p, q, r, s))
    return (e, g * scale, h / scale, j), (p, q * scale, r / scale, s), (t, u * scale, v / scale, w)


@njit(cache=True)
def exponential_and_phi(a: float, b: float, c: float, d: float) -> tuple[Four, Four]:
    """Return exp(X) and phi1(X), for held inputs: see `exponential_and_phis`."""
    exponential, phi, _ = exponential_and_phis(a, b, c, d)
    return exponential, phi


@njit(cache=True)
def _all_exponentials(transition: FloatArray, dt_s: float, exponential: FloatArray, phi: FloatArray) -> None:
    for n in range(transition.shape[0]):
        rows = transition[n]
        whole, part = exponential_and_phi(
            rows[0, 0] * dt_s, rows[0, 1] * dt_s, rows[1, 0] * dt_s, rows[1, 1] * dt_s
        )
        for m in range(4):
            exponential[n, m // 2, m % 2], phi[n, m // 2, m % 2] = whole[m], part[m]


def discretize(parameters: MotorParameters, dt_s: float) -> DiscreteModel:
    """Discretize by zero-order hold: Ad = exp(A dt), Bd = dt phi1(A dt) B (Franklin, Powell & Workman 1998, ch. 4.3).

    Raises:
        ValueError: `dt_s` is not positive.
    """
    instance("parameters", parameters, MotorParameters)
    dt_s = float(require_positive("dt_s", dt_s, one=True))
    with np.errstate(all="ignore"):
        model = continuous_model(parameters)
        flat = np.ascontiguousarray(model.transition.reshape(-1, N_STATES, N_STATES))
        exponential, phi = np.empty_like(flat), np.empty_like(flat)
        with suppress(ZeroDivisionError):  # said below
            exponential[-1:] = np.nan
            _all_exponentials(flat, dt_s, exponential, phi)
        shape = model.transition.shape
        gain = dt_s * (phi.reshape(shape) @ model.gain)
        found = DiscreteModel(exponential.reshape(shape), gain, dt_s)
    if not math.isfinite(np.vdot(exponential, exponential) + np.vdot(gain, gain)):
        raise ValueError(
            f"a motor of such parameters cannot be computed at dt_s = {dt_s:g}: one is too large or too small"
        )
    return found


@njit(cache=True)
def propagate(
    transition: FloatArray,
    gain: FloatArray,
    inputs: FloatArray,
    noise: FloatArray,
    state: FloatArray,
    out: FloatArray,
) -> None:
    """Compute x[k+1] = A x[k] + B u[k] + w[k] for every case (paper, eq. (3)); one-row arrays serve all cases.

    `state` is updated in place; `noise` may have no rows.
    """
    for n in range(out.shape[0]):
        a = transition[n if transition.shape[0] > 1 else 0]
        b = gain[n if gain.shape[0] > 1 else 0]
        u = inputs[n if inputs.shape[0] > 1 else 0]
        a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
        b00, b01, b10, b11 = b[0, 0], b[0, 1], b[1, 0], b[1, 1]
        current, speed = state[n, 0], state[n, 1]
        noisy = noise.shape[0] > 0
        for k in range(out.shape[1]):
            new_current = a00 * current + a01 * speed + b00 * u[k, 0] + b01 * u[k, 1]
            speed = a10 * current + a11 * speed + b10 * u[k, 0] + b11 * u[k, 1]
            current = new_current
            if noisy:
                current += noise[n, k, 0]
                speed += noise[n, k, 1]
            out[n, k, 0] = current
            out[n, k, 1] = speed
        state[n, 0], state[n, 1] = current, speed


def load_torque(constant_n_m: Floats, fan_n_m_s2: Floats, speed_rad_s: Floats) -> Floats:
    """Return the torque of a given load plus a fan, which opposes the motion.

    `fan_n_m_s2` is torque over the square of the speed.
    """
    torque: Floats = constant_n_m + fan_n_m_s2 * speed_rad_s * np.abs(speed_rad_s)
    return torque


load_in_kernel = inlined(load_torque)
"""`load_torque` for compiled code."""


def steady_state(parameters: MotorParameters, voltage_v: Floats, load_torque_n_m: Floats = 0.0) -> FloatArray:
    """Return current and speed in steady state, shape (..., 2): -A^-1 B u."""
    p = parameters
    # -A^-1 B u written out: the determinant of A is (R B + Kt Kb) / (L J).
    stiffness = p.torque_constant_n_m_per_a * p.back_emf_constant_v_s_per_rad
    total = p.resistance_ohm * p.viscous_friction_n_m_s_per_rad + stiffness
    voltage, load = np.asarray(voltage_v, dtype=np.float64), np.asarray(load_torque_n_m, dtype=np.float64)
    current = (p.viscous_friction_n_m_s_per_rad * voltage + p.back_emf_constant_v_s_per_rad * load) / total
    speed = (p.torque_constant_n_m_per_a * voltage - p.resistance_ohm * load) / total
    return np.stack(np.broadcast_arrays(current, speed), axis=-1)
