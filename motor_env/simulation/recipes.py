"""Recipes: what is sampled when a motor and its fault are drawn, for data sets and environments."""

from __future__ import annotations

from dataclasses import dataclass, field as dataclass_field, fields, replace
from types import NoneType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import instance, whole
from motor_env.motor.faults import BUILT_IN_KINDS, HEALTHY, Fault, FaultKind
from motor_env.motor.parameters import (
    PAPER_MOTOR,
    FloatArray,
    MotorParameters,
    SensorParameters,
    SupplyParameters,
    require,
    require_plausible,
    require_positive,
)
from motor_env.simulation.disturbances import DUTY_PRIORS, PRIORS, Duty, Field, Range
from motor_env.simulation.nonlinear import substeps
from motor_env.simulation.sensor_faults import VOLTAGE
from motor_env.simulation.simulate import Timing

# A normal number of the streams stays below 6.77, so a factor 1 + 0.14 z stays positive.
LARGEST_SPREAD = 0.14
MOST_STARTS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Spread:
    """Relative standard deviations of the five nuisance factors, each 1 + sd z with independent standard normal z.

    `constants` is one common factor on Kt and Kb.
    """

    supply: float = 0.0
    resistance: float = 0.0
    constants: float = 0.0
    inertia: float = 0.0
    friction: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            require_positive(f"spread of {f.name}", getattr(self, f.name), zero_allowed=True, one=True)
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


LARGEST_SEVERITY = 10.0
"""Beyond that, percents were meant."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """A fault that comes and goes, as a loose contact does: times of geometric laws, of at least a sample.

    Attributes:
        mean_duration_s: mean time for which it acts.
        mean_pause_s: mean time for which it is gone.
    """

    mean_duration_s: float
    mean_pause_s: float

    def __post_init__(self) -> None:
        for f in fields(self):
            require_positive(f.name, getattr(self, f.name), one=True)

    def log_stay(self, dt_s: float) -> FloatArray:
        """Logarithm of the probability that duration and pause last a sample longer, shape (2,).

        A time is 1 + floor(log u / log_stay) samples, with u uniform in (0, 1).
        """
        samples = np.maximum(np.array([self.mean_duration_s, self.mean_pause_s]) / dt_s, 1.0)
        with np.errstate(divide="ignore"):
            stay: FloatArray = np.log1p(-1.0 / samples)
        return stay

    def changes(self, u: FloatArray, dt_s: float) -> FloatArray:
        """Sample after the onset at which the fault ends and returns in turn, from uniform u of shape (..., n)."""
        parity = np.arange(u.shape[-1]) % 2
        times: FloatArray = np.cumsum(1.0 + np.floor(np.log(u) / self.log_stay(dt_s)[parity]), axis=-1)
        return times


@dataclass(frozen=True, slots=True)
class FaultClass:
    """A class: a fault kind at a level of severity, or healthy (kind None, severity 0).

    Attributes:
        kind: the fault; None for healthy.
        severity: its level, or the smallest where `severity_to` is given.
        weight: how often it is drawn, relative to the others.
        severity_to: the largest severity, drawn uniformly; None for one level.
        also: joint faults that come with it; of one that is as severe, its kind is enough. Their weights are ignored.
        recovery: how long it acts and pauses; None: it stays. The first time begins with the record, or at the onset.

    Raises:
        ValueError: a healthy class with a severity, a fault without one or beyond `LARGEST_SEVERITY`, a negative
            weight.
    """

    kind: FaultKind | None = None
    severity: float = 0.0
    weight: float = 1.0
    severity_to: float | None = None
    also: tuple[FaultClass, ...] = ()
    recovery: Recovery | None = None

    def __post_init__(self) -> None:
        if self.kind is None:
            require(self.severity == 0.0, f"severity of healthy must be 0, got {self.severity:g}")
            require(
                self.severity_to is None and not self.also, "a healthy class cannot have a fault beside it"
            )
            require(self.recovery is None, "a healthy class cannot have a recovery")
        else:
            object.__setattr__(self, "kind", FaultKind(self.kind))
            is_range = self.severity_to is not None
            require_positive(f"severity of {self.kind}", self.severity, zero_allowed=is_range)
            self.kind.require_severity(self.largest_severity)
            require(
                self.largest_severity <= LARGEST_SEVERITY,
                f"severity of {self.kind} must be a share of at most {LARGEST_SEVERITY:g} (0.15 is 15 %), "
                f"got {self.largest_severity:g}",
            )
            also: Any = self.also
            also = also if isinstance(also, tuple | list) else (also,)
            same: dict[str, Any] = {"severity": self.severity, "severity_to": self.severity_to}
            joint = tuple(
                FaultClass(FaultKind(each), **same) if isinstance(each, str) else each for each in also
            )
            for each in joint:
                instance("also", each, FaultClass)
            object.__setattr__(self, "also", joint)
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
    name = str(part.kind) if part.severity_to is not None else f"{part.kind}_{100.0 * part.severity:g}"
    return name if part.recovery is None else f"{name}_recovers"


PAPER_CLASSES = (
    FaultClass(),
    FaultClass(FaultKind.BEARING, 0.10),
    FaultClass(FaultKind.BEARING, 0.25),
    FaultClass(FaultKind.WINDING_CONTACT, 0.10),
    FaultClass(FaultKind.WINDING_CONTACT, 0.25),
)
"""The paper's fault levels (part 4): healthy, and 10 and 25 % of friction or resistance."""


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
    """Distribution of motors, faults and measurements, from which cases are drawn.

    Attributes:
        name: as in files.
        motor: nominal motor.
        supply: nominal supply.
        spread: nuisances of motors and starts.
        classes: what can be wrong, and how often.
        sensor: channels and noise.
        timing: time axis.
        field: departures from the textbook motor, errors of the sensor; None for none.
        duty: voltage profiles and loads of a motor at work, beside a field; None for starts.
        starts_per_motor: starts of each motor; parameters and fault stay.
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
    duty: Duty | None = None
    starts_per_motor: int = 1
    healthy_starts: int = 0
    shifts: tuple[Shift, ...] = ()

    __pydantic_config__: ClassVar = {"extra": "forbid"}  # in files; for the dataclasses in its fields too

    def __post_init__(self) -> None:
        self._require_kinds()
        require_plausible(self)
        require(self.name.isprintable(), f"name must be one line, got {self.name[:40]!r}")
        require(len(self.classes) > 0, f"classes of recipe {self.name} must not be empty")
        for parts, named in (("classes", self.classes), ("shifts", self.shifts)):
            names = [part.name for part in named]
            require(
                len(set(names)) == len(names),
                f"{parts} of recipe {self.name} must differ, got {', '.join(names)}",
            )
        require(
            any(fault_class.weight > 0.0 for fault_class in self.classes),
            f"weights of recipe {self.name} must not all be 0",
        )
        require(
            self.healthy_starts <= self.starts_per_motor,
            f"healthy_starts must be in 0 .. starts_per_motor ({self.starts_per_motor}), got {self.healthy_starts}",
        )
        require(
            self.healthy_starts == 0 or HEALTHY in self.class_names,
            "healthy_starts need a healthy class among the classes",
        )
        require(self.motor.batch_shape == (), f"motor of recipe {self.name} must be one motor, got a batch")
        moved = [
            part for c in self.classes for part in c.parts if part.kind is not None and part.kind.motor_powers
        ]
        require(
            self.field is None or all(part.recovery is None for part in moved),
            "a fault of the motor cannot have a recovery beside a table field",
        )
        for surroundings in (self.field, *(shift.field for shift in self.shifts)):
            if surroundings is not None:
                substeps(self.motor, self.timing.dt_s, surroundings.ripple_hz)
                idle = (surroundings.ramp_s, surroundings.trigger_jitter) == ((0.0, 0.0), (0.0, 0.0))
                require(
                    self.duty is None or idle, "ramp_s and trigger_jitter of a recipe with a duty must be 0"
                )
        require(
            self.duty is None or (self.field is not None and self.timing.n_quiet == 0),
            "a duty needs a table field beside it, and quiet_s = 0",
        )

    def _require_kinds(self) -> None:
        kinds: dict[str, type | tuple[type, ...]] = {
            "name": str, "motor": MotorParameters, "supply": SupplyParameters, "spread": Spread, "classes": tuple,
            "sensor": SensorParameters, "timing": Timing, "field": (Field, NoneType), "duty": (Duty, NoneType),
            "shifts": tuple,
        }  # fmt: skip
        for name, kind in kinds.items():
            instance(name, getattr(self, name), kind)
        for name, kind in (("classes", FaultClass), ("shifts", Shift)):
            for each in getattr(self, name):
                instance(f"each of {name}", each, kind)
        require(
            np.shape(self.supply.voltage_v) == (), "supply of a recipe must have one voltage_v, got a batch"
        )
        whole("starts_per_motor", self.starts_per_motor, 1, MOST_STARTS)
        whole("healthy_starts", self.healthy_starts, 0, MOST_STARTS)

    @property
    def kinds(self) -> tuple[FaultKind, ...]:
        """Kinds of its faults: those of the package in their order, then others by name."""
        present = {part.kind for fault_class in self.classes for part in fault_class.parts}
        known = [kind for kind in BUILT_IN_KINDS if kind in present]
        return (*known, *sorted(k for k in present if k is not None and k not in BUILT_IN_KINDS))

    @property
    def severity_columns(self) -> tuple[FaultKind, ...]:
        """Kind of each number of a case's severities: a case depends on its recipe, not on what else is registered."""
        return (*BUILT_IN_KINDS, *(kind for kind in self.kinds if kind not in BUILT_IN_KINDS))

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
    def channels(self) -> tuple[str, ...]:
        """Channels of a case: those of the sensor, and the applied voltage of a motor at work."""
        return (*self.sensor.channels, VOLTAGE) if self.duty is not None else self.sensor.channels

    @property
    def priors(self) -> dict[str, Range]:
        """Uniform priors of its tables field and duty, in the order in which they are drawn."""
        named = ((self.field, PRIORS), (self.duty, DUTY_PRIORS))
        return {name: getattr(part, name) for part, names in named if part is not None for name in names}

    @property
    def nominal_voltage_v(self) -> FloatArray:
        """Step of the nominal supply at time 0, shape (n_samples,).

        Raises:
            ValueError: a motor at work, which has another voltage in each case.
        """
        self.require_step()
        return self.timing.step(float(np.asarray(self.supply.voltage_v)))

    def require_step(self) -> None:
        """Raise `ValueError` for a motor at work, which has no step of the supply."""
        require(
            self.duty is None,
            f"recipe {self.name} has a voltage of its own in each case, and no step of the supply, which this needs",
        )

    @property
    def recovering(self) -> tuple[str, ...]:
        """Names of its classes with a fault that recovers."""
        return tuple(c.name for c in self.classes if any(part.recovery is not None for part in c.parts))

    def require_motor_faults(self) -> None:
        """Raise `ValueError` for failed sensors, and for faults that recover."""
        failed = [kind for kind in self.kinds if kind.is_sensor]
        require(
            not failed,
            f"recipe {self.name} must have faults of motors alone for this, got {', '.join(failed)}",
        )
        require(
            not self.recovering,
            f"recipe {self.name} must have faults that stay for this, got {', '.join(self.recovering)}",
        )

    def shifted(self, name: str) -> Recipe:
        """The recipe under the conditions of one of its shifts.

        Raises:
            ValueError: no such shift.
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
