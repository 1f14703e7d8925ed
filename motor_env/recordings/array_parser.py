"""Parses one MATLAB file from standard input, or one Parquet file by its path, in a process of its own.

What comes out: a line of JSON with how many rows are one, and name and shape of each array of numbers, then their
values as bytes of float64.
A file that cannot be parsed ends it with status 1 and a sentence on standard error.

This file is run as a script: it imports nothing of the package.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator
from typing import Any, cast

import numpy as np

MOST_NUMBERS = 50_000_000
_MOST_READ = 1_000_000_000  # of a Parquet file, in pieces
_MOST_ROWS = 4_000_000  # of a long log, beyond which neighbours are averaged
_BATCH_ROWS = 65_536
_MEMORY_BYTES = 1_600_000_000


def check_count(numbers: int, most: int = MOST_NUMBERS) -> None:
    """Refuse more numbers than a recording holds.

    Raises:
        ValueError: they are more.
    """
    if numbers > most:
        raise ValueError(f"it unpacks to {numbers:,} numbers; at most {most:,} are read")


def parse_matlab(content: bytes) -> dict[str, Any]:
    """Variables of a MATLAB file; those of structs by their own name, or as `struct.name` where it is there twice."""
    from scipy.io import loadmat

    variables = loadmat(cast("Any", io.BytesIO(content)), simplify_cells=True)
    named = list(_named({name: value for name, value in variables.items() if not name.startswith("__")}))
    shorts = [name.rpartition(".")[2] for name, _ in named]
    return {
        short if shorts.count(short) == 1 else name: np.asarray(value)
        for short, (name, value) in zip(shorts, named, strict=True)
    }


def _named(variables: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in variables.items():
        entries: list[Any] = value if isinstance(value, list) else []
        if isinstance(value, np.ndarray) and value.dtype.kind == "O":
            entries = list(value.flat)
        if isinstance(value, dict):
            yield from _named(value, f"{prefix}{name}.")
        elif entries and isinstance(entries[0], dict):
            structs = {f"{name}({n})": entry for n, entry in enumerate(entries, 1) if isinstance(entry, dict)}
            yield from _named(structs, prefix)
        elif not isinstance(value, list) or all(isinstance(entry, (int, float)) for entry in value):
            yield prefix + name, value


def parse_parquet(path: str) -> tuple[dict[str, Any], int]:
    """Columns of numbers of a Parquet file, and how many of its rows are averaged to one."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, pre_buffer=False) as file:
        fields = [
            field.name
            for field in file.schema_arrow
            if pa.types.is_floating(field.type) or pa.types.is_integer(field.type)
        ]
        count, factor = file.metadata.num_rows, max(-(-file.metadata.num_rows // _MOST_ROWS), 1)
        check_count(count * len(fields), _MOST_READ)
        parts: dict[str, list[Any]] = {name: [] for name in fields}
        rest = {name: np.empty(0) for name in fields}
        for batch in file.iter_batches(_BATCH_ROWS, columns=fields, use_threads=False):
            for name in fields:
                values = batch.column(name).to_numpy(zero_copy_only=False)
                values = np.concatenate([rest[name], values], dtype=np.float64)
                whole = len(values) // factor * factor
                parts[name].append(values[:whole].reshape(-1, factor) @ np.full(factor, 1.0 / factor))
                rest[name] = values[whole:]
    return {name: np.concatenate(values) for name, values in parts.items() if values}, factor


def main() -> int:
    """Limit the memory, parse, write."""
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY_BYTES, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    try:
        if sys.argv[1] == "Parquet":
            arrays, averaged = parse_parquet(sys.argv[2])
        else:
            arrays, averaged = parse_matlab(sys.stdin.buffer.read()), 1
        found = {
            name: array.astype(np.float64, copy=False)
            for name, array in arrays.items()
            if array.dtype.kind in "fiub"
        }
        check_count(sum(array.size for array in found.values()))
    except Exception as error:  # noqa: BLE001  # a damaged file makes a parser raise anything
        sys.stderr.write(str(error) or type(error).__name__)
        return 1
    shapes = [(name, array.shape) for name, array in found.items()]
    sys.stdout.buffer.write(json.dumps([averaged, shapes]).encode() + b"\n")
    for array in found.values():
        sys.stdout.buffer.write(np.ascontiguousarray(array).data)
    return 0


if __name__ == "__main__":
    sys.exit(main())
