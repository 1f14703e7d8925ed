"""Train models for `motor-classifiers train`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from motor_classifiers.cli.sweep import numbers
from motor_classifiers.estimators.methods import find_method, model_input
from motor_classifiers.estimators.networks.posterior_network import UNKNOWN_NOISE, PosteriorNetwork
from motor_classifiers.model_files.persistence import check_saveable, save_model
from motor_datasets.loaders import load
from motor_env.common.console import working
from motor_env.common.errors import InputError
from motor_env.motor.data_sheet import Motor, load_motor, usable_parameters
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import Channel
from motor_env.simulation.named_recipes import changed_recipe, load_recipe, motor_recipe, settling_timing
from motor_env.simulation.recipes import FaultClass, Recipe


def train_on_dataset(dataset: str, method: str, seed: int, out: Path) -> dict[str, Any]:
    """Train a method on the training split of a data set, write it, and summarise."""
    with working(f"training {method} on {dataset}"):
        cases = load(dataset, "train")
        chosen = find_method(method)
        model = chosen.make(cases.recipe, seed)
        check_saveable(model)
        model.fit(model_input(model, cases.X), cases.class_name)
        save_model(model, cases.recipe, method, out)
    return {"method": method, "n_train": len(cases), "out": str(out)}


def training_recipe(motor: str | None, recipe: str | None, **changes: float | None) -> Recipe:
    """Recipe of a motor file or of a recipe's name or file, changed as by `changed_recipe`."""
    if motor is None:
        chosen = load_recipe(str(recipe))
    else:
        chosen = network_recipe(load_motor(motor), changes["voltage_v"], changes["duration_s"])
    return changed_recipe(chosen, **changes)  # type: ignore[arg-type]  # a number for each of its names


def network_recipe(motor: Motor, voltage_v: float | None = None, duration_s: float | None = None) -> Recipe:
    """Recipe for a network of a motor file: the current, with each kind of fault as one class, 5 to 30 %.

    Dry friction, brushes and ramps are not drawn.
    """
    kinds = (FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT)
    classes = (FaultClass(), *(FaultClass(kind, 0.05, severity_to=0.30) for kind in kinds))
    usable_parameters(motor, needs_speed=False)
    recipe = motor_recipe(
        motor, voltage_v=voltage_v, timing=settling_timing(motor, duration_s), classes=classes
    )
    return replace(recipe, field=None, sensor=replace(recipe.sensor, channels=(Channel.CURRENT,)))


def noise_factors(text: str | None, *, for_motor: bool) -> tuple[float, float] | None:
    """Factors of `--noise-range`; a motor's noise is not known unless one is given.

    Raises:
        InputError: not two numbers.
    """
    if text is None:
        return UNKNOWN_NOISE if for_motor else None
    factors = numbers("noise-range", text)
    if len(factors) != 2:
        raise InputError(f"--noise-range must be two factors with a comma between, got {text!r}")
    return factors[0], factors[1]


def train_on_stream(
    recipe: Recipe, *, noise_range: tuple[float, float] | None, steps: int | None, seed: int, out: Path
) -> dict[str, Any]:
    """Train a network on a recipe's stream, write it, and summarise."""
    parameters = {} if steps is None else {"steps": steps}
    with working(f"training a network for {recipe.name}") as update:
        model = PosteriorNetwork.from_recipe(
            recipe,
            on_step=lambda seen, total: update(completed=seen, total=total),
            noise_range=noise_range,
            random_state=seed,
            **parameters,
        )
    save_model(model, recipe, "posterior-network", out)
    return {"method": "posterior-network", "n_train": model.n_drawn_, "out": str(out)}
