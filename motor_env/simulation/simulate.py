"""Simulation of measured transients: the linear motor by exact zero-order hold, one motor or a batch."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.common.arrays import instance, number, numbers, spread, whole, wholes
from motor_env.motor.faults import Fault, NoiseSource, apply_faults, noise_variance_factor
from motor_env.motor.model import N_STATES, Input, discretize, propagate
from motor_env.motor.parameters import (
    Channel,
    FloatArray,
    Floats,
    MotorParameters,
    SensorParameters,
    SupplyParameters,
    common_shape,
    require,
    require_positive,
)
from motor_env.simulation.random_streams import Stream, normals, whole_blocks
from motor_env.simulation.sensor_faults import fail_after_noise, fail_before_noise

LARGEST_SEED = 2**64 - 1
MOST_SAMPLES = 10_000_000
"""Most samples of a transient: about a gigabyte of memory."""


@dataclass(frozen=True, slots=True)
class Timing:
    """The time axis of a transient. Time 0 is the step of the supply.

    Attributes:
        sampling_rate_hz: samples a second.
        duration_s: time sampled after the step.
        quiet_s: time sampled before the step.
    """

    sampling_rate_hz: float = 10_000.0
    duration_s: float = 0.1
    quiet_s: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = require_positive(name, getattr(self, name), zero_allowed=name == "quiet_s", one=True)
            object.__setattr__(self, name, value)
        samples = self.sampling_rate_hz * (self.duration_s + self.quiet_s)
        require(
            samples <= MOST_SAMPLES,
            f"duration_s and quiet_s must hold at most {MOST_SAMPLES} samples at {self.sampling_rate_hz:g} Hz,"
            f" got {samples:g}",
        )
        require(
            self.n_after >= 1,
            f"duration_s must hold at least one sample at {self.sampling_rate_hz:g} Hz, got {self.duration_s:g}",
        )

    @property
    def dt_s(self) -> float:
        """Sampling interval."""
        return 1.0 / self.sampling_rate_hz

    @property
    def n_quiet(self) -> int:
        """Samples before the step (the last is read at the moment of the step)."""
        return round(self.quiet_s * self.sampling_rate_hz)

    @property
    def n_after(self) -> int:
        """Samples after the step."""
        return round(self.duration_s * self.sampling_rate_hz)

    @property
    def n_samples(self) -> int:
        """All samples."""
        return self.n_quiet + self.n_after

    @property
    def time_s(self) -> FloatArray:
        """Time of each sample at the end of its interval, shape (n_samples,)."""
        return np.arange(1 - self.n_quiet, self.n_after + 1, dtype=np.float64) * self.dt_s

    @property
    def interval_start_s(self) -> FloatArray:
        """Begin of each sampling interval, shape (n_samples,)."""
        return np.arange(-self.n_quiet, self.n_after, dtype=np.float64) * self.dt_s

    def step(self, level: float) -> FloatArray:
        """Return a step to `level` at time 0, for each interval, shape (n_samples,)."""
        return np.where(np.arange(self.n_samples) >= self.n_quiet, level, 0.0)


def case_numbers(cases: ArrayLike) -> NDArray[np.int64]:
    """Return case numbers as an array (n_cases,); `ValueError` unless they are whole and >= 0."""
    found = np.atleast_1d(wholes("cases", cases))
    require(found.ndim == 1, f"cases must have shape (n_cases,), got {found.shape}")
    return found


_SEVERAL = "motors, supply, states and severities, where not of one motor,"


def _check_motors(parameters: MotorParameters, faults: tuple[Fault, ...]) -> None:
    instance("parameters", parameters, MotorParameters)
    instance("faults", faults, (tuple, list))
    for n, fault in enumerate(faults):
        instance(f"faults[{n}]", fault, Fault)


@dataclass(frozen=True, slots=True)
class Scenario:
    """Settings of a transient but its random numbers; one motor or a batch.

    Attributes:
        parameters: the motor without its faults, one or a batch.
        faults: in a batch a severity is an array, 0 for motors without the fault.
        supply: voltage step, one level or one a motor.
        sensor: channels and noise.
        timing: time axis.
        load_torque_n_m: constant load from the step on.
        process_noise_std: noise added to [current, speed] in each interval.
    """

    parameters: MotorParameters
    faults: tuple[Fault, ...] = ()
    supply: SupplyParameters = field(default_factory=SupplyParameters)
    sensor: SensorParameters = field(default_factory=SensorParameters)
    timing: Timing = field(default_factory=Timing)
    load_torque_n_m: float = 0.0
    process_noise_std: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _check_motors(self.parameters, self.faults)
        for kind in (SupplyParameters, SensorParameters, Timing):
            name = kind.__name__.removesuffix("Parameters").lower()
            instance(name, getattr(self, name), kind)
        object.__setattr__(self, "load_torque_n_m", number("load_torque_n_m", self.load_torque_n_m))
        numbers("process_noise_std", self.process_noise_std, (N_STATES,), least=0.0)
        _ = self.batch_shape

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """`()` for one motor, `(n_motors,)` for a batch."""
        severities = (fault.severity for fault in self.faults)
        motors = (getattr(self.parameters, name) for name in self.parameters.__slots__)
        return common_shape(_SEVERAL, *motors, self.supply.voltage_v, *severities)

    @property
    def full_scale(self) -> dict[str, Floats]:
        """Full scale of current and speed: the blocked motor's current and the ideal no-load speed."""
        volts, motor = np.abs(self.supply.voltage_v), self.parameters
        return {
            Channel.CURRENT: volts / motor.resistance_ohm,
            Channel.SPEED: volts / motor.back_emf_constant_v_s_per_rad,
        }

    def checked_cases(self, cases: ArrayLike) -> NDArray[np.int64]:
        """Return case numbers as an array; `ValueError` unless there is one for each motor."""
        found = case_numbers(cases)
        require(
            self.batch_shape in ((), found.shape),
            f"cases must number as many as the scenario's motors {self.batch_shape}, got {found.size}",
        )
        return found


@dataclass(frozen=True, slots=True)
class Transients:
    """Simulated transients: readings, and the truth for scoring.

    Attributes:
        time_s: shape (n_samples,); 0 is the step.
        voltage_v: applied voltage, shape (n_cases, n_samples).
        measurements: readings of the sensors, shape (n_cases, n_channels, n_samples).
        channels: their names.
        states: true current and speed, shape (n_cases, n_samples, 2).
    """

    time_s: FloatArray
    voltage_v: FloatArray
    measurements: FloatArray
    channels: tuple[Channel, ...]
    states: FloatArray


def simulate_states(
    parameters: MotorParameters,
    voltage_v: ArrayLike,
    dt_s: float,
    *,
    faults: tuple[Fault, ...] = (),
    load_torque_n_m: ArrayLike = 0.0,
    initial_state: ArrayLike = (0.0, 0.0),
    process_noise: FloatArray | None = None,
    start_s: float = 0.0,
) -> FloatArray:
    """Return true current and speed of one motor or a batch, for any voltage (paper, eq. (3)).

    Args:
        parameters: the motor without its faults.
        voltage_v: voltage held in each interval, shape (n_samples,) or (n_cases, n_samples).
        dt_s: sampling interval.
        faults: their onsets count from time 0.
        load_torque_n_m: scalar, or the shape of `voltage_v`.
        initial_state: current and speed before the first interval, shape (2,) or (n_cases, 2).
        process_noise: added to the state at the end of each interval, shape (n_cases, n_samples, 2).
        start_s: time at which the first interval begins.

    Returns:
        States at the end of each interval, shape (n_samples, 2), or (n_cases, n_samples, 2) for a batch.

    Raises:
        ValueError: a number is not finite, shapes do not fit, or the motor leaves the range of numbers.
    """
    _check_motors(parameters, faults)
    voltage = numbers("voltage_v", voltage_v, ("...", "n_samples"))
    require(
        voltage.ndim <= 2,
        f"voltage_v must have shape (n_samples,) or (n_cases, n_samples), got {voltage.shape}",
    )
    n_samples = voltage.shape[-1]
    begin = numbers("initial_state", initial_state, ("...", N_STATES))
    added = np.zeros((n_samples, N_STATES))
    if process_noise is not None:
        added = numbers("process_noise", process_noise, ("...", n_samples, N_STATES))
    motors = (getattr(parameters, name) for name in parameters.__slots__)
    severities = (fault.severity for fault in faults)
    batch = common_shape(_SEVERAL, voltage[..., 0], begin[..., 0], added[..., 0, 0], *motors, *severities)
    require(len(batch) <= 1, f"motors must be one, or of shape (n_cases,), got {batch}")
    n_cases = int(np.prod(batch))
    inputs = np.empty((int(np.prod(voltage.shape[:-1])), n_samples, len(Input)))
    inputs[..., Input.VOLTAGE] = voltage
    inputs[..., Input.LOAD_TORQUE] = spread("load_torque_n_m", load_torque_n_m, voltage.shape)
    state = np.broadcast_to(begin, (n_cases, N_STATES)).copy()
    noise = np.empty((0, n_samples, N_STATES))
    if process_noise is not None:
        noise = np.ascontiguousarray(np.broadcast_to(added, (n_cases, n_samples, N_STATES)))
    start_s, dt_s = number("start_s", start_s), number("dt_s", dt_s, above=0.0)
    out = np.empty((n_cases, n_samples, N_STATES))
    for first, end, active in _segments(faults, start_s + dt_s * np.arange(n_samples, dtype=np.float64)):
        model = discretize(apply_faults(parameters, active), dt_s)
        propagate(
            model.transition.reshape(-1, N_STATES, N_STATES),
            np.ascontiguousarray(model.gain).reshape(-1, N_STATES, len(Input)),
            inputs[:, first:end],
            noise[:, first:end],
            state,
            out[:, first:end],
        )
    require(
        bool(np.isfinite(out[:, -1]).all()),
        "the current or speed left the range of numbers: a parameter, the voltage or the load is too large",
    )
    return out.reshape(*batch, n_samples, N_STATES)


def _segments(
    faults: tuple[Fault, ...], interval_start_s: FloatArray
) -> list[tuple[int, int, tuple[Fault, ...]]]:
    """Cut the time axis where a severity changes: (begin, end, faults at their severities between)."""
    n_samples = len(interval_start_s)
    changing = [fault for fault in faults if not fault.is_constant]
    if not changing:
        return [(0, n_samples, faults)]
    fractions = [fault.fraction_at(interval_start_s) for fault in changing]
    changes = [np.diff(np.atleast_2d(fraction)).any(axis=0) for fraction in fractions]
    cuts = [0, *(np.flatnonzero(np.any(changes, axis=0)) + 1).tolist(), n_samples]
    constant = tuple(fault for fault in faults if fault.is_constant)
    segments = []
    for begin, end in pairwise(cuts):
        held = tuple(
            Fault(fault.kind, fault.severity * fraction[..., begin], noise_source=fault.noise_source)
            for fault, fraction in zip(changing, fractions, strict=True)
        )
        segments.append((begin, end, constant + held))
    return segments


def simulate(scenario: Scenario, seed: int, cases: ArrayLike) -> Transients:
    """Simulate a scenario; the noise of row n comes from the streams of case `cases[n]` alone.

    `cases` has shape (n_cases,).

    Raises:
        ValueError: the batch is not n_cases long.
    """
    instance("scenario", scenario, Scenario)
    seed = whole("seed", seed, most=LARGEST_SEED)
    rows, timing, sensor = scenario.checked_cases(cases), scenario.timing, scenario.sensor
    states = scenario_states(scenario, seed, rows)
    level = np.broadcast_to(np.asarray(scenario.supply.voltage_v, dtype=np.float64), rows.shape)
    n_channels = len(sensor.channels)
    stride = whole_blocks(timing.n_samples)  # a channel begins with a block of its own
    noise = normals(seed, Stream.MEASUREMENT, rows, n_channels * stride)
    noise = noise.reshape(-1, n_channels, stride)[..., : timing.n_samples] * sensor.noise_std[:, None]
    factor = noise_variance_factor(scenario.faults, NoiseSource.MEASUREMENT, timing.interval_start_s)
    noise *= np.sqrt(factor)[:, None, :]
    columns, begins = sensor.observation @ np.moveaxis(states, -1, -2), timing.interval_start_s
    fail_before_noise(columns, sensor.channels, scenario.faults, begins, scenario.full_scale)
    columns += noise
    fail_after_noise(columns, sensor.channels, scenario.faults, begins)
    return Transients(timing.time_s, level[:, None] * timing.step(1.0), columns, sensor.channels, states)


def scenario_states(scenario: Scenario, seed: int, cases: NDArray[np.int64]) -> FloatArray:
    """Return true current and speed of each case, shape (n_cases, n_samples, 2)."""
    timing = scenario.timing
    step = timing.step(1.0)
    level = np.broadcast_to(np.asarray(scenario.supply.voltage_v, dtype=np.float64), cases.shape)
    return simulate_states(
        scenario.parameters,
        level[:, None] * step,
        timing.dt_s,
        faults=scenario.faults,
        load_torque_n_m=scenario.load_torque_n_m * step,
        process_noise=_process_noise(scenario, seed, cases),
        start_s=float(timing.interval_start_s[0]),
    )


def _process_noise(scenario: Scenario, seed: int, cases: NDArray[np.int64]) -> FloatArray | None:
    if not any(scenario.process_noise_std):
        return None
    n_samples = scenario.timing.n_samples
    noise = normals(seed, Stream.PROCESS, cases, n_samples * N_STATES).reshape(-1, n_samples, N_STATES)
    factor = noise_variance_factor(scenario.faults, NoiseSource.PROCESS, scenario.timing.interval_start_s)
    scaled: FloatArray = noise * np.asarray(scenario.process_noise_std) * np.sqrt(factor)[:, :, None]
    return scaled
