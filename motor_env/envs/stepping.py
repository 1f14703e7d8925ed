"""The compiled step of a vector and of a single environment: blocks of lanes through the kernel, ends and begins.

A single environment is a block of width 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import kernel, layout
from motor_env.envs.episode_sampling import begin_noise, begin_state, draw_episode, refill, set_motor
from motor_env.envs.layout import (
    LANES,
    MODEL_LENGTH,
    N_CONSTANTS,
    ROWS,
    Block,
    BoolArray,
    Constants,
    Lanes,
    Model,
    TaskNumbers,
    block_of,
    fixed_tuple,
    unpack_task,
)
from motor_env.motor.compiled import compiled, inlined
from motor_env.motor.parameters import FloatArray

DECLARE_ABOVE = 0.5
Float32Array = NDArray[np.float32]


@compiled
def _change_levels(s: Block, p: Constants, task: TaskNumbers, lanes: Lanes, first: int, width: int) -> None:
    """Let the faults of a block reach the levels that are due, and note when the next one is."""
    quiet = p.horizon
    for j in range(width):
        while s.next_change[j] <= s.time[j]:
            level = int(s.level[j]) + 1
            set_motor(s, j, task, lanes, first + j, level)
            s.level[j] = level
            due = s.onset[j] + np.floor(p.growth * level / p.n_levels)
            s.next_change[j] = due if level < p.n_levels else layout.NEVER
            lanes.flags[layout.FAULT_ACTIVE, first + j] = True
        if s.time[j] < p.horizon:
            quiet = min(quiet, min(s.next_change[j], p.horizon) - s.time[j])
    lanes.marks[layout.QUIET, first] = int(quiet)


T11 = Model._fields.index("t11")


@inlined
def _advance_all(s: Block, p: Constants, row: int, kept: float, width: int) -> None:
    """Advance a block by a sample; four loops, each without what it does not need.

    The normals are copied to a fixed row, so that the compiler knows that nothing written overlaps them. What a loop
    leaves out are constants, but no literals: numba would compile the equations once for each.
    """
    yes, no = np.bool_(True), np.bool_(False)
    speed_row = row + int(p.n_channels) - 1
    for j in range(width):
        s.normal_current[j] = s.noise[row, j]
    if p.c1 > 0.0:
        for j in range(width):
            s.normal_speed[j] = s.noise[speed_row, j]
    if p.full > 0.0:
        if p.c1 > 0.0:
            for j in range(width):
                kernel.advance(s, j, p, kept, yes, yes)
        else:
            for j in range(width):
                kernel.advance(s, j, p, kept, no, yes)
    elif p.c1 > 0.0:
        for j in range(width):
            kernel.advance(s, j, p, kept, yes, no)
    else:
        for j in range(width):
            kernel.advance(s, j, p, kept, no, no)


@inlined
def _step_block(
    s: Block,
    p: Constants,
    task: TaskNumbers,
    lanes: Lanes,
    first: int,
    row: int,
    samples: int,
    width: int,
) -> int:
    """Advance the first `width` lanes of a block by the samples of a step; return the next row of noise."""
    channels, kept = int(p.n_channels), p.zero
    for j in range(width):
        s.energy_due[j] += s.energy[j]
    for _ in range(samples):
        if lanes.marks[layout.QUIET, first] <= 0:
            _change_levels(s, p, task, lanes, first, width)
        lanes.marks[layout.QUIET, first] -= 1
        if row >= ROWS:
            refill(s, lanes.words, first, channels, width)
            row = 0
        _advance_all(s, p, row, kept, width)
        if p.loop_i > 0.0:
            for j in range(width):
                kernel.hold_speed(s, j, p)
        for m in range(task.bank.shape[0]):
            if task.bank[m, T11] != 0.0:
                t = Model(*fixed_tuple(task.bank[m], MODEL_LENGTH))
                for j in range(width):
                    kernel.weigh(s, j, m, p, t)
        kept = p.one
        row += channels
    return row


@inlined
def _begin_lane(s: Block, j: int, task: TaskNumbers, lanes: Lanes, n: int, row: int) -> None:
    """Begin the next episode of lane j of a block, lane n of all; its noise goes on at that row."""
    layout.begin_episode(lanes.words, lanes.flags, n)
    for f in range(layout.N_FIELDS):
        s.rows[f, j] = 0.0
    onset = draw_episode(task, lanes, n)
    s.onset[j] = s.next_change[j] = onset
    set_motor(s, j, task, lanes, n, np.int64(0))
    begin_state(s, j, task, lanes, n)
    current, speed = s.current[j], s.speed[j]
    error_current, error_speed = s.error_current[j], s.error_speed[j]
    s.estimated_current[j] = current - error_current
    s.estimated_speed[j] = speed - error_speed
    for m in range(layout.MAX_BANK):
        s.bank_current[m, j], s.bank_speed[m, j] = error_current, error_speed
    p = Constants(*fixed_tuple(task.constants, N_CONSTANTS))
    channels = int(p.n_channels)
    four = begin_noise(s, lanes.words, n, row, channels)
    s.measured_current[j] = current + s.sigma_current[j] * four[0]
    s.measured_speed[j] = speed + s.sigma_speed[j] * four[channels - 1]
    lanes.marks[layout.TIMES, n] = 0
    first = n - j
    soon = int(min(s.next_change[j], p.horizon))
    lanes.marks[layout.QUIET, first] = min(lanes.marks[layout.QUIET, first], soon)


@compiled
def begin_lanes(mask: BoolArray, numbers: FloatArray, prior: FloatArray, *arrays: Any) -> None:
    """Begin the next episodes of the lanes in the mask."""
    task, lanes = unpack_task(numbers, prior), Lanes(*arrays)
    row = np.int64(lanes.marks[layout.ROW, 0])  # as in a step, so that a begin is compiled once
    for n in range(mask.shape[0]):
        if mask[n]:
            _begin_lane(block_of(lanes.state, n // LANES), n % LANES, task, lanes, n, row)


@inlined
def _observe_block(s: Block, view: FloatArray, observation: Float32Array, first: int, width: int) -> None:
    """Write the observed features of a block, scaled and clipped, one row a feature."""
    for m in range(view.shape[0]):
        scale, bound, offset = view[m, layout.SCALE], view[m, layout.BOUND], view[m, layout.OFFSET]
        values, row = s.rows[int(view[m, layout.FIELD])], observation[m, first : first + LANES]
        for j in range(width):
            value = (values[j] + offset) * scale
            value = -bound if value < -bound else value
            row[j] = np.float32(bound if value > bound else value)


@compiled
def observe(observation: Float32Array, numbers: FloatArray, prior: FloatArray, *arrays: Any) -> None:
    """Write the observed features of all lanes, one row a feature."""
    task, lanes = unpack_task(numbers, prior), Lanes(*arrays)
    for first in range(0, observation.shape[1], LANES):
        s = block_of(lanes.state, first // LANES)
        _observe_block(s, task.features, observation, first, min(LANES, observation.shape[1] - first))


@inlined
def _pay_step(s: Block, p: Constants, samples: int, parts: FloatArray, first: int, width: int) -> None:
    """Pay what the agent itself has spent in a step: its probe. The rest is due where the episode ends.

    What depends on the fault would tell the onset at once to whoever sees the last reward.
    """
    for m in range(parts.shape[0]):
        row = parts[m, first : first + width]
        for j in range(width):
            row[j] = 0.0
    if parts.shape[0] > 2:
        probe = parts[2, first : first + width]
        for j in range(width):
            probe[j] = -p.probe_cost * s.voltage[j] * s.voltage[j] * samples


@inlined
def _settle(s: Block, j: int, p: Constants, samples: int, declared: int, parts: FloatArray, n: int) -> float:
    """Pay the end of the episode of lane j of a block, lane n of all: verdict, delay and energy.

    The step that declares counts neither as a delay nor as energy.
    """
    acting = s.time[j] - s.onset[j] - (samples if declared > 0 else 0)
    parts[0, n] = kernel.settle(s, j, p, samples, declared)
    parts[1, n] = -p.delay_cost * max(acting, p.zero)
    total = parts[0, n] + parts[1, n]
    if parts.shape[0] > 2:
        parts[3, n] = -s.energy_due[j] - (p.zero if declared > 0 else s.energy[j])
        total += parts[2, n] + parts[3, n]
    return float(total)


@inlined
def _finish_block(
    s: Block,
    p: Constants,
    task: TaskNumbers,
    lanes: Lanes,
    first: int,
    width: int,
    row: int,
    samples: int,
    next_step: bool,
    reward: FloatArray,
    parts: FloatArray,
) -> int:
    """Write rewards, ends and begins of a block; return how many episodes end."""
    n_over = 0
    for j in range(width):
        n = first + j
        if next_step and lanes.flags[layout.TERMINATED, n]:
            _begin_lane(s, j, task, lanes, n, row)
            reward[n] = 0.0
            for m in range(parts.shape[0]):
                parts[m, n] = 0.0
        elif lanes.marks[layout.DECLARED, n] > 0 or s.time[j] >= p.horizon:
            reward[n] = _settle(s, j, p, samples, lanes.marks[layout.DECLARED, n], parts, n)
            lanes.flags[layout.TERMINATED, n] = True
            n_over += 1
    return n_over


@inlined
def lay_discrete(lanes: Lanes, actions: NDArray[np.int64], offsets_v: FloatArray, n_offsets: int) -> bool:
    """Write offset and declaration of each action into the lanes; False if an action does not exist.

    `offsets_v` has an entry for each action; those after the first `n_offsets` declare.
    """
    lowest, highest = 0, 0
    declared = lanes.marks[layout.DECLARED]
    for n in range(actions.shape[0]):
        lowest, highest = min(lowest, actions[n]), max(highest, actions[n])
        declared[n] = max(0, actions[n] - n_offsets + 1)
    if lowest < 0 or highest >= offsets_v.shape[0]:
        return False
    if n_offsets > 1 or offsets_v[0] != 0.0:
        for n in range(actions.shape[0]):
            block_of(lanes.state, n // LANES).voltage[n % LANES] = offsets_v[actions[n]]
    return True


@compiled
def decode_continuous(action: FloatArray, reach_v: float) -> tuple[float, int]:
    """Voltage offset and declaration of an action (offset, then one entry a kind), clipped to -1 .. 1."""
    best, declared = DECLARE_ABOVE, 0
    for m in range(1, action.shape[0]):
        if action[m] > best:
            best, declared = action[m], m
    offset = min(max(action[0], -1.0), 1.0) * reach_v
    return (0.0 if declared > 0 else offset), declared


@inlined
def _confirm(p: Constants, lanes: Lanes, samples: int, n_envs: int) -> None:
    """Drop declarations not yet chosen often enough in a row, except in the last step of an episode."""
    times, chosen, declared = (
        lanes.marks[layout.TIMES],
        lanes.marks[layout.CHOSEN],
        lanes.marks[layout.DECLARED],
    )
    for n in range(n_envs):
        times[n] = times[n] + 1 if declared[n] == chosen[n] else 1
        chosen[n] = declared[n]
        sample = block_of(lanes.state, n // LANES).time[n % LANES]
        if times[n] < p.confirm and sample + samples < p.horizon:
            declared[n] = 0


@inlined
def _step_lanes(
    lanes: Lanes,
    n_envs: int,
    samples: int,
    next_step: bool,
    observation: Float32Array,
    reward: FloatArray,
    parts: FloatArray,
    numbers: FloatArray,
    prior: FloatArray,
) -> int:
    """Step all lanes, whose actions lie in them: write observations and rewards; return how many are over."""
    task = unpack_task(numbers, prior)
    p = Constants(*fixed_tuple(task.constants, N_CONSTANTS))
    if p.confirm > 1.0:
        _confirm(p, lanes, samples, n_envs)
    n_over, row = 0, lanes.marks[layout.ROW, 0]
    next_row = row
    for first in range(0, reward.shape[0], LANES):
        s = block_of(lanes.state, first // LANES)
        next_row = _step_block(s, p, task, lanes, first, row, samples, LANES)
        rewards, something = reward[first : first + LANES], 0
        over, declared = (
            lanes.flags[layout.TERMINATED, first : first + LANES],
            lanes.marks[layout.DECLARED, first : first + LANES],
        )
        _pay_step(s, p, samples, parts, first, LANES)
        for j in range(LANES):
            rewards[j] = parts[2, first + j] if parts.shape[0] > 2 else 0.0
        for j in range(LANES):
            something |= declared[j] | np.int32(over[j])
        if something != 0 or lanes.marks[layout.QUIET, first] <= 0:
            width = min(LANES, n_envs - first)
            n_over += _finish_block(
                s, p, task, lanes, first, width, next_row, samples, next_step, reward, parts
            )
        _observe_block(s, task.features, observation, first, LANES)
    lanes.marks[layout.ROW, 0] = next_row
    return n_over


@compiled
def step_discrete(
    actions: NDArray[np.int64],
    offsets_v: FloatArray,
    n_offsets: int,
    samples: int,
    next_step: bool,
    *arrays: Any,
) -> int:
    """Step all lanes with an action number each; how many are over, -1 if an action does not exist.

    `arrays` are those that `_step_lanes` writes, the task, and the lanes.
    """
    lanes = Lanes(*arrays[5:])
    if not lay_discrete(lanes, actions, offsets_v, n_offsets):
        return -1
    return int(_step_lanes(lanes, len(actions), samples, next_step, *arrays[:5]))


@compiled
def step_continuous(actions: FloatArray, reach_v: float, samples: int, next_step: bool, *arrays: Any) -> int:
    """Step all lanes with a row of actions each, see `decode_continuous`; return how many are over."""
    lanes = Lanes(*arrays[5:])
    for n in range(actions.shape[0]):
        offset_v, declared = decode_continuous(actions[n], reach_v)
        block_of(lanes.state, n // LANES).voltage[n % LANES] = offset_v
        lanes.marks[layout.DECLARED, n] = declared
    return int(_step_lanes(lanes, len(actions), samples, next_step, *arrays[:5]))


@compiled
def step_single(
    offset_v: float,
    declared: int,
    samples: int,
    observation: Float32Array,
    parts: FloatArray,
    numbers: FloatArray,
    prior: FloatArray,
    *arrays: Any,
) -> tuple[float, bool, bool, tuple[float, ...]]:
    """Step a single environment, lane 0 of a block of its own; writes `parts`, shape (4, 1).

    Returns:
        Reward, end, whether a fault acts, and the four parts of the reward.
    """
    task, lanes = unpack_task(numbers, prior), Lanes(*arrays)
    p, s = Constants(*fixed_tuple(task.constants, N_CONSTANTS)), block_of(lanes.state, 0)
    s.voltage[0], lanes.marks[layout.DECLARED, 0] = offset_v, declared
    if p.confirm > 1.0:
        _confirm(p, lanes, samples, 1)
        declared = lanes.marks[layout.DECLARED, 0]
    lanes.marks[layout.ROW, 0] = _step_block(s, p, task, lanes, 0, lanes.marks[layout.ROW, 0], samples, 1)
    _pay_step(s, p, samples, parts, 0, 1)
    over = declared > 0 or s.time[0] >= p.horizon
    reward = _settle(s, 0, p, samples, declared, parts, 0) if over else parts[2, 0]
    _observe_block(s, task.features, observation.reshape((-1, 1)), 0, 1)
    return (
        reward,
        over,
        lanes.flags[layout.FAULT_ACTIVE, 0],
        (parts[0, 0], parts[1, 0], parts[2, 0], parts[3, 0]),
    )
