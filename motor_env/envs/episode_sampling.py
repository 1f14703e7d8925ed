"""Random numbers of an episode, compiled into the step: class, onset, motor at each level of its fault, sensor noise.

An episode depends on (task, seed, sub-environment, number of the episode) alone. Class, onset and motor are those of
`simulation.drawing.draw` and `motor.model.discretize` for its case, to the bit. A motor's matrices are computed at the
begin of an episode and when its fault reaches a level; where all motors are alike they stand in a table.

Standard normal q of an episode is number q of `random_streams.normals(seed, Stream.MEASUREMENT, case)` with the case
(sub-environment << 32) | episode; a sample takes one for each channel. All lanes are refilled together, four rows at a
time, wherever each stands in its episode. One counter gives four normals, so a lane's next normal may be in the middle
of four: each lane keeps its last four, makes four more, and takes its rows out of these eight, without a branch.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from motor_env.envs import layout
from motor_env.envs.layout import (
    CASE_HIGH,
    CASE_LOW,
    LANES,
    NEVER,
    ROW_LENGTH,
    ROWS,
    SEED_HIGH,
    SEED_LOW,
    Block,
    Lanes,
    TaskNumbers,
    WordArray,
    class_of,
    drawn_of,
    prior_of,
    random_uniforms,
    random_words,
)
from motor_env.envs.options import MonitorOptions, Start
from motor_env.filters.kalman import KalmanFilter
from motor_env.motor.compiled import compiled_with_arrays, inlined
from motor_env.motor.faults import FaultKind
from motor_env.motor.model import Input, exponential_and_phi
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray, MotorParameters
from motor_env.simulation.random_streams import Stream, box_muller, philox

_STREAM = np.uint32(Stream.MEASUREMENT)


@inlined
def four_normals(group: int, words: WordArray, n: int) -> tuple[np.float32, ...]:
    """Normals 4 group .. 4 group + 3 of lane n's episode."""
    a, b, c, d = random_words(_STREAM, group, words, n)
    n0, n1 = box_muller(a, b)
    n2, n3 = box_muller(c, d)
    return n0, n1, n2, n3


@inlined
def begin_noise(s: Block, words: WordArray, n: int, row: int, channels: int) -> tuple[np.float32, ...]:
    """Fill the rows from `row` on for a new episode of lane n; return its first four normals.

    The first, one a channel, belong to the measurement of the initial state.
    """
    j = n % LANES
    first: tuple[np.float32, ...] = four_normals(np.int64(0), words, n)
    beyond = channels + ROWS - row  # the first normal that the next refill gives
    second = four_normals(np.int64(1), words, n) if beyond >= ROWS else first
    for place in range(row, ROWS):
        q = channels + place - row
        s.noise[place, j] = first[q] if q < ROWS else second[q - ROWS]
    for m in range(ROWS):
        s.latest[m, j] = second[m]
    return first


@compiled_with_arrays
def refill(s: Block, words: WordArray, first: int, channels: int, width: int) -> None:
    """Refill all rows of a block for its lanes up to `width`; `first` is the number of its first lane.

    Arrays of its own, and rows of the words one by one: else the compiler does not see that they lie side by side.
    """
    low, high = words[CASE_LOW, first : first + width], words[CASE_HIGH, first : first + width]
    k0, k1 = words[SEED_LOW, first : first + width], words[SEED_HIGH, first : first + width]
    following = np.empty(LANES, dtype=np.uint32)  # the normal with which each lane goes on
    made = np.empty((4, LANES), dtype=np.uint32)
    new = np.empty((4, LANES), dtype=np.float32)
    for j in range(width):
        following[j] = np.uint32((np.int32(s.time[j]) + 1) * channels)
    for j in range(width):
        counter = np.uint32((following[j] >> np.uint32(2)) + np.uint32(1))
        made[0, j], made[1, j], made[2, j], made[3, j] = philox(
            counter, _STREAM, low[j], high[j], k0[j], k1[j]
        )
    for j in range(width):
        new[0, j], new[1, j] = box_muller(made[0, j], made[1, j])
        new[2, j], new[3, j] = box_muller(made[2, j], made[3, j])
    for j in range(width):
        by_two = (following[j] & np.uint32(2)) != np.uint32(0)
        by_one = (following[j] & np.uint32(1)) != np.uint32(0)
        n0 = s.latest[2, j] if by_two else s.latest[0, j]
        n1 = s.latest[3, j] if by_two else s.latest[1, j]
        n2 = new[0, j] if by_two else s.latest[2, j]
        n3 = new[1, j] if by_two else s.latest[3, j]
        n4 = new[2, j] if by_two else new[0, j]
        s.noise[0, j] = n1 if by_one else n0
        s.noise[1, j] = n2 if by_one else n1
        s.noise[2, j] = n3 if by_one else n2
        s.noise[3, j] = n4 if by_one else n3
    for m in range(ROWS):
        for j in range(width):
            s.latest[m, j] = new[m, j]


_CLASS, _MOTOR, _SUPPLY = np.uint32(Stream.CLASS), np.uint32(Stream.MOTOR), np.uint32(Stream.SUPPLY)
_ONSET, _SEVERITY = np.uint32(Stream.ONSET), np.uint32(Stream.SEVERITY)


def _fault_powers(kind: FaultKind) -> tuple[float, ...]:
    """Powers of a fault on the six parameters."""
    of_field = {
        field: power for quantity, power in kind.motor_powers.items() for field in QUANTITY_FIELDS[quantity]
    }
    return tuple(of_field.get(name, 0.0) for name in MotorParameters.__slots__)


def make_prior(
    options: MonitorOptions, belief: KalmanFilter, rest: FloatArray, verdicts: list[int], n_observed: int
) -> tuple[FloatArray, FloatArray]:
    """Prior and classes of a task, see `layout.TaskNumbers`.

    `rest` is the current and speed at which the belief rests; `verdicts` has the number of the right verdict of each
    class, 0 for healthy.
    """
    recipe, motor = options.task, options.task.motor
    mean = options.mean_onset_s / options.dt_s
    ranged = any(c.severity_to is not None for c in recipe.classes)
    numbers = {
        "n_classes": len(recipe.classes),
        "n_observed": n_observed,
        "n_levels": options.n_levels,
        **{name: float(np.asarray(getattr(motor, name))) for name in MotorParameters.__slots__},
        "supply_v": float(recipe.supply.voltage_v),
        "load_n_m": options.load_n_m,
        "dt_s": options.dt_s,
        "is_running": options.start is Start.RUNNING,
        "is_known": not (ranged or recipe.spread.std.any()),
        "rest": rest,
        "initial": belief.initial_state,
        "transition": belief.model.transition,
        "by_volt": belief.model.gain[:, Input.VOLTAGE],
        "noise": (recipe.sensor.current_noise_a, recipe.sensor.speed_noise_rad_s),
        "spread": tuple(recipe.spread.std),
        "earliest": round(options.earliest_onset_s / options.dt_s),
        "log_stay": (math.log(mean / (1.0 + mean)) or -1e-300) if mean > 0.0 else -np.inf,
    }
    prior = np.zeros(1, dtype=layout.PRIOR)
    for name, number in numbers.items():
        prior[name] = number
    classes = np.zeros(len(recipe.classes), dtype=layout.CLASS)
    classes["cumulated"], classes["verdict"] = np.cumsum(recipe.class_probabilities), verdicts
    classes["cumulated"][-1] = np.inf
    for row, c in zip(classes, recipe.classes, strict=True):
        if c.kind is not None:
            row["severity_from"], row["severity_to"] = c.severity, c.largest_severity
            row["kind"], row["loses"] = list(FaultKind).index(c.kind), c.kind.loses
            row["powers"], row["noise_power"] = _fault_powers(c.kind), c.kind.powers.get("noise", 0.0)
    return prior.view(np.float64), classes.view(np.float64).reshape(len(classes), -1)


@intrinsic
def _fused(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """A b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


@inlined
def _factor(power: float, loses: float, severity: float) -> float:
    """Factor of a fault on a quantity, as `FaultKind.factor`."""
    if power == 0.0:
        return 1.0
    base = 1.0 - severity if loses > 0.0 else 1.0 + severity
    size = base if abs(power) == 1.0 else base * base ** (abs(power) - 1.0)
    return size if loses > 0.0 or power > 0.0 else 1.0 / size


@inlined
def motor_row(p: Any, c: Any, drawn: Any, share: float, row: FloatArray) -> None:
    """Write the motor of a class at a share of its severity, as its difference to the healthy model.

    Args:
        p: prior of the task, a `layout.PRIOR`.
        c: the class, a `layout.CLASS`.
        drawn: severity and factors, a `layout.DRAWN`.
        share: of the severity, 0 to 1.
        row: written, shape (ROW_LENGTH,).
    """
    severity, loses, powers = drawn.severity * share, c.loses, c.powers
    supply, constants = drawn.supply, drawn.constants
    ohm = p.resistance_ohm * drawn.resistance * _factor(powers.resistance_ohm, loses, severity)
    henry = p.inductance_h * _factor(powers.inductance_h, loses, severity)
    of_kb = _factor(powers.back_emf_constant_v_s_per_rad, loses, severity)
    of_kt = _factor(powers.torque_constant_n_m_per_a, loses, severity)
    back_emf = p.back_emf_constant_v_s_per_rad * constants * of_kb
    torque = p.torque_constant_n_m_per_a * constants * of_kt
    moment = p.inertia_kg_m2 * drawn.inertia * _factor(powers.inertia_kg_m2, loses, severity)
    of_b = _factor(powers.viscous_friction_n_m_s_per_rad, loses, severity)
    drag = p.viscous_friction_n_m_s_per_rad * drawn.friction * of_b
    dt = p.dt_s
    a, phi = exponential_and_phi(
        -ohm / henry * dt, -back_emf / henry * dt, torque / moment * dt, -drag / moment * dt
    )
    by_volt, by_load = 1.0 / henry, -1.0 / moment
    volts, rest_0, rest_1 = p.supply_v * supply, p.rest[0], p.rest[1]
    for m in range(2):
        row[2 * m] = a[2 * m] - p.transition[m, 0]
        row[2 * m + 1] = a[2 * m + 1] - p.transition[m, 1]
        gain, load_gain = dt * (phi[2 * m] * by_volt), dt * (phi[2 * m + 1] * by_load)
        # NumPy's product of a matrix and a vector rounds once here; the first data of these ids were made with it.
        moved = _fused(a[2 * m], rest_0, a[2 * m + 1] * rest_1)
        row[4 + m] = moved + gain * volts + load_gain * p.load_n_m - p.rest[m]
        row[6 + m] = gain * supply - p.by_volt[m]
    noise = np.sqrt(_factor(c.noise_power, loses, severity))
    row[8], row[9] = noise * p.noise[0], noise * p.noise[1]


@compiled_with_arrays
def motor_table(task: TaskNumbers) -> FloatArray:
    """All motors of a task whose motors are alike, see `TaskNumbers.motors`."""
    n_classes, n_levels = len(task.classes), int(task.motors.shape[1]) - 1
    table = np.zeros((n_classes, n_levels + 1, ROW_LENGTH))
    ones = np.ones(layout.DRAWN_LENGTH)
    p, drawn = prior_of(task.prior, 0), drawn_of(ones, 0)
    for which in range(n_classes):
        c = class_of(task.classes, which)
        drawn.severity = c.severity_from
        for level in range(n_levels + 1):
            motor_row(p, c, drawn, level / n_levels, table[which, level])
    return table


@inlined
def set_motor(s: Block, j: int, task: TaskNumbers, lanes: Lanes, n: int, level: int) -> None:
    """Set the motor of lane j of a block, lane n of all, to a level of its fault."""
    p, which = prior_of(task.prior, 0), lanes.marks[layout.CLASS_INDEX, n]
    if p.is_known > 0.0:
        for f in range(ROW_LENGTH):
            s.rows[f, j] = task.motors[which, level, f]
    else:
        row = s.rows[:ROW_LENGTH, j]
        motor_row(p, class_of(task.classes, which), drawn_of(lanes.drawn, n), level / p.n_levels, row)


@inlined
def _draw_factors(task: TaskNumbers, words: WordArray, n: int, out: Any) -> None:
    """Draw the five nuisance factors of `recipes.FACTORS`."""
    p = prior_of(task.prior, 0)
    a, b, c, d = random_words(_MOTOR, 0, words, n)
    out.resistance = 1.0 + p.spread.resistance * float(box_muller(a, b)[1])
    two = box_muller(c, d)
    out.constants, out.inertia = (
        1.0 + p.spread.constants * float(two[0]),
        1.0 + p.spread.inertia * float(two[1]),
    )
    a, b, c, d = random_words(_MOTOR, 1, words, n)
    out.friction = 1.0 + p.spread.friction * float(box_muller(a, b)[0])
    a, b, c, d = random_words(_SUPPLY, 0, words, n)
    out.supply = 1.0 + p.spread.supply * float(box_muller(a, b)[0])


@inlined
def draw_episode(task: TaskNumbers, lanes: Lanes, n: int) -> float:
    """Draw lane n's episode into its marks and `drawn`; return its onset, NEVER without a fault."""
    p, words, drawn = prior_of(task.prior, 0), lanes.words, drawn_of(lanes.drawn, n)
    which, u = 0, random_uniforms(_CLASS, 0, words, n)[0]
    while u >= class_of(task.classes, which).cumulated:
        which += 1
    c = class_of(task.classes, which)
    drawn.severity = c.severity_from
    if c.severity_to > c.severity_from:
        u = random_uniforms(_SEVERITY, int(c.kind) >> 2, words, n)[int(c.kind) & 3]
        drawn.severity += (c.severity_to - c.severity_from) * u
    if p.is_known > 0.0:
        drawn.supply = drawn.resistance = drawn.constants = drawn.inertia = drawn.friction = 1.0
    else:
        _draw_factors(task, words, n, drawn)
    onset = NEVER
    if c.verdict > 0.0:
        onset = p.earliest
        if p.log_stay > -np.inf:
            onset += np.floor(np.log(random_uniforms(_ONSET, 0, words, n)[0]) / p.log_stay)
    lanes.marks[layout.CLASS_INDEX, n] = which
    lanes.marks[layout.RUNNING_ONSET, n] = int(min(onset, 2.0**31 - 1.0)) if onset < NEVER else -1
    return onset


@inlined
def begin_state(s: Block, j: int, task: TaskNumbers, lanes: Lanes, n: int) -> None:
    """Set the initial state of lane j of a block, lane n of all."""
    p, drawn = prior_of(task.prior, 0), drawn_of(lanes.drawn, n)
    current, speed = 0.0, 0.0
    if p.is_running > 0.0:
        volts, ohm = p.supply_v * drawn.supply, p.resistance_ohm * drawn.resistance
        back_emf = p.back_emf_constant_v_s_per_rad * drawn.constants
        torque = p.torque_constant_n_m_per_a * drawn.constants
        drag = p.viscous_friction_n_m_s_per_rad * drawn.friction
        total = ohm * drag + torque * back_emf
        current = (drag * volts + back_emf * p.load_n_m) / total
        speed = (torque * volts - ohm * p.load_n_m) / total
    s.current[j], s.speed[j] = current - p.rest[0], speed - p.rest[1]
    s.held[j] = speed - p.rest[1]
    s.error_current[j] = current - p.initial[0]
    s.error_speed[j] = speed - p.initial[1]
    s.kind[j] = class_of(task.classes, lanes.marks[layout.CLASS_INDEX, n]).verdict
    s.supply[j] = drawn.supply
