"""Recipes by name, from TOML files and of a motor file; the schema of a file is the dataclasses themselves."""

from __future__ import annotations

import json
import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.arrays import instance
from motor_env.common.errors import InputError
from motor_env.motor.data_sheet import Motor, load_motor, require_told, usable_parameters
from motor_env.motor.faults import FaultKind
from motor_env.motor.healthy import Healthy, Starts
from motor_env.motor.identifiable import tolerance_std
from motor_env.motor.parameters import (
    PAPER_MOTOR,
    Channel,
    SensorParameters,
    SupplyParameters,
    require,
)
from motor_env.motor.toml_files import from_dict, one_line, read_toml
from motor_env.simulation.disturbances import NOTHING, Duty, Field, Range
from motor_env.simulation.recipes import (
    FACTORS,
    LARGEST_SPREAD,
    PAPER_CLASSES,
    FaultClass,
    Recipe,
    Shift,
    Spread,
)
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
    """Recipe of one motor: parameters, nuisances, noise, and supply of its starts.

    Args:
        motor: data sheet, identified or commissioned motor.
        voltage_v: level of the supply; the file's nominal voltage by default.
        timing: time axis; that of its commissioning by default, else `settling_timing`.
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
    require_told(motor)
    std = tolerance_std(motor.tolerance)
    usual = motor.usual_tolerances  # that of friction from a no-load current is wider than what can be drawn
    values = {name: min(std[name], LARGEST_SPREAD) if name in usual else std[name] for name in FACTORS}
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


BENCH_FULL_CLASSES = (
    *PAPER_CLASSES,
    FaultClass(FaultKind.WINDING_SHORT, 0.10),
    FaultClass(FaultKind.WINDING_SHORT, 0.25),
    FaultClass(FaultKind.NOISE, 0.50),
    FaultClass(FaultKind.NOISE, 1.00),
)
"""The paper's levels, and the other two fault kinds: shorted turns, and a rise of the noise's variance."""


BENCH_SPREAD = Spread(supply=0.01, resistance=0.01, constants=0.01, inertia=0.02, friction=0.02)

FIELD = Field(
    coulomb_ratio=(0.3, 0.4),
    stribeck_ratio=(0.0, 0.1),
    brush_drop_v=(0.0, 0.1),
    supply_resistance_ohm=(0.02, 0.06),
    commutation_ripple=(0.0, 0.02),
    sensor_gain=(0.995, 1.005),
    sensor_offset_a=(-0.0025, 0.0025),
    temperature_rise_k=(-5.0, 15.0),
    load_ratio=(0.0, 0.05),
    ramp_s=(0.0, 0.0005),
    ripple_v=(0.0, 0.05),
    trigger_jitter=(0.0, 0.99),
    bearing_ripple_ratio=(0.0, 0.5),
    sensor_lag_s=2e-5,
    sensor_range_a=8.2,
    adc_bits=12,
)
"""A small motor on a bench supply, its current read by a shunt and a 12-bit converter (docs/datasets.md)."""

_FIELD_SHIFTS = (
    Shift("hotter", field=replace(FIELD, temperature_rise_k=(25.0, 45.0))),
    Shift("loaded", field=replace(FIELD, load_ratio=(0.5, 1.0))),
    Shift("other_sensor", field=replace(FIELD, sensor_gain=(0.98, 1.02), sensor_offset_a=(-0.02, 0.02))),
    Shift(
        "unseen_severity",
        classes=(
            FaultClass(),
            FaultClass(FaultKind.BEARING, 0.17),
            FaultClass(FaultKind.WINDING_CONTACT, 0.17),
        ),
    ),
    Shift(
        "unseen_kind",
        classes=(FaultClass(), FaultClass(FaultKind.WINDING_SHORT, 0.10), FaultClass(FaultKind.NOISE, 1.0)),
    ),
)

WORK = Field(
    coulomb_ratio=(0.3, 0.4),
    brush_drop_v=(0.0, 0.1),
    temperature_rise_k=(-5.0, 15.0),
    load_ratio=(0.0, 1.0),
)
"""What surrounds a motor at work whose drive knows the voltage that it applies (docs/datasets.md)."""

_WORK_SHIFTS = (
    Shift("hotter", field=replace(WORK, temperature_rise_k=(25.0, 45.0))),
    Shift("loaded", field=replace(WORK, load_ratio=(1.5, 2.0))),
)

RECIPES: dict[str, Recipe] = {
    "paper": Recipe(name="paper"),
    "bench": Recipe(name="bench", spread=BENCH_SPREAD),
    "bench-full": Recipe(name="bench-full", spread=BENCH_SPREAD, classes=BENCH_FULL_CLASSES),
    "field": Recipe(
        name="field",
        # The table's friction holds all no-load torque; here a good third of it is Coulomb friction.
        motor=PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=0.65),
        spread=Spread(supply=0.01, resistance=0.03, constants=0.02, inertia=0.02, friction=0.05),
        timing=Timing(quiet_s=0.02),
        sensor=SensorParameters(current_noise_a=0.004),
        field=FIELD,
        starts_per_motor=5,
        healthy_starts=3,
        shifts=_FIELD_SHIFTS,
    ),
    "operation": Recipe(
        name="operation",
        # The paper's motor with the choke of its drive and the inertia of its load.
        motor=PAPER_MOTOR.scaled(viscous_friction_n_m_s_per_rad=0.65, inductance_h=10.0, inertia_kg_m2=4.0),
        spread=BENCH_SPREAD,
        timing=Timing(1_000.0, 0.5),
        sensor=SensorParameters(current_noise_a=0.002),
        field=WORK,
        duty=Duty(load_end_ratio=(0.0, 1.0), fan_ratio=(0.0, 0.2)),
        shifts=_WORK_SHIFTS,
    ),
    "easy": Recipe(
        name="easy",
        classes=(FaultClass(weight=2.0), PAPER_CLASSES[2], PAPER_CLASSES[4]),
        sensor=SensorParameters(current_noise_a=0.005),
    ),
    "medium": Recipe(name="medium", classes=(FaultClass(weight=4.0), *PAPER_CLASSES[1:])),
    "hard": Recipe(
        name="hard",
        spread=Spread(supply=0.01, resistance=0.003, constants=0.002, inertia=0.002, friction=0.002),
        classes=(
            FaultClass(weight=6.0),
            *PAPER_CLASSES[1:3],
            FaultClass(FaultKind.WINDING_CONTACT, 0.05),
            FaultClass(FaultKind.WINDING_CONTACT, 0.10),
            FaultClass(FaultKind.WINDING_SHORT, 0.05),
            FaultClass(FaultKind.NOISE, 0.5),
        ),
    ),
    "small": Recipe(
        name="small",
        classes=(
            FaultClass(weight=3.0),
            *(FaultClass(FaultKind.WINDING_CONTACT, severity) for severity in (0.005, 0.01, 0.02, 0.03)),
            FaultClass(FaultKind.BEARING, 0.25, weight=2.0),
        ),
        sensor=SensorParameters(current_noise_a=0.01),
    ),
    "sensor": Recipe(
        name="sensor",
        classes=(
            FaultClass(weight=10.0),
            *PAPER_CLASSES[1:3],
            *(FaultClass(FaultKind.WINDING_CONTACT, severity) for severity in (0.02, 0.05, 0.10)),
            FaultClass(FaultKind("current_gain"), 0.02),
            FaultClass(FaultKind("current_offset"), 0.001),  # 0.3 standard deviations of the noise
            FaultClass(FaultKind("current_drift"), 0.02),  # 0.1 A/s
            FaultClass(FaultKind("speed_gain"), 0.001),
            FaultClass(FaultKind("speed_drift"), 0.02),  # 10 rad/s2
        ),
        sensor=SensorParameters((Channel.CURRENT, Channel.SPEED)),
    ),
}
"""Named recipes. Of data sets: `paper`: noise only. `bench`: tolerances of motors and starts. `bench-full`: with all
fault kinds. `field`: with all priors of `Field`. `operation`: motors at work.

Of environments, whose motor is known exactly but for `hard`: `easy`: large faults, a good sensor. `medium`: the paper's
fault levels. `hard`: smaller faults of more kinds, on a motor known as well as commissioning allows and a supply known
to 1 %. `small`: winding faults of 0.5 to 3 %, which only a moving voltage shows, and a bearing fault. `sensor`: faults
of the motor and of its two sensors, so small that the other quantity has to tell which of them it is.
"""


def named_recipe(name: str, **changes: object) -> Recipe:
    """Recipe of that name, with fields replaced.

    Raises:
        ValueError: no such recipe.
    """
    if name not in RECIPES:
        known = ", ".join(sorted(RECIPES))
        raise ValueError(f"recipe must be one of {known}, or a TOML file, got {reprlib.repr(name)}")
    return replace(RECIPES[name], **changes)  # type: ignore[arg-type]  # replace checks the names


def changed_recipe(
    recipe: Recipe,
    *,
    voltage_v: float | None = None,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    quiet_s: float | None = None,
    current_noise_a: float | None = None,
    speed_noise_rad_s: float | None = None,
    channels: tuple[str, ...] | None = None,
) -> Recipe:
    """The recipe with another supply, time axis or sensor; what is None stays.

    Raises:
        ValueError: a value out of its range.
    """
    changes: dict[str, dict[str, Any]] = {
        "supply": {"voltage_v": voltage_v},
        "timing": {"sampling_rate_hz": sampling_rate_hz, "duration_s": duration_s, "quiet_s": quiet_s},
        "sensor": {
            "current_noise_a": current_noise_a,
            "speed_noise_rad_s": speed_noise_rad_s,
            "channels": channels,
        },
    }
    parts: dict[str, Any] = {
        part: replace(getattr(recipe, part), **{name: v for name, v in values.items() if v is not None})
        for part, values in changes.items()
    }
    return replace(recipe, **parts)


def recipe_to_dict(recipe: Recipe) -> dict[str, Any]:
    """The recipe in strings, numbers, lists and dictionaries."""

    def without(items: list[tuple[str, Any]]) -> dict[str, Any]:  # as in every file that knew neither
        return {name: v for name, v in items if v is not None or name not in ("duty", "recovery")}

    content: dict[str, Any] = json.loads(json.dumps(asdict(recipe, dict_factory=without)))
    return content


def recipe_from_dict(content: Mapping[str, Any]) -> Recipe:
    """The recipe that a dictionary describes; what is left out has its default.

    Raises:
        ValueError: an unknown key, a value of another type or out of its range.
    """
    return from_dict(Recipe, content, "the recipe")


def load_recipe(name_or_path: str | Path, **changes: Any) -> Recipe:
    """A named recipe, or one from a TOML file, with fields replaced.

    A file holds the recipe's fields; `base = "bench"` starts from a named recipe, and `motor` may be a motor file or
    catalogue name.

    Raises:
        InputError: no such recipe or file, not TOML, an unknown key, a value out of range.
    """
    instance("name_or_path", name_or_path, (str, Path))
    path = Path(name_or_path)
    if path.suffix != ".toml":
        return named_recipe(str(name_or_path), **changes)
    content = read_toml(path, f"no such recipe file; named recipes are {', '.join(sorted(RECIPES))}")
    try:
        return replace(_from_toml(content, path), **changes)
    except InputError:
        raise
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: {error}") from None


def _from_toml(content: dict[str, Any], path: Path) -> Recipe:
    base = content.pop("base", None)
    motor, known = content.get("motor"), None
    if isinstance(motor, str):
        one_line("motor", motor)
        beside = path.parent / motor
        known = load_motor(beside if beside.is_file() else motor)
        content["motor"] = asdict(known.parameters)
    require(base is None or isinstance(base, str), f"base must be the name of a recipe, got {base!r}")
    start: dict[str, Any] = {} if base is None else recipe_to_dict(named_recipe(base))
    recipe = recipe_from_dict(_merged(start | {"name": path.stem}, content))
    if known is not None:
        usable_parameters(known, needs_speed=Channel.SPEED in recipe.sensor.channels)
    return recipe


def _merged(start: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(start)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = (
            _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
        )
    return merged
