"""The compiled step of a vector and of a single environment: blocks of lanes through the kernel, ends and begins.

A single environment is a block of width 1. A lane costs something beside its samples only when its episode ends or
begins, and its block is searched for such lanes only when it has one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from motor_env.envs.drawing import begin_state, draw_episode, set_motor
from motor_env.envs.kernel import (
    BANK,
    BANK_LENGTH,
    BLOCK,
    BOUND,
    C1,
    COST,
    CURRENT,
    DELAY,
    DELAY_COST,
    ERROR_CURRENT,
    ERROR_SPEED,
    ESTIMATED_CURRENT,
    ESTIMATED_SPEED,
    FIELD,
    FULL,
    GROWTH,
    HORIZON,
    LANES,
    LEVEL,
    MEASURED_CURRENT,
    MEASURED_SPEED,
    MODEL_LENGTH,
    N_CHANNELS,
    N_CONSTANTS,
    N_FIELDS,
    N_LEVELS,
    NEVER,
    NEXT_CHANGE,
    NOISE,
    NORMAL_CURRENT,
    NORMAL_SPEED,
    OFFSET,
    ONE,
    ONSET,
    ROWS,
    SAMPLE,
    SCALE,
    SIGMA_CURRENT,
    SIGMA_SPEED,
    SPEED,
    T11,
    VOLTAGE,
    ZERO,
    Constants,
    advance,
    settle,
    weigh,
)
from motor_env.envs.lanes import (
    CASE_LOW,
    DECLARED,
    FAULT_ACTIVE,
    QUIET,
    ROW,
    TERMINATED,
    BoolArray,
    Lanes,
    TaskNumbers,
    unpack_lanes,
    unpack_task,
)
from motor_env.envs.noise import begin_noise, refill
from motor_env.motor.parameters import FloatArray

DECLARE_ABOVE = 0.5
Float32Array = NDArray[np.float32]


@njit(cache=True, error_model="numpy")
def _change_levels(
    s: FloatArray, p: Constants, task: TaskNumbers, lanes: Lanes, first: int, width: int
) -> None:
    """Let the faults of a block reach the levels that are due, and see when the next one is."""
    quiet = p[HORIZON]
    for j in range(width):
        while s[j + NEXT_CHANGE * LANES] <= s[j + SAMPLE * LANES]:
            level = int(s[j + LEVEL * LANES]) + 1
            set_motor(s, j, task, lanes, first + j, level)
            s[j + LEVEL * LANES], s[j + DELAY * LANES] = level, p[DELAY_COST]
            due = s[j + ONSET * LANES] + np.floor(p[GROWTH] * level / p[N_LEVELS])
            s[j + NEXT_CHANGE * LANES] = due if level < p[N_LEVELS] else NEVER
            lanes.flags[FAULT_ACTIVE, first + j] = True
        if s[j + SAMPLE * LANES] < p[HORIZON]:
            quiet = min(quiet, min(s[j + NEXT_CHANGE * LANES], p[HORIZON]) - s[j + SAMPLE * LANES])
    lanes.marks[QUIET, first] = int(quiet)


@njit(cache=True, forceinline=True, error_model="numpy")
def _advance_all(s: FloatArray, p: Constants, row: int, kept: float, width: int) -> None:
    """A sample of a block; four loops, each without what it does not need.

    The normals are copied to a place that the compiler knows: else it cannot tell them from what is written.
    """
    n0, n1 = (NOISE + row) * LANES, (NOISE + row + int(p[N_CHANNELS]) - 1) * LANES
    for j in range(width):
        s[j + NORMAL_CURRENT * LANES] = s[n0 + j]
    if p[C1] > 0.0:
        for j in range(width):
            s[j + NORMAL_SPEED * LANES] = s[n1 + j]
    if p[FULL] > 0.0:
        if p[C1] > 0.0:
            for j in range(width):
                advance(s, j, p, kept, True, True)
        else:
            for j in range(width):
                advance(s, j, p, kept, False, True)
    elif p[C1] > 0.0:
        for j in range(width):
            advance(s, j, p, kept, True, False)
    else:
        for j in range(width):
            advance(s, j, p, kept, False, False)


@njit(cache=True, forceinline=True, error_model="numpy")
def _step_block(
    s: FloatArray,
    p: Constants,
    task: TaskNumbers,
    lanes: Lanes,
    first: int,
    row: int,
    samples: int,
    width: int,
) -> int:
    """The samples of a step for the lanes of one block up to `width`; the next row of noise."""
    channels, kept = int(p[N_CHANNELS]), p[ZERO]
    for _ in range(samples):
        if lanes.marks[QUIET, first] <= 0:
            _change_levels(s, p, task, lanes, first, width)
        lanes.marks[QUIET, first] -= 1
        if row >= ROWS:
            refill(s, lanes.words, first, channels, width)
            row = 0
        _advance_all(s, p, row, kept, width)
        for m in range(task.bank.shape[0]):
            if task.bank[m, T11] != 0.0:
                t = to_fixed_tuple(task.bank[m], MODEL_LENGTH)
                for j in range(width):
                    weigh(s, j, BANK + BANK_LENGTH * m, p, t)
        kept = p[ONE]
        row += channels
    return row


@njit(cache=True, error_model="numpy")
def _begin_lane(s: FloatArray, j: int, task: TaskNumbers, lanes: Lanes, n: int, row: int) -> None:
    """Let lane j of a block, lane n of all, begin its next episode; its noise goes on at that row."""
    lanes.words[CASE_LOW, n] += np.uint32(1)
    for f in range(N_FIELDS):
        s[j + f * LANES] = 0.0
    onset = draw_episode(task, lanes, n)
    s[j + ONSET * LANES] = s[j + NEXT_CHANGE * LANES] = onset
    set_motor(s, j, task, lanes, n, 0)
    begin_state(s, j, task, lanes, n)
    current, speed = s[j + CURRENT * LANES], s[j + SPEED * LANES]
    error_current, error_speed = s[j + ERROR_CURRENT * LANES], s[j + ERROR_SPEED * LANES]
    s[j + ESTIMATED_CURRENT * LANES] = current - error_current
    s[j + ESTIMATED_SPEED * LANES] = speed - error_speed
    for m in range(BANK, N_FIELDS, BANK_LENGTH):
        s[j + m * LANES], s[j + (m + 1) * LANES] = error_current, error_speed
    channels = int(task.constants[N_CHANNELS])
    four = begin_noise(s, lanes.words, n, row, channels)
    s[j + MEASURED_CURRENT * LANES] = current + s[j + SIGMA_CURRENT * LANES] * four[0]
    s[j + MEASURED_SPEED * LANES] = speed + s[j + SIGMA_SPEED * LANES] * four[channels - 1]
    lanes.flags[TERMINATED, n], lanes.flags[FAULT_ACTIVE, n] = False, False
    first = n - j
    soon = int(min(s[j + NEXT_CHANGE * LANES], task.constants[HORIZON]))
    lanes.marks[QUIET, first] = min(lanes.marks[QUIET, first], soon)


@njit(cache=True, error_model="numpy")
def begin_lanes(mask: BoolArray, numbers: FloatArray, prior: FloatArray, *arrays: Any) -> None:
    """Let the lanes of the mask begin their next episodes."""
    task, lanes = unpack_task(numbers, prior), unpack_lanes(*arrays)
    row = lanes.marks[ROW, 0]
    for n in range(mask.shape[0]):
        if mask[n]:
            block, j = n // LANES, n % LANES
            s = lanes.state[block * BLOCK : (block + 1) * BLOCK]
            _begin_lane(s, j, task, lanes, n, row)


@njit(cache=True, forceinline=True, error_model="numpy")
def _observe_block(
    s: FloatArray, view: FloatArray, observation: Float32Array, first: int, width: int
) -> None:
    """Write the observed features of a block, scaled and clipped, one row a feature."""
    for m in range(view.shape[0]):
        scale, bound, offset = view[m, SCALE], view[m, BOUND], view[m, OFFSET]
        at = int(view[m, FIELD]) * LANES
        values, row = s[at : at + LANES], observation[m, first : first + LANES]
        for j in range(width):
            value = (values[j] + offset) * scale
            value = -bound if value < -bound else value
            row[j] = np.float32(bound if value > bound else value)


@njit(cache=True, error_model="numpy")
def observe(observation: Float32Array, numbers: FloatArray, prior: FloatArray, *arrays: Any) -> None:
    """Write the observed features of all lanes, one row a feature."""
    task, lanes = unpack_task(numbers, prior), unpack_lanes(*arrays)
    for first in range(0, observation.shape[1], LANES):
        s = lanes.state[first // LANES * BLOCK : (first // LANES + 1) * BLOCK]
        _observe_block(s, task.features, observation, first, min(LANES, observation.shape[1] - first))


@njit(cache=True, error_model="numpy")
def _finish_block(
    s: FloatArray,
    p: Constants,
    task: TaskNumbers,
    lanes: Lanes,
    first: int,
    width: int,
    row: int,
    samples: int,
    next_step: bool,
    reward: FloatArray,
) -> int:
    """Rewards, ends and begins of the lanes of a block; how many end."""
    n_over = 0
    for j in range(width):
        n = first + j
        if next_step and lanes.flags[TERMINATED, n]:
            _begin_lane(s, j, task, lanes, n, row)
            reward[n] = 0.0
        elif lanes.marks[DECLARED, n] > 0 or s[j + SAMPLE * LANES] >= p[HORIZON]:
            reward[n] = settle(s, j, p, samples, lanes.marks[DECLARED, n])
            lanes.flags[TERMINATED, n] = True
            n_over += 1
    return n_over


@njit(cache=True, error_model="numpy")
def lay_discrete(lanes: Lanes, actions: NDArray[np.int64], offsets_v: FloatArray, n_offsets: int) -> bool:
    """Lay offset and declaration of each action into the lanes; False if an action does not exist.

    `offsets_v` has an entry for each action; the first `n_offsets` are offsets, the others declare (offset 0).
    """
    lowest, highest = 0, 0
    declared = lanes.marks[DECLARED]
    for n in range(actions.shape[0]):
        lowest, highest = min(lowest, actions[n]), max(highest, actions[n])
        declared[n] = max(0, actions[n] - n_offsets + 1)
    if lowest < 0 or highest >= offsets_v.shape[0]:
        return False
    if n_offsets > 1 or offsets_v[0] != 0.0:
        for n in range(actions.shape[0]):
            lanes.state[(n // LANES) * BLOCK + VOLTAGE * LANES + n % LANES] = offsets_v[actions[n]]
    return True


@njit(cache=True, error_model="numpy")
def decode_continuous(action: FloatArray, reach_v: float) -> tuple[float, int]:
    """Offset of the voltage, and declaration, of an action (offset, then one entry a kind), clipped to -1 .. 1."""
    best, declared = DECLARE_ABOVE, 0
    for m in range(1, action.shape[0]):
        if action[m] > best:
            best, declared = action[m], m
    offset = min(max(action[0], -1.0), 1.0) * reach_v
    return (0.0 if declared > 0 else offset), declared


@njit(cache=True, error_model="numpy")
def _step_lanes(
    task: TaskNumbers,
    lanes: Lanes,
    samples: int,
    next_step: bool,
    observation: Float32Array,
    reward: FloatArray,
    n_envs: int,
) -> int:
    """A step of all lanes, whose actions lie in them: writes observations and rewards; how many are over now."""
    p = to_fixed_tuple(task.constants, N_CONSTANTS)
    n_over, row = 0, lanes.marks[ROW, 0]
    next_row = row
    for first in range(0, reward.shape[0], LANES):
        s = lanes.state[first // LANES * BLOCK : (first // LANES + 1) * BLOCK]
        next_row = _step_block(s, p, task, lanes, first, row, samples, LANES)
        rewards, something = reward[first : first + LANES], 0
        over, declared = (
            lanes.flags[TERMINATED, first : first + LANES],
            lanes.marks[DECLARED, first : first + LANES],
        )
        for j in range(LANES):
            rewards[j] = -s[j + COST * LANES]
        for j in range(LANES):
            something |= declared[j] | np.int32(over[j])
        if something != 0 or lanes.marks[QUIET, first] <= 0:
            width = min(LANES, n_envs - first)
            n_over += _finish_block(s, p, task, lanes, first, width, next_row, samples, next_step, reward)
        _observe_block(s, task.features, observation, first, LANES)
    lanes.marks[ROW, 0] = next_row
    return n_over


@njit(cache=True, error_model="numpy")
def step_discrete(
    actions: NDArray[np.int64],
    offsets_v: FloatArray,
    n_offsets: int,
    samples: int,
    next_step: bool,
    observation: Float32Array,
    reward: FloatArray,
    numbers: FloatArray,
    prior: FloatArray,
    *arrays: Any,
) -> int:
    """A step of all lanes with the number of an action for each; how many are over, -1 if an action does not exist."""
    task, lanes = unpack_task(numbers, prior), unpack_lanes(*arrays)
    if not lay_discrete(lanes, actions, offsets_v, n_offsets):
        return -1
    return int(_step_lanes(task, lanes, samples, next_step, observation, reward, len(actions)))


@njit(cache=True, error_model="numpy")
def step_continuous(
    actions: FloatArray,
    reach_v: float,
    samples: int,
    next_step: bool,
    observation: Float32Array,
    reward: FloatArray,
    numbers: FloatArray,
    prior: FloatArray,
    *arrays: Any,
) -> int:
    """A step of all lanes with a row of actions for each, see `decode_continuous`; how many are over."""
    task, lanes = unpack_task(numbers, prior), unpack_lanes(*arrays)
    for n in range(actions.shape[0]):
        offset_v, declared = decode_continuous(actions[n], reach_v)
        lanes.state[(n // LANES) * BLOCK + VOLTAGE * LANES + n % LANES] = offset_v
        lanes.marks[DECLARED, n] = declared
    return int(_step_lanes(task, lanes, samples, next_step, observation, reward, len(actions)))


@njit(cache=True, error_model="numpy")
def step_single(
    offset_v: float,
    declared: int,
    samples: int,
    observation: Float32Array,
    numbers: FloatArray,
    prior: FloatArray,
    *arrays: Any,
) -> tuple[float, bool, bool]:
    """A step of a single environment, which is lane 0 of a block of its own: reward, end, and whether a fault acts."""
    task, lanes = unpack_task(numbers, prior), unpack_lanes(*arrays)
    p, s = to_fixed_tuple(task.constants, N_CONSTANTS), lanes.state
    s[VOLTAGE * LANES] = offset_v
    lanes.marks[ROW, 0] = _step_block(s, p, task, lanes, 0, lanes.marks[ROW, 0], samples, 1)
    over = declared > 0 or s[SAMPLE * LANES] >= p[HORIZON]
    reward = settle(s, 0, p, samples, declared) if over else float(-s[COST * LANES])
    _observe_block(s, task.features, observation.reshape((-1, 1)), 0, 1)
    return reward, over, lanes.flags[FAULT_ACTIVE, 0]
