"""Equations of a sample of Monitor and Probe, compiled: plant, filter, statistics, energy, verdict.

`advance` takes one lane (one sub-environment) from sample k to k + 1; `stepping` runs it over one lane or many blocks.
The matrices come from `motor_env.motor.model.discretize`, the gain from `motor_env.filters.kalman`. The same source
serves float32 and float64.
"""

from __future__ import annotations

from motor_env.envs.layout import Block, Constants, Model
from motor_env.motor.compiled import inlined


@inlined
def advance(s: Block, j: int, p: Constants, kept: float, with_speed: bool, full: bool) -> None:
    """One sample of lane j of the block s: plant, measurement, filter, statistics, price of the energy.

    States, measurements and the voltage u are deviations from the rest point of the healthy model (F, G). The error of
    the estimate, e = x - xhat, is a state in its own right, and the motor is its difference M, B, D to (F, G): as the
    difference of two large numbers the innovation would lose its digits in float32. The rows of the speed hold F - I,
    and what rounding takes from its error is carried over to the next sample (Kahan 1965).

    m[k] = M x[k] + B u[k] + D; x[k+1] = F x[k] + G u[k] + m[k]; e = F e[k] + m[k]; with the sensor's noise v the
    innovation is C (e + v), and e[k+1] = e - K (e + v) with the gain to which the filter converges. Exponentially
    weighted means of the whitened innovation are scaled to a standard deviation of 1.

    The filter does not know what a speed loop adds to the voltage, d: it is a part of m.

    `kept` is 0 on the first sample of a step, 1 after that. `with_speed` (there is a speed sensor) and `full` (the
    voltage may move, or a bank follows) are constants at each call, so the compiler leaves out what is not needed.
    """
    x0, x1 = s.current[j], s.speed[j]
    m0 = s.m00[j] * x0 + s.m01[j] * x1 + s.d0[j]
    m1 = s.m10[j] * x0 + s.m11[j] * x1 + s.d1[j]
    if full:
        u, d, b0, b1 = (s.voltage[j], s.drive[j], s.b0[j], s.b1[j])
        m0, m1 = m0 + b0 * u + (p.g0 + b0) * d, m1 + b1 * u + (p.g1 + b1) * d
        y0 = p.f00 * x0 + p.f01 * x1 + p.g0 * u + m0
        y1 = x1 + (p.f10 * x0 + p.f11 * x1 + p.g1 * u + m1)
    else:
        y0 = p.f00 * x0 + p.f01 * x1 + m0
        y1 = x1 + (p.f10 * x0 + p.f11 * x1 + m1)
    s.current[j], s.speed[j] = y0, y1
    e0, e1 = s.error_current[j], s.error_speed[j]
    a0 = p.f00 * e0 + p.f01 * e1 + m0
    rise = p.f10 * e0 + p.f11 * e1 + m1
    v0 = s.sigma_current[j] * s.normal_current[j]
    d0 = p.c0 * (a0 + v0)
    r0 = p.w00 * d0
    e0, correction, power = a0 - p.k00 * d0, p.k10 * d0, r0 * r0
    fast, slow = p.memory_fast, p.memory_slow
    if with_speed:
        v1 = s.sigma_speed[j] * s.normal_speed[j]
        d1 = e1 + rise + v1
        r1 = p.w10 * d0 + p.w11 * d1
        e0, correction, power = e0 - p.k01 * d1, correction + p.k11 * d1, power + r1 * r1
        s.measured_speed[j] = y1 + v1
        s.noise_speed[j] = v1
        s.innovation_speed[j] = kept * s.innovation_speed[j] + r1
        s.fast_speed[j] = fast * s.fast_speed[j] + p.into_fast * r1
        s.slow_speed[j] = slow * s.slow_speed[j] + p.into_slow * r1
    rise -= correction + s.carry[j]
    before, e1 = e1, e1 + rise
    s.carry[j] = (e1 - before) - rise
    s.error_current[j], s.error_speed[j] = e0, e1
    s.measured_current[j] = y0 + v0
    s.estimated_current[j], s.estimated_speed[j] = y0 - e0, y1 - e1
    s.innovation_current[j] = kept * s.innovation_current[j] + r0
    s.fast_current[j] = fast * s.fast_current[j] + p.into_fast * r0
    s.slow_current[j] = slow * s.slow_current[j] + p.into_slow * r0
    s.excess[j] = slow * s.excess[j] + p.into_excess * (power - p.n_channels)
    if full:
        taken = (u + d + p.rest_voltage) * s.supply[j] * (y0 + p.rest_current)
        s.energy[j] = kept * s.energy[j] + p.energy_cost * abs(taken)
        s.old_current[j], s.old_speed[j] = x0, x1
        s.mismatch_0[j], s.mismatch_1[j] = m0, m1
        s.noise_current[j], s.power[j] = v0, power
    s.time[j] += p.one


@inlined
def hold_speed(s: Block, j: int, p: Constants) -> None:
    """Update the speed loop of lane j: a PI controller in incremental form, which begins without a jump."""
    speed = s.speed[j]
    away = p.loop_p * (speed - s.old_speed[j]) + p.loop_i * (speed - s.held[j])
    s.drive[j] -= away


@inlined
def weigh(s: Block, j: int, m: int, p: Constants, t: Model) -> None:
    """Update filter m of the bank: the CUSUM of its log-likelihood ratio to the healthy filter.

    Each filter assumes one fault. Where its sum falls to 0 it restarts from the healthy estimate, as though the fault
    set in now (Page 1954, with a signal that depends on the onset: Willsky & Jones 1976).
    """
    u = s.voltage[j]
    x0, x1 = s.old_current[j], s.old_speed[j]
    m0 = s.mismatch_0[j] - (t.m00 * x0 + t.m01 * x1 + t.b0 * u + t.d0)
    m1 = s.mismatch_1[j] - (t.m10 * x0 + t.m11 * x1 + t.b1 * u + t.d1)
    a0 = t.t00 * s.bank_current[m, j] + t.t01 * s.bank_speed[m, j] + m0
    a1 = s.bank_speed[m, j] + (t.t10 * s.bank_current[m, j] + t.t11 * s.bank_speed[m, j] + m1)
    d0, d1 = p.c0 * (a0 + s.noise_current[j]), p.c1 * (a1 + s.noise_speed[j])
    r0 = p.w00 * d0
    r1 = p.w10 * d0 + p.w11 * d1
    total = s.evidence[m, j] + p.half * (s.power[j] - r0 * r0 - r1 * r1)
    goes_on = total > p.zero
    s.evidence[m, j] = total if goes_on else p.zero
    a0 -= p.k00 * d0 + p.k01 * d1
    a1 -= p.k10 * d0 + p.k11 * d1
    s.bank_current[m, j] = a0 if goes_on else s.error_current[j]
    s.bank_speed[m, j] = a1 if goes_on else s.error_speed[j]


@inlined
def settle(s: Block, j: int, p: Constants, samples: int, declared: int) -> float:
    """Reward of the verdict at the end of lane j's episode, whose last step took `samples`.

    A declaration is judged by what had been observed before it: a fault that had acted on no observed sample cannot be
    declared rightly. The horizon ends an episode with a miss, or with the reward of silence.
    """
    onset = s.onset[j]
    if declared == 0:
        return -p.miss if onset < p.horizon else p.silent
    if s.time[j] - samples <= onset:
        return -p.false_alarm
    return p.correct if declared == s.kind[j] else -p.wrong_kind
