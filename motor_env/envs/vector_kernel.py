"""The compiled step over a vector of environments: the lanes of `motor_env.envs.kernel`, block by block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from motor_env.envs.kernel import (
    BANK,
    BANK_LENGTH,
    C1,
    COST,
    DECLARED,
    DONE,
    F11,
    FIELD_OF_FEATURE,
    HEAD_ONSET,
    LANES,
    MODEL_LENGTH,
    N_CONSTANTS,
    N_FIELDS,
    NEVER,
    NEXT_CHANGE,
    ONE,
    ONSET,
    REWARD,
    SAMPLE,
    VOLTAGE,
    WHITE_CURRENT,
    WHITE_SPEED,
    ZERO,
    Float32Array,
    KeyArray,
    advance,
    begin_episode,
    change_level,
    next_sample,
    settle,
    weigh,
)
from motor_env.envs.noise import normal, normal_pair
from motor_env.parameters import FloatArray

BLOCK = N_FIELDS * LANES
DEPTH = 4
DECLARE_ABOVE = 0.5
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


class Store(NamedTuple):
    """A ring of `DEPTH` episodes a lane: the one that runs, and the next ones as far as they have been drawn.

    Several, so that many episodes are drawn at once: drawing one costs as much as drawing a hundred.

    Attributes:
        heads: shape (DEPTH, lanes, HEAD_LENGTH).
        tables: shape (DEPTH, lanes, levels + 1, ROW_LENGTH).
        keys: shape (DEPTH, lanes, 2).
        class_index: shape (DEPTH, lanes).
    """

    heads: FloatArray
    tables: FloatArray
    keys: KeyArray
    class_index: IntArray


class Now(NamedTuple):
    """Where each lane stands.

    Attributes:
        slot: which episode of its ring runs.
        ready: how many after it have been drawn.
        over: whether its episode is over.
        class_index: class of the running episode.
        onset: its onset in samples, -1 without a fault.
        episode: its number in the stream of the lane.
    """

    slot: IntArray
    ready: IntArray
    over: BoolArray
    class_index: IntArray
    onset: IntArray
    episode: IntArray


class Outcome(NamedTuple):
    """What a step gives: `observation` has shape (features, lanes), the others (lanes,)."""

    observation: Float32Array
    reward: FloatArray
    terminated: BoolArray
    active: BoolArray


@njit(cache=True, error_model="numpy")
def decode_discrete(
    state: FloatArray, actions: NDArray[np.int64], offsets_v: FloatArray, kinds: FloatArray
) -> bool:
    """Lay offset and declaration of each action into the lanes; False if an action does not exist."""
    good = True
    for n in range(actions.shape[0]):
        action = actions[n]
        inside = 0 <= action < offsets_v.shape[0]
        good = good and inside
        at = (n // LANES) * BLOCK + n % LANES
        which = action if inside else 0
        state[at + VOLTAGE * LANES] = offsets_v[which]
        state[at + DECLARED * LANES] = kinds[which]
    return good


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
def lay_continuous(state: FloatArray, actions: FloatArray, reach_v: float) -> None:
    """Lay offset and declaration of each action into the lanes."""
    for n in range(actions.shape[0]):
        at = (n // LANES) * BLOCK + n % LANES
        offset_v, declared = decode_continuous(actions[n], reach_v)
        state[at + VOLTAGE * LANES] = offset_v
        state[at + DECLARED * LANES] = declared


@njit(cache=True, inline="always", error_model="numpy")
def _change_levels(s: FloatArray, p: tuple[float, ...], tables: FloatArray, slot: IntArray) -> None:
    """Let the faults of a block grow: seldom one does, so first look at all lanes at once."""
    due = 0
    for j in range(LANES):
        due += s[j + NEXT_CHANGE * LANES] <= s[j + SAMPLE * LANES]
    if due > 0:
        for j in range(LANES):
            if s[j + NEXT_CHANGE * LANES] <= s[j + SAMPLE * LANES]:
                change_level(s, j, tables[slot[j], j], p)


@njit(cache=True, inline="always", error_model="numpy")
def _weigh_all(s: FloatArray, p: tuple[float, ...], bank: FloatArray) -> None:
    """The filters of the bank that are in use."""
    for m in range(bank.shape[0]):
        if bank[m, F11] != 0.0:
            model = to_fixed_tuple(bank[m], MODEL_LENGTH)
            for j in range(LANES):
                weigh(s, j, BANK + BANK_LENGTH * m, p, model)


@njit(cache=True, error_model="numpy")
def step_block(
    s: FloatArray,
    low: KeyArray,
    high: KeyArray,
    p: tuple[float, ...],
    bank: FloatArray,
    tables: FloatArray,
    slot: NDArray[np.int64],
    scratch: FloatArray,
    samples: int,
) -> None:
    """A step of the lanes of one block."""
    n0, n1 = scratch[0], scratch[1]
    zero, typed_samples = p[ZERO], samples * p[ONE]
    for j in range(LANES):
        s[j + COST * LANES], s[j + WHITE_CURRENT * LANES], s[j + WHITE_SPEED * LANES] = zero, zero, zero
    for _ in range(samples):
        _change_levels(s, p, tables, slot)
        if p[C1] > 0.0:
            for j in range(LANES):
                n0[j], n1[j] = normal_pair(next_sample(s, j), low[j], high[j])
            for j in range(LANES):
                advance(s, j, p, n0[j], n1[j], True)
        else:
            for j in range(LANES):
                n0[j] = normal(next_sample(s, j), low[j], high[j])
            for j in range(LANES):
                advance(s, j, p, n0[j], p[ZERO], False)
        _weigh_all(s, p, bank)
    for j in range(LANES):
        settle(s, j, p, typed_samples)


@njit(cache=True, error_model="numpy")
def begin_lane(
    state: FloatArray, n: int, low: KeyArray, high: KeyArray, constants: FloatArray, store: Store, now: Now
) -> None:
    """Let lane n begin the episode that has been drawn for it."""
    which = (now.slot[n] + 1) % DEPTH
    now.slot[n] = which
    now.ready[n] -= 1
    head, key = store.heads[which, n], store.keys[which, n]
    s = state[(n // LANES) * BLOCK : (n // LANES + 1) * BLOCK]
    begin_episode(s, n % LANES, head, store.tables[which, n], key, constants)
    low[n], high[n] = key[0], key[1]
    now.class_index[n] = store.class_index[which, n]
    now.onset[n] = int(head[HEAD_ONSET]) if head[HEAD_ONSET] < NEVER else -1
    now.episode[n] += 1
    now.over[n] = False


@njit(cache=True, error_model="numpy")
def begin_lanes(
    state: FloatArray,
    mask: BoolArray,
    low: KeyArray,
    high: KeyArray,
    constants: FloatArray,
    store: Store,
    now: Now,
) -> None:
    """Let the lanes of the mask begin their next episodes."""
    for n in range(mask.shape[0]):
        if mask[n]:
            begin_lane(state, n, low, high, constants, store, now)


@njit(cache=True, error_model="numpy")
def observe(state: FloatArray, chosen: NDArray[np.int64], view: FloatArray, out: Float32Array) -> None:
    """Write the chosen features of all lanes, scaled and clipped, one row a feature."""
    n_lanes = out.shape[1]
    for first in range(0, n_lanes, LANES):
        s = state[(first // LANES) * BLOCK : (first // LANES + 1) * BLOCK]
        _observe_block(s, chosen, view, out, first, min(first + LANES, n_lanes))


@njit(cache=True, inline="always", error_model="numpy")
def _observe_block(
    s: FloatArray, chosen: NDArray[np.int64], view: FloatArray, out: Float32Array, first: int, last: int
) -> None:
    for m in range(chosen.shape[0]):
        feature = chosen[m]
        scale, bound, offset = view[0, feature], view[1, feature], view[2, feature]
        values, row = s[FIELD_OF_FEATURE[feature] * LANES :], out[m][first:last]
        for j in range(row.shape[0]):
            value = (values[j] + offset) * scale
            value = -bound if value < -bound else value
            row[j] = np.float32(bound if value > bound else value)


@njit(cache=True, inline="always", error_model="numpy")
def _finish_block(
    s: FloatArray, reward: FloatArray, terminated: BoolArray, active: BoolArray, over: BoolArray
) -> None:
    """Hand out rewards and ends of a block; loops apart, each of which the compiler takes for several lanes at once."""
    for j in range(reward.shape[0]):
        reward[j] = s[j + REWARD * LANES]
    for j in range(reward.shape[0]):
        terminated[j] = s[j + DONE * LANES] != 0
    for j in range(reward.shape[0]):
        active[j] = s[j + SAMPLE * LANES] > s[j + ONSET * LANES]
    for j in range(reward.shape[0]):
        over[j] = terminated[j]


@njit(cache=True, error_model="numpy")
def step_vector(
    state: FloatArray,
    low: KeyArray,
    high: KeyArray,
    constants: FloatArray,
    bank: FloatArray,
    view: FloatArray,
    chosen: NDArray[np.int64],
    store: Store,
    now: Now,
    out: Outcome,
    samples: int,
    next_step: bool,
) -> tuple[int, int]:
    """A step of all lanes.

    `next_step`: lanes that were over begin their next episode instead.

    Returns:
        How many lanes are over now, and how many of those have no next episode drawn.
    """
    p = to_fixed_tuple(constants, N_CONSTANTS)
    n_lanes = out.reward.shape[0]
    n_over, n_unready = 0, 0
    scratch = np.empty((2, LANES), dtype=np.float32)
    for first in range(0, n_lanes, LANES):
        s = state[(first // LANES) * BLOCK : (first // LANES + 1) * BLOCK]
        last = min(first + LANES, n_lanes)
        step_block(
            s,
            low[first : first + LANES],
            high[first : first + LANES],
            p,
            bank,
            store.tables[:, first : first + LANES],
            now.slot[first : first + LANES],
            scratch,
            samples,
        )
        if next_step:
            for n in range(first, last):
                if now.over[n]:
                    begin_lane(state, n, low, high, constants, store, now)
        _observe_block(s, chosen, view, out.observation, first, last)
        _finish_block(
            s,
            out.reward[first:last],
            out.terminated[first:last],
            out.active[first:last],
            now.over[first:last],
        )
    for n in range(n_lanes):
        n_over += now.over[n]
        n_unready += now.over[n] and now.ready[n] == 0
    return n_over, n_unready
