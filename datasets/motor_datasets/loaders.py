"""Data sets for NumPy, torch, pandas and MATLAB."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from motor_datasets.arrays import COLUMN_OF_CHANNEL, LABELS, Dataset
from motor_datasets.manifest import Folder, folder_of, read_manifest
from motor_env.common.arrays import instance
from motor_env.common.errors import InputError, require_extra
from motor_env.common.files import replacing
from motor_env.simulation.recipes import Recipe

if TYPE_CHECKING:
    import pandas as pd


SUFFIXES = (".npz", ".mat")


def export(dataset: Dataset, path: Path) -> None:
    """Write X, time_s, every label and parameter to a .npz or .mat file.

    Raises:
        InputError: another suffix, an existing file, or one that cannot be written.
    """
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path} must end in {' or '.join(SUFFIXES)}")
    if path.exists():
        raise InputError(f"{path} exists already and is not overwritten")
    labels = {name: getattr(dataset, name) for name in LABELS}
    arrays = {"X": dataset.X, "time_s": dataset.time_s, **labels, **dataset.parameters}
    with replacing(path) as temporary:
        if path.suffix == ".npz":
            np.savez(temporary, **arrays)
        else:
            from scipy.io import savemat

            arrays.update({name: v.astype(object) for name, v in arrays.items() if v.dtype.kind == "U"})
            savemat(temporary, arrays, oned_as="column", long_field_names=True)


def load(folder: str | Folder, split: str | None = None) -> Dataset:
    """Load a data set or a split of it, ordered by case.

    Args:
        folder: of `motor-datasets generate`, or a URL such as `s3://bucket/prefix`.
        split: train, validation, test or shift_NAME; None: all but the shifts.

    Raises:
        InputError: no data set, a missing or damaged file, an unknown or empty split.
    """
    from motor_datasets.parquet import read_files

    path = folder_of(folder)
    return read_files(path, read_manifest(path), split)


def to_torch(dataset: Dataset) -> Any:
    """Return a `torch.utils.data.TensorDataset` of (X, class_index, severity)."""
    instance("dataset", dataset, Dataset)
    require_extra("torch", "classifiers")
    from torch.utils.data import TensorDataset

    from motor_datasets.torch_batches import tensors

    return TensorDataset(*tensors(dataset))


def to_torch_iterable(recipe: Recipe, seed: int, batch_size: int = 256, **options: Any) -> Any:
    """Return a `torch.utils.data.IterableDataset` of (X, class_index, severity) batches, shared by workers."""
    require_extra("torch", "classifiers")
    from motor_datasets.torch_batches import TorchBatches

    return TorchBatches(recipe, seed, batch_size=batch_size, **options)


def to_pandas(dataset: Dataset) -> pd.DataFrame:
    """Return labels and parameters, one row a case; samples are arrays in `current_a`, `speed_rad_s`."""
    import pandas as pd

    instance("dataset", dataset, Dataset)
    columns: dict[str, Any] = {name: getattr(dataset, name) for name in LABELS} | dict(dataset.parameters)
    for n, channel in enumerate(dataset.recipe.channels):
        columns[COLUMN_OF_CHANNEL[channel]] = list(dataset.X[:, n])
    return pd.DataFrame(columns)
