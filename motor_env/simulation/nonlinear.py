"""Effects in a real motor beyond the textbook one, integrated with fixed steps, all cases side by side.

States: current i, speed w, angle phi, winding temperature above the start's. With the linear motor's L, J, B:

    L di/dt      = Vs(t) - (R(T) + Rs) i - Kb(T) w - Vb s(i)
    J dw/dt      = Kt(T) (1 + a cos(n phi)) i - B w - (Tc + Tx / (1 + (w / ws)^2) + Tload + Tr cos(q phi)) s(w)
    dphi/dt      = w
    C d(dT)/dt   = i^2 R(T) - dT / Rth                      R(T) = R(start) (1 + 0.00393 dT)

s is the sign, made smooth as x / sqrt(x^2 + e^2); the falling Stribeck part is that of Hess & Soom (1990). The supply
Vs rises over `ramp_s` along 3 r^2 - 2 r^3 and carries a ripple. Copper: R (1 + 0.00393 dT) (IEC 60028); ferrite and
NdFeB magnets about -0.1 %/K.

The classical Runge-Kutta method takes `substeps` steps a sample; the nominal motor sets them, so that a case does not
depend on its batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.compiled import njit
from motor_env.motor.model import load_in_kernel
from motor_env.motor.parameters import (
    COPPER_PER_KELVIN,
    MAGNET_PER_KELVIN,
    FloatArray,
    Floats,
    MotorParameters,
    require,
    require_finite,
    require_positive,
)

LANES = 8
# At 10 kHz four steps a sample for the paper's motor; the error is in docs/datasets.md.
_STEPS_PER_TIME_CONSTANT = 4.3
_STEPS_PER_PERIOD = 12.0
_MOST_STEPS = 10_000


@dataclass(frozen=True, slots=True)
class Effects:
    """Departures from the textbook motor (the defaults); floats, or one entry a case.

    Attributes:
        coulomb_friction_n_m: Tc.
        stribeck_friction_n_m: Tx, breakaway torque above Tc.
        stribeck_speed_rad_s: ws.
        brush_drop_v: Vb, of both brushes.
        temperature_rise_k: of winding and magnets at the start, above that of the parameters.
        supply_resistance_ohm: Rs.
        ramp_s: rise time of the supply; 0 for a step.
        ripple_v: amplitude of the supply's ripple (PWM, rectifier).
        ripple_hz: its frequency.
        load_torque_n_m: Tload, while the motor turns.
        commutation_ripple: a, relative ripple of the torque constant.
        commutation_per_turn: n, ripples a turn.
        bearing_ripple_n_m: Tr, torque ripple of a damaged bearing.
        bearing_per_turn: q, ball passes a turn (outer race: (balls / 2)(1 - d/D cos phi)).
        delay_s: delay of the supply's step, below one sampling interval.
        heat_capacity_j_per_k: C of the winding.
        thermal_resistance_k_per_w: Rth from the winding to the housing.
    """

    coulomb_friction_n_m: Floats = 0.0
    stribeck_friction_n_m: Floats = 0.0
    stribeck_speed_rad_s: Floats = 5.0
    brush_drop_v: Floats = 0.0
    temperature_rise_k: Floats = 0.0
    supply_resistance_ohm: Floats = 0.0
    ramp_s: Floats = 0.0
    ripple_v: Floats = 0.0
    ripple_hz: Floats = 0.0
    load_torque_n_m: Floats = 0.0
    commutation_ripple: Floats = 0.0
    commutation_per_turn: Floats = 14.0
    bearing_ripple_n_m: Floats = 0.0
    bearing_per_turn: Floats = 3.1
    delay_s: Floats = 0.0
    heat_capacity_j_per_k: Floats = 3.87
    thermal_resistance_k_per_w: Floats = 3.1

    def __post_init__(self) -> None:
        signed = ("temperature_rise_k", "load_torque_n_m")
        positive = ("stribeck_speed_rad_s", "heat_capacity_j_per_k", "thermal_resistance_k_per_w")
        for f in fields(self):
            if f.name in signed:
                require_finite(f.name, getattr(self, f.name))
            else:
                require_positive(f.name, getattr(self, f.name), zero_allowed=f.name not in positive)


_CONSTANTS = (
    "resistance", "inverse_l", "kb", "kt", "inverse_j", "b", "dry", "stribeck", "inverse_ws", "brush", "source_r",
    "ramp_rate", "ripple", "ripple_rad_s", "commutation", "commutation_turn", "bearing", "bearing_turn", "delay",
    "inverse_c", "leak", "voltage", "no_ramp",
)  # fmt: skip
_STATES = ("current", "speed", "angle", "heat", "time", "step")
_GROUP = np.dtype([(name, np.float64, LANES) for name in (*_CONSTANTS, *_STATES)])
"""Record of a group of cases that are integrated side by side: constants, states, time and step."""
Group = Any
"""A record of `_GROUP`."""

_ROUND = 6755399441055744.0  # 1.5 x 2^52: adding and subtracting it rounds to the nearest integer
_TURNS_PER_RAD, _RAD_PER_TURN = 0.5 / math.pi, 2.0 * math.pi
_S1, _S3, _S5, _S7, _S9, _S11, _S13 = (
    (-1.0) ** (k + 1) / math.factorial(2 * k + 3) for k in range(7)
)  # of sin(x) - x
_BRUSH_CURRENT_A = 0.02  # width of the smooth sign of the brush drop
_STICTION_SPEED_RAD_S = 1.0  # width of the smooth sign of the friction


class Sampling(NamedTuple):
    """When cases are sampled, and which quantities.

    Attributes:
        dt_s: sampling interval.
        steps: Runge-Kutta steps in one sample (`substeps`).
        is_current: whether a channel is the current (or the speed), shape (n_channels,).
        out: filled with the truth at the end of each interval, shape (n_cases, n_channels, n_samples); motors at work
            have one channel more, the voltage.
    """

    dt_s: float
    steps: int
    is_current: NDArray[np.bool_]
    out: NDArray[np.float32]


def substeps(nominal: MotorParameters, dt_s: float, ripple_hz: float = 0.0) -> int:
    """Return Runge-Kutta steps in one sample: 4.3 an electrical time constant, twelve a ripple's period."""
    require(nominal.batch_shape == (), "nominal must be given for a batch of motors")
    largest_s = float(nominal.electrical_time_constant_s) / _STEPS_PER_TIME_CONSTANT
    if ripple_hz > 0.0:
        largest_s = min(largest_s, 1.0 / (_STEPS_PER_PERIOD * ripple_hz))
    steps = max(1, math.ceil(dt_s / largest_s))
    require(
        steps <= _MOST_STEPS,
        f"a sampling interval of {dt_s:g} s must hold at most {_MOST_STEPS} integration steps, got {steps:g}: the"
        " inductance is too small or ripple_hz too high for it",
    )
    return steps


def groups_of(
    parameters: MotorParameters, effects: Effects, voltage_v: Floats, n_cases: int
) -> NDArray[np.void]:
    """Return the cases in groups, with all constants; the first case fills up the last group."""
    e = effects
    copper = 1.0 + COPPER_PER_KELVIN * e.temperature_rise_k
    magnet = 1.0 + MAGNET_PER_KELVIN * e.temperature_rise_k
    ramp = np.asarray(e.ramp_s, dtype=np.float64)
    values: dict[str, Floats] = {
        "resistance": parameters.resistance_ohm * copper,
        "inverse_l": 1.0 / parameters.inductance_h,
        "kb": parameters.back_emf_constant_v_s_per_rad * magnet,
        "kt": parameters.torque_constant_n_m_per_a * magnet,
        "inverse_j": 1.0 / parameters.inertia_kg_m2,
        "b": parameters.viscous_friction_n_m_s_per_rad,
        "dry": e.coulomb_friction_n_m + e.load_torque_n_m,
        "stribeck": e.stribeck_friction_n_m,
        "inverse_ws": 1.0 / e.stribeck_speed_rad_s,
        "brush": e.brush_drop_v,
        "source_r": e.supply_resistance_ohm,
        "ramp_rate": (ramp > 0.0) / np.where(ramp > 0.0, ramp, 1.0),
        "ripple": e.ripple_v,
        "ripple_rad_s": 2.0 * math.pi * e.ripple_hz,
        "commutation": e.commutation_ripple,
        "commutation_turn": e.commutation_per_turn,
        "bearing": e.bearing_ripple_n_m,
        "bearing_turn": e.bearing_per_turn,
        "delay": e.delay_s,
        "inverse_c": 1.0 / e.heat_capacity_j_per_k,
        "leak": 1.0 / e.thermal_resistance_k_per_w,
        "voltage": voltage_v,
        "no_ramp": (ramp == 0.0).astype(np.float64),
    }
    groups = np.zeros(-(-n_cases // LANES), dtype=_GROUP)
    for name, value in values.items():
        row = np.empty(groups[name].size)
        row[:n_cases] = value
        row[n_cases:] = row[0]
        groups[name] = row.reshape(-1, LANES)
    return groups


@njit(cache=True, inline="always", error_model="numpy")
def _cosine(x: float) -> float:
    """Compute the cosine by range reduction and a Taylor polynomial of order 16: within 1e-11, and it vectorises."""
    turns = x * _TURNS_PER_RAD
    y = _RAD_PER_TURN * (turns - ((turns + _ROUND) - _ROUND))  # -pi .. pi
    # cos y = 1 - 2 sin^2(y / 2), the sine by its series on (-pi/2, pi/2)
    h = 0.5 * y
    z = h * h
    p = _S13 * z + _S11
    p = p * z + _S9
    p = p * z + _S7
    p = p * z + _S5
    p = p * z + _S3
    sine = h + h * z * (p * z + _S1)
    return 1.0 - 2.0 * sine * sine


@njit(cache=True, inline="always", error_model="numpy")
def _derivative(
    p: Group, n: int, t: float, current: float, speed: float, angle: float, heat: float
) -> tuple[float, float, float, float]:
    """Compute the right-hand side of lane n of a group at time t since its step."""
    resistance = p.resistance[n] * (1.0 + COPPER_PER_KELVIN * heat)
    r = t * p.ramp_rate[n] + p.no_ramp[n]
    r = r if r < 1.0 else 1.0
    ripple = p.ripple[n] * _cosine(p.ripple_rad_s[n] * t)
    supply = (p.voltage[n] + ripple) * r * r * (3.0 - 2.0 * r)
    brush = p.brush[n] * current / np.sqrt(current * current + _BRUSH_CURRENT_A * _BRUSH_CURRENT_A)
    drop = (resistance + p.source_r[n]) * current + p.kb[n] * speed + brush
    current_rate = (supply - drop) * p.inverse_l[n]
    ratio = speed * p.inverse_ws[n]
    smooth_sign = speed / np.sqrt(speed * speed + _STICTION_SPEED_RAD_S * _STICTION_SPEED_RAD_S)
    stribeck = p.stribeck[n] / (1.0 + ratio * ratio)
    bearing = p.bearing[n] * _cosine(p.bearing_turn[n] * angle)
    against = p.b[n] * speed + (p.dry[n] + stribeck + bearing) * smooth_sign
    commutation = 1.0 + p.commutation[n] * _cosine(p.commutation_turn[n] * angle)
    speed_rate = (p.kt[n] * commutation * current - against) * p.inverse_j[n]
    heat_rate = (current * current * resistance - heat * p.leak[n]) * p.inverse_c[n]
    return current_rate, speed_rate, speed, heat_rate


@njit(cache=True, error_model="numpy")  # a check for division by 0 would keep the loop from vectorising
def step_lanes(p: Group) -> None:
    """Take one step of the classical Runge-Kutta method (Kutta 1901) for a group of cases."""
    for lane in range(LANES):
        i, w = p.current[lane], p.speed[lane]
        a, q = p.angle[lane], p.heat[lane]
        time, step = p.time[lane], p.step[lane]
        half = 0.5 * step
        i1, w1, a1, q1 = _derivative(p, lane, time, i, w, a, q)
        i2, w2, a2, q2 = _derivative(
            p, lane, time + half, i + half * i1, w + half * w1, a + half * a1, q + half * q1
        )
        i3, w3, a3, q3 = _derivative(
            p, lane, time + half, i + half * i2, w + half * w2, a + half * a2, q + half * q2
        )
        i4, w4, a4, q4 = _derivative(
            p, lane, time + step, i + step * i3, w + step * w3, a + step * a3, q + step * q3
        )
        sixth = step / 6.0
        p.current[lane] = i + sixth * (i1 + 2.0 * (i2 + i3) + i4)
        p.speed[lane] = w + sixth * (w1 + 2.0 * (w2 + w3) + w4)
        p.angle[lane] = a + sixth * (a1 + 2.0 * (a2 + a3) + a4)
        p.heat[lane] = q + sixth * (q1 + 2.0 * (q2 + q3) + q4)
        p.time[lane] = time + step


@njit(cache=True, error_model="numpy")  # a check for division by 0 would keep the loop from vectorising
def _integrate(groups: NDArray[np.void], sampling: Sampling, n_quiet: int) -> None:
    dt_s, steps, is_current, out = sampling
    n_cases, n_channels, n_samples = out.shape
    for first in range(0, n_cases, LANES):
        p = groups[first // LANES]
        for k in range(n_samples):
            if k >= n_quiet:
                for lane in range(LANES):  # the first interval is shorter by the delay of the step
                    delay = p.delay[lane] if k == n_quiet else 0.0
                    p.step[lane] = (dt_s - delay) / steps
                for _ in range(steps):
                    step_lanes(p)
            for lane in range(min(LANES, n_cases - first)):
                for c in range(n_channels):
                    out[first + lane, c, k] = p.current[lane] if is_current[c] else p.speed[lane]


def integrate(
    parameters: MotorParameters,
    effects: Effects,
    voltage_v: Floats,
    sampling: Sampling,
    n_quiet: int,
) -> None:
    """Compute the true current and speed of each case at the end of each sampling interval.

    `parameters` hold the faults; `n_quiet` samples lie before the step of `voltage_v`.

    Raises:
        ValueError: a delay is not below one sampling interval.
    """
    largest, dt_s = float(np.max(effects.delay_s)), sampling.dt_s
    require(largest < dt_s, f"delay_s must be < one sampling interval ({dt_s:g} s), got {largest:g}")
    _integrate(groups_of(parameters, effects, voltage_v, len(sampling.out)), sampling, n_quiet)


LOOP_GAIN, LOOP_INTEGRAL = 0.5, 0.05
"""Gains of the speed loop on a back-EMF in volts, and of its sum over the samples."""


class Driving(NamedTuple):
    """Voltage and load of drawn cases.

    Attributes:
        voltage_v: applied voltage, or a speed loop's target back-EMF, shape (n_cases or 1, n_samples).
        is_loop: whether there is a speed loop, shape (n_cases,).
        resistance_ohm: assumed by the loop.
        limit_v: largest voltage that the loop can apply, shape (n_cases,).
        load_rise_n_m: rise of the load over the record, shape (n_cases,).
        fan_n_m_s2: load over the square of the speed, shape (n_cases,).
    """

    voltage_v: FloatArray
    is_loop: NDArray[np.bool_]
    resistance_ohm: float
    limit_v: FloatArray
    load_rise_n_m: FloatArray
    fan_n_m_s2: FloatArray


@njit(cache=True, error_model="numpy")
def integrate_driven(
    groups: NDArray[np.void], sampling: Sampling, driving: Driving, noise: FloatArray
) -> None:
    """Compute the true current, speed and applied voltage of each sampling interval.

    Args:
        groups: the cases (`groups_of`); of their supply only resistance and ripple count.
        sampling: times and output.
        driving: voltage and load.
        noise: of the speed loop's current, shape (n_cases, n_samples); no rows without a loop.
    """
    dt_s, steps, is_current, out = sampling
    wanted, limit = driving.voltage_v, driving.limit_v
    n_cases, last, n_samples = out.shape[0], out.shape[1] - 1, out.shape[2]
    for first in range(0, n_cases, LANES):
        p = groups[first // LANES]
        lanes = min(LANES, n_cases - first)
        still, integral = p.dry.copy(), np.zeros(LANES)
        p.step[:] = dt_s / steps
        for k in range(n_samples):
            for lane in range(lanes):
                n, current, speed = first + lane, p.current[lane], p.speed[lane]
                volts = wanted[n if wanted.shape[0] > 1 else 0, k]
                if driving.is_loop[n] and k > 0:
                    error = volts - (
                        out[n, last, k - 1] - driving.resistance_ohm * (current + noise[n, k - 1])
                    )
                    integral[lane] = min(max(integral[lane] + LOOP_INTEGRAL * error, -limit[n]), limit[n])
                    volts = min(max(volts + LOOP_GAIN * error + integral[lane], -limit[n]), limit[n])
                out[n, last, k] = volts
                p.voltage[lane] = out[n, last, k]  # what is applied is what is recorded
                share = (k + 0.5) / n_samples
                load = load_in_kernel(share * driving.load_rise_n_m[n], driving.fan_n_m_s2[n], abs(speed))
                p.dry[lane] = still[lane] + load
            for _ in range(steps):
                step_lanes(p)
            for lane in range(lanes):
                for c in range(last):
                    out[first + lane, c, k] = p.current[lane] if is_current[c] else p.speed[lane]
