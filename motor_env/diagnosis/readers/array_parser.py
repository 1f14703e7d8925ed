"""Parser of MATLAB, HDF5 and Excel files from standard input, and Parquet by path, in a process of its own.

Writes a line of JSON with how many rows are one, and name and shape of each array, then the values as bytes of float64;
of a workbook the text of a sheet as CSV. What cannot be parsed ends it with status 1 and a sentence.

This file is run as a script: it imports nothing of the package.
"""

from __future__ import annotations

import csv
import io
import json
import sys
import zipfile
from collections.abc import Iterable, Iterator
from typing import Any, cast

import numpy as np

MOST_NUMBERS = 50_000_000
WAVEFORM_TIME = "time [s]"
_MOST_READ = 1_000_000_000  # of a Parquet file, in pieces
_MOST_ROWS = 4_000_000  # of a long log, beyond which neighbours are averaged
_BATCH_ROWS = 65_536
_MEMORY_BYTES = 1_600_000_000
_FEWEST_ROWS = 20  # with a number, of the sheet that is read
_MOST_SHEET_ROWS = 2**20  # of Excel; a forged number of a row is filled up with empty ones


def check_count(numbers: int, most: int = MOST_NUMBERS) -> None:
    """Refuse more numbers than a recording holds by a ValueError."""
    if numbers > most:
        raise ValueError(f"it unpacks to {numbers:,} numbers; at most {most:,} are read")


def parse_matlab(content: bytes) -> dict[str, Any]:
    """Return a MATLAB file's variables; those of structs by their own name where that is unique."""
    from scipy.io import loadmat

    variables = loadmat(cast("Any", io.BytesIO(content)), simplify_cells=True)
    return _by_short_names(
        _named({name: value for name, value in variables.items() if not name.startswith("__")})
    )


def _by_short_names(values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    named = list(values)
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


def parse_hdf5(content: bytes) -> dict[str, Any]:
    """Return an HDF5 file's arrays of numbers, such as MATLAB 7.3 writes; nothing that it points to is read."""
    import h5py

    datasets: dict[str, Any] = {}

    def take(name: str, dataset: Any) -> None:
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiub" or name.startswith("#"):
            return
        is_text = dataset.attrs.get("MATLAB_class") == b"char"
        # Values of a virtual or an external data set stand in other files.
        if not (is_text or dataset.is_virtual or dataset.external or dataset.attrs.get("MATLAB_empty")):
            datasets[name.replace("/", ".")] = dataset

    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(take)  # follows no link
        check_count(sum(dataset.size for dataset in datasets.values()))
        return _by_short_names((name, dataset[()]) for name, dataset in datasets.items())


def parse_tdms(content: bytes) -> dict[str, Any]:
    """Return the channels of a TDMS file with their units, and the time of its waveforms."""
    from nptdms import TdmsFile

    named: dict[str, Any] = {}
    with TdmsFile.open(io.BytesIO(content)) as file:
        channels = [channel for group in file.groups() for channel in group.channels()]
        check_count(sum(map(len, channels)))
        for channel in channels:
            values, unit = channel[:], channel.properties.get("unit_string")
            if values.dtype.kind == "M":
                values, unit = (values - values[:1]) / np.timedelta64(1, "s"), "s"
            named[f"{channel.group_name}.{channel.name}" + (f" [{unit}]" if unit else "")] = values
            step = float(channel.properties.get("wf_increment", 0.0))
            if step > 0.0:
                begin = float(channel.properties.get("wf_start_offset", 0.0))
                named.setdefault(WAVEFORM_TIME, begin + step * np.arange(len(values)))
    return _by_short_names(named.items())


def parse_workbook(content: bytes) -> tuple[str, list[str]]:
    """Return a workbook's first sheet with rows of numbers as CSV: values, no formulas; and what it leaves out."""
    import openpyxl

    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        check_count(sum(member.file_size for member in archive.infolist()) // 8)
    book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True, keep_links=False)
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # what a file says of them may be wrong
        rows: list[list[str]] = []
        counts: list[int] = []  # of the numbers of each row
        cells = 0
        for n, row in enumerate(sheet.iter_rows(values_only=True), 1):
            cells += len(row)
            check_count(cells)
            if n > _MOST_SHEET_ROWS:
                raise ValueError(f"a sheet has at most {_MOST_SHEET_ROWS:,} rows")
            counts.append(sum(isinstance(cell, int | float) for cell in row))
            texts = ["" if cell is None else " ".join(str(cell).split()) for cell in row]
            rows.append(texts if any(texts) else [])
        if sum(map(bool, counts)) >= _FEWEST_ROWS:
            stray = _take_stray(rows, counts)
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows(rows)
            return text.getvalue(), stray
    raise ValueError(f"no sheet holds {_FEWEST_ROWS} rows of numbers")


def _take_stray(rows: list[list[str]], counts: list[int]) -> list[str]:
    """Take away, and return, what stands below and beside a table: rows with fewer numbers, cells beyond most rows."""
    typical = int(np.median([count for count in counts if count]))
    last = max(n for n, count in enumerate(counts) if count >= typical)
    first = next(n for n, count in enumerate(counts) if count >= typical)
    width = int(np.quantile([len(_filled(row)) for row in rows[first : last + 1]], 0.9))
    beside, stray = [cell for row in rows[first : last + 1] for cell in row[width:] if cell], []
    if len(rows) - last <= _FEWEST_ROWS:
        stray = [cell for row in rows[last + 1 :] for cell in row if cell]
        del rows[last + 1 :]
    if len(beside) < _FEWEST_ROWS:
        rows[first : last + 1] = [row[:width] for row in rows[first : last + 1]]
        stray += beside
    return stray


def _filled(row: list[str]) -> list[str]:
    """Return a row without empty cells at its end."""
    return row[: max((k + 1 for k, cell in enumerate(row) if cell), default=0)]


def parse_parquet(path: str) -> tuple[dict[str, Any], int]:
    """Return a Parquet file's columns of numbers, and how many rows are averaged to one."""
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

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        most = _MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(_MEMORY_BYTES, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
    try:
        if sys.argv[1] == "workbook":
            sys.stdout.buffer.write(json.dumps(parse_workbook(sys.stdin.buffer.read())).encode())
            return 0
        if sys.argv[1] == "Parquet":
            arrays, averaged = parse_parquet(sys.argv[2])
        else:
            parsers = {"HDF5": parse_hdf5, "MATLAB": parse_matlab, "TDMS": parse_tdms}
            arrays, averaged = parsers[sys.argv[1]](sys.stdin.buffer.read()), 1
        numbers = {
            name: array.astype(np.float64, copy=False)
            for name, array in arrays.items()
            if array.dtype.kind in "fiub"
        }
        check_count(sum(array.size for array in numbers.values()))
    except Exception as error:  # noqa: BLE001  # a damaged file makes a parser raise anything
        sys.stderr.write(str(error) or type(error).__name__)
        return 1
    shapes = [(name, array.shape) for name, array in numbers.items()]
    sys.stdout.buffer.write(json.dumps([averaged, shapes]).encode() + b"\n")
    for array in numbers.values():
        sys.stdout.buffer.write(np.ascontiguousarray(array).data)
    return 0


if __name__ == "__main__":
    sys.exit(main())
