"""From a recipe to labelled transients in memory. Case n depends on (recipe, seed, n) alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_datasets.arrays import EFFECTS, LOADS, SENSOR_ERRORS, Dataset, at_least_one
from motor_datasets.layout import split_of
from motor_env.common.arrays import instance, whole, wholes
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.sampling import Draw, draw, measure_draw

_CASES_AT_ONCE = 4096  # bounds the memory of what only some recipes need; more gains nothing


def generate_arrays(recipe: Recipe, seed: int, cases: int | ArrayLike) -> Dataset:
    """Draw and simulate cases in memory.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        cases: how many (cases 0 .. n-1), or the case numbers, shape (n_cases,).

    Raises:
        ValueError: fewer than one case, case numbers that are none or no list, or a seed out of range.
    """
    instance("recipe", recipe, Recipe)
    whole("seed", seed, most=2**64 - 1)
    if isinstance(cases, int | float | str | np.generic) or getattr(cases, "ndim", 1) == 0:
        numbers = np.arange(at_least_one("cases", cases), dtype=np.int64)
    else:
        numbers = wholes("cases", cases)
        require(numbers.ndim == 1, f"cases must be one list of numbers, got shape {numbers.shape}")
        require(numbers.size >= 1, "cases must name at least one case, got none")
    X = np.empty((len(numbers), len(recipe.channels), recipe.timing.n_samples), dtype=np.float32)
    labels = []
    for begin in range(0, len(numbers), _CASES_AT_ONCE):
        part = slice(begin, begin + _CASES_AT_ONCE)
        drawn = draw(recipe, seed, numbers[part])
        measure_draw(drawn, recipe, seed, X[part])
        labels.append(_labels(drawn))
    parameters, of_case = (
        {name: np.concatenate([one[table][name] for one in labels]) for name in labels[0][table]}
        for table in (0, 1)
    )
    index = of_case["class_index"]
    return Dataset(
        X=X,
        class_name=np.array(recipe.class_names)[index],
        kind=np.array([fault_class.label_kind for fault_class in recipe.classes])[index],
        parameters=parameters,
        case_id=numbers,
        split=split_of(seed, of_case["motor_id"]),
        recipe=recipe,
        seed=seed,
        **of_case,
    )


def _labels(drawn: Draw) -> tuple[dict[str, FloatArray], dict[str, NDArray[Any]]]:
    """Parameters of some cases, and what else is known of each."""
    parameters, n_cases = drawn.scenario.parameters, len(drawn.cases)
    values = {name: getattr(parameters, name) for name in type(parameters).__dataclass_fields__}
    values["voltage_v"] = drawn.scenario.supply.voltage_v
    if drawn.effects is not None:
        values.update({name: getattr(drawn.effects, name) for name in EFFECTS})
        values.update({name: getattr(drawn.chain, name) for name in SENSOR_ERRORS})
    if drawn.driving is not None:
        values.update({name: getattr(drawn.driving, name) for name in LOADS})
    of_case = {name: getattr(drawn, name) for name in ("class_index", "severity", "motor_id")}
    return {name: np.broadcast_to(np.asarray(v, float), n_cases) for name, v in values.items()}, of_case
