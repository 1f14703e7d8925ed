"""Priors of what surrounds a motor (friction, supply, load, sensor), and the voltage profiles of motors at work."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.parameters import FloatArray, Floats, require, require_positive
from motor_env.simulation.sensor import SensorChain
from motor_env.simulation.simulate import Timing

Range = tuple[float, float]

NOTHING: Range = (0.0, 0.0)

COLDEST_K, HOTTEST_K = -250.0, 900.0
"""Temperature rises between which the linear laws of copper and magnets keep R, Kt and Kb positive."""


@dataclass(frozen=True, slots=True)
class Field:
    """Uniform priors (low, high) of departures from the textbook motor and of the current sensor's errors.

    Torques are relative to the nominal viscous friction torque at no-load speed.

    Attributes:
        coulomb_ratio: Coulomb friction, one draw a motor; a bearing fault raises it.
        stribeck_ratio: breakaway torque above it, one a motor.
        brush_drop_v: voltage drop of the brushes, one a motor.
        supply_resistance_ohm: resistance of supply and leads, one a motor.
        commutation_ripple: relative ripple of the torque constant, one a motor.
        sensor_gain: factor of the current sensor, one a motor.
        sensor_offset_a: its offset, one a start.
        temperature_rise_k: above the data sheet's temperature, one a start.
        load_ratio: load torque, one a start.
        ramp_s: rise time of the supply, one a start.
        ripple_v: amplitude of the supply's ripple, one a start.
        trigger_jitter: delay of the step, as a share of the sampling interval, one a start.
        bearing_ripple_ratio: torque ripple of a bearing fault of severity 1, one a start.
        ripple_hz: frequency of the supply's ripple.
        sensor_lag_s: time constant of the current sensor.
        sensor_range_a: where the current sensor saturates; 0 for no limit.
        adc_bits: bits of its converter; 0 for none.
        missing_fraction: share of samples that read NaN.
    """

    coulomb_ratio: Range = NOTHING
    stribeck_ratio: Range = NOTHING
    brush_drop_v: Range = NOTHING
    supply_resistance_ohm: Range = NOTHING
    commutation_ripple: Range = NOTHING
    sensor_gain: Range = (1.0, 1.0)
    sensor_offset_a: Range = NOTHING
    temperature_rise_k: Range = NOTHING
    load_ratio: Range = NOTHING
    ramp_s: Range = NOTHING
    ripple_v: Range = NOTHING
    trigger_jitter: Range = NOTHING
    bearing_ripple_ratio: Range = NOTHING
    ripple_hz: float = 100.0
    sensor_lag_s: float = 0.0
    sensor_range_a: float = 0.0
    adc_bits: int = 0
    missing_fraction: float = 0.0

    def __post_init__(self) -> None:
        for name in PRIORS:
            low, high = getattr(self, name)
            require(
                math.isfinite(low) and math.isfinite(high) and low <= high,
                f"field.{name} must be a finite [low, high] with low <= high, got [{low:g}, {high:g}]",
            )
            signed = ("sensor_offset_a", "temperature_rise_k")
            require(name in signed or low >= 0.0, f"field.{name} must be >= 0, got {low:g}")
        require(
            self.trigger_jitter[1] < 1.0, f"field.trigger_jitter must be < 1, got {self.trigger_jitter[1]:g}"
        )
        require(self.sensor_gain[0] > 0.0, f"field.sensor_gain must be > 0, got {self.sensor_gain[0]:g}")
        low, high = self.temperature_rise_k
        require(
            low >= COLDEST_K and high <= HOTTEST_K,
            f"field.temperature_rise_k must be in {COLDEST_K:g} .. {HOTTEST_K:g}, got [{low:g}, {high:g}]",
        )
        require_positive("field.ripple_hz", self.ripple_hz, zero_allowed=True)
        self.sensor_chain(gain=1.0, offset_a=0.0)

    def sensor_chain(self, gain: Floats, offset_a: Floats) -> SensorChain:
        """Return the current sensor with the given gain and offset."""
        return SensorChain(
            gain, offset_a, self.sensor_lag_s, self.sensor_range_a, self.adc_bits, self.missing_fraction
        )


PRIORS = tuple(f.name for f in fields(Field) if "Range" in str(f.type))
"""Names of the priors, in the order in which they are drawn."""

PER_MOTOR = PRIORS[:6]
"""Priors drawn once a motor; the others are drawn once a start."""


PROFILES = ("steps", "reversals", "staircase", "binary", "sine", "speed_loop")

DUTY_PRIORS = ("load_end_ratio", "fan_ratio")
"""Priors of a duty, drawn once a case, after those of the field."""

_LEVELS = 64  # held levels of a record; beyond them they repeat
_OTHERS = 4  # numbers that decide profile, pace, size and phase
N_UNIFORMS = _LEVELS + _OTHERS
"""Uniform numbers from which a profile is made."""


@dataclass(frozen=True, slots=True)
class Duty:
    """Priors of speed and load of a motor at work. Torques are relative to the viscous torque at no-load speed.

    Attributes:
        profiles: of the voltage, each equally often. `steps`: random levels of one direction. `reversals`: one level,
            back and forth. `staircase`: up and down in four steps. `binary`: one of two levels at random. `sine`: both
            directions. `speed_loop`: a controller follows random speeds of both directions, with the nominal back-EMF v
            - R i for the speed.
        hold_s: time of a level, log-uniform; a fourth of the sine's period.
        load_end_ratio: load torque at the end, linear from the field's `load_ratio`.
        fan_ratio: load with the square of the speed, at no-load speed.
    """

    profiles: tuple[str, ...] = PROFILES
    hold_s: Range = (0.02, 0.1)
    load_end_ratio: Range = NOTHING
    fan_ratio: Range = NOTHING

    def __post_init__(self) -> None:
        unknown = [name for name in self.profiles if name not in PROFILES]
        require(
            len(self.profiles) > 0 and not unknown,
            f"duty.profiles must be among {', '.join(PROFILES)}, got {', '.join(unknown) or 'none'}",
        )
        for name in ("hold_s", *DUTY_PRIORS):
            low, high = getattr(self, name)
            require(
                math.isfinite(high) and 0.0 <= low <= high,
                f"duty.{name} must be a finite [low, high] with 0 <= low <= high, got [{low:g}, {high:g}]",
            )
        require(self.hold_s[0] > 0.0, "duty.hold_s must be > 0, got 0")

    def profile(self, u: FloatArray, timing: Timing) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the voltage of each interval as a share of the supply's, and whether it is a speed loop's target.

        `u` are uniform numbers, shape (n_cases, N_UNIFORMS).

        Returns:
            Shapes (n_cases, n_samples) and (n_cases,).
        """
        kind = np.array([PROFILES.index(name) for name in self.profiles])[
            (u[:, 0] * len(self.profiles)).astype(np.int64)
        ][:, None]
        low, high = np.log(self.hold_s)
        size, phase = 0.4 + 0.6 * u[:, 2:3], u[:, 3:4]
        time = timing.interval_start_s / np.exp(low + (high - low) * u[:, 1:2]) + phase
        place = time.astype(np.int64)
        level = np.take_along_axis(u[:, _OTHERS:], place % _LEVELS, axis=1)
        stair = 4 - np.abs(place % 8 - 4)  # 0 1 2 3 4 3 2 1
        signed = np.where(level < 0.5, -1.0, 1.0) * (0.2 + 0.7 * np.abs(2.0 * level - 1.0))
        shapes = [
            0.2 + 0.8 * level,
            size * (1 - 2 * (place % 2)),
            size * (0.2 + 0.2 * stair),
            size * np.where(level < 0.5, 0.3, 1.0),
            size * np.sin(0.5 * np.pi * time),
            signed,
        ]
        return np.select([kind == n for n in range(len(PROFILES))], shapes), kind[:, 0] == 5
