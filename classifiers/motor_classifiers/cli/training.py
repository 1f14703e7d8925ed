"""What `motor-classifiers train` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from motor_classifiers.cli.options import numbers
from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import save_model
from motor_classifiers.motor_recipe import UNKNOWN_NOISE, changed_recipe, motor_recipe
from motor_datasets.loaders import load
from motor_env.errors import InputError
from motor_env.motor.data_sheet import load_motor
from motor_env.simulation.recipe_files import load_recipe
from motor_env.simulation.recipes import Recipe


def train_on_dataset(dataset: str, method: str, seed: int, out: Path) -> dict[str, Any]:
    """Train a method of the benchmark on the training split of a data set, write it, and tell what was done."""
    cases = load(dataset, "train")
    model = make_method(method, cases.recipe, seed)
    with Console(stderr=True).status(f"training {method} on {len(cases)} starts"):
        METHODS[method].train(model, cases.X, cases.class_name)
        save_model(model, cases.recipe, method, out)
    return {"method": method, "n_train": len(cases), "out": str(out)}


def training_recipe(
    motor: str | None,
    recipe: str | None,
    voltage: float | None,
    sampling_rate_hz: float | None,
    duration_s: float | None,
    current_noise_a: float | None,
) -> Recipe:
    """Recipe of a motor file or of a recipe's name or file, with the options' changes; one of the two is given."""
    if motor is not None:
        found = motor_recipe(load_motor(motor), voltage_v=voltage, duration_s=duration_s)
    else:
        found = load_recipe(str(recipe))
    return changed_recipe(
        found,
        voltage_v=voltage,
        sampling_rate_hz=sampling_rate_hz,
        duration_s=duration_s,
        current_noise_a=current_noise_a,
    )


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
    recipe: Recipe, noise_range: tuple[float, float] | None, steps: int | None, seed: int, out: Path
) -> dict[str, Any]:
    """Train a network on a recipe's stream with a progress bar, write it, and tell what was done."""
    parameters = {} if steps is None else {"steps": steps}
    columns = (TextColumn("{task.description}"), BarColumn(30), TimeElapsedColumn(), TimeRemainingColumn())
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, disable=not errors.is_terminal) as bar:
        task = bar.add_task(f"training a network for {recipe.name}", total=None)
        model = PosteriorNetwork.from_recipe(
            recipe,
            on_step=lambda done, total: bar.update(task, completed=done, total=total),
            noise_range=noise_range,
            random_state=seed,
            **parameters,
        )
    save_model(model, recipe, "posterior-network", out)
    return {"method": "posterior-network", "n_train": model.n_drawn_, "out": str(out)}
