"""Faults that no model of ours is trained on, and their starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from motor_env.motor.parameters import SupplyParameters
from motor_env.simulation.drawing import apply_factors, draw
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe
from motor_env.simulation.simulate import simulate


@dataclass(frozen=True, slots=True)
class ForeignFault:
    """A departure from the healthy motor that no fault kind explains: factors on its quantities.

    Attributes:
        name: for tables.
        supply: factor on the supply's voltage.
        resistance: factor on the resistance.
        constants: common factor on both motor constants.
        inertia: factor on the inertia.
        friction: factor on the viscous friction.
    """

    name: str
    supply: float = 1.0
    resistance: float = 1.0
    constants: float = 1.0
    inertia: float = 1.0
    friction: float = 1.0


UNKNOWN_FAULTS = (
    ForeignFault("inertia +25 %", inertia=1.25),
    ForeignFault("motor constants -10 %", constants=0.9),
    ForeignFault("supply -10 %", supply=0.9),
)
"""Faults on which no model of ours is trained: a heavier rotor, magnets that lost strength, a weak supply."""


def foreign_starts(
    recipe: Recipe, fault: ForeignFault, seed: int, cases: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Starts of otherwise healthy motors of a recipe with a foreign fault, shape (n_cases, n_channels, n_samples).

    Args:
        recipe: tolerances, supply, sensor and timing.
        fault: what is wrong with them.
        seed: the random seed.
        cases: case numbers, shape (n_cases,).

    Raises:
        ValueError: the recipe departs from the textbook motor.
    """
    if recipe.field is not None:
        raise ValueError(f"foreign faults are those of textbook motors, recipe {recipe.name} has a field")
    scenario = draw(replace(recipe, classes=(FaultClass(),), healthy_starts=0), seed, cases).scenario
    changed = replace(
        scenario,
        parameters=apply_factors(scenario.parameters, np.array([getattr(fault, name) for name in FACTORS])),
        supply=SupplyParameters(scenario.supply.voltage_v * fault.supply),
    )
    return simulate(changed, seed, cases).measurements.astype(np.float32)
