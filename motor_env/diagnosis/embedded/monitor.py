"""Build a monitor for a controller: a filter with known gains, a rule with thresholds, a check of the sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from motor_env.detection.rules.cusum import Cusum
from motor_env.filters.kalman import KalmanFilter, Schedule, schedule
from motor_env.motor.data_sheet import Motor
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import Channel, FloatArray, SensorParameters, require, require_positive

DEAD_AFTER = 4
"""Successive samples without a current, where the model's is large, that show a dead sensor."""
LARGE_CURRENT_SHARE = 0.1
"""Share of the stall current above which the model's current is large."""
DEADBAND = 0.01
_HEADROOM = 2.0
_YEAR_S = 365.25 * 86_400.0
_OVERLAP = 12.0


class Readings(NamedTuple):
    """One number for each reading: its largest magnitude, or the size of one count."""

    current_a: float
    speed_rad_s: float
    voltage_v: float

    def counts(self, *given: float | None) -> Self:
        """Return the size of one count: as given, else a power of ten, with 1e7 to 1e8 counts a reading."""
        tens = [10.0 ** (math.floor(math.log10(largest)) - 7) for largest in self]
        chosen = zip(tens, given or 3 * [None], strict=True)
        return type(self)(*(ten if count is None else count for ten, count in chosen))


@dataclass(frozen=True, slots=True)
class CusumBank:
    """Two-sided CUSUMs of several shifts on the innovation of the current, each times a sign.

    The sign is known before the sample, so the product stays white and each sum has its exact threshold. Friction
    moves the current with the sign of the speed, averaged over the mechanical time constant, a resistance against that
    of the current less such an average. False alarm rates nearly add up.

    Attributes:
        friction: shifts with the first sign, in standard deviations of a sample.
        winding: shifts with the second sign.
    """

    friction: tuple[float, ...] = (0.15, 0.5)
    winding: tuple[float, ...] = (1.25,)

    @property
    def shifts(self) -> tuple[float, ...]:
        """List the shift of each sum."""
        return (*self.friction, *self.winding)

    def thresholds_for(self, arl0: float) -> tuple[float, ...]:
        """Return the threshold of each sum, at equal shares of the false alarms."""
        overlap = min(_OVERLAP / math.sqrt(arl0), 0.1) if len(self.shifts) > 1 else 0.0
        own_arl0 = arl0 * len(self.shifts) * (1.0 - overlap)
        return tuple(Cusum(shift, two_sided=True).threshold_for(arl0=own_arl0).value for shift in self.shifts)


@dataclass(frozen=True, slots=True)
class Monitor:
    """Filter of one motor, with a rule on its innovations and thresholds.

    Attributes:
        motor: for its name, brush drop and dry friction.
        kalman: of the current, or of current and speed, with the steady covariance.
        rule: bank of CUSUMs.
        thresholds: of each sum.
        limits: of the sensors.
        stuck_after: equal readings in a row, with voltage on, of a stuck sensor.
    """

    motor: Motor
    kalman: KalmanFilter
    rule: CusumBank
    thresholds: tuple[float, ...]
    limits: Readings
    stuck_after: int = 100

    def gains(self) -> tuple[FloatArray, FloatArray]:
        """Return the steady Kalman gain (2, m), and the current's whitening over each threshold (p, 1)."""
        steps = steady_schedule(self.kalman)
        white = np.linalg.inv(np.linalg.cholesky(steps.innovation_covariance[-1]))
        return steps.gain[-1], white[:1, :1] / np.array(self.thresholds)[:, None]


def steady_schedule(kalman: KalmanFilter) -> Schedule:
    """Compute gains until they no longer change."""
    for power in range(8, 21):
        steps = schedule(kalman, 2**power)
        if steps.held_from < 2**power:
            break
    return steps


def sensor_of(
    motor: Motor, current_noise_a: float | None = None, speed_noise_rad_s: float | None = None
) -> SensorParameters:
    """Return the current sensor, with a speed sensor where its noise is given.

    Raises:
        ValueError: the noise of the current is unknown.
    """
    noise_a = motor.current_noise_a if current_noise_a is None else current_noise_a
    require(
        noise_a is not None, "the motor file has no sensor.current_noise_a; give the noise of the current"
    )
    channels = (Channel.CURRENT,) if speed_noise_rad_s is None else (Channel.CURRENT, Channel.SPEED)
    return SensorParameters(channels, noise_a or 0.0, speed_noise_rad_s or 0.0)


def monitor_of(
    motor: Motor,
    rate_hz: float,
    *,
    rule: CusumBank,
    sensor: SensorParameters,
    voltage_v: float,
    false_alarms_per_year: float = 1.0,
    stuck_after: int = 100,
) -> Monitor:
    """Build the monitor of an exactly known motor without a load.

    Args:
        motor: with the filter's parameters.
        rate_hz: samples a second.
        rule: bank of CUSUMs.
        sensor: current, or current and speed, with their noise.
        voltage_v: level of the supply; the sensors' limits are twice its effect.
        false_alarms_per_year: of the healthy motor.
        stuck_after: equal readings in a row, with voltage on, of a stuck sensor.

    Raises:
        ValueError: a value out of range, or too few false alarms to solve for.
    """
    for name, value in (
        ("rate_hz", rate_hz),
        ("voltage_v", voltage_v),
        ("false_alarms_per_year", false_alarms_per_year),
    ):
        require_positive(name, value)
    require(1 <= stuck_after < 65_536, f"stuck_after must be from 1 to 65535, got {stuck_after}")
    kalman = KalmanFilter.from_parameters(motor.parameters, sensor, 1.0 / rate_hz)
    kalman = replace(kalman, initial_covariance=steady_schedule(kalman).covariance[-1])
    arl0 = _YEAR_S * rate_hz / false_alarms_per_year
    thresholds = rule.thresholds_for(arl0)
    _, speed = steady_state(motor.parameters, voltage_v).tolist()
    limits = Readings(
        current_a=_HEADROOM * voltage_v / float(motor.parameters.resistance_ohm),
        speed_rad_s=_HEADROOM * speed,
        voltage_v=_HEADROOM * voltage_v,
    )
    for name, value in zip(Readings._fields, limits, strict=True):
        require_positive(name, value)
    return Monitor(motor, kalman, rule, thresholds, limits, stuck_after)
