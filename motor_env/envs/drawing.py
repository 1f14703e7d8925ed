"""The drawing of episodes, compiled into the step: class, onset, motor, and the motor at each level of its fault.

The numbers are those of `simulation.drawing.draw` and `motor.model.discretize` for the case of the episode, to the bit,
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

from motor_env.envs import kernel, layout
from motor_env.envs.compiling import compiled_with_arrays, inlined
from motor_env.envs.kernel import LANES, NEVER, ROW_LENGTH
from motor_env.envs.layout import FACTORS, SEVERITY, Lanes, TaskNumbers, WordArray
from motor_env.envs.options import MonitorOptions, Start
from motor_env.filters.kalman import KalmanFilter
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.model import Input, exponential_and_phi
from motor_env.motor.parameters import QUANTITY_FIELDS, FloatArray, MotorParameters
from motor_env.simulation.random_streams import Stream, box_muller, philox

# The prior after its sizes: the nominal motor, the supply, the belief, the tolerances, the onset, the sensor's noise.
R, L, KE, KT, J, B = range(3, 9)
SUPPLY_V, LOAD, DT, RUNNING, IS_KNOWN, IS_RANGED = range(9, 15)
REST, INITIAL, BELIEF_A, BELIEF_B, STD = 15, 17, 19, 23, 25
SPREAD, EARLIEST, LOG_STAY = 27, 32, 33
STARTS_PER_MOTOR, HEALTHY_STARTS, HEALTHY_CLASS = range(34, layout.N_PRIOR)
# A class: up to which uniform number it is drawn, its verdict, its severity; `_fault_law`.
CUMULATED, VERDICT, SEVERITY_FROM, SEVERITY_TO, KIND_INDEX, LOSES, POWERS = range(7)
NOISE_POWER = POWERS + 6

_CLASS, _MOTOR, _SUPPLY = np.uint32(Stream.CLASS), np.uint32(Stream.MOTOR), np.uint32(Stream.SUPPLY)
_ONSET, _SEVERITY = np.uint32(Stream.ONSET), np.uint32(Stream.SEVERITY)
_LOW, _WORD = np.uint64(0xFFFFFFFF), np.uint64(32)


def _fault_law(kind: FaultKind) -> list[float]:
    """Whether the severity is lost; powers on the six parameters and on the noise's variance."""
    of_field = {
        field: power for quantity, power in kind.motor_powers.items() for field in QUANTITY_FIELDS[quantity]
    }
    powers = [of_field.get(name, 0.0) for name in MotorParameters.__slots__]
    return [float(kind.loses), *powers, kind.powers.get("noise", 0.0)]


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
    known = not (ranged or recipe.spread.std.any())
    prior = np.array(
        [
            *(len(recipe.classes), n_observed, options.n_levels),
            *(float(np.asarray(getattr(motor, name))) for name in MotorParameters.__slots__),
            *(float(recipe.supply.voltage_v), options.load_n_m, options.dt_s),
            *(options.start is Start.RUNNING, known, ranged),
            *rest,
            *belief.initial_state,
            *belief.model.transition.ravel(),
            *belief.model.gain[:, Input.VOLTAGE],
            *(recipe.sensor.current_noise_a, recipe.sensor.speed_noise_rad_s),
            *recipe.spread.std,
            round(options.earliest_onset_s / options.dt_s),
            (math.log(mean / (1.0 + mean)) or -1e-300) if mean > 0.0 else -np.inf,
            *(recipe.starts_per_motor, recipe.healthy_starts),
            recipe.class_names.index(HEALTHY) if recipe.healthy_starts else -1,
        ],
        dtype=np.float64,
    )
    classes = np.zeros((len(recipe.classes), layout.CLASS_LENGTH))
    for row, c, cumulated, verdict in zip(
        classes, recipe.classes, np.cumsum(recipe.class_probabilities), verdicts, strict=True
    ):
        row[CUMULATED], row[VERDICT] = cumulated, verdict
        if c.kind is not None:
            row[SEVERITY_FROM], row[SEVERITY_TO] = c.severity, c.largest_severity
            row[KIND_INDEX], row[LOSES:] = list(FaultKind).index(c.kind), _fault_law(c.kind)
    classes[-1, CUMULATED] = np.inf
    return prior, classes


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
def motor_row(p: FloatArray, c: FloatArray, drawn: FloatArray, share: float, row: FloatArray) -> None:
    """The motor of a class at a share of its fault's severity, as its difference to the belief's: the kernel's row.

    Args:
        p: prior of the task.
        c: row of the class.
        drawn: severity and factors.
        share: of the severity, 0 to 1.
        row: written, shape (ROW_LENGTH,).
    """
    severity, loses, supply, constants = (
        drawn[SEVERITY] * share,
        c[LOSES],
        drawn[FACTORS],
        drawn[FACTORS + 2],
    )
    ohm = p[R] * drawn[FACTORS + 1] * _factor(c[POWERS], loses, severity)
    henry = p[L] * _factor(c[POWERS + 1], loses, severity)
    back_emf = p[KE] * constants * _factor(c[POWERS + 2], loses, severity)
    torque = p[KT] * constants * _factor(c[POWERS + 3], loses, severity)
    moment = p[J] * drawn[FACTORS + 3] * _factor(c[POWERS + 4], loses, severity)
    drag = p[B] * drawn[FACTORS + 4] * _factor(c[POWERS + 5], loses, severity)
    dt = p[DT]
    a, phi = exponential_and_phi(
        -ohm / henry * dt, -back_emf / henry * dt, torque / moment * dt, -drag / moment * dt
    )
    by_volt, by_load = 1.0 / henry, -1.0 / moment
    volts, rest_0, rest_1 = p[SUPPLY_V] * supply, p[REST], p[REST + 1]
    for m in range(2):
        row[2 * m] = a[2 * m] - p[BELIEF_A + 2 * m]
        row[2 * m + 1] = a[2 * m + 1] - p[BELIEF_A + 2 * m + 1]
        gain, load_gain = dt * (phi[2 * m] * by_volt), dt * (phi[2 * m + 1] * by_load)
        # NumPy's product of a matrix and a vector rounds once here; the first data of these ids were made with it.
        moved = _fused(a[2 * m], rest_0, a[2 * m + 1] * rest_1)
        row[4 + m] = moved + gain * volts + load_gain * p[LOAD] - p[REST + m]
        row[6 + m] = gain * supply - p[BELIEF_B + m]
    noise = np.sqrt(_factor(c[NOISE_POWER], loses, severity))
    row[kernel.SIGMA_CURRENT], row[kernel.SIGMA_SPEED] = noise * p[STD], noise * p[STD + 1]


@compiled_with_arrays
def motor_table(task: TaskNumbers) -> FloatArray:
    """All motors of a task whose motors are alike, as `TaskNumbers.motors` wants them; zeros where they are not."""
    n_classes, n_levels = len(task.classes), int(task.motors.shape[1]) - 1
    table = np.zeros((n_classes, n_levels + 1, ROW_LENGTH))
    drawn = np.ones(FACTORS + 5)
    for which in range(n_classes):
        drawn[SEVERITY] = task.classes[which, SEVERITY_FROM]
        for level in range(n_levels + 1):
            motor_row(task.prior, task.classes[which], drawn, level / n_levels, table[which, level])
    return table


@inlined
def set_motor(s: FloatArray, j: int, task: TaskNumbers, lanes: Lanes, n: int, level: int) -> None:
    """Let lane j of a block, lane n of all, have the motor at a level of its fault."""
    which = lanes.marks[layout.CLASS_INDEX, n]
    if task.prior[IS_KNOWN] > 0.0:
        for f in range(ROW_LENGTH):
            s[j + f * LANES] = task.motors[which, level, f]
    else:
        row = s[j : j + ROW_LENGTH * LANES : LANES]
        motor_row(task.prior, task.classes[which], lanes.drawn[n], level / task.prior[layout.N_LEVELS], row)


@inlined
def _uniform(stream: np.uint32, words: WordArray, n: int, case: np.uint64, number: int) -> float:
    """Uniform number of a case in (0, 1), as `random_streams.uniforms`."""
    four = philox(
        np.uint32(number >> 2),
        stream,
        np.uint32(case & _LOW),
        np.uint32(case >> _WORD),
        words[layout.SEED_LOW, n],
        words[layout.SEED_HIGH, n],
    )
    return float((float(four[number & 3]) + 0.5) * 2.0**-32)


@inlined
def _draw_factors(
    task: TaskNumbers, words: WordArray, n: int, case: np.uint64, motor: np.uint64, out: FloatArray
) -> None:
    """The five nuisance factors into `drawn`, in the order of `recipes.FACTORS`: supply first."""
    p = task.prior
    low, high, k0, k1 = (
        np.uint32(motor & _LOW),
        np.uint32(motor >> _WORD),
        words[layout.SEED_LOW, n],
        words[layout.SEED_HIGH, n],
    )
    a, b, c, d = philox(np.uint32(0), _MOTOR, low, high, k0, k1)
    out[FACTORS + 1] = 1.0 + p[SPREAD + 1] * float(box_muller(a, b)[1])
    two = box_muller(c, d)
    out[FACTORS + 2], out[FACTORS + 3] = (
        1.0 + p[SPREAD + 2] * float(two[0]),
        1.0 + p[SPREAD + 3] * float(two[1]),
    )
    a, b, c, d = philox(np.uint32(1), _MOTOR, low, high, k0, k1)
    out[FACTORS + 4] = 1.0 + p[SPREAD + 4] * float(box_muller(a, b)[0])
    a, b, c, d = philox(np.uint32(0), _SUPPLY, np.uint32(case & _LOW), np.uint32(case >> _WORD), k0, k1)
    out[FACTORS] = 1.0 + p[SPREAD] * float(box_muller(a, b)[0])


@inlined
def draw_episode(task: TaskNumbers, lanes: Lanes, n: int) -> float:
    """Draw the episode that the words of lane n name, into its marks and `drawn`; its onset, NEVER without a fault."""
    p, words, drawn = task.prior, lanes.words, lanes.drawn[n]
    case = np.uint64(words[layout.CASE_LOW, n]) | (np.uint64(words[layout.CASE_HIGH, n]) << _WORD)
    starts = np.uint64(p[STARTS_PER_MOTOR])
    motor = case // starts if starts > np.uint64(1) else case
    which = 0
    if float(case - motor * starts) < p[HEALTHY_STARTS]:
        which = int(p[HEALTHY_CLASS])
    else:
        u = _uniform(_CLASS, words, n, motor, 0)
        while u >= task.classes[which, CUMULATED]:
            which += 1
    c = task.classes[which]
    drawn[SEVERITY] = c[SEVERITY_FROM]
    if c[SEVERITY_TO] > c[SEVERITY_FROM]:
        u = _uniform(_SEVERITY, words, n, motor, int(c[KIND_INDEX]))
        drawn[SEVERITY] += (c[SEVERITY_TO] - c[SEVERITY_FROM]) * u
    if p[IS_KNOWN] > 0.0:
        for m in range(FACTORS, layout.DRAWN_LENGTH):  # a slice would cost more than the draw
            drawn[m] = 1.0
    else:
        _draw_factors(task, words, n, case, motor, drawn)
    onset = NEVER
    if c[VERDICT] > 0.0:
        onset = p[EARLIEST]
        if p[LOG_STAY] > -np.inf:
            onset += np.floor(np.log(_uniform(_ONSET, words, n, case, 0)) / p[LOG_STAY])
    lanes.marks[layout.CLASS_INDEX, n] = which
    lanes.marks[layout.RUNNING_ONSET, n] = int(min(onset, 2.0**31 - 1.0)) if onset < NEVER else -1
    return onset


@inlined
def begin_state(s: FloatArray, j: int, task: TaskNumbers, lanes: Lanes, n: int) -> None:
    """Let lane j of a block, lane n of all, take the initial state of the episode drawn for it."""
    p, drawn = task.prior, lanes.drawn[n]
    current, speed = 0.0, 0.0
    if p[RUNNING] > 0.0:
        volts, ohm = p[SUPPLY_V] * drawn[FACTORS], p[R] * drawn[FACTORS + 1]
        back_emf, torque = p[KE] * drawn[FACTORS + 2], p[KT] * drawn[FACTORS + 2]
        drag = p[B] * drawn[FACTORS + 4]
        total = ohm * drag + torque * back_emf
        current = (drag * volts + back_emf * p[LOAD]) / total
        speed = (torque * volts - ohm * p[LOAD]) / total
    s[j + kernel.CURRENT * LANES], s[j + kernel.SPEED * LANES] = current - p[REST], speed - p[REST + 1]
    s[j + kernel.HELD * LANES] = speed - p[REST + 1]
    s[j + kernel.ERROR_CURRENT * LANES] = current - p[INITIAL]
    s[j + kernel.ERROR_SPEED * LANES] = speed - p[INITIAL + 1]
    s[j + kernel.KIND * LANES], s[j + kernel.SUPPLY * LANES] = (
        task.classes[lanes.marks[layout.CLASS_INDEX, n], VERDICT],
        drawn[FACTORS],
    )
