"""Recipes: what is sampled when a motor and its fault are drawn, for data sets and environments."""

from __future__ import annotations

from dataclasses import dataclass, field as dataclass_field, fields, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.motor.faults import BUILT_IN_KINDS, HEALTHY, Fault, FaultKind
from motor_env.motor.parameters import (
    PAPER_MOTOR,
    QUANTITY_FIELDS,
    FloatArray,
    MotorParameters,
    SensorParameters,
    SupplyParameters,
    require,
    require_positive,
)
from motor_env.simulation.disturbances import Field, draw_field
from motor_env.simulation.fast_path import measure
from motor_env.simulation.nonlinear import Effects
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.sensor import SensorChain
from motor_env.simulation.simulate import Scenario, Timing

LARGEST_SPREAD = (
    0.14  # a normal number of the streams stays below 6.77, so a factor 1 + 0.14 z stays positive
)


@dataclass(frozen=True, slots=True)
class Spread:
    """Relative standard deviations of the five nuisance factors, each 1 + sd z with independent standard normal z.

    Each factor multiplies the nominal value, or the faulty one. `constants` is one common factor on Kt and Kb
    (both are the same flux linkage).
    """

    supply: float = 0.0
    resistance: float = 0.0
    constants: float = 0.0
    inertia: float = 0.0
    friction: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            require_positive(f"spread of {f.name}", getattr(self, f.name), zero_allowed=True)
            require(
                getattr(self, f.name) <= LARGEST_SPREAD,
                f"spread of {f.name} must be <= {LARGEST_SPREAD}, got {getattr(self, f.name):g}",
            )

    @property
    def std(self) -> FloatArray:
        """The five standard deviations, in the order of `FACTORS`."""
        return np.array([getattr(self, name) for name in FACTORS])


FACTORS = tuple(f.name for f in fields(Spread))
"""Order of the nuisance factors in every array."""


def apply_factors(parameters: MotorParameters, factors: FloatArray) -> MotorParameters:
    """Parameters times the motor's factors; `factors` has shape (n, 5), of which the supply's column is not used."""
    by_name = dict(zip(FACTORS, np.moveaxis(factors, -1, 0), strict=True))
    return parameters.scaled(
        **{field: factor for name, factor in by_name.items() for field in QUANTITY_FIELDS.get(name, ())}
    )


@dataclass(frozen=True, slots=True)
class FaultClass:
    """A class to be told: a fault kind at a level of severity, or healthy (kind None, severity 0).

    Attributes:
        kind: the fault; None for healthy.
        severity: its level, or the smallest where `severity_to` is given.
        weight: how often the class is drawn, relative to the others; 0 for never.
        severity_to: the largest severity, drawn uniformly, from 0 on where `severity` is 0; None for one level.
        also: faults that come with it (joint faults); their weights are ignored.

    Raises:
        ValueError: a healthy class with a severity, a fault without one, or a weight that is negative.
    """

    kind: FaultKind | None = None
    severity: float = 0.0
    weight: float = 1.0
    severity_to: float | None = None
    also: tuple[FaultClass, ...] = ()

    def __post_init__(self) -> None:
        if self.kind is None:
            require(self.severity == 0.0, f"severity of healthy must be 0, got {self.severity:g}")
            require(
                self.severity_to is None and not self.also, "a healthy class cannot have a fault beside it"
            )
        else:
            object.__setattr__(self, "kind", FaultKind(self.kind))
            is_range = self.severity_to is not None
            require_positive(f"severity of {self.kind}", self.severity, zero_allowed=is_range)
        if self.severity_to is not None:
            require(
                self.severity_to > self.severity,
                f"severity_to of {self.kind} must be > severity ({self.severity:g}), got {self.severity_to:g}",
            )
        require_positive("weight", self.weight, zero_allowed=True)
        kinds = [part.kind for part in self.parts]
        require(
            None not in kinds[1:] and len(set(kinds)) == len(kinds), "joint faults must be of different kinds"
        )

    @property
    def parts(self) -> tuple[FaultClass, ...]:
        """This fault and those that come with it."""
        return (self, *self.also)

    @property
    def largest_severity(self) -> float:
        """The level, or the upper end of its range."""
        return self.severity if self.severity_to is None else self.severity_to

    @property
    def label_kind(self) -> str:
        """Kind as a label: healthy, or the fault's kind; joint faults with a plus between."""
        return "+".join(HEALTHY if part.kind is None else str(part.kind) for part in self.parts)

    @property
    def name(self) -> str:
        """Label with the level in per cent: healthy, bearing_10, ...; without it where the severity is continuous."""
        return "+".join(_level_name(part) for part in self.parts)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults of this class at their (smallest) severity, always there; none for healthy."""
        return tuple(Fault(part.kind, part.severity) for part in self.parts if part.kind is not None)


def _level_name(part: FaultClass) -> str:
    if part.kind is None:
        return HEALTHY
    return str(part.kind) if part.severity_to is not None else f"{part.kind}_{100.0 * part.severity:g}"


PAPER_CLASSES = (
    FaultClass(),
    FaultClass(FaultKind.BEARING, 0.10),
    FaultClass(FaultKind.BEARING, 0.25),
    FaultClass(FaultKind.WINDING_CONTACT, 0.10),
    FaultClass(FaultKind.WINDING_CONTACT, 0.25),
)
"""The paper's fault levels (part 4): healthy, and 10 and 25 % of friction or resistance."""


BENCH_FULL_CLASSES = (
    *PAPER_CLASSES,
    FaultClass(FaultKind.WINDING_SHORT, 0.10),
    FaultClass(FaultKind.WINDING_SHORT, 0.25),
    FaultClass(FaultKind.NOISE, 0.50),
    FaultClass(FaultKind.NOISE, 1.00),
)
"""The paper's levels, and the other two fault kinds: shorted turns, and a rise of the noise's variance."""


@dataclass(frozen=True, slots=True)
class Shift:
    """A test under other conditions than the training: what is not None replaces the recipe's."""

    name: str
    classes: tuple[FaultClass, ...] | None = None
    sensor: SensorParameters | None = None
    spread: Spread | None = None
    field: Field | None = None

    def __post_init__(self) -> None:
        require(self.name.isidentifier(), f"name of a shift must be one word, got {self.name!r}")


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a case is drawn from.

    Attributes:
        name: name of the recipe.
        motor: nominal motor.
        supply: nominal supply.
        spread: nuisances: what differs from motor to motor and start to start.
        classes: what can be wrong, and how often.
        sensor: channels and noise.
        timing: time axis.
        field: departures from the textbook motor and errors of the sensor; None for the textbook motor.
        starts_per_motor: starts of each motor; its parameters and fault stay, supply and temperature change.
        healthy_starts: how many of them, the first, are healthy (commissioning).
        shifts: tests under other conditions.
    """

    name: str
    motor: MotorParameters = PAPER_MOTOR
    supply: SupplyParameters = dataclass_field(default_factory=SupplyParameters)
    spread: Spread = dataclass_field(default_factory=Spread)
    classes: tuple[FaultClass, ...] = PAPER_CLASSES
    sensor: SensorParameters = dataclass_field(default_factory=SensorParameters)
    timing: Timing = dataclass_field(default_factory=Timing)
    field: Field | None = None
    starts_per_motor: int = 1
    healthy_starts: int = 0
    shifts: tuple[Shift, ...] = ()

    __pydantic_config__: ClassVar = {"extra": "forbid"}  # in files; for the dataclasses in its fields too

    def __post_init__(self) -> None:
        require(len(self.classes) > 0, f"classes of recipe {self.name} must not be empty")
        names = [fault_class.name for fault_class in self.classes]
        require(
            len(set(names)) == len(names),
            f"classes of recipe {self.name} must differ, got {', '.join(names)}",
        )
        require(
            any(fault_class.weight > 0.0 for fault_class in self.classes),
            f"weights of recipe {self.name} must not all be 0",
        )
        require(self.starts_per_motor >= 1, f"starts_per_motor must be >= 1, got {self.starts_per_motor}")
        require(
            0 <= self.healthy_starts <= self.starts_per_motor,
            f"healthy_starts must be in 0 .. starts_per_motor ({self.starts_per_motor}), got {self.healthy_starts}",
        )
        require(
            self.healthy_starts == 0 or HEALTHY in names,
            "healthy_starts need a healthy class among the classes",
        )
        require(self.motor.batch_shape == (), f"motor of recipe {self.name} must be one motor, got a batch")

    @property
    def kinds(self) -> tuple[FaultKind, ...]:
        """Kinds of its faults: those of the package in their order, then others by name."""
        present = {part.kind for fault_class in self.classes for part in fault_class.parts}
        known = [kind for kind in BUILT_IN_KINDS if kind in present]
        return (*known, *sorted(k for k in present if k is not None and k not in BUILT_IN_KINDS))

    @property
    def class_names(self) -> tuple[str, ...]:
        """Label of each class."""
        return tuple(fault_class.name for fault_class in self.classes)

    @property
    def class_probabilities(self) -> FloatArray:
        """Prior probability of each class."""
        weights = np.array([fault_class.weight for fault_class in self.classes])
        probabilities: FloatArray = weights / weights.sum()
        return probabilities

    @property
    def nominal_voltage_v(self) -> FloatArray:
        """Step of the nominal supply at time 0, shape (n_samples,)."""
        return self.timing.step(float(np.asarray(self.supply.voltage_v)))

    def shifted(self, name: str) -> Recipe:
        """The recipe under the conditions of one of its shifts.

        Raises:
            ValueError: no such shift; the sentence lists those that exist.
        """
        by_name = {shift.name: shift for shift in self.shifts}
        require(name in by_name, f"shift must be one of {', '.join(by_name) or '(none)'}, got {name!r}")
        shift = by_name[name]
        changes: dict[str, Any] = {
            f.name: getattr(shift, f.name)
            for f in fields(shift)
            if f.name != "name" and getattr(shift, f.name) is not None
        }
        return replace(self, **changes)

    def motor_id(self, cases: NDArray[np.int64]) -> NDArray[np.int64]:
        """Motor of each case: consecutive cases are the starts of one motor."""
        return cases // self.starts_per_motor


class Draw(NamedTuple):
    """Cases drawn from a recipe: the truth.

    Attributes:
        cases: case numbers, shape (n_cases,).
        class_index: index into `recipe.classes`, shape (n_cases,).
        factors: nuisance factors in the order of `FACTORS`, shape (n_cases, 5).
        scenario: what to simulate.
        motor_id: motor of each case, shape (n_cases,).
        severity: sum over the faults of the case, 0 for healthy, shape (n_cases,).
        effects: departures from the textbook motor; None for none.
        chain: errors of the current sensor; None for none.
    """

    cases: NDArray[np.int64]
    class_index: NDArray[np.int64]
    factors: FloatArray
    scenario: Scenario
    motor_id: NDArray[np.int64]
    severity: FloatArray
    effects: Effects | None = None
    chain: SensorChain | None = None


def draw(recipe: Recipe, seed: int, cases: ArrayLike) -> Draw:
    """Draw the given cases. Case n depends on (recipe, seed, n) alone.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        cases: case numbers, shape (n_cases,).
    """
    numbers = np.atleast_1d(np.asarray(cases, dtype=np.int64))
    motor_id = recipe.motor_id(numbers)
    class_index = _draw_classes(recipe, seed, numbers, motor_id)
    z = normals(seed, Stream.MOTOR, motor_id, len(FACTORS))
    supply = FACTORS.index("supply")
    z[:, supply] = normals(seed, Stream.SUPPLY, numbers, 1)[:, 0]
    factors = 1.0 + recipe.spread.std * z
    severities = _draw_severities(recipe, seed, class_index, motor_id)
    scenario = Scenario(
        parameters=apply_factors(recipe.motor, factors),
        faults=tuple(Fault(kind, severity) for kind, severity in severities.items()),
        supply=SupplyParameters(recipe.supply.voltage_v * factors[:, supply]),
        sensor=recipe.sensor,
        timing=recipe.timing,
    )
    first = np.zeros(len(numbers))
    for kind, severity in severities.items():
        first += severity * np.array([c.kind == kind for c in recipe.classes])[class_index]
    effects, chain = None, None
    if recipe.field is not None:
        bearing = sum(
            (s for kind, s in severities.items() if kind.verdict == FaultKind.BEARING.verdict),
            np.zeros(len(numbers)),
        )
        voltage, dt_s = recipe.supply.voltage_v, recipe.timing.dt_s
        effects, chain = draw_field(
            recipe.field,
            recipe.motor,
            voltage,
            dt_s,
            bearing_severity=bearing,
            seed=seed,
            motor_id=motor_id,
            cases=numbers,
        )
    return Draw(numbers, class_index, factors, scenario, motor_id, first, effects, chain)


def _draw_classes(
    recipe: Recipe, seed: int, cases: NDArray[np.int64], motor_id: NDArray[np.int64]
) -> NDArray[np.int64]:
    cumulated = np.cumsum(recipe.class_probabilities)
    index = np.searchsorted(cumulated[:-1], uniforms(seed, Stream.CLASS, motor_id, 1)[:, 0], side="right")
    if recipe.healthy_starts:
        commissioning = cases % recipe.starts_per_motor < recipe.healthy_starts
        index = np.where(commissioning, recipe.class_names.index(HEALTHY), index)
    return index.astype(np.int64)


def _draw_severities(
    recipe: Recipe, seed: int, class_index: NDArray[np.int64], motor_id: NDArray[np.int64]
) -> dict[FaultKind, FloatArray]:
    """Severity of each fault kind that the recipe has, shape (n_cases,); one draw a motor where it is continuous."""
    severities: dict[FaultKind, FloatArray] = {}
    u = None
    others = [kind for kind in recipe.kinds if kind not in BUILT_IN_KINDS]
    columns = [*BUILT_IN_KINDS, *others]  # a case depends on its recipe, not on what else is registered
    for kind in recipe.kinds:
        low, high = np.array(
            [
                next(((p.severity, p.largest_severity) for p in c.parts if p.kind == kind), (0.0, 0.0))
                for c in recipe.classes
            ]
        )[class_index].T
        if (low != high).any():
            u = uniforms(seed, Stream.SEVERITY, motor_id, len(columns)) if u is None else u
            low = low + (high - low) * u[:, columns.index(kind)]
        severities[kind] = np.ascontiguousarray(low)
    return severities


def measure_draw(
    drawn: Draw, recipe: Recipe, seed: int, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Readings of drawn cases, float32, shape (n_cases, n_channels, n_samples)."""
    return measure(
        drawn.scenario,
        seed,
        drawn.cases,
        effects=drawn.effects,
        chain=drawn.chain,
        nominal=recipe.motor,
        out=out,
    )


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
}
"""Named recipes. `paper`: noise only. `bench`: every motor and every start differs by its tolerances. `bench-full`: the
same with all fault kinds. `field`: temperature, supply, load, sensor errors, dry friction, brushes, trigger jitter."""


def named_recipe(name: str, **changes: object) -> Recipe:
    """Recipe of that name, with fields replaced.

    Raises:
        ValueError: no such recipe; the sentence lists those that exist.
    """
    if name not in RECIPES:
        raise ValueError(f"recipe must be one of {', '.join(sorted(RECIPES))}, got {name!r}")
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
