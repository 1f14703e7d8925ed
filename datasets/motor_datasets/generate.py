"""From a recipe to labelled transients, in memory or on disk. Case n depends on (recipe, seed, n) alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_datasets import storage
from motor_datasets.arrays import Dataset
from motor_datasets.splits import split_of
from motor_env.parameters import require
from motor_env.recipes import Draw, Recipe, draw
from motor_env.simulation import simulate

_CASES_AT_ONCE = 1024  # bounds the memory of the float64 intermediates


def generate_arrays(recipe: Recipe, seed: int, cases: int | ArrayLike) -> Dataset:
    """Draw and simulate cases in memory.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        cases: how many (cases 0 .. n-1), or the case numbers, shape (n_cases,).

    Raises:
        ValueError: fewer than one case, or a seed out of range.
    """
    numbers = np.arange(cases) if isinstance(cases, int) else np.atleast_1d(np.asarray(cases, dtype=np.int64))
    require(numbers.size >= 1, f"cases must be >= 1, got {numbers.size}")
    drawn = draw(recipe, seed, numbers)
    X = np.empty((len(numbers), len(recipe.sensor.channels), recipe.timing.n_samples), dtype=np.float32)
    for begin in range(0, len(numbers), _CASES_AT_ONCE):
        part = slice(begin, begin + _CASES_AT_ONCE)
        X[part] = simulate(draw(recipe, seed, numbers[part]).scenario, seed, numbers[part]).measurements
    return _labelled(X, drawn, recipe, seed)


def _labelled(X: NDArray[np.float32], drawn: Draw, recipe: Recipe, seed: int) -> Dataset:
    classes = recipe.classes
    index = drawn.class_index
    parameters, n_cases = drawn.scenario.parameters, len(drawn.cases)
    values = {name: getattr(parameters, name) for name in type(parameters).__dataclass_fields__}
    values["voltage_v"] = drawn.scenario.supply.voltage_v
    motor_id = drawn.cases
    return Dataset(
        X=X,
        class_name=np.array(recipe.class_names)[index],
        class_index=index,
        kind=np.array([fault_class.label_kind for fault_class in classes])[index],
        severity=np.array([fault_class.severity for fault_class in classes])[index],
        parameters={name: np.broadcast_to(np.asarray(v, float), n_cases) for name, v in values.items()},
        case_id=drawn.cases,
        motor_id=motor_id,
        split=split_of(seed, motor_id),
        recipe=recipe,
        seed=seed,
    )


def generate_dataset(
    recipe: Recipe,
    cases: int,
    seed: int,
    out: Path,
    *,
    on_progress: Callable[[int], object] = lambda _: None,
) -> storage.Manifest:
    """Write a data set to a new folder.

    Args:
        recipe: what to draw from.
        cases: how many cases.
        seed: the random seed.
        out: folder; it must not exist, or be empty.
        on_progress: called with the number of cases just written.

    Raises:
        ValueError: fewer than one case, or a seed out of range.
        InputError: `out` is there and not empty.
    """
    plan = storage.make_plan(recipe, cases, seed)
    with storage.new_folder(out) as folder:
        entries = []
        for file in plan.files:
            entries.append(storage.write_file(folder, file, generate_arrays(recipe, seed, file.case_id)))
            on_progress(len(file.case_id))
        return storage.write_manifest(folder, plan, entries)
