"""The drawing of episodes, compiled into the step: class, onset, motor, and the motor at each level of its fault.

Numbers are those of `simulation.sampling.draw` and `motor.model.discretize` for the case of the episode, to the bit,
so a data set and an environment draw the same motors (a test compares them). An episode depends on (task, seed,
sub-environment, number of the episode) alone. What costs most, a motor's matrices, is computed when it is needed: at
the begin of an episode, and when its fault reaches a level. Where all motors are alike they stand in a table.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from motor_env.envs import layout
from motor_env.envs.kernel import NEVER, ROW_LENGTH, Block
from motor_env.envs.layout import (
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
from motor_env.simulation.random_streams import Stream, box_muller

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

    Args:
        options: the task.
        belief: the filter.
        rest: current and speed at which the belief rests.
        verdicts: number of the verdict that is right for each class, 0 for healthy.
        n_observed: number of the observed features.
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
    """What a fault multiplies a quantity by: `FaultKind.factor`."""
    if power == 0.0:
        return 1.0
    base = 1.0 - severity if loses > 0.0 else 1.0 + severity
    size = base if abs(power) == 1.0 else base * base ** (abs(power) - 1.0)
    return size if loses > 0.0 or power > 0.0 else 1.0 / size


@inlined
def motor_row(p: Any, c: Any, drawn: Any, share: float, row: FloatArray) -> None:
    """The motor of a class at a share of its fault's severity, as its difference to the belief's: the kernel's row.

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
    """All motors of a task whose motors are alike, as `TaskNumbers.motors` wants them; zeros where they are not."""
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
    """Let lane j of a block, lane n of all, have the motor at a level of its fault."""
    p, which = prior_of(task.prior, 0), lanes.marks[layout.CLASS_INDEX, n]
    if p.is_known > 0.0:
        for f in range(ROW_LENGTH):
            s.rows[f, j] = task.motors[which, level, f]
    else:
        row = s.rows[:ROW_LENGTH, j]
        motor_row(p, class_of(task.classes, which), drawn_of(lanes.drawn, n), level / p.n_levels, row)


@inlined
def _draw_factors(task: TaskNumbers, words: WordArray, n: int, out: Any) -> None:
    """The five nuisance factors into `drawn`, in the order of `recipes.FACTORS`: supply first."""
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
    """Draw the episode that the words of lane n name, into its marks and `drawn`; its onset, NEVER without a fault."""
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
    """Let lane j of a block, lane n of all, take the initial state of the episode drawn for it."""
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
