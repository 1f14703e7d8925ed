"""The step of the environments, compiled once for all: plant, noise, filter, statistics, reward, end.

`advance` is the one place where a sample is made: it takes one lane (one sub-environment) from sample k to k + 1. The
single environment runs it over one lane, a vector over blocks of `LANES` lanes. The matrices come from
`motor_env.model.discretize`, the gain from `motor_env.kalman`; the kernel multiplies and adds.

State lies in blocks, `state[block, field, lane]`, flat: all lanes of a block stand side by side at distances that the
compiler knows, so that it computes several lanes with one instruction, and a block fits into the first-level cache.
The same source serves float32 and float64: whichever the arrays are.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from motor_env.envs.noise import normal_pair
from motor_env.parameters import FloatArray

LANES = 64
KeyArray = NDArray[np.uint64]
Float32Array = NDArray[np.float32]

# Fields of a lane. The first ROW_LENGTH are the motor as it is now: a row of the episode's table of fault levels.
A00, A01, A10, A11, B0, B1, D0, D1, SIGMA_CURRENT, SIGMA_SPEED = range(10)
ROW_LENGTH = 10
CURRENT, SPEED, ESTIMATED_CURRENT, ESTIMATED_SPEED = range(10, 14)  # the true state; the filter's estimate
FAST_CURRENT, SLOW_CURRENT, FAST_SPEED, SLOW_SPEED, EXCESS = range(14, 19)  # running statistics
MEASURED_CURRENT, MEASURED_SPEED, WHITE_CURRENT, WHITE_SPEED = range(19, 23)  # the last sample
SAMPLE, ONSET, NEXT_CHANGE, LEVEL, KIND, SUPPLY = range(23, 29)  # the episode
VOLTAGE, DECLARED, COST, REWARD, DONE = range(29, 34)  # the step
INNOVATION_0, INNOVATION_1 = range(34, 36)  # whitened, of the last sample
CARRY, ESTIMATED_CARRY = range(36, 38)  # what rounding took from the speeds
BANK = 38  # three fields for each filter of the bank: its current, its speed, its evidence
BANK_LENGTH = 3
MAX_BANK = 3
N_FIELDS = BANK + BANK_LENGTH * MAX_BANK

# The belief, the statistics' memories and the rewards, common to all lanes.
(F00, F01, F10, F11, G0, G1, H0, H1, K00, K01, K10, K11, W00, W10, W11, C0, C1) = range(17)
MEMORY_FAST, MEMORY_SLOW, INTO_FAST, INTO_SLOW, INTO_EXCESS, N_CHANNELS = range(17, 23)
HORIZON, DELAY_COST, CORRECT, SILENT, FALSE_ALARM, WRONG_KIND, MISS = range(23, 30)
REST_VOLTAGE, PROBE_COST, ENERGY_COST, GROWTH, N_LEVELS = range(30, 35)
ZERO, HALF, ONE = range(35, 38)  # typed as the state is: a literal would make float64 of float32
REST_CURRENT, REST_SPEED = range(38, 40)
N_CONSTANTS = 40
MODEL_LENGTH = 8  # F00 .. H1: a filter of the bank differs from the belief in its model alone
Constants = tuple[float, ...]

# The head of an episode: what is drawn for it, beside its table of fault levels.
HEAD_ONSET, HEAD_KIND, HEAD_SUPPLY, HEAD_CURRENT, HEAD_SPEED, HEAD_EST_CURRENT, HEAD_EST_SPEED = range(7)
HEAD_LENGTH = 7

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
    "evidence_bearing",
    "evidence_winding_contact",
    "evidence_winding_short",
)
"""Everything that can be observed, in the kernel's order."""
FIELD_OF_FEATURE = np.array(
    [
        MEASURED_CURRENT,
        MEASURED_SPEED,
        ESTIMATED_CURRENT,
        ESTIMATED_SPEED,
        WHITE_CURRENT,
        WHITE_SPEED,
        FAST_CURRENT,
        SLOW_CURRENT,
        FAST_SPEED,
        SLOW_SPEED,
        EXCESS,
        VOLTAGE,
        SAMPLE,
        BANK + 2,
        BANK + BANK_LENGTH + 2,
        BANK + 2 * BANK_LENGTH + 2,
    ]
)
NEVER = 1e15


@njit(cache=True, inline="always", error_model="numpy")
def next_sample(s: FloatArray, j: int) -> np.uint64:
    """Number of the next sample of lane j, as the noise takes it."""
    return np.uint64(np.uint32(np.int32(s[j + SAMPLE * LANES]) + 1))


@njit(cache=True, inline="always", error_model="numpy")
def advance(s: FloatArray, j: int, p: Constants, n0: float, n1: float, with_speed: bool) -> None:
    """One sample of lane j of the block s: plant, measurement, filter, statistics, cost of waiting.

    States, measurements and the voltage u stand as deviations from the point at which the belief would rest: float32
    has little to spare beside a speed of 500 rad/s. The rows of the speed hold A - I, and what rounding takes from a
    speed is carried over to the next sample (Kahan 1965), for a speed moves by a hair a sample. n0 and n1 are the
    standard normals of the sample. Without a speed sensor its part is left out (`with_speed` is a literal where this
    is called, so the compiler drops it).

    x[k+1] = A x[k] + B u[k]; z = x[k+1] + v; then predict and update with the gain that the filter converges to, and
    exponentially weighted means of the whitened innovation, each scaled to a standard deviation of 1.
    """
    u = s[j + VOLTAGE * LANES]
    w = u * s[j + SUPPLY * LANES]
    x0, x1 = s[j + CURRENT * LANES], s[j + SPEED * LANES]
    y0 = s[j + A00 * LANES] * x0 + s[j + A01 * LANES] * x1 + s[j + B0 * LANES] * w + s[j + D0 * LANES]
    rise = s[j + A10 * LANES] * x0 + s[j + A11 * LANES] * x1 + s[j + B1 * LANES] * w + s[j + D1 * LANES]
    rise -= s[j + CARRY * LANES]
    y1 = x1 + rise
    s[j + CARRY * LANES] = (y1 - x1) - rise
    s[j + CURRENT * LANES], s[j + SPEED * LANES] = y0, y1
    z0 = y0 + s[j + SIGMA_CURRENT * LANES] * n0
    s[j + MEASURED_CURRENT * LANES] = z0

    v0, v1 = s[j + ESTIMATED_CURRENT * LANES], s[j + ESTIMATED_SPEED * LANES]
    q0 = p[F00] * v0 + p[F01] * v1 + p[G0] * u
    rise = p[F10] * v0 + p[F11] * v1 + p[G1] * u
    d0 = p[C0] * (z0 - q0)
    r0 = p[W00] * d0
    q0, correction, power = q0 + p[K00] * d0, p[K10] * d0, r0 * r0
    fast, slow = p[MEMORY_FAST], p[MEMORY_SLOW]
    if with_speed:
        z1 = y1 + s[j + SIGMA_SPEED * LANES] * n1
        s[j + MEASURED_SPEED * LANES] = z1
        d1 = z1 - v1 - rise
        r1 = p[W10] * d0 + p[W11] * d1
        q0, correction, power = q0 + p[K01] * d1, correction + p[K11] * d1, power + r1 * r1
        s[j + WHITE_SPEED * LANES] += r1
        s[j + INNOVATION_1 * LANES] = r1
        s[j + FAST_SPEED * LANES] = fast * s[j + FAST_SPEED * LANES] + p[INTO_FAST] * r1
        s[j + SLOW_SPEED * LANES] = slow * s[j + SLOW_SPEED * LANES] + p[INTO_SLOW] * r1
    rise += correction - s[j + ESTIMATED_CARRY * LANES]
    q1 = v1 + rise
    s[j + ESTIMATED_CARRY * LANES] = (q1 - v1) - rise
    s[j + ESTIMATED_CURRENT * LANES], s[j + ESTIMATED_SPEED * LANES] = q0, q1
    s[j + WHITE_CURRENT * LANES] += r0
    s[j + INNOVATION_0 * LANES] = r0
    s[j + FAST_CURRENT * LANES] = fast * s[j + FAST_CURRENT * LANES] + p[INTO_FAST] * r0
    s[j + SLOW_CURRENT * LANES] = slow * s[j + SLOW_CURRENT * LANES] + p[INTO_SLOW] * r0
    s[j + EXCESS * LANES] = slow * s[j + EXCESS * LANES] + p[INTO_EXCESS] * (power - p[N_CHANNELS])

    sample = s[j + SAMPLE * LANES]
    delay = p[DELAY_COST] if sample >= s[j + ONSET * LANES] else p[ZERO]
    power = (w + p[REST_VOLTAGE] * s[j + SUPPLY * LANES]) * (y0 + p[REST_CURRENT])
    s[j + COST * LANES] += delay + p[PROBE_COST] * u * u + p[ENERGY_COST] * abs(power)
    s[j + SAMPLE * LANES] = sample + p[ONE]


@njit(cache=True, inline="always", error_model="numpy")
def weigh(s: FloatArray, j: int, m: int, p: Constants, model: Constants) -> None:
    """Filter m of the bank after a sample of lane j: the cumulative sum of its log-likelihood ratio to the belief.

    Each filter believes in one fault. Where its sum falls to 0 it starts anew from the belief's estimate, as though
    the fault set in now (Page 1954, with a signal that depends on the onset: Willsky & Jones 1976).
    """
    at0, at1, evidence = j + m * LANES, j + (m + 1) * LANES, j + (m + 2) * LANES
    u = s[j + VOLTAGE * LANES]
    q0 = model[F00] * s[at0] + model[F01] * s[at1] + model[G0] * u + model[H0]
    q1 = s[at1] + model[F10] * s[at0] + model[F11] * s[at1] + model[G1] * u + model[H1]
    d0, d1 = p[C0] * (s[j + MEASURED_CURRENT * LANES] - q0), p[C1] * (s[j + MEASURED_SPEED * LANES] - q1)
    r0 = p[W00] * d0
    r1 = p[W10] * d0 + p[W11] * d1
    b0, b1 = s[j + INNOVATION_0 * LANES], s[j + INNOVATION_1 * LANES]
    total = s[evidence] + p[HALF] * (b0 * b0 + b1 * b1 - r0 * r0 - r1 * r1)
    goes_on = total > p[ZERO]
    s[evidence] = total if goes_on else p[ZERO]
    q0 += p[K00] * d0 + p[K01] * d1
    q1 += p[K10] * d0 + p[K11] * d1
    s[at0] = q0 if goes_on else s[j + ESTIMATED_CURRENT * LANES]
    s[at1] = q1 if goes_on else s[j + ESTIMATED_SPEED * LANES]


@njit(cache=True, inline="always", error_model="numpy")
def settle(s: FloatArray, j: int, p: Constants, samples: float) -> None:
    """Reward and end of a step of lane j that took so many samples (typed as the state is).

    A declaration ends the episode and is judged by what had been observed before it: a fault that had acted on no
    observed sample cannot be declared rightly. The horizon ends it with a miss, or with the reward of silence.
    """
    onset, declared = s[j + ONSET * LANES], s[j + DECLARED * LANES]
    sample = s[j + SAMPLE * LANES]
    right = p[CORRECT] if declared == s[j + KIND * LANES] else -p[WRONG_KIND]
    verdict = right if sample - samples > onset else -p[FALSE_ALARM]
    silent = -p[MISS] if onset < p[HORIZON] else p[SILENT]
    over = sample >= p[HORIZON]
    waited = (silent if over else p[ZERO]) - s[j + COST * LANES]
    says = declared > p[ZERO]
    s[j + REWARD * LANES] = verdict if says else waited
    s[j + DONE * LANES] = p[ONE] if (says or over) else p[ZERO]


@njit(cache=True, error_model="numpy")
def change_level(s: FloatArray, j: int, table: FloatArray, p: Constants) -> None:
    """Let the fault of lane j reach the levels that are due; `table` holds the motor at each level, healthy first."""
    while s[j + NEXT_CHANGE * LANES] <= s[j + SAMPLE * LANES]:
        level = s[j + LEVEL * LANES] + 1.0
        for f in range(ROW_LENGTH):
            s[j + f * LANES] = table[int(level), f]
        s[j + LEVEL * LANES] = level
        due = s[j + ONSET * LANES] + np.floor(p[GROWTH] * level / p[N_LEVELS])
        s[j + NEXT_CHANGE * LANES] = due if level < p[N_LEVELS] else NEVER


@njit(cache=True, error_model="numpy")
def begin_episode(
    s: FloatArray, j: int, head: FloatArray, table: FloatArray, key: KeyArray, constants: FloatArray
) -> None:
    """Set lane j to the start of an episode, with the measurement of its initial state."""
    for f in range(N_FIELDS):
        s[j + f * LANES] = 0.0
    for f in range(ROW_LENGTH):
        s[j + f * LANES] = table[0, f]
    s[j + CURRENT * LANES], s[j + SPEED * LANES] = head[HEAD_CURRENT], head[HEAD_SPEED]
    s[j + ESTIMATED_CURRENT * LANES] = head[HEAD_EST_CURRENT]
    s[j + ESTIMATED_SPEED * LANES] = head[HEAD_EST_SPEED]
    for m in range(BANK, N_FIELDS, BANK_LENGTH):
        s[j + m * LANES], s[j + (m + 1) * LANES] = head[HEAD_EST_CURRENT], head[HEAD_EST_SPEED]
    s[j + ONSET * LANES], s[j + NEXT_CHANGE * LANES] = head[HEAD_ONSET], head[HEAD_ONSET]
    s[j + KIND * LANES], s[j + SUPPLY * LANES] = head[HEAD_KIND], head[HEAD_SUPPLY]
    n0, n1 = normal_pair(np.uint64(0), key[0], key[1])
    s[j + MEASURED_CURRENT * LANES] = head[HEAD_CURRENT] + table[0, SIGMA_CURRENT] * n0
    s[j + MEASURED_SPEED * LANES] = head[HEAD_SPEED] + table[0, SIGMA_SPEED] * n1


@njit(cache=True, error_model="numpy")
def observe_lane(
    s: FloatArray, j: int, chosen: NDArray[np.int64], view: FloatArray, out: Float32Array
) -> None:
    """Write the chosen features of lane j, scaled and clipped."""
    for m in range(chosen.shape[0]):
        feature = chosen[m]
        value = (s[j + FIELD_OF_FEATURE[feature] * LANES] + view[2, feature]) * view[0, feature]
        bound = view[1, feature]
        out[m] = min(max(value, -bound), bound)


@njit(cache=True, error_model="numpy")
def step_single(
    s: FloatArray,
    table: FloatArray,
    key: KeyArray,
    constants: FloatArray,
    bank: FloatArray,
    view: FloatArray,
    chosen: NDArray[np.int64],
    out: Float32Array,
    offset_v: float,
    declared: int,
    samples: int,
) -> tuple[float, bool]:
    """A step of a single environment, which is lane 0 of a block of its own: reward and end."""
    p = to_fixed_tuple(constants, N_CONSTANTS)
    s[VOLTAGE * LANES], s[DECLARED * LANES], s[COST * LANES] = offset_v, float(declared), 0.0
    s[WHITE_CURRENT * LANES], s[WHITE_SPEED * LANES] = 0.0, 0.0
    for _ in range(samples):
        if s[NEXT_CHANGE * LANES] <= s[SAMPLE * LANES]:
            change_level(s, 0, table, p)
        n0, n1 = normal_pair(next_sample(s, 0), key[0], key[1])
        if p[C1] > 0.0:
            advance(s, 0, p, n0, n1, True)
        else:
            advance(s, 0, p, n0, n1, False)
        for m in range(bank.shape[0]):
            if bank[m, F11] != 0.0:
                model = to_fixed_tuple(bank[m], MODEL_LENGTH)
                weigh(s, 0, BANK + BANK_LENGTH * m, p, model)
    settle(s, 0, p, samples * p[ONE])
    observe_lane(s, 0, chosen, view, out)
    return float(s[REWARD * LANES]), s[DONE * LANES] > 0.0
