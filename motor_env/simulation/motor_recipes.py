"""A motor file as a recipe: what a learned method must have seen before it judges the starts of that motor.

A data sheet gives the tolerances of its series; a commissioned motor gives the spread of its own starts. The spread of
a recipe is in factors on V, R, K, J and B, that of a commissioned motor in what its recordings can tell (see
`motor_env.motor.identifiable`): what the current alone tells of K^2/J is put on K, because the inertia of one motor
does not change from start to start, and what it tells of B/J on B.
"""

from __future__ import annotations

import math

import numpy as np

from motor_env.motor.data_sheet import MotorFile, StartReference
from motor_env.motor.parameters import (
    COPPER_PER_KELVIN,
    MAGNET_PER_KELVIN,
    Channel,
    SensorParameters,
    SupplyParameters,
)
from motor_env.simulation.disturbances import NOTHING, Field, Range
from motor_env.simulation.recipes import LARGEST_SPREAD, PAPER_CLASSES, FaultClass, Recipe, Spread
from motor_env.simulation.simulate import Timing

_FACTOR_OF = {
    "R": ("resistance", 1.0),
    "R/V": ("resistance", 1.0),
    "K": ("constants", 1.0),
    "K/V": ("constants", 1.0),
    "K^2/J": ("constants", 0.5),
    "K^2/(J V)": ("constants", 0.5),
    "J": ("inertia", 1.0),
    "J/V": ("inertia", 1.0),
    "B": ("friction", 1.0),
    "B/V": ("friction", 1.0),
    "B/J": ("friction", 1.0),
}
"""The recipe's factor that a quantity's spread becomes, and with which share. L has no factor in a recipe."""


def recipe_of(
    motor: MotorFile, *, timing: Timing | None = None, classes: tuple[FaultClass, ...] = PAPER_CLASSES
) -> Recipe:
    """The recipe of one motor: its parameters, its own nuisances, its noise, and the supply of its starts.

    Args:
        motor: data sheet, identified or commissioned motor.
        timing: time axis; that of the starts it was commissioned on unless given, else the default one.
        classes: what may be wrong with it.

    """
    reference = motor.reference
    if timing is None:
        timing = _timing(reference)
    noise = motor.current_noise_a or (math.exp(reference.log_noise) if reference is not None else None)
    channels: tuple[Channel, ...] = (Channel.CURRENT,)
    if motor.speed_noise_rad_s is not None:
        channels = (Channel.CURRENT, Channel.SPEED)
    default = SensorParameters()
    return Recipe(
        name=motor.name,
        motor=motor.parameters,
        supply=SupplyParameters(motor.nominal_voltage_v or SupplyParameters().voltage_v),
        spread=_sheet_spread(motor) if reference is None else _start_spread(reference),
        classes=classes,
        sensor=SensorParameters(
            channels,
            default.current_noise_a if noise is None else noise,
            motor.speed_noise_rad_s or default.speed_noise_rad_s,
        ),
        timing=timing,
        field=_field(motor),
    )


def _timing(reference: StartReference | None) -> Timing:
    if reference is None or reference.sampling_rate_hz is None or reference.duration_s is None:
        return Timing()
    return Timing(reference.sampling_rate_hz, reference.duration_s, reference.quiet_s or 0.0)


def _sheet_spread(motor: MotorFile) -> Spread:
    t = motor.tolerance
    return _capped(
        supply=t.supply,
        resistance=math.hypot(t.resistance, COPPER_PER_KELVIN * t.temperature_k),
        constants=math.hypot(t.constants, MAGNET_PER_KELVIN * t.temperature_k),
        inertia=t.inertia,
        friction=t.friction,
    )


def _start_spread(reference: StartReference) -> Spread:
    # The standard deviation of a Student t exceeds its scale.
    freedom = max(reference.degrees_of_freedom, 3.0)
    std = np.sqrt(np.diag(reference.log_covariance) * freedom / (freedom - 2.0))
    told = dict(zip(reference.quantities, std.tolist(), strict=True))
    return _capped(
        **{
            _FACTOR_OF[name][0]: _FACTOR_OF[name][1] * spread
            for name, spread in told.items()
            if name in _FACTOR_OF
        }
    )


def _capped(**spread: float) -> Spread:
    """A recipe's factors must stay positive: a wider spread is cut."""
    return Spread(**{name: min(value, LARGEST_SPREAD) for name, value in spread.items()})


def _field(motor: MotorFile) -> Field | None:
    """Coulomb friction, brush drop, supply ramp and sensor lag of the motor's starts; None for none of them."""
    reference, p = motor.reference, motor.parameters
    told: dict[str, Range] = {}
    if reference is not None and reference.model_low and reference.model_high:
        bounds = zip(reference.model_low, reference.model_high, strict=True)
        told = dict(zip(reference.model, bounds, strict=True))
    voltage = motor.nominal_voltage_v or SupplyParameters().voltage_v
    no_load = float(
        np.max(p.viscous_friction_n_m_s_per_rad) * voltage / np.max(p.back_emf_constant_v_s_per_rad)
    )
    coulomb = motor.coulomb_friction_n_m / no_load if no_load > 0.0 else 0.0
    if not told and coulomb == 0.0 and motor.brush_drop_v == 0.0:
        return None
    low, high = told.get("sensor_lag", NOTHING)
    return Field(
        coulomb_ratio=(coulomb, coulomb),
        brush_drop_v=(motor.brush_drop_v, motor.brush_drop_v),
        ramp_s=told.get("supply_ramp", NOTHING),
        trigger_jitter=(0.0, 0.99),
        sensor_lag_s=math.sqrt(low * high),
    )
