"""The stream of batches as torch's data set."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch

from motor_datasets.arrays import Dataset
from motor_datasets.generate import stream
from motor_env.simulation.recipes import Recipe


def tensors(dataset: Dataset) -> tuple[torch.Tensor, ...]:
    """Return X, class_index and severity."""
    return (
        torch.from_numpy(dataset.X),
        torch.tensor(dataset.class_index),
        torch.tensor(dataset.severity, dtype=torch.float32),
    )


class TorchBatches(torch.utils.data.IterableDataset[Any]):
    """Batches of (X, class_index, severity), shared by a loader's workers.

    Args:
        options: further arguments of `stream`.
    """

    def __init__(self, recipe: Recipe, seed: int, *, batch_size: int, **options: Any) -> None:
        self._batches = partial(stream, recipe, seed, batch_size, **options)

    def __iter__(self) -> Iterator[Any]:
        info = torch.utils.data.get_worker_info()
        share = (0, 1) if info is None else (info.id, info.num_workers)
        return map(tensors, self._batches(share=share))
