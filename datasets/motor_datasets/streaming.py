"""Batches made while training eats them: nothing is stored, and the same (recipe, seed) gives the same batches."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np

from motor_datasets.arrays import Dataset, at_least_one
from motor_datasets.generate import generate_arrays
from motor_datasets.layout import BLOCK, Split, split_of
from motor_env.common.arrays import instance, is_one_of, shown, whole, wholes
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Recipe


def stream(
    recipe: Recipe,
    seed: int,
    batch_size: int = 256,
    *,
    split: str | None = None,
    batches: int | None = None,
    share: tuple[int, int] = (0, 1),
) -> Iterator[Dataset]:
    """Endless batches of fresh cases; batch n depends on (recipe, seed, batch_size, split, n) alone.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        batch_size: cases of a batch.
        split: only motors of this split; None for all.
        batches: end after so many; None for never.
        share: (n, m): only every m-th batch, beginning with the n-th; for m workers.

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
        mine = cases if split is None else cases[split_of(seed, recipe.motor_id(cases)) == split]
        pending = np.concatenate([pending, mine])
        while len(pending) >= batch_size:
            yield pending[:batch_size]
            pending = pending[batch_size:]
