"""The stream of batches as torch's data set: a module of its own, which needs torch and which spawned workers find."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch

from motor_datasets.streaming import stream
from motor_env.simulation.recipes import Recipe


class TorchBatches(torch.utils.data.IterableDataset[Any]):
    """Batches of (X, class_index, severity); the workers of a loader share them.

    Args:
        recipe: what to draw from.
        seed: the random seed.
        batch_size: cases of a batch.
        options: further arguments of `stream`.
    """

    def __init__(self, recipe: Recipe, seed: int, *, batch_size: int, **options: Any) -> None:
        self._arguments = (recipe, seed, batch_size)
        self._options = options

    def __iter__(self) -> Iterator[Any]:
        """The batches of this process."""
        info = torch.utils.data.get_worker_info()
        share = (0, 1) if info is None else (info.id, info.num_workers)
        for batch in stream(*self._arguments, share=share, **self._options):
            yield (
                torch.from_numpy(batch.X),
                torch.tensor(batch.class_index),
                torch.tensor(batch.severity, dtype=torch.float32),
            )
