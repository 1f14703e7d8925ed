"""The step of the environments, compiled once for all: plant, filter, statistics, cost, reward, end.

`advance` is the one place where a sample is made: it takes one lane (one sub-environment) from sample k to k + 1. The
single environment runs it over one lane, a vector over blocks of `LANES` lanes. The matrices come from
`motor_env.motor.model.discretize`, the gain from `motor_env.filters.kalman`; the kernel multiplies and adds.

State lies in blocks, `state[block, field, lane]`, flat: all lanes of a block stand side by side at distances that the
compiler knows, so that it computes several lanes with one instruction, and a block fits into the first-level cache.
The same source serves float32 and float64: whichever the arrays are.
"""

from __future__ import annotations

from typing import NamedTuple

from motor_env.envs.compiling import inlined
from motor_env.motor.parameters import FloatArray

LANES = 64
ROWS = 4
"""Normals of a lane that are made at a time: those that one counter gives."""

# Fields of a lane. The first ROW_LENGTH are the motor as it is now, as its difference to the belief's.
M00, M01, M10, M11, D0, D1, B0, B1, SIGMA_CURRENT, SIGMA_SPEED = range(10)
ROW_LENGTH = 10
CURRENT, SPEED, ERROR_CURRENT, ERROR_SPEED = range(10, 14)  # the true state; what the filter's estimate lacks
FAST_CURRENT, SLOW_CURRENT, FAST_SPEED, SLOW_SPEED, EXCESS = range(14, 19)  # running statistics
SAMPLE, NEXT_CHANGE, DELAY, COST = range(19, 23)  # the time, and what it costs
MEASURED_CURRENT, MEASURED_SPEED, ESTIMATED_CURRENT, ESTIMATED_SPEED = range(23, 27)  # the last sample
WHITE_CURRENT, WHITE_SPEED, VOLTAGE = range(27, 30)  # the last step
ONSET, LEVEL, KIND, SUPPLY = range(30, 34)  # the episode
OLD_CURRENT, OLD_SPEED, MISMATCH_0, MISMATCH_1 = range(34, 38)  # for the bank, as the next three
NOISE_CURRENT, NOISE_SPEED, POWER = range(38, 41)
CARRY = 41  # what rounding took from the error of the speed
DRIVE, HELD = 42, 43  # what a speed loop adds to the voltage, and the speed that it holds
BANK = 44  # three fields for each filter of the bank: the errors of its current and speed, its evidence
BANK_LENGTH = 3
MAX_BANK = 5
N_FIELDS = BANK + BANK_LENGTH * MAX_BANK
NORMAL_CURRENT, NORMAL_SPEED = N_FIELDS, N_FIELDS + 1  # the normals of the sample
NOISE, LATEST = N_FIELDS + 2, N_FIELDS + 2 + ROWS  # the normals made ahead, and those made last
BLOCK = (LATEST + ROWS) * LANES

FIELD, SCALE, BOUND, OFFSET = range(4)  # a row of the observed features
FEATURE_LENGTH = 4
NEVER = 2.0**50  # the same in both precisions


class Constants(NamedTuple):
    """The belief, the statistics' memories and the rewards, common to all lanes."""

    f00: float  # transition of the belief, whose rows of the speed hold F - I
    f01: float
    f10: float
    f11: float
    g0: float  # its gain of the voltage
    g1: float
    k00: float  # gain of the filter
    k01: float
    k10: float
    k11: float
    w00: float  # what whitens the innovation, a lower triangle
    w10: float
    w11: float
    c0: float  # 1 where a sensor reads that state
    c1: float
    memory_fast: float  # share of a running statistic that is left after a sample
    memory_slow: float
    into_fast: float  # share of a new sample in it
    into_slow: float
    into_excess: float
    n_channels: float
    horizon: float  # in samples, as `growth`
    delay_cost: float  # a sample, as the prices of probe and energy
    correct: float
    silent: float
    false_alarm: float
    wrong_kind: float
    miss: float
    rest_voltage: float
    rest_current: float
    probe_cost: float
    energy_cost: float
    growth: float
    n_levels: float
    zero: float  # typed as the state is: a literal would make float64 of float32
    half: float
    one: float
    full: float  # whether the voltage may move, or a bank follows
    loop_p: float  # gains of the speed loop
    loop_i: float
    confirm: float  # how often in a row a kind has to be chosen


N_CONSTANTS, FULL = len(Constants._fields), Constants._fields.index("full")


class Model(NamedTuple):
    """A filter of the bank, and its difference to the belief in transition, voltage gain and drift."""

    t00: float  # its transition
    t01: float
    t10: float
    t11: float
    m00: float  # differences
    m01: float
    m10: float
    m11: float
    b0: float
    b1: float
    d0: float
    d1: float


MODEL_LENGTH = len(Model._fields)

FEATURES = (
    "measured_current",
    "measured_speed",
    "estimated_current",
    "estimated_speed",
    "innovation_current",
    "innovation_speed",
    "fast_current",
    "slow_current",
    "fast_speed",
    "slow_speed",
    "excess",
    "voltage",
    "time",
)
"""What can be observed of every task; then comes the evidence of each filter of the bank."""
FIELD_OF_FEATURE = (
    *range(MEASURED_CURRENT, WHITE_SPEED + 1),
    *range(FAST_CURRENT, EXCESS + 1),
    *(VOLTAGE, SAMPLE),
    *range(BANK + 2, N_FIELDS, BANK_LENGTH),
)


@inlined
def advance(s: FloatArray, j: int, p: Constants, kept: float, with_speed: bool, full: bool) -> None:
    """One sample of lane j of the block s: plant, measurement, filter, statistics, cost of waiting.

    States, measurements and the voltage u stand as deviations from the point at which the belief would rest. What the
    filter's estimate lacks to the truth, e = x - xhat, is a state in its own right, and the motor stands as its
    difference M, B, D to the belief (F, G): the innovation is small beside the state, and as the difference of two
    large numbers it would lose its digits in float32. The rows of the speed hold F - I: it moves by a hair a sample,
    so what rounding takes from its error is carried over to the next (Kahan 1965).

    m[k] = M x[k] + B u[k] + D; x[k+1] = F x[k] + G u[k] + m[k]; e = F e[k] + m[k]; with the sensor's noise v the
    innovation is C (e + v), and e[k+1] = e - K (e + v) with the gain to which the filter converges. Exponentially
    weighted means of the whitened innovation are scaled to a standard deviation of 1.

    What a speed loop adds to the voltage, d, the filter is not told: it is a part of m.

    `kept` is 0 on the first sample of a step, 1 after that.
    `with_speed` (a speed sensor is there) and `full` (the voltage may move, or a bank follows) are literals where this
    is called, so the compiler leaves out what is not needed.
    """
    x0, x1 = s[j + CURRENT * LANES], s[j + SPEED * LANES]
    m0 = s[j + M00 * LANES] * x0 + s[j + M01 * LANES] * x1 + s[j + D0 * LANES]
    m1 = s[j + M10 * LANES] * x0 + s[j + M11 * LANES] * x1 + s[j + D1 * LANES]
    if full:
        u, d, b0, b1 = (
            s[j + VOLTAGE * LANES],
            s[j + DRIVE * LANES],
            s[j + B0 * LANES],
            s[j + B1 * LANES],
        )
        m0, m1 = m0 + b0 * u + (p.g0 + b0) * d, m1 + b1 * u + (p.g1 + b1) * d
        y0 = p.f00 * x0 + p.f01 * x1 + p.g0 * u + m0
        y1 = x1 + (p.f10 * x0 + p.f11 * x1 + p.g1 * u + m1)
    else:
        y0 = p.f00 * x0 + p.f01 * x1 + m0
        y1 = x1 + (p.f10 * x0 + p.f11 * x1 + m1)
    s[j + CURRENT * LANES], s[j + SPEED * LANES] = y0, y1
    e0, e1 = s[j + ERROR_CURRENT * LANES], s[j + ERROR_SPEED * LANES]
    a0 = p.f00 * e0 + p.f01 * e1 + m0
    rise = p.f10 * e0 + p.f11 * e1 + m1
    v0 = s[j + SIGMA_CURRENT * LANES] * s[j + NORMAL_CURRENT * LANES]
    d0 = p.c0 * (a0 + v0)
    r0 = p.w00 * d0
    e0, correction, power = a0 - p.k00 * d0, p.k10 * d0, r0 * r0
    fast, slow = p.memory_fast, p.memory_slow
    if with_speed:
        v1 = s[j + SIGMA_SPEED * LANES] * s[j + NORMAL_SPEED * LANES]
        d1 = e1 + rise + v1
        r1 = p.w10 * d0 + p.w11 * d1
        e0, correction, power = e0 - p.k01 * d1, correction + p.k11 * d1, power + r1 * r1
        s[j + MEASURED_SPEED * LANES] = y1 + v1
        s[j + NOISE_SPEED * LANES] = v1
        s[j + WHITE_SPEED * LANES] = kept * s[j + WHITE_SPEED * LANES] + r1
        s[j + FAST_SPEED * LANES] = fast * s[j + FAST_SPEED * LANES] + p.into_fast * r1
        s[j + SLOW_SPEED * LANES] = slow * s[j + SLOW_SPEED * LANES] + p.into_slow * r1
    rise -= correction + s[j + CARRY * LANES]
    before, e1 = e1, e1 + rise
    s[j + CARRY * LANES] = (e1 - before) - rise
    s[j + ERROR_CURRENT * LANES], s[j + ERROR_SPEED * LANES] = e0, e1
    s[j + MEASURED_CURRENT * LANES] = y0 + v0
    s[j + ESTIMATED_CURRENT * LANES], s[j + ESTIMATED_SPEED * LANES] = y0 - e0, y1 - e1
    s[j + WHITE_CURRENT * LANES] = kept * s[j + WHITE_CURRENT * LANES] + r0
    s[j + FAST_CURRENT * LANES] = fast * s[j + FAST_CURRENT * LANES] + p.into_fast * r0
    s[j + SLOW_CURRENT * LANES] = slow * s[j + SLOW_CURRENT * LANES] + p.into_slow * r0
    s[j + EXCESS * LANES] = slow * s[j + EXCESS * LANES] + p.into_excess * (power - p.n_channels)
    cost = kept * s[j + COST * LANES] + s[j + DELAY * LANES]
    if full:
        taken = (u + d + p.rest_voltage) * s[j + SUPPLY * LANES] * (y0 + p.rest_current)
        cost += p.probe_cost * u * u + p.energy_cost * abs(taken)
        s[j + OLD_CURRENT * LANES], s[j + OLD_SPEED * LANES] = x0, x1
        s[j + MISMATCH_0 * LANES], s[j + MISMATCH_1 * LANES] = m0, m1
        s[j + NOISE_CURRENT * LANES], s[j + POWER * LANES] = v0, power
    s[j + COST * LANES] = cost
    s[j + SAMPLE * LANES] += p.one


@inlined
def hold_speed(s: FloatArray, j: int, p: Constants) -> None:
    """The speed loop of lane j after a sample: a PI controller in its incremental form, which begins without a jump."""
    speed = s[j + SPEED * LANES]
    away = p.loop_p * (speed - s[j + OLD_SPEED * LANES]) + p.loop_i * (speed - s[j + HELD * LANES])
    s[j + DRIVE * LANES] -= away


@inlined
def weigh(s: FloatArray, j: int, m: int, p: Constants, t: Model) -> None:
    """Filter m of the bank after a sample of lane j: the cumulative sum of its log-likelihood ratio to the belief.

    Each filter believes in one fault. Where its sum falls to 0 it starts anew from the belief's estimate, as though
    the fault set in now (Page 1954, with a signal that depends on the onset: Willsky & Jones 1976).
    """
    at0, at1, evidence = j + m * LANES, j + (m + 1) * LANES, j + (m + 2) * LANES
    u = s[j + VOLTAGE * LANES]
    x0, x1 = s[j + OLD_CURRENT * LANES], s[j + OLD_SPEED * LANES]
    m0 = s[j + MISMATCH_0 * LANES] - (t.m00 * x0 + t.m01 * x1 + t.b0 * u + t.d0)
    m1 = s[j + MISMATCH_1 * LANES] - (t.m10 * x0 + t.m11 * x1 + t.b1 * u + t.d1)
    a0 = t.t00 * s[at0] + t.t01 * s[at1] + m0
    a1 = s[at1] + (t.t10 * s[at0] + t.t11 * s[at1] + m1)
    d0, d1 = p.c0 * (a0 + s[j + NOISE_CURRENT * LANES]), p.c1 * (a1 + s[j + NOISE_SPEED * LANES])
    r0 = p.w00 * d0
    r1 = p.w10 * d0 + p.w11 * d1
    total = s[evidence] + p.half * (s[j + POWER * LANES] - r0 * r0 - r1 * r1)
    goes_on = total > p.zero
    s[evidence] = total if goes_on else p.zero
    a0 -= p.k00 * d0 + p.k01 * d1
    a1 -= p.k10 * d0 + p.k11 * d1
    s[at0] = a0 if goes_on else s[j + ERROR_CURRENT * LANES]
    s[at1] = a1 if goes_on else s[j + ERROR_SPEED * LANES]


@inlined
def settle(s: FloatArray, j: int, p: Constants, samples: int, declared: int) -> float:
    """Verdict on the last step of lane j's episode, which took so many samples; at the horizon the cost comes on top.

    A declaration ends the episode and is judged by what had been observed before it: a fault that had acted on no
    observed sample cannot be declared rightly. The horizon ends it with a miss, or with the reward of silence.
    """
    onset = s[j + ONSET * LANES]
    if declared == 0:
        return -p.miss if onset < p.horizon else p.silent
    if s[j + SAMPLE * LANES] - samples <= onset:
        return -p.false_alarm
    return p.correct if declared == s[j + KIND * LANES] else -p.wrong_kind
