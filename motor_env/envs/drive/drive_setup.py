"""Constants and lanes of the compiled step of the drive, and the filters of its motors.

A block is a record whose fields are rows of `LANES` numbers, as in `motor_env.envs.layout`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from motor_env.envs.drive.options import Control, DriveOptions
from motor_env.envs.layout import BoolArray, WordArray, aligned_zeros, empty_streams
from motor_env.envs.setup import LinearBelief, converged_gain
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD
from motor_env.motor.exponentials import ROOM
from motor_env.motor.faults import Fault, apply_fault
from motor_env.motor.model import DiscreteModel, Input, discretize
from motor_env.motor.parameters import FloatArray, MotorParameters

LANES = 64
PARTS = ("tracking", "heat", "wear", "limp", "stop", "failure")
"""Parts of a reward."""
TRUTH = ("current", "speed", "load", "temperature", "severity", "kind", "onset", "growth")
_BELIEF = ("estimated_current", "estimated_speed", "step", "integral")
_DUE = ("heat_due", "wear_due")  # what heat and wear have cost: paid where the episode ends
_MOTOR = ("a00", "a01", "a10", "a11", "b0", "b1", "e0", "e1")
_MEASURED = ("measured_current", "measured_speed", "estimated_load", "innovation_current", "innovation_speed")
_OBSERVED = (*_MEASURED, "slow_current", "slow_speed", "voltage", "estimated_temperature", "scale", "time")
_WORK = ("share", "aim", "asked", "torque", "worn")
Block = Any
"""A record of `block_type`, or of `work_type`."""


class Task(NamedTuple):
    """Constants of the task, named as in `MotorParameters` and `DriveOptions`; a cost is that of a step."""

    resistance_ohm: float
    inductance_h: float
    back_emf_constant_v_s_per_rad: float
    torque_constant_n_m_per_a: float
    inertia_kg_m2: float  # with that of what it drives
    viscous_friction_n_m_s_per_rad: float
    period_s: float
    voltage_limit_v: float
    current_limit_a: float
    load_torque_n_m: float
    fan_n_m_s2: float
    load_memory: float  # share of the unknown load that is left after a step
    load_stir_n_m: float  # standard deviation of what comes on top
    lowest_speed_rad_s: float
    top_speed_rad_s: float
    shortest_plateau_s: float
    longest_plateau_s: float
    shortest_ramp_s: float
    longest_ramp_s: float
    healthy_share: float  # probability that no fault sets in
    no_winding_share: float  # that none does, or one of the bearing
    earliest_onset: float  # in steps
    log_stay: float  # logarithm of the probability that the onset is a step later
    slowest_growth_per_s: float
    log_growth_range: float
    stress_share: float
    full_power_w: float  # of the load at top speed
    bearing_onset: float  # severity
    winding_onset: float
    bearing_failure: float  # severity
    winding_failure: float
    heating_k_per_a2: float
    cooling: float  # share of a rise of temperature that happens in a step
    warm_k: float
    burn_k: float
    limp_share: float
    limp_step: float  # by how much the scale of the profile moves in a step
    current_noise_a: float
    speed_noise_rad_s: float
    horizon: float  # in steps
    tracking_cost: float  # of the squared error in units of the top speed
    heat_cost: float  # of a kelvin
    wear_cost: float  # of a unit of a bearing's severity
    failure_cost: float  # once
    stop_cost_per_s: float
    limp_cost: float  # of all of the profile's scale
    a00: float  # the discrete motor without a fault: x' = A x + b voltage + e load torque
    a01: float
    a10: float
    a11: float
    b0: float
    b1: float
    e0: float
    e1: float
    k00: float  # gain of its filter on current, speed and unknown load
    k01: float
    k10: float
    k11: float
    k20: float
    k21: float
    w00: float  # what whitens the innovation, a lower triangle
    w10: float
    w11: float
    slow_memory: float  # share of the slow means that is left after a step
    tracking_limit: float
    holds_speed: float  # 1: the drive's own controller sets the voltage
    by_current: float  # its gains
    by_speed: float
    by_integral: float
    periods: float  # of a decision


N_CONSTANTS = len(Task._fields)


class Lanes(NamedTuple):
    """State of all lanes, and where the profile is observed."""

    ahead: NDArray[np.int64]  # steps ahead at which the profile is observed
    state: NDArray[np.void]  # blocks, see `block_type`
    work: NDArray[np.void]  # one record of `work_type`
    words: WordArray  # as in `motor_env.envs.layout`, shape (4, n_lanes)
    flags: BoolArray  # shape (4, n_lanes)
    profile: FloatArray  # speeds, shape (n_lanes, n_steps and those observed beyond)


@cache
def block_type(n_ahead: int) -> np.dtype[np.void]:
    """A block of lanes: truth, filter, motor, observation.

    `asked` is the observed profile, `profile` its first row, `observed` all observed rows, `everything` all rows.
    """
    rows = (*TRUTH, *_BELIEF, *_DUE, *_MOTOR, *_OBSERVED)
    row, n_rows, first = 8 * LANES, len(rows) + n_ahead, len(rows) - len(_OBSERVED)
    wide = {"asked": (len(rows), n_ahead), "observed": (first, n_rows - first), "everything": (0, n_rows)}
    return np.dtype(
        {
            "names": [*rows, "profile", *wide],
            "formats": [(np.float64, (LANES,))] * (len(rows) + 1)
            + [(np.float64, (height, LANES)) for _, height in wide.values()],
            "offsets": [*range(0, row * len(rows) + 1, row), *(row * begin for begin, _ in wide.values())],
            "itemsize": row * n_rows,
        }
    )


@cache
def work_type(n_rows: int) -> np.dtype[np.void]:
    """Work space of a step of a block of so many rows; `kept` is a copy of the block."""
    return np.dtype(
        [
            *((name, np.float64, (LANES,)) for name in _WORK),
            ("parts", np.float64, (len(PARTS), LANES)),
            ("x", np.float64, (4, LANES)),
            ("exponential", np.float64, (4, LANES)),
            ("phi", np.float64, (4, LANES)),
            ("room", np.float64, (ROOM, LANES)),
            ("kept", np.float64, (n_rows, LANES)),
            ("made", np.uint32, (4, LANES)),
            ("noise", np.float32, (4, LANES)),
            ("faulty", np.int64, (LANES,)),
            ("stands", np.uint8, (LANES,)),
            ("over", np.uint8, (LANES,)),
        ]
    )


def empty_lanes(ahead: NDArray[np.int64], n_steps: int, count: int) -> Lanes:
    """Lanes before their first episode."""
    blocks = -(-count // LANES)
    block = block_type(len(ahead))
    state = aligned_zeros((blocks,), block)
    work = aligned_zeros((1,), work_type(block.itemsize // (8 * LANES)))
    words, flags = empty_streams(count)
    return Lanes(ahead, state, work, words, flags, np.zeros((count, n_steps + int(ahead.max()) + 1)))


SLOW_MEMORY_S = 0.3
INNOVATION_BOUND, MARGIN = 10.0, 1.5
_INNOVATIONS = ("innovation_current", "innovation_speed", "slow_current", "slow_speed")


class DriveSetup(NamedTuple):
    """Setup of a drive."""

    options: DriveOptions  # of the task
    task: Task  # constants of the compiled step
    ahead: NDArray[np.int64]  # steps ahead at which the profile is observed
    view: FloatArray  # unit, least and most of each observed number, shape (3, n_observed)
    observed: tuple[str, ...]  # their names


def drive_filter(options: DriveOptions, motor: MotorParameters) -> LinearBelief:
    """Filter of a driven motor, with the unknown load as a third state.

    The fan's torque is linearised at the middle of the profile's speeds.
    """
    model = discretize(motor, options.period_s)
    by_load = model.gain[:, Input.LOAD_TORQUE]
    middle = 0.5 * (options.lowest_speed_rad_s + options.top_speed_rad_s)
    transition = np.zeros((3, 3))
    transition[:2, :2] = model.transition
    transition[:2, 1] += 2.0 * options.fan_n_m_s2 * middle * by_load
    transition[:2, 2], transition[2, 2] = by_load, options.load_memory
    stir = options.load_std_n_m * math.sqrt(1.0 - options.load_memory**2)
    return LinearBelief(
        model=DiscreteModel(transition, model.gain, options.period_s),
        observation=np.eye(2, 3),
        process_covariance=np.diag(np.square([*DEFAULT_PROCESS_NOISE_STD, stir])),
        measurement_covariance=np.diag(np.square([options.current_noise_a, options.speed_noise_rad_s])),
    )


SPEED_WEIGHT, INTEGRAL_WEIGHT = 1.0, 3000.0  # on squared rad/s and rad beside squared volt


def speed_feedback(options: DriveOptions, motor: MotorParameters) -> FloatArray:
    """Linear-quadratic gain: voltage for current, speed, and integral of the speed's error."""
    model = drive_filter(options, motor).model
    a, b = np.eye(3), np.zeros((3, 1))
    a[:2, :2], b[:2, 0] = model.transition[:2, :2], model.gain[:, Input.VOLTAGE]
    a[2, 1] = options.period_s
    cost = solve_discrete_are(a, b, np.diag([0.0, SPEED_WEIGHT, INTEGRAL_WEIGHT]), np.eye(1))
    gain: FloatArray = np.linalg.solve(np.eye(1) + b.T @ cost @ b, b.T @ cost @ a)[0]
    return gain


def _rounded(*values: float) -> list[float]:
    """Round to twelve digits: linear algebra differs between processors, and an id's steps are the same to the bit."""
    return [float(f"{value:.12g}") for value in values]


def faulty(options: DriveOptions, label: str, severity: float) -> MotorParameters:
    """The driven motor with a fault; severity 0: the healthy one."""
    return apply_fault(options.driven, Fault(label, severity)) if severity > 0.0 else options.driven  # type: ignore[arg-type]


def make_setup(options: DriveOptions) -> DriveSetup:
    """Derive the setup from the options."""
    current, top = options.current_limit_a, options.top_speed_rad_s
    bound = {
        "measured_current": (current, -MARGIN, MARGIN),
        "measured_speed": (top, -MARGIN, MARGIN),
        "estimated_load": (10.0 * options.load_std_n_m, -MARGIN, MARGIN),
        **dict.fromkeys(_INNOVATIONS, (1.0, -INNOVATION_BOUND, INNOVATION_BOUND)),
        "voltage": (options.voltage_limit_v, -1.0, 1.0),
        "estimated_temperature": (options.burn_k, 0.0, MARGIN),
        "scale": (1.0, 0.0, 1.0),
        "time": (1.0, 0.0, 1.0),
        **{f"profile_{k}": (top, 0.0, 1.0) for k in options.ahead_steps},
    }
    return DriveSetup(
        options=options,
        task=_task(options),
        ahead=np.array(options.ahead_steps, dtype=np.int64),
        view=np.array(list(bound.values())).T.copy(),
        observed=tuple(bound),
    )


def _task(options: DriveOptions) -> Task:
    o, dt, motor = options, options.period_s, options.driven
    belief = drive_filter(o, motor)
    gain, covariance = converged_gain(belief)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    shares = np.cumsum(o.weights) / sum(o.weights)
    mean = o.mean_onset_s / dt
    slowest, fastest = o.growth_per_s
    bearing, _ = o.failure_severity
    model = discretize(motor, dt)
    numbers = [
        *(float(np.asarray(getattr(motor, name))) for name in MotorParameters.__slots__),
        *(dt, o.voltage_limit_v, o.current_limit_a, o.load_torque_n_m, o.fan_n_m_s2),
        *(o.load_memory, o.load_std_n_m * math.sqrt(1.0 - o.load_memory**2)),
        *(o.lowest_speed_rad_s, o.top_speed_rad_s, *o.plateau_s, *o.ramp_s),
        *(shares[0], shares[1], round(o.earliest_onset_s / dt)),
        (math.log(mean / (1.0 + mean)) or -1e-300) if mean > 0.0 else -np.inf,
        *(slowest, math.log(fastest / slowest), o.stress_share),
        max(o.load_torque_n_m + o.fan_torque_n_m, 1e-12) * o.top_speed_rad_s,
        *(*o.onset_severity, *o.failure_severity),
        o.thermal_resistance_k_per_w * float(np.asarray(motor.resistance_ohm)),
        *(1.0 - math.exp(-dt / o.thermal_time_s), o.warm_k, o.burn_k),
        *(o.limp_share, (1.0 - o.limp_share) * min(dt / o.limp_time_s, 1.0)),
        *(o.current_noise_a, o.speed_noise_rad_s, o.n_steps),
        *(o.tracking_cost_per_s * dt, o.heat_cost_per_k_s * dt, o.wear_cost / bearing, o.failure_cost),
        *(o.stop_cost_per_s, o.limp_cost_per_s * dt / (1.0 - o.limp_share)),
        *model.transition.ravel(),
        *(*model.gain[:, Input.VOLTAGE], *model.gain[:, Input.LOAD_TORQUE]),
        *_rounded(*gain.ravel(), whitening[0, 0], *whitening[1]),
        math.exp(-dt / SLOW_MEMORY_S),
        *(o.tracking_limit_per_s * dt, float(o.control is Control.DECISION)),
        *_rounded(*speed_feedback(o, motor)),
        o.steps_per_decision,
    ]
    return Task._make(numbers)
