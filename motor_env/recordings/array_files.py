"""Arrays out of binary files: MATLAB, NumPy, Parquet. None of them may run code."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, cast

import numpy as np

from motor_env.errors import InputError, require_extra


def read_arrays(path: Path, content: bytes) -> dict[str, Any] | None:
    """Arrays of a binary file by name; None where its ending is that of no such file.

    Raises:
        InputError: it is not what its ending says.
    """
    match path.suffix.lower():
        case ".mat":
            return _mat(path, content)
        case ".npy" | ".npz":
            return _numpy(path, content)
        case ".parquet" | ".pq":
            return _parquet(path, content)
    return None


def _mat(path: Path, content: bytes) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        variables = loadmat(cast("Any", io.BytesIO(content)), simplify_cells=True)
    except Exception as error:  # noqa: BLE001  # a damaged file makes scipy raise anything, struct.error to MemoryError
        reason = "it is of version 7.3; save it with -v7" if content[:19] == b"MATLAB 7.3 MAT-file" else error
        raise InputError(f"{path}: is not a MATLAB file that can be read ({_short(reason)})") from None
    out: dict[str, Any] = {}
    for name, value in variables.items():
        if name.startswith("__"):
            continue
        out |= value if isinstance(value, dict) else {name: value}
    return out


def _numpy(path: Path, content: bytes) -> dict[str, Any]:
    try:
        loaded = np.load(io.BytesIO(content), allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            if loaded.dtype.names:
                return {name: loaded[name] for name in loaded.dtype.names}
            return {"array": loaded}
        return {name: loaded[name] for name in loaded.files}
    except Exception as error:  # noqa: BLE001  # a damaged file makes NumPy raise anything, zipfile's errors among them
        raise InputError(f"{path}: is not a NumPy file that can be read ({_short(error)})") from None


def _parquet(path: Path, content: bytes) -> dict[str, Any]:
    require_extra("pyarrow", "datasets")
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(pa.BufferReader(content))
        return {
            name: table.column(name).to_numpy()
            for name in table.column_names
            if pa.types.is_floating(table.schema.field(name).type)
            or pa.types.is_integer(table.schema.field(name).type)
        }
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: is not a Parquet file that can be read ({_short(error)})") from None


def _short(reason: object) -> str:
    return " ".join(str(reason).split())[:100]
