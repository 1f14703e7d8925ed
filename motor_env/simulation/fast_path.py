"""Measured transients by the million: the motor, its noise and its sensor in one compiled pass, in float32.

`measure` gives the readings of `simulate` in float32, ten times as fast.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import whole
from motor_env.motor.compiled import njit
from motor_env.motor.faults import NoiseSource, apply_faults, noise_variance_factor
from motor_env.motor.model import State, discretize, steady_state
from motor_env.motor.parameters import Channel, FloatArray, MotorParameters, require
from motor_env.simulation.nonlinear import (
    Driving,
    Effects,
    Sampling,
    groups_of,
    integrate,
    integrate_driven,
    substeps,
)
from motor_env.simulation.random_streams import Stream, normals, uniforms, whole_blocks
from motor_env.simulation.sensor import SensorChain, read_sensors
from motor_env.simulation.sensor_faults import VOLTAGE, fail_after_noise, fail_before_noise
from motor_env.simulation.simulate import LARGEST_SEED, Scenario, scenario_states


@njit(cache=True)
def _step_response(
    transition: FloatArray,
    rest: FloatArray,
    n_quiet: int,
    is_current: NDArray[np.bool_],
    out: NDArray[np.float32],
) -> None:
    n_channels, n_samples = out.shape[1], out.shape[2]
    n_driven = n_samples - n_quiet
    currents, speeds = np.empty(n_driven + 1), np.empty(n_driven + 1)
    for n in range(out.shape[0]):
        m = n if transition.shape[0] > 1 else 0
        a, b, c, d = transition[m, 0, 0], transition[m, 0, 1], transition[m, 1, 0], transition[m, 1, 1]
        currents[0], speeds[0] = -rest[n, 0], -rest[n, 1]
        known = 1
        while known <= n_driven:
            new = min(known, n_driven + 1 - known)
            from_current, from_speed = currents[:new], speeds[:new]
            to_current, to_speed = currents[known : known + new], speeds[known : known + new]
            for k in range(new):
                to_current[k] = a * from_current[k] + b * from_speed[k]
            for k in range(new):
                to_speed[k] = c * from_current[k] + d * from_speed[k]
            known += new
            a, b, c, d = a * a + b * c, b * (a + d), c * (a + d), d * d + b * c
        for channel in range(n_channels):
            quiet, driven = out[n, channel, :n_quiet], out[n, channel, n_quiet:]
            quiet[:] = 0.0
            deviation = currents[1:] if is_current[channel] else speeds[1:]
            level = rest[n, 0] if is_current[channel] else rest[n, 1]
            for k in range(n_driven):
                driven[k] = level + deviation[k]


def measure(
    scenario: Scenario,
    seed: int,
    cases: ArrayLike,
    *,
    effects: Effects | None = None,
    chain: SensorChain | None = None,
    nominal: MotorParameters | None = None,
    driving: Driving | None = None,
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return readings of the sensors; row n depends on its scenario and on (seed, case n) alone.

    Args:
        scenario: one motor, or a batch of n_cases.
        seed: the random seed.
        cases: case numbers, shape (n_cases,).
        effects: departures from the textbook motor; they allow no fault with an onset.
        chain: errors of the current sensor.
        nominal: motor that sets the integration step of effects; the scenario's by default.
        driving: of a motor at work, with effects; replaces the supply.
        out: filled where given.

    Returns:
        Shape (n_cases, n_channels, n_samples), float32; with driving, the voltage is one channel more.

    Raises:
        ValueError: the batch is not n_cases long, or effects with an onset or process noise.
    """
    numbers, timing, sensor = scenario.checked_cases(cases), scenario.timing, scenario.sensor
    seed = whole("seed", seed, most=LARGEST_SEED)
    n_cases = numbers.size
    if out is None:
        n_channels = len(sensor.channels) + (driving is not None)
        out = np.empty((n_cases, n_channels, timing.n_samples), dtype=np.float32)
    is_current = np.array([channel is Channel.CURRENT for channel in sensor.channels])
    constant = all(fault.is_constant or fault.kind.is_sensor for fault in scenario.faults) and not any(
        scenario.process_noise_std
    )
    faulty = apply_faults(scenario.parameters, scenario.faults)
    if effects is not None:
        require(constant, "effects need faults without an onset, and no process noise")
        motor = scenario.parameters if nominal is None else nominal
        steps = substeps(motor, timing.dt_s, float(np.max(effects.ripple_hz)))
        sampling = Sampling(timing.dt_s, steps, is_current, out)
        if driving is None:
            integrate(faulty, effects, scenario.supply.voltage_v, sampling, timing.n_quiet)
        else:
            noise_a = _noise_of_loop(scenario, driving, seed, numbers)
            integrate_driven(groups_of(faulty, effects, 0.0, n_cases), sampling, driving, noise_a)
    elif constant:
        transition = discretize(faulty, timing.dt_s).transition.reshape(-1, 2, 2)
        rest = steady_state(faulty, scenario.supply.voltage_v, scenario.load_torque_n_m)
        rest = np.ascontiguousarray(np.broadcast_to(rest, (n_cases, 2)))
        _step_response(transition, rest, timing.n_quiet, is_current, out)
    else:
        states = scenario_states(scenario, seed, numbers)
        out[:] = np.moveaxis(states, -1, -2)[:, np.where(is_current, State.CURRENT, State.SPEED)]
    require(
        bool(np.isfinite(out[..., -1]).all()),
        "the simulated current or speed left the range of numbers: a value of the recipe is too large or too small",
    )
    channels = [*sensor.channels, *([] if driving is None else [VOLTAGE])]
    fail_before_noise(out, channels, scenario.faults, timing.interval_start_s, scenario.full_scale)
    rows = np.empty((0, 5)) if chain is None else chain.rows(n_cases, timing.dt_s)
    read = out if driving is None else np.ascontiguousarray(out[:, :-1])
    read_sensors(read, is_current, rows, _noise_std(scenario), np.uint64(seed), numbers.astype(np.uint64))
    if driving is not None:
        out[:, :-1] = read
    fail_after_noise(out, channels, scenario.faults, timing.interval_start_s)
    if chain is not None and chain.missing_fraction > 0.0:
        lost = uniforms(seed, Stream.MISSING, numbers, timing.n_samples) < chain.missing_fraction
        read = out[:, : len(is_current)]
        read[np.broadcast_to(lost[:, None], read.shape)] = np.nan
    return out


def _noise_of_loop(scenario: Scenario, driving: Driving, seed: int, cases: NDArray[np.int64]) -> FloatArray:
    """Return the current noise that `read_sensors` adds later, (n_cases, n_samples); no rows without a loop."""
    n_samples, channels = scenario.timing.n_samples, scenario.sensor.channels
    if not driving.is_loop.any():
        return np.empty((0, n_samples))
    require(Channel.CURRENT in channels, "a speed loop needs the current among the channels")
    place, stride = channels.index(Channel.CURRENT), whole_blocks(n_samples)
    z = normals(seed, Stream.MEASUREMENT, cases, (place + 1) * stride)[:, place * stride :]
    noise: FloatArray = z[:, :n_samples] * _noise_std(scenario)[:, place]
    return noise


def _noise_std(scenario: Scenario) -> NDArray[np.float32]:
    """Return the noise of each reading, shape (n_cases or 1, n_channels, n_samples or 1)."""
    begins = scenario.timing.interval_start_s
    if all(fault.is_constant for fault in scenario.faults):
        begins = begins[:1]
    factor = np.sqrt(noise_variance_factor(scenario.faults, NoiseSource.MEASUREMENT, begins))
    std: NDArray[np.float32] = (scenario.sensor.noise_std[:, None] * factor[:, None, :]).astype(np.float32)
    return np.ascontiguousarray(std)
