"""From a recipe to labelled transients, in memory or on disk. Case n depends on (recipe, seed, n) alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_datasets import storage
from motor_datasets.arrays import EFFECTS, SENSOR_ERRORS, Dataset
from motor_datasets.layout import Plan, PlannedFile, make_plan
from motor_datasets.remote import Folder, RemotePath, folder_of
from motor_datasets.splits import split_of
from motor_env.errors import InputError
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Draw, Recipe, draw, measure_draw

_CASES_AT_ONCE = 4096  # bounds the memory of what only some recipes need; more gains nothing


def generate_arrays(recipe: Recipe, seed: int, cases: int | ArrayLike) -> Dataset:
    """Draw and simulate cases in memory.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        cases: how many (cases 0 .. n-1), or the case numbers, shape (n_cases,).

    Raises:
        ValueError: fewer than one case, or a seed out of range.
    """
    if isinstance(cases, int):
        require(cases >= 1, f"cases must be >= 1, got {cases}")
        numbers = np.arange(cases, dtype=np.int64)
    else:
        numbers = np.atleast_1d(np.asarray(cases, dtype=np.int64))
        require(numbers.size >= 1, "cases must name at least one case, got none")
    drawn = draw(recipe, seed, numbers)
    X = np.empty((len(numbers), len(recipe.sensor.channels), recipe.timing.n_samples), dtype=np.float32)
    for begin in range(0, len(numbers), _CASES_AT_ONCE):
        part = slice(begin, begin + _CASES_AT_ONCE)
        measure_draw(draw(recipe, seed, numbers[part]), recipe, seed, X[part])
    return _labelled(X, drawn, recipe, seed)


def _labelled(X: NDArray[np.float32], drawn: Draw, recipe: Recipe, seed: int) -> Dataset:
    index = drawn.class_index
    parameters, n_cases = drawn.scenario.parameters, len(drawn.cases)
    values = {name: getattr(parameters, name) for name in type(parameters).__dataclass_fields__}
    values["voltage_v"] = drawn.scenario.supply.voltage_v
    if drawn.effects is not None:
        values.update({name: getattr(drawn.effects, name) for name in EFFECTS})
        values.update({name: getattr(drawn.chain, name) for name in SENSOR_ERRORS})
    return Dataset(
        X=X,
        class_name=np.array(recipe.class_names)[index],
        class_index=index,
        kind=np.array([fault_class.label_kind for fault_class in recipe.classes])[index],
        severity=drawn.severity,
        parameters={name: np.broadcast_to(np.asarray(v, float), n_cases) for name, v in values.items()},
        case_id=drawn.cases,
        motor_id=drawn.motor_id,
        split=split_of(seed, drawn.motor_id),
        recipe=recipe,
        seed=seed,
    )


def _make_file(folder: Folder, file: PlannedFile, recipe: Recipe, seed: int) -> storage.Entry:
    """Generate and write one file: all that a worker does."""
    own = recipe if file.shift is None else recipe.shifted(file.shift)
    dataset = generate_arrays(own, seed, file.case_id(recipe, seed))
    return storage.write_file(folder, file, dataset)


def _run(jobs: list[PlannedFile], folder: Folder, plan: Plan, workers: int) -> Iterator[storage.Entry]:
    if workers == 1:
        yield from (_make_file(folder, job, plan.recipe, plan.seed) for job in jobs)
        return
    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    pool: Any = Parallel(n_jobs=workers, return_as="generator_unordered")
    try:
        yield from pool(delayed(_make_file)(folder, job, plan.recipe, plan.seed) for job in jobs)
    except TerminatedWorkerError:
        raise InputError(
            f"a worker was killed (out of memory?); what is whole in {folder} stays: resume it"
        ) from None


def generate_dataset(
    recipe: Recipe,
    cases: int,
    seed: int,
    out: str | Path | RemotePath,
    *,
    workers: int = 1,
    resume: bool = False,
    on_progress: Callable[[int], object] = lambda _: None,
) -> storage.Manifest:
    """Write a data set to a folder. The bytes do not depend on the workers, nor on interruptions.

    Args:
        recipe: what to draw from.
        cases: how many cases, those of the recipe's shifts aside.
        seed: the random seed.
        out: folder, or a URL for fsspec (`s3://bucket/prefix`); it must not exist, be empty, or (with `resume`) hold
            the unfinished same data set.
        workers: processes; inside `joblib.parallel_config(backend="dask")` those of that backend.
        resume: finish what an interrupted generation began.
        on_progress: called with the number of cases just written.

    Raises:
        ValueError: fewer than one case or worker, or a seed out of range.
        InputError: `out` holds something else or cannot be used, or a worker was killed.
    """
    require(workers >= 1, f"workers must be >= 1, got {workers}")
    plan = make_plan(recipe, cases, seed)
    folder = folder_of(out)
    if isinstance(folder, RemotePath) and not folder.shared:
        require(
            workers == 1, f"workers must be 1 for {folder}, which other processes do not see, got {workers}"
        )
    finished = storage.open_folder(folder, plan, resume=resume)
    if finished is not None:
        on_progress(plan.cases_of_all)
        return finished
    entries: dict[str, storage.Entry] = {}
    jobs = []
    for file in plan.files:
        entry = storage.existing_entry(folder, file) if resume else None
        if entry is None:
            jobs.append(file)
        else:
            entries[file.path] = entry
            on_progress(entry.rows)
    for entry in _run(jobs, folder, plan, workers):
        entries[entry.path] = entry
        on_progress(entry.rows)
    return storage.finish_folder(folder, plan, [entries[file.path] for file in plan.files])
