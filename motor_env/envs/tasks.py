"""Recipes of the environments: easy, medium and hard versions of the same task."""

from __future__ import annotations

from motor_env.faults import FaultKind
from motor_env.parameters import SensorParameters
from motor_env.recipes import FaultClass, Recipe, Spread, named_recipe

_HEALTHY = FaultClass(weight=2.0)

EASY = Recipe(
    name="easy",
    classes=(
        _HEALTHY,
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.25),
    ),
    sensor=SensorParameters(current_noise_a=0.005),
)
"""Large faults, a good sensor, a motor known exactly."""

MEDIUM = Recipe(
    name="medium",
    classes=(
        FaultClass(weight=4.0),
        FaultClass(FaultKind.BEARING, 0.10),
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.10),
        FaultClass(FaultKind.WINDING_CONTACT, 0.25),
    ),
)
"""The paper's fault levels at 20 mA of noise, a motor known exactly."""

HARD = Recipe(
    name="hard",
    spread=Spread(supply=0.01, resistance=0.003, constants=0.002, inertia=0.002, friction=0.002),
    classes=(
        FaultClass(weight=6.0),
        FaultClass(FaultKind.BEARING, 0.10),
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.05),
        FaultClass(FaultKind.WINDING_CONTACT, 0.10),
        FaultClass(FaultKind.WINDING_SHORT, 0.05),
        FaultClass(FaultKind.NOISE, 0.5),
    ),
)
"""Smaller faults of more kinds, on a motor that is known as well as commissioning tells and a supply known to 1 %."""

SMALL = Recipe(
    name="small",
    classes=(
        FaultClass(weight=3.0),
        FaultClass(FaultKind.WINDING_CONTACT, 0.005),
        FaultClass(FaultKind.WINDING_CONTACT, 0.01),
        FaultClass(FaultKind.WINDING_CONTACT, 0.02),
        FaultClass(FaultKind.WINDING_CONTACT, 0.03),
        FaultClass(FaultKind.BEARING, 0.25, weight=2.0),
    ),
    sensor=SensorParameters(current_noise_a=0.01),
)
"""Windings worse by 0.5 to 3 %, which only a moving voltage shows, and a bearing that shows by itself."""

TASKS = {recipe.name: recipe for recipe in (EASY, MEDIUM, HARD, SMALL)}


def task_recipe(name: str) -> Recipe:
    """Recipe of an environment by name: easy, medium, hard, small, or a named recipe of the package.

    Raises:
        ValueError: no such recipe.
    """
    return TASKS[name] if name in TASKS else named_recipe(name)
