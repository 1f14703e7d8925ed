"""Kept answers of other packages' classifiers, which benchmarks/peers.py made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motor_classifiers.model_files.containers import read_arrays
from motor_classifiers.scoring.judging import Answer, Cost
from motor_classifiers.scoring.task import ClassTask
from motor_datasets.arrays import Dataset
from motor_env.common.errors import InputError
from motor_env.motor.parameters import FloatArray

PEERS = {
    "quant": "QUANT of aeon: quantiles of intervals, extra trees (Dempster et al. 2024)",
    "minirocket": "MiniRocket of aeon: shares of positive convolutions, ridge (Dempster et al. 2021)",
    "multirocket-hydra": "MultiRocket-Hydra of aeon: convolutions, ridge (Dempster et al. 2023)",
}
"""Peers by name, with what they are."""

_SAME_MEAN_A = 1e-6  # between machines the last bits of a simulated start may differ, and no more


def _means(X: NDArray[np.float32]) -> NDArray[np.float32]:
    means: NDArray[np.float32] = X.mean(axis=(1, 2), dtype=np.float64).astype(np.float32)
    return means


def identity(train: Dataset, test: Dataset) -> dict[str, NDArray[Any]]:
    """What tells these starts from all others: level and class of each."""
    return {
        "train_mean": _means(train.X),
        "train_class_index": train.class_index.astype(np.int8),
        "test_mean": _means(test.X),
        "test_class_index": test.class_index.astype(np.int8),
    }


def read_peers(path: Path, task: ClassTask) -> dict[str, Answer]:
    """Answers of peers to the starts of a setting, by name; none when the file's starts are others.

    A slow peer may have judged the first starts only.

    Raises:
        InputError: no such file, or not one that benchmarks/aeon_peers.py wrote.
    """
    arrays = read_arrays(path)
    try:
        facts = json.loads(str(arrays["facts"]))
        if not _same_starts(arrays, task):
            return {}
        origin = f"{facts['date']}, {facts['machine']}, aeon {facts['aeon']}, {facts['command']}"
        return {
            name: _answer(arrays[name].astype(np.float64), measured, task)._replace(origin=origin)
            for name, measured in facts["methods"].items()
            if len(arrays[name]) >= task.n_test
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: holds no answers of peers ({' '.join(str(error).split())[:100]})"
        ) from None


def _same_starts(arrays: dict[str, NDArray[Any]], task: ClassTask) -> bool:
    """Whether a file speaks of the starts of this setting; the file may hold more test starts."""
    if len(arrays["test_mean"]) < task.n_test or len(arrays["train_mean"]) != task.n_train:
        return False
    ours = identity(task.train(), task.starts())
    return all(
        np.allclose(arrays[name][: len(values)], values, rtol=0.0, atol=_SAME_MEAN_A)
        for name, values in ours.items()
    )


def _answer(probabilities: FloatArray, measured: dict[str, Any], task: ClassTask) -> Answer:
    if probabilities.ndim != 2 or probabilities.shape[1] != len(task.recipe.classes):
        raise ValueError(f"probabilities of shape {probabilities.shape}")
    shown = probabilities[: task.n_test]
    shown = shown / shown.sum(axis=1, keepdims=True)
    seconds = 1e-6 * float(measured["microseconds_per_transient"]) * len(shown)
    return Answer(
        shown,
        Cost(float(measured["train_s"]), measured["train_memory_mb"]),
        Cost(seconds, measured["inference_memory_mb"]),
    )
