"""A motor at work: the voltage profiles that drive it and the loads that it meets, as priors and as drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.disturbances import NOTHING, Range
from motor_env.simulation.simulate import Timing

PROFILES = ("steps", "reversals", "staircase", "binary", "sine", "speed_loop")

DUTY_PRIORS = ("load_end_ratio", "fan_ratio")
"""Priors of a duty, drawn once a case, after those of the field."""

_LEVELS = 64  # held levels of a record; beyond them they repeat
_OTHERS = 4  # numbers that decide profile, pace, size and phase
N_UNIFORMS = _LEVELS + _OTHERS
"""Uniform numbers that a profile is made from."""


@dataclass(frozen=True, slots=True)
class Duty:
    """What a motor at work is asked for. Torques are relative to the viscous torque at no-load speed.

    Attributes:
        profiles: of the voltage, each equally often. `steps`: random levels of one direction. `reversals`: one level,
            back and forth. `staircase`: up and down in four steps. `binary`: one of two levels at random. `sine`: both
            directions. `speed_loop`: a controller follows random speeds of both directions; it takes the back-EMF
            v - R i of the nominal motor for the speed, with i the current and its noise.
        hold_s: time for which a level is held, log-uniform; a fourth of a period for the sine.
        load_end_ratio: load torque at the end; it moves there in a straight line from the field's `load_ratio`.
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
        """Voltage in each interval as a share of the supply's, and whether it is what a speed loop wants.

        Args:
            u: uniform numbers, shape (n_cases, N_UNIFORMS).
            timing: time axis.

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
