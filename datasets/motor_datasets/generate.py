"""From a recipe to labelled transients: cases in memory, splits, the layout of files, streams.

Case n depends on (recipe, seed, n) alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_datasets.arrays import EFFECTS, LOADS, SENSOR_ERRORS, Dataset, at_least_one, parameter_names
from motor_env.common.arrays import instance, is_one_of, shown, whole, wholes
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.sampling import Draw, draw, measure_draw


class Split(StrEnum):
    """Training, validation or test."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


MOTORS_OF_BLOCK = {Split.TRAIN: 14, Split.VALIDATION: 3, Split.TEST: 3}
"""Number of twenty consecutive motors in each split: 70, 15 and 15 %."""

BLOCK = sum(MOTORS_OF_BLOCK.values())

_BY_RANK = np.repeat([str(split) for split in MOTORS_OF_BLOCK], list(MOTORS_OF_BLOCK.values()))


def split_of(seed: int, motor_id: ArrayLike) -> NDArray[np.str_]:
    """Return the split of each motor, in the shape of `motor_id`; it depends on (seed, motor) alone.

    Every block of twenty consecutive motors is shuffled and dealt out 14 : 3 : 3.
    """
    whole("seed", seed, most=2**64 - 1)
    motors = wholes("motor_id", motor_id)
    blocks, which = np.unique(motors // BLOCK, return_inverse=True)
    order = np.argsort(uniforms(seed, Stream.SPLIT, blocks, BLOCK), axis=1, kind="stable")
    rank = np.argsort(order, axis=1, kind="stable")
    splits: NDArray[np.str_] = _BY_RANK[rank[which.reshape(motors.shape), motors % BLOCK]]
    return splits


SHIFT_CASES = 2**40
"""Spacing of the shifts' case numbers: the n-th shift begins at n times this."""

_SHARD_BYTES = 32 * 2**20
_MOST_SHARDS = 10**6  # six digits of a file's name
_SHARE_OF_SHIFT = 10  # a shift has a tenth of the cases


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One Parquet file: the cases `begin` .. `end` - 1, or those whose motors belong to `split`."""

    path: str
    split: str
    begin: int
    end: int
    shift: str | None = None

    def case_id(self, recipe: Recipe, seed: int) -> NDArray[np.int64]:
        """Return the case numbers of the file."""
        cases = np.arange(self.begin, self.end, dtype=np.int64)
        if self.shift is not None:
            return cases
        mine: NDArray[np.int64] = cases[split_of(seed, recipe.motor_id(cases)) == self.split]
        return mine


@dataclass(frozen=True, slots=True)
class Plan:
    """Plan of a data set's files, from recipe, seed and number of cases."""

    recipe: Recipe
    seed: int
    cases: int
    files: tuple[PlannedFile, ...]

    @property
    def cases_of_all(self) -> int:
        """Cases, with those of the shifts."""
        return self.cases + sum(file.end - file.begin for file in self.files if file.shift is not None)

    @property
    def bytes_uncompressed(self) -> int:
        """Bytes of all samples and labels before compression."""
        return self.cases_of_all * bytes_of_case(self.recipe)


def bytes_of_case(recipe: Recipe) -> int:
    """Return the bytes of one case before compression."""
    labels = 8 * (len(parameter_names(recipe)) + 4)
    return 4 * len(recipe.channels) * recipe.timing.n_samples + labels


def make_plan(recipe: Recipe, cases: int, seed: int) -> Plan:
    """Lay the cases out over files of some 32 MB.

    Raises:
        ValueError: fewer than one case, too many, or a seed out of range.
    """
    instance("recipe", recipe, Recipe)
    cases, seed = at_least_one("cases", cases), whole("seed", seed, most=2**64 - 1)
    per_shard = max(1, _SHARD_BYTES // bytes_of_case(recipe))
    most = min(per_shard * _MOST_SHARDS, SHIFT_CASES - 1)
    require(
        cases <= most,
        f"cases must fit into a million files of {_SHARD_BYTES / 2**20:g} MB, here {most} cases, got {cases}",
    )
    files = []
    for shard, begin in enumerate(range(0, cases, per_shard)):
        end = min(begin + per_shard, cases)
        files += [
            PlannedFile(f"data/{split}-{shard:06d}.parquet", split, begin, end)
            for split in _splits_of_range(recipe, seed, begin, end)
        ]
    per_shift = max(1, cases // _SHARE_OF_SHIFT)
    for number, shift in enumerate(recipe.shifts, start=1):
        first = number * SHIFT_CASES
        for shard, begin in enumerate(range(first, first + per_shift, per_shard)):
            name = f"shift_{shift.name}"
            path = f"data/{name}-{shard:06d}.parquet"
            files.append(
                PlannedFile(path, name, begin, min(begin + per_shard, first + per_shift), shift.name)
            )
    return Plan(recipe, seed, cases, tuple(files))


def _splits_of_range(recipe: Recipe, seed: int, begin: int, end: int) -> list[str]:
    if end - begin >= 2 * BLOCK * recipe.starts_per_motor:  # a whole block lies inside: all splits are there
        return [str(split) for split in Split]
    present = set(split_of(seed, recipe.motor_id(np.arange(begin, end, dtype=np.int64))).tolist())
    return [str(split) for split in Split if str(split) in present]


_LARGEST_ARRAY_BYTES = 2**40  # no machine of a user has it: refused before hours of drawing
_CASES_AT_ONCE = 4096  # bounds the memory of what only some recipes need; more gains nothing


def generate_arrays(recipe: Recipe, seed: int, cases: int | ArrayLike) -> Dataset:
    """Draw and simulate cases in memory.

    Args:
        recipe: distribution of the cases.
        seed: the random seed.
        cases: their number (cases 0 .. n-1), or case numbers, shape (n_cases,).

    Raises:
        ValueError: fewer than one case, no valid case numbers, or a seed out of range.
    """
    instance("recipe", recipe, Recipe)
    whole("seed", seed, most=2**64 - 1)
    if isinstance(cases, int | float | str | np.generic) or getattr(cases, "ndim", 1) == 0:
        count = at_least_one("cases", cases)
        most = _LARGEST_ARRAY_BYTES // (4 * len(recipe.channels) * recipe.timing.n_samples)
        require(count <= most, f"cases must be at most {most} in memory, got {count}")
        numbers = np.arange(count, dtype=np.int64)
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
        {
            name: np.concatenate([part_labels[table][name] for part_labels in labels])
            for name in labels[0][table]
        }
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


def stream(
    recipe: Recipe,
    seed: int,
    batch_size: int = 256,
    *,
    split: str | None = None,
    batches: int | None = None,
    share: tuple[int, int] = (0, 1),
) -> Iterator[Dataset]:
    """Yield batches of fresh cases; batch n depends on (recipe, seed, batch_size, split, n) alone.

    Args:
        recipe: distribution of the cases.
        seed: the random seed.
        batch_size: cases of a batch.
        split: of the motors; None for all.
        batches: their number; None for no end.
        share: (n, m): every m-th batch from the n-th on, for m workers.

    Raises:
        ValueError: fewer than one case a batch, or an unknown split.
    """
    instance("recipe", recipe, Recipe)
    whole("seed", seed, most=2**64 - 1)
    batch_size = at_least_one("batch_size", batch_size)
    is_split = split is None or is_one_of(split, Split)
    require(is_split, f"split must be one of {', '.join(Split)}, got {shown(split)}")
    batches = None if batches is None else whole("batches", batches)
    part, of = wholes("share", share).tolist() if np.shape(share) == (2,) else (0, 0)
    require(of >= 1, f"share must be two numbers, the second >= 1, got {shown(share)}")
    numbers = count() if batches is None else range(batches)
    offsets = _case_blocks(recipe, seed, batch_size, split)
    for number, cases in zip(numbers, offsets, strict=False):
        if number % of == part:
            yield generate_arrays(recipe, seed, cases)


def _case_blocks(
    recipe: Recipe, seed: int, batch_size: int, split: str | None
) -> Iterator[np.ndarray[Any, np.dtype[np.int64]]]:
    pending = np.empty(0, dtype=np.int64)
    width = BLOCK * recipe.starts_per_motor * max(1, batch_size // BLOCK)
    for number in count():
        cases = np.arange(number * width, (number + 1) * width, dtype=np.int64)
        of_split = cases if split is None else cases[split_of(seed, recipe.motor_id(cases)) == split]
        pending = np.concatenate([pending, of_split])
        while len(pending) >= batch_size:
            yield pending[:batch_size]
            pending = pending[batch_size:]
