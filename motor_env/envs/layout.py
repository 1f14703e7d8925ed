"""Lanes and tasks: the arrays that the compiled step reads and writes, beside the fields of the kernel.

A call from Python to compiled code costs 0.1 us an array, and ten times that for a named tuple. So a step is called
with few arrays, of which `unpack_task` and `Lanes` make the tuples that the compiled functions pass around.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import shown, whole
from motor_env.envs import kernel
from motor_env.envs.compiling import record_maker
from motor_env.motor.compiled import inlined
from motor_env.motor.parameters import FloatArray, MotorParameters, require
from motor_env.simulation.random_streams import philox
from motor_env.simulation.recipes import FACTORS

_CACHE_LINE = 64  # bytes
_SIZES = ("n_classes", "n_observed", "n_levels")
_SUPPLY = ("supply_v", "load_n_m", "dt_s", "is_running", "is_known")
PRIOR = np.dtype(
    [
        *((name, float) for name in (*_SIZES, *MotorParameters.__slots__, *_SUPPLY)),
        *((name, float, 2) for name in ("rest", "initial", "by_volt", "noise")),
        ("transition", float, (2, 2)),
        ("spread", [(name, float) for name in FACTORS]),
        *((name, float) for name in ("earliest", "log_stay")),  # of the onset, in samples
    ]
)
"""What is drawn from: the nominal motor, the belief's model and where it begins, tolerances, onset."""
_LAW = ("kind", "loses", "noise_power")
_CLASS = ("cumulated", "verdict", "severity_from", "severity_to", *_LAW)
CLASS = np.dtype(
    [*((name, float) for name in _CLASS), ("powers", [(name, float) for name in MotorParameters.__slots__])]
)
"""A class: up to which uniform number it is drawn, its verdict, severity and kind, and what that does to a motor."""
N_PRIOR, CLASS_LENGTH = PRIOR.itemsize // 8, CLASS.itemsize // 8
prior_of, class_of = record_maker(lambda _: PRIOR, N_PRIOR), record_maker(lambda _: CLASS, CLASS_LENGTH)

DRAWN = np.dtype([(name, float) for name in ("severity", *FACTORS)])
"""What an episode was drawn to be: severity, and the factors of its nuisances."""
DRAWN_LENGTH = DRAWN.itemsize // 8
drawn_of = record_maker(lambda _: DRAWN, DRAWN_LENGTH)

# Rows of the words (of what the random numbers of an episode depend on), the marks, and the flags.
CASE_LOW, CASE_HIGH, SEED_LOW, SEED_HIGH = range(4)
BEFORE_FIRST = 0xFFFFFFFF  # number of the episode before the first: one more is 0
CLASS_INDEX, RUNNING_ONSET, DECLARED, CHOSEN, TIMES, QUIET, ROW = range(7)
"""Class and onset (-1: none) of the episode; number of the kind that is declared (0: none), and of the one that was
chosen, with how often in a row; in the first lane of a block, how many samples it has until a fault of its lanes
changes or an episode ends; in the first lane of all, the noise's row."""
TERMINATED, TRUNCATED, FAULT_ACTIVE, KNOWN = range(4)

Float32Array = NDArray[np.float32]
WordArray = NDArray[np.uint32]
MarkArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]


class TaskNumbers(NamedTuple):
    """What is common to all lanes.

    Attributes:
        constants: shape (kernel.N_CONSTANTS,).
        bank: models of the other filters, zeros where there is none, shape (kernel.MAX_BANK, kernel.MODEL_LENGTH).
        features: field, scale, bound and offset of each observed feature, shape (n_observed, kernel.FEATURE_LENGTH).
        motors: where all motors of a class are alike, them at each level of their fault, shape (n_classes, levels + 1,
            kernel.ROW_LENGTH).
        prior: a `PRIOR`, float64, shape (N_PRIOR,).
        classes: a `CLASS` each, float64, shape (n_classes, CLASS_LENGTH).
    """

    constants: FloatArray
    bank: FloatArray
    features: FloatArray
    motors: FloatArray
    prior: FloatArray
    classes: FloatArray


class Lanes(NamedTuple):
    """Everything that changes.

    Attributes:
        state: blocks of fields and noise, flat.
        words: see the rows above, shape (4, n_lanes).
        marks: shape (7, n_lanes).
        flags: shape (4, n_lanes).
        drawn: a `DRAWN` each, float64, shape (n_lanes, DRAWN_LENGTH).
    """

    state: FloatArray
    words: WordArray
    marks: MarkArray
    flags: BoolArray
    drawn: FloatArray


def pack_task(task: TaskNumbers, precision: str) -> tuple[FloatArray, FloatArray]:
    """The two arrays with which a compiled step is called."""
    parts = [task.constants, task.bank.ravel(), task.features.ravel(), task.motors.ravel()]
    return np.concatenate(parts).astype(precision), np.concatenate([task.prior, task.classes.ravel()])


@inlined
def unpack_task(numbers: FloatArray, prior: FloatArray) -> TaskNumbers:
    """The task of `pack_task`."""
    p = prior_of(prior, 0)
    n_classes, n_observed, n_motors = int(p.n_classes), int(p.n_observed), int(p.n_levels) + 1
    bank = kernel.N_CONSTANTS + kernel.MAX_BANK * kernel.MODEL_LENGTH
    view = bank + n_observed * kernel.FEATURE_LENGTH
    return TaskNumbers(
        numbers[: kernel.N_CONSTANTS],
        numbers[kernel.N_CONSTANTS : bank].reshape((kernel.MAX_BANK, kernel.MODEL_LENGTH)),
        numbers[bank:view].reshape((n_observed, kernel.FEATURE_LENGTH)),
        numbers[view:].reshape((n_classes, n_motors, kernel.ROW_LENGTH)),
        prior[:N_PRIOR],
        prior[N_PRIOR:].reshape((n_classes, CLASS_LENGTH)),
    )


def aligned_zeros(shape: tuple[int, ...], dtype: Any = np.float64) -> NDArray[Any]:
    """Zeros that begin where a line of the cache does.

    numpy begins 16 bytes behind it. Then every load of 64 bytes takes two lines, and sums take half as long again.
    """
    length = int(np.prod(shape)) * np.dtype(dtype).itemsize
    room = np.zeros(length + _CACHE_LINE, dtype=np.uint8)
    begin = -room.ctypes.data % _CACHE_LINE
    aligned: NDArray[Any] = room[begin : begin + length].view(dtype).reshape(shape)
    return aligned


def empty_streams(count: int) -> tuple[WordArray, BoolArray]:
    """Words and flags of lanes that run no episode yet; all environments have them."""
    words, flags = np.zeros((4, count), dtype=np.uint32), np.zeros((KNOWN + 1, count), dtype=np.bool_)
    words[CASE_LOW], flags[KNOWN] = BEFORE_FIRST, True
    return words, flags


def reset_options(options: Any) -> dict[str, Any]:
    """A copy of the options of a reset; `ValueError` where they are no dictionary."""
    require(
        options is None or isinstance(options, Mapping),
        f"options of reset must be a dict, got {shown(options)}",
    )
    return dict(options or {})


def require_whole(name: str, number: Any, bits: int) -> int:
    """The number, if it is a whole one of so many bits; else `ValueError`."""
    try:
        return whole(name, number, most=2**bits - 1)
    except ValueError as error:
        raise ValueError(str(error).replace(f"{2**bits - 1}", f"2^{bits} - 1", 1)) from None


def begin_streams(
    words: WordArray, which: BoolArray, seed: NDArray[np.uint64], index: NDArray[np.int64]
) -> None:
    """Let some lanes stand before the first episode of the streams (seed, index), each of shape (n_lanes,)."""
    words[SEED_LOW, which], words[SEED_HIGH, which] = seed[which] & 0xFFFFFFFF, seed[which] >> 32
    words[CASE_LOW, which], words[CASE_HIGH, which] = BEFORE_FIRST, index[which]


@inlined
def begin_episode(words: WordArray, flags: BoolArray, n: int) -> None:
    """Let lane n stand in its next episode."""
    words[CASE_LOW, n] += np.uint32(1)
    flags[TERMINATED, n], flags[FAULT_ACTIVE, n] = False, False


@inlined
def random_words(
    stream: np.uint32, block: int, words: WordArray, n: int
) -> tuple[np.uint32, np.uint32, np.uint32, np.uint32]:
    """Four random words of the episode that lane n runs."""
    made: tuple[np.uint32, np.uint32, np.uint32, np.uint32] = philox(
        np.uint32(block),
        stream,
        words[CASE_LOW, n],
        words[CASE_HIGH, n],
        words[SEED_LOW, n],
        words[SEED_HIGH, n],
    )
    return made


@inlined
def random_uniforms(stream: np.uint32, block: int, words: WordArray, n: int) -> tuple[float, ...]:
    """Four uniform numbers in (0, 1) of the episode that lane n runs, as `random_streams.uniforms` gives them."""
    a, b, c, d = random_words(stream, block, words, n)
    unit = 2.0**-32
    return (float(a) + 0.5) * unit, (float(b) + 0.5) * unit, (float(c) + 0.5) * unit, (float(d) + 0.5) * unit


def empty_lanes(blocks: int, lanes: int, precision: str) -> Lanes:
    """Lanes that run no episode yet."""
    state = aligned_zeros((blocks * kernel.BLOCK,), precision)
    by_name = state.view(kernel.block_type(precision))
    by_name["onset"] = by_name["next_change"] = kernel.NEVER  # lanes that fill the last block
    marks = np.zeros((ROW + 1, lanes), dtype=np.int32)
    marks[ROW] = kernel.ROWS
    words, flags = empty_streams(lanes)
    return Lanes(state, words, marks, flags, np.zeros((lanes, DRAWN_LENGTH)))
