"""A motor file as a recipe: the starts that a learned method must have seen before it judges those of that motor.

A data sheet gives the tolerances of its series, the temperature's share included; a commissioned motor gives the
scatter of its own starts, in what its recordings can tell (`motor_env.motor.identifiable`), and a recipe wants it in
factors on V, R, K, J and B. What the current alone tells of K^2/J becomes half as much of K: the inertia of one motor
does not change from start to start, while magnets warm up, and a scatter of J would also scatter B/J beyond what was
measured. A scatter of B/J becomes one of B. Ratios per volt hold the supply's scatter already. A spread that a recipe
cannot draw is refused: a narrower one would teach a method to call healthy starts faulty.
"""

from __future__ import annotations

import math
import re

import numpy as np

from motor_env.common.errors import InputError
from motor_env.motor.data_sheet import Motor
from motor_env.motor.healthy import Healthy, Starts
from motor_env.motor.identifiable import tolerance_std
from motor_env.motor.parameters import Channel, SensorParameters, SupplyParameters
from motor_env.simulation.disturbances import NOTHING, Field, Range
from motor_env.simulation.recipes import FACTORS, LARGEST_SPREAD, PAPER_CLASSES, FaultClass, Recipe, Spread
from motor_env.simulation.simulate import Timing

_FACTOR_OF = {
    "R": ("resistance", 1.0),
    "K": ("constants", 1.0),
    "K^2/J": ("constants", 0.5),
    "J": ("inertia", 1.0),
    "B": ("friction", 1.0),
    "B/J": ("friction", 1.0),
}
"""The recipe's factor that a quantity's spread becomes, and with which share. L has no factor in a recipe."""
# Mechanical time constants: the level that shows the friction then lasts for most of the time.
_SETTLED = 25.0
_SAMPLES = 1000
_NOISE_SHARE = 0.004  # of the stall current, where the sensor's noise is not known


def motor_recipe(
    motor: Motor,
    *,
    voltage_v: float | None = None,
    timing: Timing | None = None,
    classes: tuple[FaultClass, ...] = PAPER_CLASSES,
) -> Recipe:
    """Recipe of one motor: its parameters, its own nuisances, its noise, and the supply of its starts.

    Args:
        motor: data sheet, identified or commissioned motor.
        voltage_v: level of the supply; the file's nominal voltage by default.
        timing: time axis; by default that of the starts it was commissioned on, else `settling_timing`.
        classes: what may be wrong with it.

    Raises:
        InputError: no voltage is known, or a tolerance is larger than a recipe can draw.
    """
    starts = None if motor.healthy is None else motor.healthy.starts
    voltage = motor.nominal_voltage_v if voltage_v is None else voltage_v
    if voltage is None:
        raise InputError(f"{motor.name}: gives no nominal_voltage_v; say --voltage")
    noise = motor.current_noise_a
    if noise is None and starts is not None:
        noise = math.exp(starts.log_noise)
    if noise is None:
        noise = _two_digits(_NOISE_SHARE * voltage / float(np.mean(motor.parameters.resistance_ohm)))
    speed_noise = motor.speed_noise_rad_s
    channels = (Channel.CURRENT,) if speed_noise is None else (Channel.CURRENT, Channel.SPEED)
    return Recipe(
        name=re.sub(r"\W+", "_", motor.name).strip("_") or "motor",
        motor=motor.parameters,
        supply=SupplyParameters(voltage),
        spread=_spread(motor),
        classes=classes,
        sensor=SensorParameters(channels, noise, speed_noise or SensorParameters().speed_noise_rad_s),
        timing=timing or _start_timing(starts) or settling_timing(motor),
        field=_field(motor, voltage),
    )


def settling_timing(motor: Motor, duration_s: float | None = None) -> Timing:
    """A thousand samples over 25 mechanical time constants (to two digits), or over a given duration."""
    if duration_s is None:
        duration_s = _two_digits(_SETTLED * float(np.mean(motor.parameters.mechanical_time_constant_s)))
    return Timing(round(_SAMPLES / duration_s), duration_s)


def _start_timing(starts: Starts | None) -> Timing | None:
    if starts is None or starts.sampling_rate_hz is None or starts.duration_s is None:
        return None
    return Timing(starts.sampling_rate_hz, starts.duration_s, starts.quiet_s or 0.0)


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}")


def _spread(motor: Motor) -> Spread:
    std = tolerance_std(motor.tolerance)
    values = {name: std[name] for name in FACTORS}
    if motor.healthy is not None:
        values = _learned_spread(motor.healthy, values["supply"])
    for name, value in values.items():
        if value > LARGEST_SPREAD:
            raise InputError(
                f"{motor.name}: a tolerance of {value:.3g} on {name}, temperature included, is more than "
                f"{LARGEST_SPREAD}, the largest that can be drawn"
            )
    return Spread(**values)


def _learned_spread(healthy: Healthy, supply: float) -> dict[str, float]:
    """Standard deviations of the next start's factors."""
    # The standard deviation of a Student t exceeds its scale.
    freedom = max(healthy.degrees_of_freedom, 3.0)
    std = np.sqrt(np.diag(healthy.log_covariance) * freedom / (freedom - 2.0))
    per_volt = any("V" in name for name in healthy.quantities)
    values = {"supply": 0.0 if per_volt else supply}
    for name, value in zip(healthy.quantities, std.tolist(), strict=True):
        quantity = name.replace("(J V)", "J").removesuffix("/V")
        if quantity in _FACTOR_OF:
            factor, share = _FACTOR_OF[quantity]
            # Sisters may differ by more than a factor about 1 can: their friction by half and more.
            most = math.inf if healthy.fleet is None else LARGEST_SPREAD
            values[factor] = min(share * value, most)
    return values


def _field(motor: Motor, voltage_v: float) -> Field | None:
    """Coulomb friction, brush drop, supply ramp and sensor lag of the motor's starts; None for none of them."""
    starts, p = None if motor.healthy is None else motor.healthy.starts, motor.parameters
    ranges: dict[str, Range] = {}
    if starts is not None and starts.model_low and starts.model_high:
        bounds = zip(starts.model_low, starts.model_high, strict=True)
        ranges = dict(zip(starts.model, bounds, strict=True))
    no_load = float(
        np.max(p.viscous_friction_n_m_s_per_rad) * voltage_v / np.max(p.back_emf_constant_v_s_per_rad)
    )
    coulomb = motor.coulomb_friction_n_m / no_load if no_load > 0.0 else 0.0
    if not ranges and coulomb == 0.0 and motor.brush_drop_v == 0.0:
        return None
    low, high = ranges.get("sensor_lag", NOTHING)
    return Field(
        coulomb_ratio=(coulomb, coulomb),
        brush_drop_v=(motor.brush_drop_v, motor.brush_drop_v),
        ramp_s=ranges.get("supply_ramp", NOTHING),
        trigger_jitter=(0.0, 0.99),
        sensor_lag_s=math.sqrt(low * high),
    )
