"""Recipes as dictionaries and TOML. The schema is the dataclasses themselves, so that it cannot drift from them."""

from __future__ import annotations

import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from motor_env.errors import InputError
from motor_env.motor.faults import FaultKind
from motor_env.simulation.recipes import RECIPES, Recipe, named_recipe


def recipe_to_dict(recipe: Recipe) -> dict[str, Any]:
    """The recipe in strings, numbers, lists and dictionaries."""
    content = _plain(asdict(recipe))
    if not isinstance(content, dict):
        raise TypeError("a recipe is a dictionary")
    return content


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, str) else value


def recipe_from_dict(content: Mapping[str, Any]) -> Recipe:
    """The recipe that a dictionary describes; what is left out has its default.

    Raises:
        ValueError: an unknown key, a value of another type or out of its range.
    """
    recipe = _build(Recipe, content, "")
    if not isinstance(recipe, Recipe):
        raise TypeError("not a recipe")
    return recipe


def _build(cls: Any, content: Any, where: str) -> Any:
    """An object of a dataclass from a dictionary, every entry checked against the field's type."""
    place = where or "the recipe"
    if not isinstance(content, Mapping):
        raise ValueError(f"{place} must be a table, got {content!r}")  # noqa: TRY004 - the user reads it, no caller
    known = [f.name for f in fields(cls)]
    for key in content:
        if key not in known:
            raise ValueError(f"unknown key {key!r} in {place}; known are {', '.join(known)}")
    hints = typing.get_type_hints(cls)
    values = {
        key: _convert(hints[key], entry, f"{where}.{key}".lstrip(".")) for key, entry in content.items()
    }
    try:
        return cls(**values)
    except TypeError:
        missing = [f.name for f in fields(cls) if f.name not in values]
        raise ValueError(f"{place} lacks one of {', '.join(missing)}") from None
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(arguments[0], value, where)
    if origin is tuple:
        return _convert_list(arguments, value, where)
    if is_dataclass(hint):
        return _build(hint, value, where)
    return _convert_value(hint, value, where)


def _convert_list(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{where} must be a list, got {value!r}")  # noqa: TRY004 - the user reads it, no caller
    if arguments[-1] is Ellipsis:
        return tuple(_convert(arguments[0], entry, f"{where}[{n}]") for n, entry in enumerate(value))
    if len(value) != len(arguments):
        raise ValueError(f"{where} must have {len(arguments)} entries, got {value!r}")
    return tuple(_convert(a, entry, where) for a, entry in zip(arguments, value, strict=True))


def _convert_value(hint: Any, value: Any, where: str) -> Any:
    if isinstance(hint, type) and issubclass(hint, Enum | FaultKind):
        names = list(map(str, hint))
        if value not in names:
            raise ValueError(f"{where} must be one of {', '.join(names)}, got {value!r}")
        return hint(value)
    wanted = (int, float) if hint is float else hint
    if not isinstance(value, wanted) or (isinstance(value, bool) and hint is not bool):
        name = {float: "a number", int: "an integer", str: "text"}.get(hint, str(hint))
        raise ValueError(f"{where} must be {name}, got {value!r}")
    return float(value) if hint is float else value


def load_recipe(name_or_path: str | Path) -> Recipe:
    """A named recipe, or one from a TOML file.

    A file holds the recipe's fields by name, SI units in the names. `base = "bench"` starts from a named recipe:
    tables then replace the entries that they name. `motor = "file.toml"` or a catalogue name stands for its table.

    Raises:
        InputError: no such recipe or file, not TOML, an unknown key, a value out of range.
    """
    if str(name_or_path) in RECIPES:
        return RECIPES[str(name_or_path)]
    path = Path(name_or_path)
    if path.suffix != ".toml":
        named_recipe(str(name_or_path))
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        return _from_toml(content, path)
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such recipe file; named recipes are {', '.join(sorted(RECIPES))}"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text (byte {error.start} is not UTF-8)") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML: {error}") from None
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _from_toml(content: dict[str, Any], path: Path) -> Recipe:
    base = content.pop("base", None)
    motor = content.get("motor")
    if isinstance(motor, str):
        from motor_env.motor.data_sheet import load_motor

        beside = path.parent / motor
        content["motor"] = _plain(asdict(load_motor(beside if beside.is_file() else motor).parameters))
    start = (
        recipe_to_dict(replace(named_recipe(base), name=path.stem))
        if base is not None
        else {"name": path.stem}
    )
    return recipe_from_dict(_merged(start, content))


def _merged(start: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(start)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = (
            _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
        )
    return merged
