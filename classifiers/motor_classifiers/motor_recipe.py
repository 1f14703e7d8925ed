"""The recipe of a motor file: what a network for this motor is trained on."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.data_sheet import MotorFile, StartReference
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import (
    COPPER_PER_KELVIN,
    MAGNET_PER_KELVIN,
    SensorParameters,
    SupplyParameters,
)
from motor_env.simulation.recipes import LARGEST_SPREAD, FaultClass, Recipe, Spread
from motor_env.simulation.simulate import Timing

_KINDS = (FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT)
_SMALLEST, _LARGEST = 0.05, 0.30
_SETTLED = (
    25.0  # mechanical time constants: the level that shows the friction is then seen for most of the time
)
_SAMPLES = 1000
_NOISE_SHARE = 0.004  # of the stall current, where the sensor's noise is not known

UNKNOWN_NOISE = (0.15, 5.0)
"""Factors on the recipe's noise between which a network for a motor file reads the noise off the start."""


def motor_recipe(
    motor: MotorFile,
    *,
    voltage_v: float | None = None,
    duration_s: float | None = None,
) -> Recipe:
    """Recipe of a motor: its tolerances are the nuisances, each kind of fault a class of severity 5 to 30 %.

    A commissioned motor's own scatter between healthy starts takes the place of the data sheet's tolerances. The
    inductance is taken from the file: its tolerance, and dry friction and brushes, are not drawn.

    Args:
        motor: as loaded.
        voltage_v: level of the supply; the file's nominal voltage by default.
        duration_s: time after the step, which a thousand samples fill; by default 25 mechanical time constants, to
            two digits.

    Raises:
        InputError: no voltage is known, or a tolerance is larger than a recipe can draw.
    """
    voltage = motor.nominal_voltage_v if voltage_v is None else voltage_v
    if voltage is None:
        raise InputError(f"{motor.name}: gives no nominal_voltage_v; say --voltage")
    if duration_s is None:
        duration_s = _two_digits(_SETTLED * float(np.mean(motor.parameters.mechanical_time_constant_s)))
    noise = motor.current_noise_a
    if noise is None:
        noise = _two_digits(_NOISE_SHARE * voltage / float(np.mean(motor.parameters.resistance_ohm)))
    sensor = SensorParameters(current_noise_a=noise)
    if motor.speed_noise_rad_s is not None:
        sensor = replace(sensor, speed_noise_rad_s=motor.speed_noise_rad_s)
    return Recipe(
        name=re.sub(r"\W+", "_", motor.name).strip("_") or "motor",
        motor=motor.parameters,
        supply=SupplyParameters(voltage),
        spread=_spread(motor),
        classes=(FaultClass(), *(FaultClass(kind, _SMALLEST, severity_to=_LARGEST) for kind in _KINDS)),
        sensor=sensor,
        timing=Timing(round(_SAMPLES / duration_s), duration_s),
    )


def changed_recipe(
    recipe: Recipe,
    *,
    voltage_v: float | None = None,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    current_noise_a: float | None = None,
) -> Recipe:
    """The recipe with another supply, time axis or noise; what is None stays.

    Raises:
        ValueError: a value out of its range.
    """

    def given(**values: float | None) -> dict[str, Any]:
        return {name: value for name, value in values.items() if value is not None}

    return replace(
        recipe,
        supply=replace(recipe.supply, **given(voltage_v=voltage_v)),
        timing=replace(recipe.timing, **given(sampling_rate_hz=sampling_rate_hz, duration_s=duration_s)),
        sensor=replace(recipe.sensor, **given(current_noise_a=current_noise_a)),
    )


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}")


def _spread(motor: MotorFile) -> Spread:
    """Relative standard deviations of the motor's factors, the temperature's share included."""
    t = motor.tolerance
    values = {
        "supply": t.supply,
        "resistance": math.hypot(t.resistance, COPPER_PER_KELVIN * t.temperature_k),
        "constants": math.hypot(t.constants, MAGNET_PER_KELVIN * t.temperature_k),
        "inertia": t.inertia,
        "friction": t.friction,
    }
    if motor.reference is not None:
        values |= _learned(motor.reference, values)
    for name, value in values.items():
        if value > LARGEST_SPREAD:
            raise InputError(
                f"{motor.name}: a tolerance of {value:.3g} on {name}, temperature included, is more than "
                f"{LARGEST_SPREAD}, the largest that can be drawn"
            )
    return Spread(**values)


def _learned(reference: StartReference, sheet: Mapping[str, float]) -> dict[str, float]:
    """What healthy starts say of the next one, by factor.

    The current alone shows K^2/J and B/J: their scatter is counted as the inertia's and the friction's, and the
    constants, of which it shows nothing else, are held.
    """
    spread = np.sqrt(np.diag(reference.log_covariance))
    seen = {name.split("/V")[0]: float(sd) for name, sd in zip(reference.quantities, spread, strict=True)}
    learned = {"resistance": seen.get("R", sheet["resistance"])}
    if "K" in seen:
        learned |= {"constants": seen["K"], "inertia": seen["J"], "friction": seen["B"]}
    else:
        inertia = next((sd for name, sd in seen.items() if name.startswith("K^2/")), sheet["inertia"])
        learned |= {"constants": 0.0, "inertia": inertia, "friction": seen.get("B/J", sheet["friction"])}
    if any("V" in name for name in reference.quantities):
        learned["supply"] = 0.0  # ratios per volt were learned: the supply's scatter is in them
    return learned
