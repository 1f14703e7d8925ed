"""What a real start adds to the textbook motor: supply that is no step, Coulomb friction, brush drop, sensor lag.

The equations of the motor stay those of `motor_env.motor.model`; brush drop and Coulomb friction enter as inputs that
oppose the current and the motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.special import ndtr

from motor_env.motor.compiled import njit
from motor_env.motor.model import DiscreteModel, continuous_model, discretize, steady_state
from motor_env.motor.parameters import FloatArray, MotorParameters

_SMALLEST_FRACTION = 1e-6
_DEAD_ZONE_EDGE = 0.1  # width of its edge (1 sd), of the zone


@dataclass(frozen=True, slots=True)
class Extension:
    """What the textbook lacks; all zero is the textbook.

    Attributes:
        coulomb_friction_n_m: friction torque that opposes any motion.
        brush_drop_v: voltage that opposes any current.
        supply_rise_s: time in which the supply rises.
        supply_shares: how much of the rise falls on each of as many equal parts of that time; none for a straight line.
        sensor_lag_s: time constant of the current sensor.
        speed_lag_s: time constant of the speed sensor.
        dead_zone_a: currents below it are hidden by the current sensor.
        fan_n_m_s2_per_rad2: load torque over the square of the speed.
    """

    coulomb_friction_n_m: float = 0.0
    brush_drop_v: float = 0.0
    supply_rise_s: float = 0.0
    supply_shares: tuple[float, ...] = ()
    sensor_lag_s: float = 0.0
    speed_lag_s: float = 0.0
    dead_zone_a: float = 0.0
    fan_n_m_s2_per_rad2: float = 0.0


@njit(cache=True)
def _step(
    a: FloatArray,
    b: FloatArray,
    current: float,
    speed: float,
    voltage: float,
    drop: float,
    coulomb: float,
    fan: float,
) -> tuple[float, float]:
    """One interval; drop and friction are implicit: they brake to zero and never beyond it."""
    free_current = a[0, 0] * current + a[0, 1] * speed + b[0, 0] * voltage
    free_speed = a[1, 0] * current + a[1, 1] * speed + b[1, 0] * voltage
    if fan > 0.0:
        free_current += b[0, 1] * fan * speed * abs(speed)
        free_speed += b[1, 1] * fan * speed * abs(speed)
    new_current = free_current
    if drop > 0.0:
        largest = b[0, 0] * drop
        new_current = math.copysign(max(abs(free_current) - largest, 0.0), free_current)
        free_speed -= b[1, 0] * (free_current - new_current) / b[0, 0]
    new_speed = free_speed
    if coulomb > 0.0:
        largest = -b[1, 1] * coulomb
        new_speed = math.copysign(max(abs(free_speed) - largest, 0.0), free_speed)
        new_current += b[0, 1] * (free_speed - new_speed) / -b[1, 1]
    return new_current, new_speed


@njit(cache=True)
def _run(
    a: FloatArray,
    b: FloatArray,
    first_a: FloatArray,
    first_b: FloatArray,
    voltage: FloatArray,
    begin: int,
    current: float,
    speed: float,
    drop: float,
    coulomb: float,
    fan: float,
    out: FloatArray,
) -> None:
    for k in range(voltage.shape[0]):
        if k < begin:
            out[k, 0], out[k, 1] = current, speed
            continue
        if k == begin:
            current, speed = _step(first_a, first_b, current, speed, voltage[k], drop, coulomb, fan)
        else:
            current, speed = _step(a, b, current, speed, voltage[k], drop, coulomb, fan)
        out[k, 0], out[k, 1] = current, speed


@njit(cache=True)
def _lagged(entering: FloatArray, decay: float, shown: float) -> FloatArray:
    """What a first-order lag shows of what enters it, beginning after `shown`."""
    out = np.empty_like(entering)
    for k in range(len(entering)):
        shown = entering[k] + decay * shown
        out[k] = shown
    return out


def mean_rise(extension: Extension, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Mean over the intervals [begin, end] of a supply that rises to 1, piece by piece in straight lines."""
    rise_s = extension.supply_rise_s
    if rise_s <= 0.0:
        return np.ones_like(begin_s)
    shares = np.array(extension.supply_shares or (1.0,))
    part_s = rise_s / len(shares)

    def integral(time_s: FloatArray) -> FloatArray:
        total = np.zeros_like(time_s)
        for n, share in enumerate(shares):
            since = np.maximum(time_s - n * part_s, 0.0)
            total += share * np.where(since < part_s, 0.5 * since**2 / part_s, since - 0.5 * part_s)
        return total

    mean: FloatArray = (integral(end_s) - integral(begin_s)) / (end_s - begin_s)
    return mean


def step_start(
    parameters: MotorParameters,
    extension: Extension,
    time_s: FloatArray,
    onset_s: float,
    voltage_v: float,
) -> FloatArray:
    """Current and speed at the sample times of a start from rest: a step of the supply at `onset_s`.

    The onset may lie between two samples; the first, shorter interval has a discrete model of its own.

    Args:
        parameters: one motor.
        extension: what to add to the textbook.
        time_s: evenly spaced, shape (n_samples,).
        onset_s: time of the step.
        voltage_v: level of the supply.

    Returns:
        Shape (n_samples, 2).
    """
    dt_s = float((time_s[-1] - time_s[0]) / (len(time_s) - 1))
    begin = int(np.searchsorted(time_s, onset_s, side="right"))
    model = discretize(parameters, dt_s)
    if begin >= len(time_s):
        return np.zeros((len(time_s), 2))
    starts = np.concatenate([[onset_s], time_s[begin:-1]]) - onset_s
    ends = time_s[begin:] - onset_s
    ends[0] = max(ends[0], _SMALLEST_FRACTION * dt_s)
    voltage = np.zeros(len(time_s))
    voltage[begin:] = voltage_v * mean_rise(extension, starts, ends)
    first = discretize(parameters, float(ends[0]))
    return _integrate(parameters, extension, voltage, models=(first, model), begin=begin, state=(0.0, 0.0))


def between_samples(voltage_v: FloatArray, late: float) -> FloatArray:
    """Mean of a measured voltage over each interval between two samples, shape (n_samples - 1,).

    Args:
        voltage_v: at the sample times, shape (n_samples,).
        late: how much later it changes than in the middle of an interval, in intervals. Within half of one the
            samples still tell the truth; beyond it they are read later or earlier than those of the current.
    """
    whole = round(late)
    shifted = voltage_v[np.clip(np.arange(len(voltage_v)) - whole, 0, len(voltage_v) - 1)]
    return shifted[:-1] + (0.5 - (late - whole)) * np.diff(shifted)


def driven(
    parameters: MotorParameters,
    extension: Extension,
    voltage_v: FloatArray,
    dt_s: float,
    *,
    from_rest: bool,
    late: float = 0.0,
) -> FloatArray:
    """Current and speed under a measured voltage.

    Args:
        parameters: one motor.
        extension: what to add to the textbook; the supply's rise is not used.
        voltage_v: voltage at the sample times, shape (n_samples,).
        dt_s: sampling interval.
        from_rest: start from rest, or from the steady state of the first voltage.
        late: where between two samples the voltage changes, see `between_samples`.

    Returns:
        Shape (n_samples, 2), at the sample times.
    """
    model = discretize(parameters, dt_s)
    voltage = np.concatenate([voltage_v[:1], between_samples(voltage_v, late)])
    state = (0.0, 0.0)
    if not from_rest:
        drop = math.copysign(min(extension.brush_drop_v, abs(float(voltage_v[0]))), float(voltage_v[0]))
        load = math.copysign(extension.coulomb_friction_n_m, float(voltage_v[0]))
        steady = steady_state(parameters, float(voltage_v[0]) - drop, load)
        state = (float(steady[0]), float(steady[1]))
    return _integrate(parameters, extension, voltage, models=(model, model), begin=1, state=state)


def _integrate(
    parameters: MotorParameters,
    extension: Extension,
    voltage: FloatArray,
    *,
    models: tuple[DiscreteModel, DiscreteModel],
    begin: int,
    state: tuple[float, float],
) -> FloatArray:
    """Current and speed from sample `begin` on; `models` are those of its interval and of all later ones."""
    first, model = models
    out = np.empty((len(voltage), 2))
    _run(
        model.transition,
        np.ascontiguousarray(model.gain),
        first.transition,
        np.ascontiguousarray(first.gain),
        voltage,
        begin,
        state[0],
        state[1],
        extension.brush_drop_v,
        extension.coulomb_friction_n_m,
        extension.fan_n_m_s2_per_rad2,
        out,
    )
    if extension.sensor_lag_s > 0.0:
        out[:, 0] = _sensed(parameters, extension.sensor_lag_s, out, models=models, begin=begin)
    if extension.dead_zone_a > 0.0:
        # Nothing below the zone is shown and all above it; the commutation carries the current across its edge.
        zone = extension.dead_zone_a
        out[:, 0] *= ndtr((out[:, 0] - zone) / (_DEAD_ZONE_EDGE * zone))
    if extension.speed_lag_s > 0.0:
        # A first-order lag, exact for a curve that is straight between the samples' means.
        decay, speed = math.exp(-model.dt_s / extension.speed_lag_s), out[:, 1]
        means = 0.5 * (speed[:-1] + speed[1:])
        out[1:, 1] = _lagged((1.0 - decay) * means, decay, float(speed[0]))
    return out


def _lag_row(parameters: MotorParameters, model: DiscreteModel, lag_s: float) -> FloatArray:
    """Weights of [current before, speed before, current after] in what a lagging sensor shows after an interval.

    Exact for a voltage held over the interval (matrix exponential of motor, sensor and held input; Van Loan 1978). The
    voltage follows from the current after it, so that brush drop and friction are in it.
    """
    plant = np.zeros((4, 4))
    continuous = continuous_model(parameters)
    plant[:2, :2], plant[:2, 2] = continuous.transition, continuous.gain[:, 0]
    plant[3, 0], plant[3, 3] = 1.0 / lag_s, -1.0 / lag_s
    current, speed, voltage = expm(plant * model.dt_s)[3, :3]
    a, b = model.transition, model.gain[0, 0]
    return np.array([current - voltage * a[0, 0] / b, speed - voltage * a[0, 1] / b, voltage / b])


def _sensed(
    parameters: MotorParameters,
    lag_s: float,
    states: FloatArray,
    *,
    models: tuple[DiscreteModel, DiscreteModel],
    begin: int,
) -> FloatArray:
    """The current as a sensor with a first-order lag shows it, shape (n_samples,); it begins in its steady state."""
    first, model = models
    rows = np.concatenate([states[:-1], states[1:, :1]], axis=1)
    entering = np.zeros(len(states))
    entering[1:] = rows @ _lag_row(parameters, model, lag_s)
    decay = math.exp(-model.dt_s / lag_s)
    steady = states[max(begin - 1, 0), 0]
    if begin < len(states):
        before = states[begin - 1] if begin > 0 else np.array([steady, states[0, 1]])
        step = np.array([before[0], before[1], states[begin, 0]])
        entering[begin] = step @ _lag_row(parameters, first, lag_s) + math.exp(-first.dt_s / lag_s) * steady
    shown = np.full(len(states), steady)
    shown[begin:] = _lagged(entering[begin:], decay, 0.0)
    return shown
