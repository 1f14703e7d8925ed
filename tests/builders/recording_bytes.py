"""A recording as the content of a file of any kind that is read."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from recording_csv import csv_text
from scipy.io import savemat


def bytes_of(kind: str, columns: dict[str, Any]) -> bytes:
    """Columns as the content of a file of some kind; .npy holds the time and the current alone."""
    stream: Any = io.BytesIO()
    if kind == "csv":
        return csv_text(columns).encode()
    if kind == "mat":
        savemat(stream, columns, do_compression=True)
    elif kind == "npz":
        np.savez_compressed(stream, **columns)
    elif kind == "npy":
        np.save(stream, np.column_stack([columns["time_s"], columns["current_a"]]))
    elif kind == "h5":
        with pytest.importorskip("h5py", reason="the extra files is not installed").File(stream, "w") as file:
            for name, values in columns.items():
                file.create_dataset(name, data=values, fletcher32=True)
    elif kind == "xlsx":
        book = pytest.importorskip("openpyxl", reason="the extra files is not installed").Workbook()
        for row in (list(columns), *zip(*columns.values(), strict=True)):
            book.active.append(row)
        book.save(stream)
    else:
        pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        parquet.write_table(pa.table(columns), stream)
    content: bytes = stream.getvalue()
    return content
