"""Numbers of a text file: read whole, or in pieces with neighbours averaged so that memory holds them."""

from __future__ import annotations

import csv
import io
import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.text_block import (
    CLOCK,
    CUT_OFF,
    Block,
    Table,
    block_of,
    filled,
    rows_of,
    table_of,
)
from motor_env.motor.parameters import FloatArray

MOST_ROWS = 4_000_000
NULL_SHARE = 0.2
"""Bytes of 0 in what is no text any more."""
_AT_ONCE = 2  # pieces: pandas lets other threads run while it parses
_HEAD_BYTES, _TAIL_BYTES, _PIECE_BYTES = 2_000_000, 65_536, 8_000_000
_SMALL_BYTES = 4_000_000


def whole_block(path: Path, text: str) -> Table:
    """Return the block of numbers in a text, with the header above it.

    Raises:
        InputError: there is none, or a cell in it is no number.
    """
    lines = text.splitlines()
    block = block_of(path, lines, text.endswith(("\n", "\r")))
    body = lines[block.begin - 1 :]
    values, at = _numbers(block, "\n".join(body).encode(), block.begin, len(body))
    return table_of(block, values, at)


def large_block(path: Path) -> Table:
    """Return the numbers of a large text file; neighbours are averaged beyond MOST_ROWS.

    Raises:
        InputError: there is no block, it tells the time by a clock, or a cell in it is no number.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).rpartition(b"\n")[0]
        size = file.seek(0, io.SEEK_END)
        file.seek(-min(_TAIL_BYTES, size), io.SEEK_END)
        tail = file.read().partition(b"\n")[2]
        if not head or not tail or head.count(0) > NULL_SHARE * len(head):
            raise InputError(f"{path}: is no text with lines; only plain text may be so large")
        first, last = (
            part.replace(b"\0", b"").decode("utf-8-sig", "replace").splitlines() for part in (head, tail)
        )
        block = block_of(path, [*first, *last], tail.endswith((b"\n", b"\r")))
        if block.clocks:
            raise InputError(f"{path}: so large a file needs its time in seconds, or --sampling-rate HZ")
        rows = size / (len(tail) / len(last))
        factor = max(math.ceil(rows / MOST_ROWS), 1)
        file.seek(0)
        for _ in range(block.begin - 1):
            file.readline()
        if not file.peek(1):  # what ends with a return alone is no line of a file
            raise InputError(f"{path}: is no text with lines; only plain text may be so large")
        nulls: list[int] = []
        values = _means(_pieces(file, block, nulls), factor)
    lines = range(block.begin, block.begin + len(values) * factor, factor)
    return with_nulls(table_of(block, values, lines, factor), sum(nulls))


def with_nulls(table: Table, count: int) -> Table:
    """Return a table with a note on bytes of 0 that were skipped."""
    words = f"{count} NUL byte{'s are' if count > 1 else ' is'} skipped"
    return replace(table, remarks=(*table.remarks, words)) if count else table


def _pieces(file: BinaryIO, block: Block, nulls: list[int]) -> Iterator[FloatArray]:
    """Yield the numbers of each piece of whole lines, shape (rows, columns), and count bytes of 0."""
    line = block.begin
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        waiting: deque[Future[tuple[FloatArray, Sequence[int]]]] = deque()
        while piece := file.read(_PIECE_BYTES) + file.readline():
            nulls.append(piece.count(0))
            if not (piece := piece.replace(b"\0", b"")):
                break
            if CUT_OFF in block.remarks and not piece.endswith(b"\n"):
                piece = piece.rpartition(b"\n")[0]
            piece = piece.replace(b" -> ", block.arrow.encode()) if block.arrow else piece
            rows = piece.count(b"\n") + (not piece.endswith(b"\n"))
            waiting.append(pool.submit(_numbers, block, piece, line, rows))
            line += rows
            if len(waiting) > _AT_ONCE:
                yield waiting.popleft().result()[0]
        while waiting:
            yield waiting.popleft().result()[0]


def _means(parts: Iterable[FloatArray], factor: int) -> FloatArray:
    """Return means of neighbouring rows of all parts, shape (rows, columns)."""
    means, rest = [], None
    for part in parts:
        values = part if rest is None else np.concatenate([rest, part])
        whole = len(values) // factor * factor
        sums = np.add.reduceat(values[:whole], np.arange(0, whole, factor)) if factor > 1 else values
        means.append(sums / factor)
        rest = values[whole:]
    return np.concatenate(means)


def _numbers(block: Block, piece: bytes, begin: int, rows: int) -> tuple[FloatArray, Sequence[int]]:
    """Return the numbers of whole lines, shape (rows, columns), and each row's line in the file."""
    for quick in (_plain_numbers, _most_numbers, _numbers_with_holes):
        with suppress(ValueError, KeyError):
            values = quick(block, piece, rows)
            if len(values) == rows and not np.isinf(values).any():
                return values, range(begin, begin + rows)
    return _numbers_cell_by_cell(block, piece.decode("utf-8", "replace").splitlines(), begin)


def _plain_numbers(block: Block, piece: bytes, rows: int) -> FloatArray:
    """Parse a small block of nothing but numbers, without pandas, which imports slowly; ValueError for any other."""
    table = block.table
    if len(piece) > _SMALL_BYTES or block.clocks or table.decimal_comma or table.delimiter == " ":
        raise ValueError("no small block of numbers with points")
    lines = piece.split(b"\n")
    if len(lines) != rows or {line.count(table.delimiter.encode()) for line in lines} != {block.width - 1}:
        raise ValueError("rows differ in length")
    return np.loadtxt(
        io.BytesIO(piece), delimiter=table.delimiter, usecols=block.columns, comments=None, ndmin=2
    )


def _most_numbers(block: Block, piece: bytes, rows: int, *, holes: bool = False) -> FloatArray:
    """Parse a block without quotes or blank lines; ValueError or KeyError for any other."""
    import pandas as pd

    delimiter, missing = block.table.delimiter, ["", "nan", "NaN"]
    na_values: Any = {k: missing for k in block.columns if k not in block.clocks}
    frame = pd.read_csv(
        io.BytesIO(piece),
        header=None,
        sep=r"\s+" if delimiter == " " else delimiter,
        dtype={k: str if k in block.clocks else np.float64 for k in block.columns},
        decimal="," if block.table.decimal_comma else ".",
        quoting=csv.QUOTE_NONE,
        na_filter=holes,
        keep_default_na=False,
        na_values=na_values,
        skip_blank_lines=False,
    )
    # A number behind the last column is one cell too many, or the mark of a decimal.
    if (frame.iloc[:, block.width :] != "").to_numpy().any():
        raise ValueError("a cell too many")
    return np.ascontiguousarray(
        np.column_stack(
            [_seconds(frame[k].tolist()) if k in block.clocks else frame[k].to_numpy() for k in block.columns]
        )
    )


def _numbers_with_holes(block: Block, piece: bytes, rows: int) -> FloatArray:
    """Parse a piece with empty cells as NaN; ValueError for a short row."""
    mark = None if block.table.delimiter == " " else block.table.delimiter.encode()
    if min(len(line.split(mark)) for line in piece.removesuffix(b"\n").split(b"\n")) <= max(block.columns):
        raise ValueError("a row that ends too soon")
    return _most_numbers(block, piece, rows, holes=True)


def _numbers_cell_by_cell(block: Block, lines: list[str], begin: int) -> tuple[FloatArray, Sequence[int]]:
    """Parse a piece with blank lines and quotes; InputError for a cell that is no number."""
    table = block.table
    at: list[int] = []
    columns: list[list[Any]] = [[] for _ in block.columns]
    for n, row in rows_of(table.path, lines, table.delimiter):
        if any(block.names) and [row[k].strip() for k in block.columns if k < len(row)] == list(block.names):
            continue  # a device that starts anew repeats its header
        at.append(begin - 1 + n)
        if filled(row) > block.width:
            raise InputError(
                f"{table.path}, line {at[-1]}: holds {filled(row)} cells where the others hold {block.width}"
            )
        for place, values in enumerate(columns):
            values.append(_value(block, place, row, at[-1]))
    for column, values in zip(block.columns, columns, strict=True):
        try:
            values[:] = _seconds(values) if column in block.clocks else values
        except ValueError as error:
            reason = " ".join(str(error).split())[:100]
            raise InputError(
                f"{table.path}: the times of column {column + 1} cannot be read ({reason})"
            ) from None
    return np.array(columns, dtype=np.float64).T, at


def _value(block: Block, place: int, row: list[str], line: int) -> float | str:
    """Return the number of a cell, NaN of an empty one, the text of a clock's."""
    column = block.columns[place]
    cell = row[column] if column < len(row) else ""
    where = f"{block.table.path}, line {line}: the column {block.names[place] or f'number {column + 1}'}"
    if column in block.clocks:
        if not CLOCK.match(cell):
            raise InputError(f"{where} must hold times such as 12:34:56.789, got {cell[:40]!r}")
        return cell
    if column >= len(row):
        raise InputError(f"{where} has no value")
    value = block.table.number(cell) if cell.strip() else math.nan
    if value is None or math.isinf(value):
        kind = "numbers" if value is None else "finite numbers"
        raise InputError(f"{where} must hold {kind}, got {cell[:40]!r}")
    return value


def _seconds(times: list[str]) -> FloatArray:
    """Return times of a clock in seconds since the first; ValueError for what is none."""
    import pandas as pd

    if not all(map(CLOCK.match, times)):
        raise ValueError("not all are times of a clock")
    series = pd.Series(times, dtype=str).str.strip().str.replace(",", ".")
    first = times[0].strip()
    if ":" in first[:3] and first[-1] not in "mM":  # no date
        moments: Any = pd.to_timedelta(series)
    elif first[:4].isdigit() and first[4] == "-":
        moments = pd.to_datetime(series, format="ISO8601")
    else:
        moments = pd.to_datetime(series, format="mixed", dayfirst="." in first[:3])
    return np.asarray((moments - moments.iloc[0]).dt.total_seconds(), dtype=np.float64)
