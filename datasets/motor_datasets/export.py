"""Data sets for other tools: NumPy's .npz and MATLAB's .mat."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from motor_datasets.arrays import LABELS, Dataset
from motor_env.common.errors import InputError
from motor_env.common.files import replacing

SUFFIXES = (".npz", ".mat")


def export(dataset: Dataset, path: Path) -> None:
    """Write X, time_s, every label and parameter to a .npz or .mat file.

    Raises:
        InputError: another suffix, the file is there already, or cannot be written.
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
