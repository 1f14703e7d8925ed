"""The recipes that have a name: of the paper, of the bench, of the field, and of a motor at work."""

from __future__ import annotations

import reprlib
from dataclasses import replace
from typing import Any

from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import (
    PAPER_MOTOR,
    SensorParameters,
)
from motor_env.simulation.disturbances import Field
from motor_env.simulation.duty import Duty
from motor_env.simulation.recipes import PAPER_CLASSES, FaultClass, Recipe, Shift, Spread
from motor_env.simulation.simulate import Timing

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
}
"""Named recipes. `paper`: noise only. `bench`: every motor and every start differs by its tolerances. `bench-full`: the
same with all fault kinds. `field`: temperature, supply, load, sensor errors, dry friction, brushes, trigger jitter.
`operation`: motors that run, with a voltage and a load of its own in each case."""


def named_recipe(name: str, **changes: object) -> Recipe:
    """Recipe of that name, with fields replaced.

    Raises:
        ValueError: no such recipe; the sentence lists those that exist.
    """
    if name not in RECIPES:
        raise ValueError(f"recipe must be one of {', '.join(sorted(RECIPES))}, got {reprlib.repr(name)}")
    return replace(RECIPES[name], **changes)  # type: ignore[arg-type]  # replace checks the names


def changed_recipe(
    recipe: Recipe,
    *,
    voltage_v: float | None = None,
    sampling_rate_hz: float | None = None,
    duration_s: float | None = None,
    quiet_s: float | None = None,
    current_noise_a: float | None = None,
    channels: tuple[str, ...] | None = None,
) -> Recipe:
    """The recipe with another supply, time axis or sensor; what is None stays.

    Raises:
        ValueError: a value out of its range.
    """
    changes: dict[str, dict[str, Any]] = {
        "supply": {"voltage_v": voltage_v},
        "timing": {"sampling_rate_hz": sampling_rate_hz, "duration_s": duration_s, "quiet_s": quiet_s},
        "sensor": {"current_noise_a": current_noise_a, "channels": channels},
    }
    parts: dict[str, Any] = {
        part: replace(getattr(recipe, part), **{name: v for name, v in values.items() if v is not None})
        for part, values in changes.items()
    }
    return replace(recipe, **parts)
