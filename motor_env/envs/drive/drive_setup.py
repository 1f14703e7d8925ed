"""From the options of the drive to the numbers of its compiled step, and the filters of its motors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from motor_env.envs.drive.lanes import Task
from motor_env.envs.drive.options import Control, DriveOptions
from motor_env.envs.setup import LinearBelief, converged_gain
from motor_env.filters.kalman import DEFAULT_PROCESS_NOISE_STD
from motor_env.motor.faults import Fault, apply_fault
from motor_env.motor.model import DiscreteModel, Input, discretize
from motor_env.motor.parameters import FloatArray, MotorParameters

SLOW_MEMORY_S = 0.3
INNOVATION_BOUND, ROOM = 10.0, 1.5
_INNOVATIONS = ("innovation_current", "innovation_speed", "slow_current", "slow_speed")


class DriveSetup(NamedTuple):
    """What follows from the options.

    Attributes:
        options: what it was made from.
        task: constants of the compiled step.
        ahead: steps ahead at which the profile is observed.
        view: unit, least and most of each observed number, shape (3, n_observed).
        observed: their names.
    """

    options: DriveOptions
    task: Task
    ahead: NDArray[np.int64]
    view: FloatArray
    observed: tuple[str, ...]


def drive_filter(options: DriveOptions, motor: MotorParameters) -> LinearBelief:
    """Filter that believes in a driven motor: current, speed, and the unknown load as a third state.

    The fan's torque is linear in it, at the middle of the profile's speeds; what runs the filter takes it as it is.
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
    """Linear-quadratic gain with integral action: voltage for current, speed, and integral of the speed's error."""
    model = drive_filter(options, motor).model
    a, b = np.eye(3), np.zeros((3, 1))
    a[:2, :2], b[:2, 0] = model.transition[:2, :2], model.gain[:, Input.VOLTAGE]
    a[2, 1] = options.period_s
    cost = solve_discrete_are(a, b, np.diag([0.0, SPEED_WEIGHT, INTEGRAL_WEIGHT]), np.eye(1))
    gain: FloatArray = np.linalg.solve(np.eye(1) + b.T @ cost @ b, b.T @ cost @ a)[0]
    return gain


def _rounded(*values: float) -> list[float]:
    """Twelve digits: linear algebra rounds otherwise on other processors, and an id's steps are the same to the bit."""
    return [float(f"{value:.12g}") for value in values]


def faulty(options: DriveOptions, label: str, severity: float) -> MotorParameters:
    """The driven motor with a fault; the healthy one where the severity is 0."""
    return apply_fault(options.driven, Fault(label, severity)) if severity > 0.0 else options.driven  # type: ignore[arg-type]


def make_setup(options: DriveOptions) -> DriveSetup:
    """Everything that follows from the options."""
    current, top = options.current_limit_a, options.top_speed_rad_s
    bound = {
        "measured_current": (current, -ROOM, ROOM),
        "measured_speed": (top, -ROOM, ROOM),
        "estimated_load": (10.0 * options.load_std_n_m, -ROOM, ROOM),
        **dict.fromkeys(_INNOVATIONS, (1.0, -INNOVATION_BOUND, INNOVATION_BOUND)),
        "voltage": (options.voltage_limit_v, -1.0, 1.0),
        "estimated_temperature": (options.burn_k, 0.0, ROOM),
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
