"""The step of the environments, compiled once for all: plant, noise, filter, statistics, reward, end.

`_advance` is the one place where a sample is made: it takes one lane (one sub-environment) from sample k to k + 1. The
single environment runs it over one lane, a vector over blocks of `LANES` lanes. The matrices come from
`motor_env.model.discretize`, the gain from `motor_env.kalman`; the kernel multiplies and adds.

State lies in blocks, `state[block, field, lane]`, flat: all lanes of a block stand side by side at distances that the
compiler knows, so that it computes several lanes with one instruction, and a block fits into the first-level cache.
"""

from __future__ import annotations

import numpy as np
from numba import njit
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
N_FIELDS = 34

# The belief, the statistics' memories and the rewards, common to all lanes.
(F00, F01, F10, F11, G0, G1, H0, H1, K00, K01, K10, K11, W00, W10, W11, C0, C1) = range(17)
MEMORY_FAST, MEMORY_SLOW, N_CHANNELS = range(17, 20)
HORIZON, DELAY_COST, CORRECT, SILENT, FALSE_ALARM, WRONG_KIND, MISS = range(20, 27)
REST_VOLTAGE, PROBE_COST, ENERGY_COST, GROWTH, N_LEVELS, DT = range(27, 33)
N_CONSTANTS = 33

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
)
"""Everything that can be observed, in the kernel's order."""
_FIELD_OF_FEATURE = np.array(
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
    ]
)
NEVER = 1e15
_TWO_52 = 2.0**52
_MANTISSA = np.uint64(0x000FFFFFFFFFFFFF)


@njit(cache=True, inline="always", error_model="numpy")
def _as_word(count: float) -> np.uint64:
    """A count held in a float, as an integer, by the way that the compiler can take for several at once."""
    return np.float64(count + _TWO_52).view(np.uint64) & _MANTISSA


@njit(cache=True, inline="always", error_model="numpy")
def _advance(s: FloatArray, b: int, j: int, p: FloatArray, key_low: np.uint64, key_high: np.uint64) -> None:
    """One sample of lane j of the block that begins at `b`: plant, measurement, filter, statistics, cost of waiting.

    x[k+1] = A x[k] + B u[k]; z = x[k+1] + v; then predict and update with the gain that the filter converges to, and
    exponentially weighted means of the whitened innovation, each scaled to a standard deviation of 1.
    """
    i = b + j
    v = s[i + VOLTAGE * LANES]
    driven = v * s[i + SUPPLY * LANES]
    x0, x1 = s[i + CURRENT * LANES], s[i + SPEED * LANES]
    y0 = s[i + A00 * LANES] * x0 + s[i + A01 * LANES] * x1 + s[i + B0 * LANES] * driven + s[i + D0 * LANES]
    y1 = s[i + A10 * LANES] * x0 + s[i + A11 * LANES] * x1 + s[i + B1 * LANES] * driven + s[i + D1 * LANES]
    s[i + CURRENT * LANES], s[i + SPEED * LANES] = y0, y1

    sample = s[i + SAMPLE * LANES]
    n0, n1 = normal_pair(_as_word(sample + 1.0), key_low, key_high)
    z0 = y0 + s[i + SIGMA_CURRENT * LANES] * n0
    z1 = y1 + s[i + SIGMA_SPEED * LANES] * n1
    s[i + MEASURED_CURRENT * LANES], s[i + MEASURED_SPEED * LANES] = z0, z1

    e0, e1 = s[i + ESTIMATED_CURRENT * LANES], s[i + ESTIMATED_SPEED * LANES]
    q0 = p[F00] * e0 + p[F01] * e1 + p[G0] * v + p[H0]
    q1 = p[F10] * e0 + p[F11] * e1 + p[G1] * v + p[H1]
    d0, d1 = p[C0] * (z0 - q0), p[C1] * (z1 - q1)
    s[i + ESTIMATED_CURRENT * LANES] = q0 + p[K00] * d0 + p[K01] * d1
    s[i + ESTIMATED_SPEED * LANES] = q1 + p[K10] * d0 + p[K11] * d1
    r0 = p[W00] * d0
    r1 = p[W10] * d0 + p[W11] * d1
    s[i + WHITE_CURRENT * LANES] += r0
    s[i + WHITE_SPEED * LANES] += r1

    fast, slow = p[MEMORY_FAST], p[MEMORY_SLOW]
    fast_in, slow_in = np.sqrt(1.0 - fast * fast), np.sqrt(1.0 - slow * slow)
    s[i + FAST_CURRENT * LANES] = fast * s[i + FAST_CURRENT * LANES] + fast_in * r0
    s[i + SLOW_CURRENT * LANES] = slow * s[i + SLOW_CURRENT * LANES] + slow_in * r0
    s[i + FAST_SPEED * LANES] = fast * s[i + FAST_SPEED * LANES] + fast_in * r1
    s[i + SLOW_SPEED * LANES] = slow * s[i + SLOW_SPEED * LANES] + slow_in * r1
    excess = (r0 * r0 + r1 * r1 - p[N_CHANNELS]) / np.sqrt(2.0 * p[N_CHANNELS])
    s[i + EXCESS * LANES] = slow * s[i + EXCESS * LANES] + slow_in * excess

    delay = p[DELAY_COST] if sample >= s[i + ONSET * LANES] else 0.0
    away = v - p[REST_VOLTAGE]
    s[i + COST * LANES] += delay + p[PROBE_COST] * away * away + p[ENERGY_COST] * abs(driven * y0)
    s[i + SAMPLE * LANES] = sample + 1.0


@njit(cache=True, inline="always", error_model="numpy")
def _settle(s: FloatArray, b: int, j: int, p: FloatArray, begun: float) -> None:
    """Reward and end of a step of lane j whose first sample was number `begun`.

    A declaration ends the episode and is judged by what had been observed before it: a fault that had acted on no
    observed sample cannot be declared rightly. The horizon ends it with a miss, or with the reward of silence.
    """
    i = b + j
    onset, declared = s[i + ONSET * LANES], s[i + DECLARED * LANES]
    seen = begun > onset
    right = p[CORRECT] if declared == s[i + KIND * LANES] else -p[WRONG_KIND]
    verdict = right if seen else -p[FALSE_ALARM]
    silent = -p[MISS] if onset < p[HORIZON] else p[SILENT]
    over = s[i + SAMPLE * LANES] >= p[HORIZON]
    waited = (silent if over else 0.0) - s[i + COST * LANES]
    says = declared > 0.0
    s[i + REWARD * LANES] = verdict if says else waited
    s[i + DONE * LANES] = 1.0 if (says or over) else 0.0


@njit(cache=True, error_model="numpy")
def change_level(s: FloatArray, i: int, table: FloatArray, p: FloatArray) -> None:
    """Let the fault of lane i reach the levels that are due; `table` holds the motor at each level, healthy first."""
    while s[i + NEXT_CHANGE * LANES] <= s[i + SAMPLE * LANES]:
        level = s[i + LEVEL * LANES] + 1.0
        for f in range(ROW_LENGTH):
            s[i + f * LANES] = table[int(level), f]
        s[i + LEVEL * LANES] = level
        due = s[i + ONSET * LANES] + np.floor(p[GROWTH] * level / p[N_LEVELS])
        s[i + NEXT_CHANGE * LANES] = due if level < p[N_LEVELS] else NEVER


@njit(cache=True, error_model="numpy")
def begin_episode(
    s: FloatArray, i: int, head: FloatArray, table: FloatArray, key: KeyArray, p: FloatArray
) -> None:
    """Set lane i to the start of an episode, with the measurement of its initial state."""
    for f in range(N_FIELDS):
        s[i + f * LANES] = 0.0
    for f in range(ROW_LENGTH):
        s[i + f * LANES] = table[0, f]
    s[i + CURRENT * LANES], s[i + SPEED * LANES] = head[HEAD_CURRENT], head[HEAD_SPEED]
    s[i + ESTIMATED_CURRENT * LANES] = head[HEAD_EST_CURRENT]
    s[i + ESTIMATED_SPEED * LANES] = head[HEAD_EST_SPEED]
    s[i + ONSET * LANES], s[i + NEXT_CHANGE * LANES] = head[HEAD_ONSET], head[HEAD_ONSET]
    s[i + KIND * LANES], s[i + SUPPLY * LANES] = head[HEAD_KIND], head[HEAD_SUPPLY]
    s[i + VOLTAGE * LANES] = p[REST_VOLTAGE]
    n0, n1 = normal_pair(np.uint64(0), key[0], key[1])
    s[i + MEASURED_CURRENT * LANES] = head[HEAD_CURRENT] + table[0, SIGMA_CURRENT] * n0
    s[i + MEASURED_SPEED * LANES] = head[HEAD_SPEED] + table[0, SIGMA_SPEED] * n1


@njit(cache=True, error_model="numpy")
def observe_lane(
    s: FloatArray, i: int, chosen: NDArray[np.int64], scale: FloatArray, bound: FloatArray, out: Float32Array
) -> None:
    """Write the chosen features of lane i, scaled and clipped."""
    for m in range(chosen.shape[0]):
        feature = chosen[m]
        value = s[i + _FIELD_OF_FEATURE[feature] * LANES] * scale[feature]
        out[m] = min(max(value, -bound[feature]), bound[feature])


@njit(cache=True, error_model="numpy")
def step_single(
    s: FloatArray,
    table: FloatArray,
    key: KeyArray,
    p: FloatArray,
    view: FloatArray,
    chosen: NDArray[np.int64],
    voltage_v: float,
    declared: float,
    samples: int,
    out: Float32Array,
) -> tuple[float, bool]:
    """A step of a single environment, which is lane 0 of a block of its own: reward and end."""
    begun = s[SAMPLE * LANES]
    s[VOLTAGE * LANES], s[DECLARED * LANES], s[COST * LANES] = voltage_v, declared, 0.0
    s[WHITE_CURRENT * LANES] = s[WHITE_SPEED * LANES] = 0.0
    for _ in range(samples):
        if s[NEXT_CHANGE * LANES] <= s[SAMPLE * LANES]:
            change_level(s, 0, table, p)
        _advance(s, 0, 0, p, key[0], key[1])
    _settle(s, 0, 0, p, begun)
    observe_lane(s, 0, chosen, view[0], view[1], out)
    return s[REWARD * LANES], s[DONE * LANES] > 0.0
