"""Blocks, lanes and tasks: the arrays that the compiled step reads and writes, by name.

A lane is a sub-environment. Lanes lie in blocks, see `block_type`: all of a block stand side by side at distances that
the compiler knows, so it computes several with one instruction, and a block fits into the first-level cache.

A call from Python to compiled code costs 0.1 us an array, ten times that for a named tuple. So a step is called
with few arrays; `unpack_task` and `Lanes` make the tuples that compiled functions pass around.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import from_dtype, types
from numba.core.cgutils import gep_inbounds
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from numba.np.numpy_support import as_dtype
from numpy.typing import NDArray

from motor_env.common.arrays import shown, whole
from motor_env.motor.compiled import inlined
from motor_env.motor.parameters import FloatArray, MotorParameters, require
from motor_env.simulation.random_streams import philox
from motor_env.simulation.recipes import FACTORS


@intrinsic(prefer_literal=True)
def fixed_tuple(context: Any, array: Any, length: Any) -> Any:
    """The first `length` numbers of a contiguous array as a tuple; numba's `to_fixed_tuple` takes 2 us for seventy."""
    made = types.UniTuple(array.dtype, length.literal_value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = make_array(array)(context, builder, arguments[0]).data
        values = [builder.load(gep_inbounds(builder, numbers, k)) for k in range(made.count)]
        return context.make_tuple(builder, made, values)

    return made(array, length), generate


def record_maker(type_of: Callable[[np.dtype[Any]], np.dtype[np.void]], length: int) -> Any:
    """A compiled function (array, number) that views a record of `length` numbers in a contiguous array.

    `type_of` gives the record's type for that of the array. An array of records costs 0.1 us a call more.
    """

    @intrinsic
    def record(context: Any, array: Any, number: Any) -> Any:
        made = from_dtype(type_of(as_dtype(array.dtype)))

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            numbers = make_array(array)(context, builder, arguments[0]).data
            first = builder.mul(arguments[1], arguments[1].type(length))
            return builder.bitcast(gep_inbounds(builder, numbers, first), context.get_value_type(made))

        return made(array, number), generate

    return record


LANES = 64
ROWS = 4
"""Normals of a lane that are made at a time: those that one counter gives."""

MAX_BANK = 5
Block = Any
"""A record of `block_type`."""

_MOTOR = ("m00", "m01", "m10", "m11", "d0", "d1", "b0", "b1", "sigma_current", "sigma_speed")
"""The motor as it is now, as its difference to the healthy model."""
ERRORS = ("gain", "shift", "rise", "hold")
"""What a failed sensor does: it reads a share too much, an offset, so much more with each sample, its last reading."""
_ERRORS = tuple(f"{error}_{channel}" for error in ERRORS for channel in ("current", "speed"))
GAIN, SHIFT, RISE, HOLD = range(len(_MOTOR), len(_MOTOR) + len(_ERRORS), 2)  # their rows
ROW_LENGTH = len(_MOTOR) + len(_ERRORS)
_STATE = ("current", "speed", "error_current", "error_speed", "carry")
"""True state, error of the filter's estimate, and what rounding took from the error of the speed."""
_STATISTICS = ("fast_current", "slow_current", "fast_speed", "slow_speed", "excess")  # running
_TIMES = (
    "time",
    "next_change",
    "since",
    "until",
)  # in samples; the fault has set in since, and ends or returns
_MEASURED = ("measured_current", "measured_speed", "estimated_current", "estimated_speed")  # the last sample
_STEP = ("innovation_current", "innovation_speed", "voltage")  # the last step; the innovation is white
_EPISODE = ("onset", "level", "kind", "supply")
_FOR_BANK = ("old_current", "old_speed", "mismatch_0", "mismatch_1", "noise_current", "noise_speed", "power")
_LOOP = ("drive", "held")  # what a speed loop adds to the voltage, and the speed that it holds
_PRICE = ("energy", "energy_due")  # of the energy of the last step, and of those before it
_FIELDS = (
    *_MOTOR,
    *_ERRORS,
    *_STATE,
    *_STATISTICS,
    *_TIMES,
    *_MEASURED,
    *_STEP,
    *_EPISODE,
    *_FOR_BANK,
    *_LOOP,
    *_PRICE,
)
_BANK = ("evidence", "bank_current", "bank_speed")
EVIDENCE = len(_FIELDS)  # its first row
N_FIELDS = EVIDENCE + len(_BANK) * MAX_BANK


@cache
def block_type(precision: str) -> np.dtype[np.void]:
    """A block of lanes, whose fields are rows of `LANES` numbers; `rows` are all of them.

    The first `N_FIELDS` rows are 0 at the begin of an episode. `normal_current` and `normal_speed` are the normals of
    the sample, `noise` those made ahead, `latest` those made last.
    """
    rows: dict[str, tuple[int, ...]] = dict.fromkeys(
        (*_FIELDS, *_BANK, "normal_current", "normal_speed"), (LANES,)
    )
    rows |= dict.fromkeys(_BANK, (MAX_BANK, LANES)) | dict.fromkeys(("noise", "latest"), (ROWS, LANES))
    fields: Any = dict(np.dtype([(name, precision, rows[name]) for name in rows]).fields or {})
    fields["rows"] = np.dtype((precision, (N_FIELDS + 2 + 2 * ROWS, LANES))), 0
    block: np.dtype[np.void] = np.dtype(fields)
    return block


BLOCK = block_type("float64").itemsize // 8
"""Length of a block, in numbers."""
block_of = record_maker(lambda numbers: block_type(numbers.name), BLOCK)
"""View block `number` of a flat array."""

FIELD, SCALE, BOUND, OFFSET = range(4)  # a row of the observed features
FEATURE_LENGTH = 4
NEVER = 2.0**50  # the same in both precisions


class Constants(NamedTuple):
    """Constants of a task: healthy model and filter, statistics, rewards."""

    f00: float  # transition of the healthy model; its row of the speed holds F - I
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
    rest_speed: float
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
    failing: float  # whether sensors may fail


N_CONSTANTS, FULL = len(Constants._fields), Constants._fields.index("full")


class Model(NamedTuple):
    """A filter of the bank, and its difference to the healthy model in transition, voltage gain and drift."""

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
"""Features of every task; then comes the evidence of each filter of the bank."""
FIELD_OF_FEATURE = (*map(_FIELDS.index, FEATURES), *range(EVIDENCE, EVIDENCE + MAX_BANK))


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
"""Prior of an episode: nominal motor, healthy model and initial estimate, tolerances, onset."""
_LAW = ("column", "loses", "noise_power", "log_lasts", "log_pauses")
_CLASS = ("cumulated", "verdict", "severity_from", "severity_to", *_LAW)
CLASS = np.dtype(
    [
        *((name, float) for name in _CLASS),
        ("powers", [(name, float) for name in MotorParameters.__slots__]),
        ("errors", float, (2, len(ERRORS))),
    ]
)
"""A class of the recipe: cumulated probability, verdict, severity and its random number, logarithms of the
probabilities that duration and pause go on (0: it stays), effect on the motor, and on its sensors for each severity."""
N_PRIOR, CLASS_LENGTH = PRIOR.itemsize // 8, CLASS.itemsize // 8
prior_of, class_of = record_maker(lambda _: PRIOR, N_PRIOR), record_maker(lambda _: CLASS, CLASS_LENGTH)

DRAWN = np.dtype([(name, float) for name in ("severity", *FACTORS)])
"""Severity and nuisance factors of an episode."""
DRAWN_LENGTH = DRAWN.itemsize // 8
drawn_of = record_maker(lambda _: DRAWN, DRAWN_LENGTH)

# Rows of the words (key and counter of an episode's random numbers), the marks, and the flags.
CASE_LOW, CASE_HIGH, SEED_LOW, SEED_HIGH = range(4)
BEFORE_FIRST = 0xFFFFFFFF  # number of the episode before the first: one more is 0
CLASS_INDEX, RUNNING_ONSET, DECLARED, CHOSEN, TIMES, TURN, QUIET, ROW = range(8)
"""Class and onset (-1: none) of the episode; kind declared (0: none); kind chosen, and how often in a row; how often
the fault has set in or ended; in the first lane of a block, samples until a fault of its lanes changes or an episode
ends; in the first lane of all, the noise's row."""
TERMINATED, TRUNCATED, FAULT_ACTIVE, KNOWN = range(4)

Float32Array = NDArray[np.float32]
WordArray = NDArray[np.uint32]
MarkArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]


class TaskNumbers(NamedTuple):
    """Numbers of a task, common to all lanes."""

    constants: FloatArray  # shape (N_CONSTANTS,)
    bank: FloatArray  # models of the bank of filters, 0 where there is none, shape (MAX_BANK, MODEL_LENGTH)
    features: FloatArray  # field, scale, bound and offset of each observed feature, shape (n_observed, FEATURE_LENGTH)
    # motor of each class and level, where all of a class are alike, shape (n_classes, levels + 1, ROW_LENGTH)
    motors: FloatArray
    prior: FloatArray  # a `PRIOR`, float64, shape (N_PRIOR,)
    classes: FloatArray  # a `CLASS` each, float64, shape (n_classes, CLASS_LENGTH)


class Lanes(NamedTuple):
    """State of all lanes."""

    state: FloatArray  # blocks, flat
    words: WordArray  # see the rows above, shape (4, n_lanes)
    marks: MarkArray  # shape (8, n_lanes)
    flags: BoolArray  # shape (4, n_lanes)
    drawn: FloatArray  # a `DRAWN` each, float64, shape (n_lanes, DRAWN_LENGTH)


def pack_task(task: TaskNumbers, precision: str) -> tuple[FloatArray, FloatArray]:
    """Pack a task into the two arrays with which a compiled step is called."""
    parts = [task.constants, task.bank.ravel(), task.features.ravel(), task.motors.ravel()]
    numbers = np.concatenate(parts)
    largest = float(np.abs(numbers[np.isfinite(numbers)]).max())
    require(
        largest <= float(np.finfo(precision).max),
        f"motor, supply and sensor must suit a step in {precision}: its numbers would reach {largest:.3g}",
    )
    return numbers.astype(precision), np.concatenate([task.prior, task.classes.ravel()])


@inlined
def unpack_task(numbers: FloatArray, prior: FloatArray) -> TaskNumbers:
    """Unpack the task of `pack_task`."""
    p = prior_of(prior, 0)
    n_classes, n_observed, n_motors = int(p.n_classes), int(p.n_observed), int(p.n_levels) + 1
    bank = N_CONSTANTS + MAX_BANK * MODEL_LENGTH
    view = bank + n_observed * FEATURE_LENGTH
    return TaskNumbers(
        numbers[:N_CONSTANTS],
        numbers[N_CONSTANTS:bank].reshape((MAX_BANK, MODEL_LENGTH)),
        numbers[bank:view].reshape((n_observed, FEATURE_LENGTH)),
        numbers[view:].reshape((n_classes, n_motors, ROW_LENGTH)),
        prior[:N_PRIOR],
        prior[N_PRIOR:].reshape((n_classes, CLASS_LENGTH)),
    )


def aligned_zeros(shape: tuple[int, ...], dtype: Any = np.float64) -> NDArray[Any]:
    """Zeros aligned to a cache line; numpy's are not, and sums of them take half as long again."""
    length = int(np.prod(shape)) * np.dtype(dtype).itemsize
    room = np.zeros(length + _CACHE_LINE, dtype=np.uint8)
    begin = -room.ctypes.data % _CACHE_LINE
    aligned: NDArray[Any] = room[begin : begin + length].view(dtype).reshape(shape)
    return aligned


def empty_streams(count: int) -> tuple[WordArray, BoolArray]:
    """Words and flags of lanes before their first episode."""
    words, flags = np.zeros((4, count), dtype=np.uint32), np.zeros((KNOWN + 1, count), dtype=np.bool_)
    words[CASE_LOW], flags[KNOWN] = BEFORE_FIRST, True
    return words, flags


def reset_options(options: Any) -> dict[str, Any]:
    """Copy the options of a reset; `ValueError` where they are no dictionary."""
    require(
        options is None or isinstance(options, Mapping),
        f"options of reset must be a dict, got {shown(options)}",
    )
    return dict(options or {})


def require_whole(name: str, number: Any, bits: int) -> int:
    """Check a whole number of so many bits; else `ValueError`."""
    try:
        return whole(name, number, most=2**bits - 1)
    except ValueError as error:
        raise ValueError(str(error).replace(f"{2**bits - 1}", f"2^{bits} - 1", 1)) from None


def begin_streams(
    words: WordArray, which: BoolArray, seed: NDArray[np.uint64], index: NDArray[np.int64]
) -> None:
    """Put lanes before the first episode of the streams (seed, index), each of shape (n_lanes,)."""
    words[SEED_LOW, which], words[SEED_HIGH, which] = seed[which] & 0xFFFFFFFF, seed[which] >> 32
    words[CASE_LOW, which], words[CASE_HIGH, which] = BEFORE_FIRST, index[which]


@inlined
def begin_episode(words: WordArray, flags: BoolArray, n: int) -> None:
    """Move lane n to its next episode."""
    words[CASE_LOW, n] += np.uint32(1)
    flags[TERMINATED, n], flags[FAULT_ACTIVE, n] = False, False


@inlined
def random_words(
    stream: np.uint32, block: int, words: WordArray, n: int
) -> tuple[np.uint32, np.uint32, np.uint32, np.uint32]:
    """Four random words of lane n's episode."""
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
    """Four uniform numbers in (0, 1) of lane n's episode, as `random_streams.uniforms` gives them."""
    a, b, c, d = random_words(stream, block, words, n)
    unit = 2.0**-32
    return (float(a) + 0.5) * unit, (float(b) + 0.5) * unit, (float(c) + 0.5) * unit, (float(d) + 0.5) * unit


def empty_lanes(blocks: int, lanes: int, precision: str) -> Lanes:
    """Lanes before their first episode."""
    state = aligned_zeros((blocks * BLOCK,), precision)
    by_name = state.view(block_type(precision))
    by_name["onset"] = by_name["next_change"] = NEVER  # lanes that fill the last block
    marks = np.zeros((ROW + 1, lanes), dtype=np.int32)
    marks[ROW] = ROWS
    words, flags = empty_streams(lanes)
    return Lanes(state, words, marks, flags, np.zeros((lanes, DRAWN_LENGTH)))
