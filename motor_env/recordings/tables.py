"""Tables out of the files that people have: text of many kinds, .mat, .npy, .npz, Parquet."""

from __future__ import annotations

import csv
import math
import re
import stat
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.array_files import read_arrays
from motor_env.recordings.headers import is_unit, understand

LARGEST_FILE_BYTES = 200_000_000
_LARGEST_TEXT_BYTES = 20_000_000  # of what is kept cell by cell
_LONGEST_PREAMBLE = 10_000  # lines
_MOST_COLUMNS = 1_000
_DELIMITERS = {"\t": "tab", ";": "semicolon", ",": "comma", " ": "blank"}
_DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_LOOK_AHEAD = 60  # rows at the end of a file, far from any preamble, that show its form
_MOST = 0.8  # of these rows
_CONTROL_SHARE = 0.01  # more control characters than that are no text
_FEWEST = 20


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of numbers as they stand in a file.

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


@dataclass(frozen=True, slots=True)
class TextTable:
    """Cells of a text file.

    Attributes:
        path: of the file.
        delimiter: between cells.
        decimal_comma: whether a number near the end of the file has a decimal comma.
        lines: line number of each row, counted from 1; blank lines are left out.
        rows: cells of each row.
    """

    path: Path
    delimiter: str
    decimal_comma: bool
    lines: tuple[int, ...]
    rows: tuple[list[str], ...]

    def number(self, cell: str) -> float:
        """A cell as a number; ValueError where it is none."""
        return float(cell.replace(",", ".") if self.decimal_comma else cell)

    def numbers(self, row: list[str], columns: Sequence[int]) -> int:
        """How many of these columns hold a number in a row."""
        return sum(column < len(row) and self._is_number(row[column]) for column in columns)

    def _is_number(self, cell: str) -> bool:
        try:
            self.number(cell)
        except ValueError:
            return False
        return True


def read_table(path: Path, wanted: Sequence[str] = ()) -> Table:
    """Read a table of numbers.

    Args:
        path: of the file.
        wanted: columns that must not be left out.

    Raises:
        InputError: the file is missing, empty, too large or of no kind that can be read; a cell is no finite number.
    """
    content = _content(path)
    arrays = read_arrays(path, content)
    if arrays is None:
        return _block_of_numbers(path, _decoded(path, content).splitlines())
    return _columns(path, arrays, wanted)


def read_text_table(path: Path) -> TextTable:
    """Read a text file as a table of cells.

    Raises:
        InputError: the file is missing, empty or too large, or no text.
    """
    return _cells(path, read_text(path).splitlines())


def read_text(path: Path) -> str:
    """Read a text file, whatever its code page.

    Raises:
        InputError: the file is missing, empty or too large, or no text.
    """
    return _decoded(path, _content(path, _LARGEST_TEXT_BYTES))


def _content(path: Path, largest: int = LARGEST_FILE_BYTES) -> bytes:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: is no regular file")
        # What the system makes up while it is read has no size, and may never end.
        content = b""
        if status.st_size:
            with path.open("rb") as file:
                content = file.read(largest + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read ({reason})") from None
    if len(content) > largest:
        raise InputError(f"{path}: is larger than {largest // 1_000_000} MB")
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


def _cells(path: Path, lines: list[str]) -> TextTable:
    delimiter = _delimiter(lines)
    kept = list(_rows(path, lines, delimiter))
    near_end = (cell for _, row in kept[-_LOOK_AHEAD:] for cell in row)
    comma = delimiter != "," and any(_DECIMAL_COMMA.match(cell) for cell in near_end)
    return TextTable(path, delimiter, comma, tuple(n for n, _ in kept), tuple(row for _, row in kept))


def _rows(path: Path, lines: list[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line that is not blank."""
    if delimiter == " ":
        yield from ((n, row) for n, line in enumerate(lines, 1) if (row := line.split()))
        return
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{path}: is not a table ({error})") from None


def _delimiter(lines: list[str]) -> str:
    """The delimiter that stands in most lines of the end of the file; a comma where none does."""
    tail = [line for line in lines[-_LOOK_AHEAD:] if line.strip()]
    frequent = (mark for mark in "\t;," if sum(mark in line for line in tail) > _MOST * len(tail))
    blanks = sum(len(line.split()) > 1 for line in tail) > _MOST * len(tail)
    return next(frequent, " " if blanks else ",")


def _block_of_numbers(path: Path, lines: list[str]) -> Table:
    """The block of numbers in a text file, with the header above it.

    Its form is told by the beginning and the end of the file; a preamble is at most 10,000 lines long.
    """
    while lines and not lines[-1].strip():
        lines.pop()
    seen = lines
    if len(lines) > _LONGEST_PREAMBLE + _LOOK_AHEAD:
        seen = [*lines[:_LONGEST_PREAMBLE], *lines[-_LOOK_AHEAD:]]
    table = _cells(path, seen)
    columns = _number_columns(table)
    is_full = (table.numbers(row, columns) == len(columns) for row in table.rows)
    first = next((n for n, full in enumerate(is_full) if full), None) if columns else None
    if first is None or (seen is not lines and table.lines[first] > _LONGEST_PREAMBLE):
        raise InputError(f"{path}: holds no table of numbers")
    first = _with_damaged_rows(table, first, columns)
    names, begin = _names(table, first, columns), table.lines[first]
    remarks = []
    if table.delimiter != ",":
        remarks.append(f"delimiter {_DELIMITERS[table.delimiter]}")
    if table.decimal_comma:
        remarks.append("decimal comma")
    if begin > 2:
        remarks.append(f"numbers begin in line {begin}")
    body = lines[begin - 1 :]
    values = _parsed(table, body, columns)
    numbers: Sequence[int] = range(begin, begin + len(body))
    if values is None:
        values, numbers = _parsed_cell_by_cell(table, body, columns, names=names, begin=begin)
    return Table(tuple(names), values, numbers, remarks=tuple(remarks))


def _parsed(table: TextTable, body: list[str], columns: Sequence[int]) -> FloatArray | None:
    """Plain rows of numbers by NumPy's parser, shape (n_rows, n_columns); None where it stumbles over one."""
    plain = (line.replace(",", ".") for line in body) if table.decimal_comma else body
    delimiter = None if table.delimiter == " " else table.delimiter
    try:
        values = np.loadtxt(plain, delimiter=delimiter, usecols=columns, ndmin=2, comments=None)
    except ValueError:
        return None
    return values if len(values) == len(body) and np.isfinite(values).all() else None


def _parsed_cell_by_cell(
    table: TextTable, body: list[str], columns: Sequence[int], *, names: list[str], begin: int
) -> tuple[FloatArray, Sequence[int]]:
    """The same slowly, with blank lines and quotes, and a sentence that tells the cell which is no number."""
    values, numbers = array("d"), array("q")
    for n, row in _rows(table.path, body, table.delimiter):
        numbers.append(begin - 1 + n)
        for name, column in zip(names, columns, strict=True):
            cell = row[column] if column < len(row) else ""
            where = f"line {numbers[-1]}: the column {name or f'number {column + 1}'}"
            values.append(_value(table, cell, where))
    return np.array(values).reshape(-1, len(columns)), numbers


def _number_columns(table: TextTable) -> list[int]:
    """The columns that are numbers at the end of the file.

    The columns of a scope that writes its settings beside the first samples are empty or text there.
    """
    count = len(table.rows)
    tail = table.rows[-min(_LOOK_AHEAD, max(count // 2, min(count - 1, _FEWEST), 1)) :]
    width = max((len(row) for row in tail), default=0)
    if width > _MOST_COLUMNS:
        raise InputError(f"{table.path}: has {width} columns; at most {_MOST_COLUMNS} can be read")
    return [k for k in range(width) if sum(table.numbers(row, [k]) for row in tail) > 0.5 * len(tail)]


def _with_damaged_rows(table: TextTable, first: int, columns: Sequence[int]) -> int:
    """Begin of the block with its damaged first rows: rows with a number in them, up to a header without any."""
    rows, begin = table.rows, first
    while begin > 0 and len(rows[begin - 1]) == len(rows[first]) and table.numbers(rows[begin - 1], columns):
        begin -= 1
    above = rows[begin - 1] if begin > 0 else []
    has_header = len(above) > max(columns) and not table.numbers(above, columns)
    return begin if has_header and first - begin <= 2 else first


def _names(table: TextTable, first: int, columns: Sequence[int]) -> list[str]:
    """Header above the block: the row above it, with the row of units below the names where there are two."""
    rows = [row for row in table.rows[max(first - 2, 0) : first] if len(row) > max(columns)]
    headers = [[row[k].strip() for k in columns] for row in rows if not table.numbers(row, columns)]
    if not headers:
        return ["" for _ in columns]
    units = [cell.strip("()[] ") for cell in headers[-1]]
    if len(headers) > 1 and all(is_unit(unit) or not unit for unit in units):
        return [f"{name} ({unit})" for name, unit in zip(headers[-2], units, strict=True)]
    return headers[-1]


def _value(table: TextTable, cell: str, where: str) -> float:
    if not cell.strip():
        raise InputError(f"{table.path}, {where} has no value")
    try:
        value = table.number(cell)
    except ValueError:
        raise InputError(f"{table.path}, {where} must hold numbers, got {cell[:40]!r}") from None
    if not math.isfinite(value):
        raise InputError(f"{table.path}, {where} must hold finite numbers, got {cell[:40]!r}")
    return value


def _columns(path: Path, arrays: dict[str, Any], wanted: Sequence[str]) -> Table:
    """Table of the arrays of one length, that of a wanted one or the most frequent, and of the columns of a matrix.

    Raises:
        InputError: no such array, a value that is not finite, or a quantity would be lost with an array of another
            length.
    """
    flat: dict[str, FloatArray] = {}
    for name, given in arrays.items():
        if given.dtype.kind not in "fiub" or given.size < 2:
            continue
        squeezed = np.squeeze(given).astype(np.float64)
        if squeezed.ndim == 1:
            flat[name] = squeezed
        elif squeezed.ndim == 2 and min(squeezed.shape) <= _MOST_COLUMNS:
            tall = squeezed if squeezed.shape[0] >= squeezed.shape[1] else squeezed.T
            flat |= {f"{name}#{k + 1}": tall[:, k] for k in range(tall.shape[1])}
    if not flat:
        raise InputError(f"{path}: holds no column of numbers")
    lengths = [len(flat[name]) for name in wanted if name in flat] or [
        len(values) for values in flat.values()
    ]
    length = max(set(lengths), key=lambda n: (lengths.count(n), n))
    others = {name: values for name, values in flat.items() if len(values) != length}
    flat = {name: values for name, values in flat.items() if len(values) == length}
    there = {understand(name)[0] for name in flat}
    for name, values in others.items():
        quantity = understand(name)[0]
        lost = quantity is not None and quantity not in there and len(values) >= _FEWEST
        if lost or name in wanted:
            raise InputError(f"{path}: {name} has {len(values)} values where the others have {length}")
    values = np.column_stack(list(flat.values()))
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        name = list(flat)[column]
        raise InputError(
            f"{path}, row {row + 1}: the column {name} must hold finite numbers, got {values[row, column]}"
        )
    names = tuple("" if "#" in name else name for name in flat)
    remarks = (f"left out, for their lengths: {', '.join(others)}",) if others else ()
    return Table(names, values, range(1, length + 1), where="row", remarks=remarks)
