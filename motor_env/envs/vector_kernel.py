"""The compiled step over a vector of environments: the lanes of `motor_env.envs.kernel`, block by block."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from motor_env.envs.kernel import (
    BANK,
    BANK_LENGTH,
    BOUND,
    C1,
    COST,
    FIELD,
    FULL,
    HEAD_ONSET,
    HORIZON,
    MODEL_LENGTH,
    N_CHANNELS,
    N_CONSTANTS,
    N_FIELDS,
    NEVER,
    NEXT_CHANGE,
    OFFSET,
    ONE,
    SAMPLE,
    SCALE,
    T11,
    VOLTAGE,
    ZERO,
    Constants,
    advance,
    begin_episode,
    change_level,
    settle,
    weigh,
)
from motor_env.envs.noise import EPISODE, LANES, Float32Array, WordArray, fill_lane, refill
from motor_env.motor.parameters import FloatArray

BLOCK = N_FIELDS * LANES
DEPTH = 8
"""Episodes of a lane that are kept in a ring: the one that runs, and the next ones as far as they have been drawn."""
DECLARE_ABOVE = 0.5
ByteArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]
CountArray = NDArray[np.int32]

# Rows of a lane's counts: the place of its episode in the ring, how many after it have been drawn, its number; in the
# first lane of a block, how many samples it has until a fault of one of its lanes changes or an episode ends or begins,
# and whether one declares; then the class of each episode in the ring.
SLOT, READY, NUMBER, QUIET, TALKS, RING = range(6)
# Rows of the flags and of the truth, of which each step hands out a copy.
TERMINATED, TRUNCATED, FAULT_ACTIVE, KNOWN = range(4)
CLASS_INDEX, RUNNING_ONSET = range(2)


@njit(cache=True, error_model="numpy")
def _change_levels(
    s: FloatArray, p: Constants, episodes: FloatArray, counts: CountArray, flags: BoolArray, first: int
) -> None:
    """Let the faults of a block grow where they are due, and see when the next one is."""
    quiet = p[HORIZON]
    for j in range(LANES):
        if s[j + NEXT_CHANGE * LANES] <= s[j + SAMPLE * LANES]:
            change_level(s, j, episodes[counts[SLOT, j], j], p)
            flags[FAULT_ACTIVE, first + j] = True
        if flags[TERMINATED, first + j]:
            quiet = p[ZERO]
        elif s[j + SAMPLE * LANES] < p[HORIZON]:
            quiet = min(quiet, min(s[j + NEXT_CHANGE * LANES], p[HORIZON]) - s[j + SAMPLE * LANES])
    counts[QUIET, 0] = int(quiet)


@njit(cache=True, forceinline=True, error_model="numpy")
def _refill(s: FloatArray, noise: Float32Array, names: WordArray, channels: int) -> None:
    first = np.empty(LANES, dtype=np.uint32)
    for j in range(LANES):
        first[j] = np.uint32((np.int32(s[j + SAMPLE * LANES]) + 1) * channels)
    refill(noise, names, first)


@njit(cache=True, forceinline=True, error_model="numpy")
def _advance_all(s: FloatArray, p: Constants, n0: Float32Array, n1: Float32Array, kept: float) -> None:
    """A sample of a block; four loops, each without what it does not need."""
    if p[FULL] > 0.0:
        if p[C1] > 0.0:
            for j in range(LANES):
                advance(s, j, p, n0[j], n1[j], kept, True, True)
        else:
            for j in range(LANES):
                advance(s, j, p, n0[j], n1[j], kept, False, True)
    elif p[C1] > 0.0:
        for j in range(LANES):
            advance(s, j, p, n0[j], n1[j], kept, True, False)
    else:
        for j in range(LANES):
            advance(s, j, p, n0[j], n1[j], kept, False, False)


@njit(cache=True, forceinline=True, error_model="numpy")
def step_block(
    s: FloatArray,
    p: Constants,
    bank: FloatArray,
    noise: Float32Array,
    row: int,
    names: WordArray,
    episodes: FloatArray,
    counts: CountArray,
    flags: BoolArray,
    first: int,
    samples: int,
) -> int:
    """The samples of a step for the lanes of one block; the next row of noise."""
    channels, kept = int(p[N_CHANNELS]), p[ZERO]
    for _ in range(samples):
        if counts[QUIET, 0] <= 0:
            _change_levels(s, p, episodes, counts, flags, first)
        counts[QUIET, 0] -= 1
        if row == noise.shape[0]:
            _refill(s, noise, names, channels)
            row = 0
        _advance_all(s, p, noise[row], noise[row + channels - 1], kept)
        for m in range(bank.shape[0]):
            if bank[m, T11] != 0.0:
                t = to_fixed_tuple(bank[m], MODEL_LENGTH)
                for j in range(LANES):
                    weigh(s, j, BANK + BANK_LENGTH * m, p, t)
        kept = p[ONE]
        row += channels
    return row


@njit(cache=True, error_model="numpy")
def begin_lane(
    s: FloatArray,
    j: int,
    noise: Float32Array,
    row: int,
    names: WordArray,
    constants: FloatArray,
    episodes: FloatArray,
    counts: CountArray,
    flags: BoolArray,
    truth: CountArray,
    n: int,
) -> None:
    """Let lane j of a block, lane n of all, begin the episode drawn for it; its noise goes on at that row."""
    slot = (counts[SLOT, j] + 1) % DEPTH
    counts[SLOT, j] = slot
    counts[READY, j] -= 1
    counts[NUMBER, j] += 1
    names[EPISODE, j] = counts[NUMBER, j]
    episode = episodes[slot, j]
    begin_episode(s, j, episode, names, constants)
    fill_lane(noise, j, names, row, int(constants[N_CHANNELS]))
    truth[CLASS_INDEX, n] = counts[RING + slot, j]
    truth[RUNNING_ONSET, n] = int(episode[HEAD_ONSET]) if episode[HEAD_ONSET] < NEVER else -1
    flags[TERMINATED, n], flags[FAULT_ACTIVE, n] = False, False
    counts[QUIET, 0] = 0  # see anew


@njit(cache=True, error_model="numpy")
def begin_lanes(
    mask: NDArray[np.bool_],
    state: FloatArray,
    noise: Float32Array,
    row: int,
    names: WordArray,
    constants: FloatArray,
    episodes: FloatArray,
    counts: CountArray,
    flags: BoolArray,
    truth: CountArray,
) -> None:
    """Let the lanes of the mask begin their next episodes."""
    for n in range(mask.shape[0]):
        if mask[n]:
            block, j = n // LANES, n % LANES
            s = state[block * BLOCK : (block + 1) * BLOCK]
            begin_lane(
                s,
                j,
                noise[block],
                row,
                names[block],
                constants,
                episodes[block],
                counts[block],
                flags,
                truth,
                n,
            )


@njit(cache=True, forceinline=True, error_model="numpy")
def _observe_block(s: FloatArray, view: FloatArray, observation: Float32Array, first: int) -> None:
    """Write the observed features of a block, scaled and clipped, one row a feature."""
    for m in range(view.shape[0]):
        scale, bound, offset = view[m, SCALE], view[m, BOUND], view[m, OFFSET]
        at = int(view[m, FIELD]) * LANES
        values, row = s[at : at + LANES], observation[m, first : first + LANES]
        for j in range(LANES):
            value = (values[j] + offset) * scale
            value = -bound if value < -bound else value
            row[j] = np.float32(bound if value > bound else value)


@njit(cache=True, error_model="numpy")
def observe(state: FloatArray, view: FloatArray, observation: Float32Array) -> None:
    """Write the observed features of all lanes."""
    for first in range(0, observation.shape[1], LANES):
        block = first // LANES
        _observe_block(state[block * BLOCK : (block + 1) * BLOCK], view, observation, first)


@njit(cache=True, error_model="numpy")
def _finish_block(
    s: FloatArray,
    p: Constants,
    samples: int,
    next_step: bool,
    noise: Float32Array,
    row: int,
    names: WordArray,
    constants: FloatArray,
    episodes: FloatArray,
    counts: CountArray,
    declared: ByteArray,
    reward: FloatArray,
    flags: BoolArray,
    truth: CountArray,
    first: int,
) -> tuple[int, int]:
    """Rewards and ends of the lanes of a block where one may end or begin: how many end, and lack a next episode."""
    n_over, n_unready = 0, 0
    for j in range(LANES):
        n = first + j
        if next_step and flags[TERMINATED, n]:
            begin_lane(s, j, noise, row, names, constants, episodes, counts, flags, truth, n)
            reward[n] = 0.0
        elif counts[NUMBER, j] >= 0 and (declared[j] > 0 or s[j + SAMPLE * LANES] >= p[HORIZON]):
            reward[n] = settle(s, j, p, samples, int(declared[j]))
            flags[TERMINATED, n], counts[QUIET, 0] = True, 0
            n_over += 1
            n_unready += counts[READY, j] == 0
    return n_over, n_unready


@njit(cache=True, error_model="numpy")
def lay_discrete(
    state: FloatArray,
    counts: CountArray,
    declared: ByteArray,
    actions: NDArray[np.int64],
    offsets_v: FloatArray,
    n_offsets: int,
) -> bool:
    """Lay offset and declaration of each action into the lanes; False if an action does not exist.

    `offsets_v` has an entry for each action; the first `n_offsets` are offsets, the others declare (offset 0).
    """
    lowest, highest = 0, 0
    for block in range(declared.shape[0]):
        part, says = actions[block * LANES : (block + 1) * LANES], declared[block]
        low, high = 0, 0
        for j in range(part.shape[0]):
            low, high = min(low, part[j]), max(high, part[j])
            says[j] = max(0, part[j] - n_offsets + 1)
        counts[block, TALKS, 0] = high >= n_offsets
        lowest, highest = min(lowest, low), max(highest, high)
    if lowest < 0 or highest >= offsets_v.shape[0]:
        return False
    if n_offsets > 1 or offsets_v[0] != 0.0:
        for n in range(actions.shape[0]):
            state[(n // LANES) * BLOCK + VOLTAGE * LANES + n % LANES] = offsets_v[actions[n]]
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
def lay_continuous(
    state: FloatArray, counts: CountArray, declared: ByteArray, actions: FloatArray, reach_v: float
) -> None:
    """Lay offset and declaration of each action into the lanes."""
    for n in range(actions.shape[0]):
        at = (n // LANES) * BLOCK + n % LANES
        offset_v, says = decode_continuous(actions[n], reach_v)
        state[at + VOLTAGE * LANES] = offset_v
        declared[n // LANES, n % LANES] = says
        counts[n // LANES, TALKS, 0] = 1


@njit(cache=True, error_model="numpy")
def step_lanes(
    state: FloatArray,
    noise: Float32Array,
    names: WordArray,
    constants: FloatArray,
    bank: FloatArray,
    view: FloatArray,
    episodes: FloatArray,
    counts: CountArray,
    declared: ByteArray,
    flags: BoolArray,
    truth: CountArray,
    samples: int,
    next_step: bool,
    row: int,
    observation: Float32Array,
    reward: FloatArray,
) -> tuple[int, int, int]:
    """A step of all lanes, whose actions lie in `state` and `declared`.

    Args:
        state: `state[block, field, lane]`, flat.
        noise: normals made ahead, shape (blocks, ROWS, LANES).
        names: what the noise of each lane depends on, shape (blocks, 4, LANES).
        constants: common to all lanes, see the kernel.
        bank: models of its filters, shape (MAX_BANK, MODEL_LENGTH).
        view: the observed features, shape (features, 4).
        episodes: ring of drawn episodes, shape (blocks, DEPTH, LANES, entries).
        counts: shape (blocks, RING + DEPTH, LANES).
        declared: number of the declared kind, 0 for none, shape (blocks, LANES).
        flags: changed where something happens, shape (4, lanes).
        truth: changed where an episode begins, shape (2, lanes).
        samples: of a step.
        next_step: lanes that were over begin their next episode instead.
        row: of the noise, the next one.
        observation: written, shape (features, lanes).
        reward: written, shape (lanes,).

    Returns:
        The next row of noise, how many lanes are over now, and how many of those have no next episode drawn.
    """
    p = to_fixed_tuple(constants, N_CONSTANTS)
    n_over, n_unready, next_row = 0, 0, row
    for block in range(noise.shape[0]):
        first = block * LANES
        s, ring = state[block * BLOCK : (block + 1) * BLOCK], episodes[block]
        block_names, block_counts = names[block], counts[block]
        next_row = step_block(
            s, p, bank, noise[block], row, block_names, ring, block_counts, flags, first, samples
        )
        rewards = reward[first : first + LANES]
        for j in range(LANES):
            rewards[j] = -s[j + COST * LANES]
        if block_counts[QUIET, 0] <= 0 or block_counts[TALKS, 0] > 0:
            over, unready = _finish_block(
                s,
                p,
                samples,
                next_step,
                noise[block],
                next_row,
                block_names,
                constants,
                ring,
                block_counts,
                declared[block],
                reward,
                flags,
                truth,
                first,
            )
            n_over, n_unready = n_over + over, n_unready + unready
        _observe_block(s, view, observation, first)
    return next_row, n_over, n_unready


@njit(cache=True, error_model="numpy")
def step_discrete(
    actions: NDArray[np.int64], offsets_v: FloatArray, n_offsets: int, *lanes: Any
) -> tuple[int, int, int]:
    """`lay_discrete` and `step_lanes`, whose arguments `lanes` are, in one call; row -1 if an action does not exist."""
    if not lay_discrete(lanes[0], lanes[7], lanes[8], actions, offsets_v, n_offsets):
        return -1, 0, 0
    told: tuple[int, int, int] = step_lanes(*lanes)
    return told


@njit(cache=True, error_model="numpy")
def step_continuous(actions: FloatArray, reach_v: float, *lanes: Any) -> tuple[int, int, int]:
    """`lay_continuous` and `step_lanes`, whose arguments `lanes` are, in one call."""
    lay_continuous(lanes[0], lanes[7], lanes[8], actions, reach_v)
    told: tuple[int, int, int] = step_lanes(*lanes)
    return told
