"""Recipes of the environments: easy, medium and hard versions of the same task."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.arrays import shown
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import CATALOGUE, Channel, MotorParameters, SensorParameters, require
from motor_env.simulation.named_recipes import RECIPES
from motor_env.simulation.recipes import PAPER_CLASSES, FaultClass, Recipe, Spread

EASY = Recipe(
    name="easy",
    classes=(FaultClass(weight=2.0), PAPER_CLASSES[2], PAPER_CLASSES[4]),
    sensor=SensorParameters(current_noise_a=0.005),
)
"""Large faults, a good sensor, a motor known exactly."""

MEDIUM = Recipe(
    name="medium",
    classes=(FaultClass(weight=4.0), *PAPER_CLASSES[1:]),
)
"""The paper's fault levels at 20 mA of noise, a motor known exactly."""

HARD = Recipe(
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


def described(kind: type[Any], value: Any) -> Any:
    """What a dictionary describes, as an EnvSpec's JSON makes one of a recipe or a motor; anything else as it is."""
    if not isinstance(value, Mapping) or not value:
        return value
    from motor_env.motor.toml_files import from_dict

    return from_dict(kind, value, kind.__name__)


def task_recipe(recipe: Any) -> Recipe:
    """A recipe; easy, medium, hard, small, a named recipe of the package, or a recipe's TOML file or dictionary.

    Raises:
        ValueError: no such recipe or file, or it is not a recipe.
    """
    recipe = described(Recipe, recipe)
    require(
        isinstance(recipe, Recipe | str | Path),
        f"recipe must be a name, a TOML file or a Recipe, got {shown(recipe)}",
    )
    if isinstance(recipe, Recipe):
        return recipe
    name = str(recipe)
    if name in TASKS:
        return TASKS[name]
    if name.endswith(".toml"):
        from motor_env.simulation.named_recipes import load_recipe

        return load_recipe(recipe)
    require(
        name in RECIPES,
        f"recipe must be one of {', '.join([*TASKS, *RECIPES])}, or a TOML file, got {name!r}",
    )
    return RECIPES[name]


def with_motor(recipe: Recipe, motor: Any) -> Recipe:
    """The recipe with another nominal motor; a motor's file brings its own supply, noise and tolerances along.

    Raises:
        ValueError: no such motor, its file is not one or gives no voltage, or it has more than the linear motor of an
            environment.
    """
    motor = described(MotorParameters, motor)
    if isinstance(motor, MotorParameters):
        return replace(recipe, motor=motor)
    require(
        isinstance(motor, str | Path), f"motor must be a name, a TOML file or parameters, got {shown(motor)}"
    )
    from motor_env.motor.data_sheet import load_motor

    read = load_motor(motor)
    for name in ("coulomb_friction_n_m", "brush_drop_v"):
        require(
            getattr(read, name) == 0.0,
            f"{motor}: an environment's motor is linear, so {name} must be 0, got {getattr(read, name):g}",
        )
    if str(motor) in CATALOGUE:
        return replace(recipe, motor=read.parameters)
    from motor_env.motor.data_sheet import usable_parameters
    from motor_env.simulation.named_recipes import motor_recipe

    require(read.nominal_voltage_v is not None, f"{motor}: motor.nominal_voltage_v is missing")
    usable_parameters(read, needs_speed=Channel.SPEED in recipe.sensor.channels)
    for note in () if read.assumed else read.notes:
        warnings.warn(f"{motor}: {note}", stacklevel=2)
    own = motor_recipe(read, timing=recipe.timing, classes=recipe.classes)
    return replace(recipe, motor=own.motor, supply=own.supply, sensor=own.sensor, spread=own.spread)


def require_environment(recipe: Recipe) -> None:
    """Refuse what a recipe may say for data sets, but an environment does not simulate.

    Raises:
        ValueError: the sentence says what.
    """
    name = recipe.name
    require(recipe.field is None, f"recipe {name} has a table field, which an environment does not simulate")
    require(
        all(not c.also for c in recipe.classes),
        f"recipe {name} has joint faults, of which an agent could declare only one",
    )
    require(
        recipe.starts_per_motor == 1,
        f"recipe {name} has several starts of a motor, but an environment draws a motor for each episode",
    )
    require(
        np.ndim(recipe.supply.voltage_v) == 0,
        f"voltage_v of recipe {name} must be one number for an environment",
    )
