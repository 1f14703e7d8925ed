"""Recipes as plain dictionaries, for JSON: what a data set carries with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from motor_env.faults import FaultKind
from motor_env.parameters import Channel, MotorParameters, SensorParameters, SupplyParameters
from motor_env.recipes import FaultClass, Recipe, Spread
from motor_env.simulation import Timing


def recipe_to_dict(recipe: Recipe) -> dict[str, Any]:
    """The recipe in strings, numbers, lists and dictionaries."""
    content = asdict(recipe)
    content["sensor"]["channels"] = [str(channel) for channel in recipe.sensor.channels]
    content["classes"] = [
        {**entry, "kind": None if entry["kind"] is None else str(entry["kind"])}
        for entry in content["classes"]
    ]
    return content


def recipe_from_dict(content: Mapping[str, Any]) -> Recipe:
    """The recipe that `recipe_to_dict` wrote.

    Raises:
        ValueError: a value is out of its range.
        KeyError: a field is missing.
        TypeError: a field is unknown.
    """
    sensor = dict(content["sensor"])
    sensor["channels"] = tuple(Channel(channel) for channel in sensor["channels"])
    classes = tuple(
        FaultClass(None if c["kind"] is None else FaultKind(c["kind"]), c["severity"], c["weight"])
        for c in content["classes"]
    )
    return Recipe(
        name=content["name"],
        motor=MotorParameters(**content["motor"]),
        supply=SupplyParameters(**content["supply"]),
        spread=Spread(**content["spread"]),
        classes=classes,
        sensor=SensorParameters(**sensor),
        timing=Timing(**content["timing"]),
    )
