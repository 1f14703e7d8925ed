"""Tables of numbers out of the files that people have: text of many kinds, .mat, .npy, .npz, Parquet."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray

LARGEST_FILE_BYTES = 500_000_000
_DELIMITERS = ("\t", ";", ",")
_DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_LOOK_AHEAD = 60
_CONTROL_SHARE = 0.01
_FEWEST = 20


@dataclass(frozen=True, slots=True)
class Table:
    """Columns as they stand in a file.

    Attributes:
        names: header of each column, empty strings where there is none.
        values: shape (n_rows, n_columns).
        lines: where each row stands in the file, for error messages; row numbers for binary files.
        where: the word for these: line or row.
        remarks: what was found out about the file's form.
    """

    names: tuple[str, ...]
    values: FloatArray
    lines: Sequence[int]
    where: str = "line"
    remarks: tuple[str, ...] = ()


def read_table(path: Path) -> Table:
    """Read a table of numbers.

    Raises:
        InputError: the file is missing, empty, or not of a kind that can be read; a cell is no finite number.
    """
    content = _content(path)
    match path.suffix.lower():
        case ".mat":
            return _columns(path, _mat(path, content))
        case ".npy" | ".npz":
            return _columns(path, _numpy(path, content))
        case ".parquet" | ".pq":
            return _columns(path, _parquet(path, content))
        case _:
            return _text_table(path, _decoded(path, content))


def _content(path: Path) -> bytes:
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise InputError(f"{path}: is larger than {LARGEST_FILE_BYTES // 1_000_000} MB")
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read ({reason})") from None
    if not content.strip():
        raise InputError(f"{path}: is empty")
    return content


def _decoded(path: Path, content: bytes) -> str:
    """Text in UTF-8 or UTF-16, or in the code page of an old scope."""
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    encodings = ["utf-16"] if wide else ["utf-8-sig", "cp1252"]
    for encoding in encodings:
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        control = sum(text.count(chr(code)) for code in range(32) if code not in (9, 10, 11, 12, 13))
        if control <= _CONTROL_SHARE * len(text) and "\0" not in text:
            return text
    raise InputError(f"{path}: is not text, and its ending is none of .mat, .npy, .npz, .parquet")


def _text_table(path: Path, text: str) -> Table:
    lines = text.splitlines()
    delimiter = _delimiter(lines)
    rows = _rows(path, lines, delimiter)
    comma = delimiter != "," and any(
        _DECIMAL_COMMA.match(cell) for _, row in rows[-_LOOK_AHEAD:] for cell in row
    )
    first, columns = _block(rows, comma=comma)
    if first is None:
        raise InputError(f"{path}: holds no table of numbers")
    names = _names(rows, first, columns, comma=comma)
    body = rows[first:]
    remarks = []
    if delimiter != ",":
        remarks.append(f"delimiter {_SPOKEN[delimiter]}")
    if comma:
        remarks.append("decimal comma")
    if body[0][0] > 2:
        remarks.append(f"numbers begin in line {body[0][0]}")
    values = _cells(path, body, columns, names, comma=comma)
    return Table(tuple(names), values, [line for line, _ in body], remarks=tuple(remarks))


_SPOKEN = {"\t": "tab", ";": "semicolon", ",": "comma", " ": "blank"}


def _delimiter(lines: list[str]) -> str:
    """The delimiter that stands in most lines of the end of the file."""
    tail = [line for line in lines[-_LOOK_AHEAD:] if line.strip()]
    for delimiter in _DELIMITERS:
        if sum(delimiter in line for line in tail) > 0.8 * len(tail):
            return delimiter
    return " " if sum(len(line.split()) > 1 for line in tail) > 0.8 * len(tail) else ","


def _rows(path: Path, lines: list[str], delimiter: str) -> list[tuple[int, list[str]]]:
    """Rows that are not blank, each with its line number."""
    if delimiter == " ":
        return [(n, line.split()) for n, line in enumerate(lines, 1) if line.strip()]
    try:
        reader = csv.reader(lines, delimiter=delimiter)
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: is not a table ({error})") from None


def _is_number(cell: str, *, comma: bool) -> bool:
    try:
        float(cell.replace(",", ".") if comma else cell)
    except ValueError:
        return False
    return True


def _block(rows: list[tuple[int, list[str]]], *, comma: bool) -> tuple[int | None, list[int]]:
    """First row and columns of the block of numbers: the columns that are numbers at the end of the file.

    The columns of a scope that writes its settings beside the first samples are empty or text at the end.
    """
    tail = rows[-min(_LOOK_AHEAD, max(len(rows) // 2, min(len(rows) - 1, _FEWEST), 1)) :]
    width = max(len(row) for _, row in tail)
    columns = [
        k
        for k in range(width)
        if sum(k < len(row) and _is_number(row[k], comma=comma) for _, row in tail) > 0.5 * len(tail)
    ]
    if not columns:
        return None, []
    for n, (_, row) in enumerate(rows):
        if all(k < len(row) and _is_number(row[k], comma=comma) for k in columns):
            return _back(rows, n, columns, comma=comma), columns
    return None, []


def _back(rows: list[tuple[int, list[str]]], first: int, columns: list[int], *, comma: bool) -> int:
    """Begin of the block with its damaged first rows: rows with a number in them, up to a header without any."""

    def numbers(row: list[str]) -> int:
        return sum(k < len(row) and _is_number(row[k], comma=comma) for k in columns)

    begin = first
    while begin > 0 and numbers(rows[begin - 1][1]) and len(rows[begin - 1][1]) == len(rows[first][1]):
        begin -= 1
    header_above = begin > 0 and not numbers(rows[begin - 1][1]) and len(rows[begin - 1][1]) > max(columns)
    return begin if header_above and first - begin <= 2 else first


def _names(rows: list[tuple[int, list[str]]], first: int, columns: list[int], *, comma: bool) -> list[str]:
    """Header above the block: the row above it, with the row of units below the names where there are two."""
    above = [row for _, row in rows[max(first - 2, 0) : first] if len(row) > max(columns)]
    above = [row for row in above if not any(_is_number(row[k], comma=comma) for k in columns)]
    if not above:
        return ["" for _ in columns]
    header = [above[-1][k].strip() for k in columns]
    if len(above) > 1 and all(cell.strip("()[] ") in UNIT_WORDS or not cell for cell in header):
        return [
            f"{above[-2][k].strip()} ({unit.strip('()[] ')})" for k, unit in zip(columns, header, strict=True)
        ]
    return header


def _cells(
    path: Path, body: list[tuple[int, list[str]]], columns: list[int], names: list[str], *, comma: bool
) -> FloatArray:
    values = np.empty((len(body), len(columns)))
    for n, (line, row) in enumerate(body):
        for k, column in enumerate(columns):
            name = names[k] or f"number {column + 1}"
            if column >= len(row) or not row[column].strip():
                raise InputError(f"{path}, line {line}: the column {name} has no value")
            cell = row[column]
            try:
                value = float(cell.replace(",", ".") if comma else cell)
            except ValueError:
                raise InputError(
                    f"{path}, line {line}: the column {name} must hold numbers, got {cell[:40]!r}"
                ) from None
            if not math.isfinite(value):
                raise InputError(
                    f"{path}, line {line}: the column {name} must hold finite numbers, got {cell[:40]!r}"
                )
            values[n, k] = value
    return values


def _columns(path: Path, arrays: dict[str, Any]) -> Table:
    """Table of the one-dimensional arrays of the most frequent length, and of the columns of a matrix."""
    flat: dict[str, FloatArray] = {}
    for name, array in arrays.items():
        array = np.asarray(array)
        if array.dtype.kind not in "fiub" or array.size < 2:
            continue
        squeezed = np.squeeze(array).astype(np.float64)
        if squeezed.ndim == 1:
            flat[name] = squeezed
        elif squeezed.ndim == 2:
            tall = squeezed if squeezed.shape[0] >= squeezed.shape[1] else squeezed.T
            flat |= {f"{name}#{k + 1}": tall[:, k] for k in range(tall.shape[1])}
    if not flat:
        raise InputError(f"{path}: holds no column of numbers")
    lengths = [len(values) for values in flat.values()]
    length = max(set(lengths), key=lengths.count)
    flat = {name: values for name, values in flat.items() if len(values) == length}
    values = np.column_stack(list(flat.values()))
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        name = list(flat)[column]
        raise InputError(
            f"{path}, row {row + 1}: the column {name} must hold finite numbers, got {values[row, column]}"
        )
    names = tuple("" if "#" in name else name for name in flat)
    return Table(names, values, range(1, length + 1), where="row")


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
    from motor_env.errors import require_extra

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


_TIME_UNITS = "s sec ms us µs μs ns S Sec MS US"
_OTHER_UNITS = "a ma µa A mA MA v mv kv V mV MV % hz rpm RPM 1/min u/min min-1 rad/s rad/sec deg/s °/s"
UNIT_WORDS = frozenset([*_TIME_UNITS.split(), *_OTHER_UNITS.split()])
"""What stands in a row of units."""
