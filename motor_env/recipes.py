"""Recipes: what is sampled when a motor and its fault are drawn, for data sets and environments."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_env.faults import HEALTHY, Fault, FaultKind
from motor_env.parameters import (
    PAPER_MOTOR,
    FloatArray,
    MotorParameters,
    SensorParameters,
    SupplyParameters,
    require,
    require_positive,
)
from motor_env.simulation import Scenario, Timing
from motor_env.streams import Stream, normals, uniforms

_LARGEST_SPREAD = (
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
                getattr(self, f.name) <= _LARGEST_SPREAD,
                f"spread of {f.name} must be <= {_LARGEST_SPREAD}, got {getattr(self, f.name):g}",
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
        resistance_ohm=by_name["resistance"],
        back_emf_constant_v_s_per_rad=by_name["constants"],
        torque_constant_n_m_per_a=by_name["constants"],
        inertia_kg_m2=by_name["inertia"],
        viscous_friction_n_m_s_per_rad=by_name["friction"],
    )


@dataclass(frozen=True, slots=True)
class FaultClass:
    """A class to be told: a fault kind at a level of severity, or healthy (kind None, severity 0).

    Raises:
        ValueError: a healthy class with a severity, a fault without one, or a weight that is not positive.
    """

    kind: FaultKind | None = None
    severity: float = 0.0
    weight: float = 1.0

    def __post_init__(self) -> None:
        if self.kind is None:
            require(self.severity == 0.0, f"severity of healthy must be 0, got {self.severity:g}")
        else:
            require_positive(f"severity of {self.kind}", self.severity)
        require_positive("weight", self.weight)

    @property
    def label_kind(self) -> str:
        """Kind as a label: healthy, or the fault's kind."""
        return HEALTHY if self.kind is None else str(self.kind)

    @property
    def name(self) -> str:
        """Label with the level in per cent: healthy, bearing_10, winding_contact_25, ..."""
        return HEALTHY if self.kind is None else f"{self.kind}_{100.0 * self.severity:g}"

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The fault of this class, always there; none for healthy."""
        return () if self.kind is None else (Fault(self.kind, self.severity),)


PAPER_CLASSES = (
    FaultClass(),
    FaultClass(FaultKind.BEARING, 0.10),
    FaultClass(FaultKind.BEARING, 0.25),
    FaultClass(FaultKind.WINDING_CONTACT, 0.10),
    FaultClass(FaultKind.WINDING_CONTACT, 0.25),
)
"""The paper's fault levels (part 4): healthy, and 10 and 25 % of friction or resistance."""


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
    """

    name: str
    motor: MotorParameters = PAPER_MOTOR
    supply: SupplyParameters = field(default_factory=SupplyParameters)
    spread: Spread = field(default_factory=Spread)
    classes: tuple[FaultClass, ...] = PAPER_CLASSES
    sensor: SensorParameters = field(default_factory=SensorParameters)
    timing: Timing = field(default_factory=Timing)

    def __post_init__(self) -> None:
        require(len(self.classes) > 0, f"classes of recipe {self.name} must not be empty")
        require(self.motor.batch_shape == (), f"motor of recipe {self.name} must be one motor, got a batch")

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


class Draw(NamedTuple):
    """Cases drawn from a recipe: the truth.

    Attributes:
        cases: case numbers, shape (n_cases,).
        class_index: index into `recipe.classes`, shape (n_cases,).
        factors: nuisance factors in the order of `FACTORS`, shape (n_cases, 5).
        scenario: what to simulate.
    """

    cases: NDArray[np.int64]
    class_index: NDArray[np.int64]
    factors: FloatArray
    scenario: Scenario


def draw(recipe: Recipe, seed: int, cases: ArrayLike) -> Draw:
    """Draw the given cases. Case n depends on (recipe, seed, n) alone.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        cases: case numbers, shape (n_cases,).
    """
    numbers = np.atleast_1d(np.asarray(cases, dtype=np.int64))
    cumulated = np.cumsum(recipe.class_probabilities)
    class_index = np.searchsorted(
        cumulated[:-1], uniforms(seed, Stream.CLASS, numbers, 1)[:, 0], side="right"
    )
    factors = 1.0 + recipe.spread.std * normals(seed, Stream.MOTOR, numbers, len(FACTORS))
    severity = np.array([fault_class.severity for fault_class in recipe.classes])[class_index]
    kinds = np.array([fault_class.label_kind for fault_class in recipe.classes])[class_index]
    faults = tuple(
        Fault(kind, np.where(kinds == str(kind), severity, 0.0))
        for kind in FaultKind
        if any(fault_class.kind is kind for fault_class in recipe.classes)
    )
    scenario = Scenario(
        parameters=apply_factors(recipe.motor, factors),
        faults=faults,
        supply=SupplyParameters(recipe.supply.voltage_v * factors[:, FACTORS.index("supply")]),
        sensor=recipe.sensor,
        timing=recipe.timing,
    )
    return Draw(numbers, class_index.astype(np.int64), factors, scenario)


RECIPES: dict[str, Recipe] = {
    "paper": Recipe(name="paper"),
    "bench": Recipe(
        name="bench",
        spread=Spread(supply=0.01, resistance=0.01, constants=0.01, inertia=0.02, friction=0.02),
    ),
}
"""Named recipes. `paper`: noise only. `bench`: every motor and every start differs by its tolerances."""


def named_recipe(name: str, **changes: object) -> Recipe:
    """Recipe of that name, with fields replaced.

    Raises:
        ValueError: no such recipe; the sentence lists those that exist.
    """
    if name not in RECIPES:
        raise ValueError(f"recipe must be one of {', '.join(sorted(RECIPES))}, got {name!r}")
    return replace(RECIPES[name], **changes)  # type: ignore[arg-type]  # replace checks the names
