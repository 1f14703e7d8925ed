"""Recipes as dictionaries and TOML. The schema is the dataclasses themselves, so that it cannot drift from them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from motor_env.common.arrays import instance
from motor_env.common.errors import InputError
from motor_env.motor.assumptions import usable_parameters
from motor_env.motor.data_sheet import load_motor
from motor_env.motor.parameters import Channel, require
from motor_env.motor.toml_files import from_dict, one_line, read_toml
from motor_env.simulation.named_recipes import RECIPES, named_recipe
from motor_env.simulation.recipes import Recipe


def recipe_to_dict(recipe: Recipe) -> dict[str, Any]:
    """The recipe in strings, numbers, lists and dictionaries."""
    content: dict[str, Any] = json.loads(json.dumps(asdict(recipe)))
    if recipe.duty is None:
        del content["duty"]  # as in every file of a release that knew no duty
    return content


def recipe_from_dict(content: Mapping[str, Any]) -> Recipe:
    """The recipe that a dictionary describes; what is left out has its default.

    Raises:
        ValueError: an unknown key, a value of another type or out of its range.
    """
    return from_dict(Recipe, content, "the recipe")


def load_recipe(name_or_path: str | Path, **changes: Any) -> Recipe:
    """A named recipe, or one from a TOML file, with fields replaced.

    A file holds the recipe's fields by name, SI units in the names. `base = "bench"` starts from a named recipe:
    tables then replace the entries that they name. `motor = "file.toml"` or a catalogue name stands for its table.

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
