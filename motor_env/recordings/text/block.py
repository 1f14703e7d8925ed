"""The block of numbers in a text file, its header, and its values."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.headers import is_unit_cell, understand, unit_quantity
from motor_env.recordings.text.cells import (
    DELIMITERS,
    LOOK_AHEAD,
    TextTable,
    cells,
    delimiter_of,
    has_date,
    is_clock,
    rows_of,
)
from motor_env.recordings.text.settings import Block, Table, filled, with_settings

MOST_COLUMNS = 1_000
_LONGEST_PREAMBLE = 10_000  # lines
_FEWEST = 20
_SMALL_BYTES = 4_000_000
_SPLIT_DECIMAL = re.compile(r"^0\d+$")  # 1,05 between commas
CUT_OFF = "the last line is cut off and left out"
_ARROW = " -> "  # between the clock of Arduino's serial monitor and what was printed


def block_of_numbers(path: Path, lines: list[str], has_end: bool = True) -> Table:
    """The block of numbers in a text file, with the header above it.

    Its form is told by the beginning and the end of the file; a preamble is at most 10,000 lines long.

    Args:
        path: of the file.
        lines: its lines.
        has_end: whether the last line is whole.

    Raises:
        InputError: there is none, or a cell in it is no number.
    """
    block, form = form_of(path, lines, has_end)
    begin = block.table.lines[block.first]
    if form.arrow:
        lines = [line.replace(_ARROW, form.arrow, 1) for line in lines]
    body = lines[begin - 1 :]
    values = parsed(block, "\n".join(body).encode(), len(body))
    at: Sequence[int] = range(begin, begin + len(body))
    if values is None:
        values, at = parsed_cell_by_cell(block, body, form.names, begin)
    return form.table(block, values, at)


class Form(NamedTuple):
    """How a block of numbers stands in its file: names and units of its columns, what was found out about its form.

    `arrow` is the delimiter that stands for the arrow after the clock of Arduino's serial monitor; empty without one.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    remarks: tuple[str, ...]
    arrow: str

    def table(self, block: Block, values: FloatArray, at: Sequence[int], averaged: int = 1) -> Table:
        """The table of these values."""
        numbers = tuple(k + 1 for k in block.columns)
        table = Table(self.names, values, at, self.units, numbers, remarks=self.remarks, averaged=averaged)
        return with_settings(table, block)


def form_of(path: Path, lines: list[str], has_end: bool = True) -> tuple[Block, Form]:
    """Where the numbers stand in lines, and how; a last line that is cut off, and blank ones, are taken away.

    Raises:
        InputError: there are none.
    """
    while lines and not lines[-1].strip():
        lines.pop()
    remarks = []
    near_end = lines[-LOOK_AHEAD:-1]
    if not has_end and near_end and len(lines[-1]) < min(len(line) for line in near_end):
        lines.pop()
        remarks.append(CUT_OFF)
    arrow = ""
    if near_end and all(_ARROW in line for line in near_end):
        arrow = delimiter_of([line.partition(_ARROW)[2] for line in near_end])
        lines = [line.replace(_ARROW, arrow, 1) for line in lines]
    block = _block(path, lines)
    names, units = _header(block)
    begin = block.table.lines[block.first]
    table = block.table
    remarks += [f"delimiter {DELIMITERS[table.delimiter]}"] * (table.delimiter != ",")
    remarks += ["decimal comma"] * table.decimal_comma
    remarks += [f"numbers begin in line {begin}"] * (begin > 2)
    remarks += _lost(block)
    return block, Form(names, units, tuple(remarks), arrow)


def _block(path: Path, lines: list[str]) -> Block:
    seen = lines
    if len(lines) > _LONGEST_PREAMBLE + LOOK_AHEAD:
        seen = [*lines[:_LONGEST_PREAMBLE], *lines[-LOOK_AHEAD:]]
    table = cells(path, seen)
    count = len(table.rows)
    tail = table.rows[-min(LOOK_AHEAD, max(count // 2, min(count - 1, _FEWEST), 1)) :]
    width = max((len(row) for row in tail), default=0)
    if width > MOST_COLUMNS:
        raise InputError(f"{path}: has {width} columns; at most {MOST_COLUMNS} can be read")
    in_tail = [cell.strip() for row in tail for cell in row]
    # The columns of a scope that writes its settings beside the first samples are empty or text at the end.
    most = 0.5 * len(tail)
    clocks = [k for k in range(width) if sum(k < len(row) and is_clock(row[k]) for row in tail) > most]
    plain = [k for k in range(width) if sum(table.numbers(row, [k]) for row in tail) > most]
    typical = int(np.median([filled(row) for row in tail])) if tail else 0
    block = Block(table, 0, tuple(sorted([*clocks, *plain])), tuple(clocks), typical)
    if (
        table.delimiter == ","
        and any(map(_SPLIT_DECIMAL.match, in_tail))
        and not any("." in cell for cell in in_tail)
    ):
        raise InputError(f"{path}: decimal commas need another mark between the columns than a comma")
    first = next((n for n, row in enumerate(table.rows) if block.is_full(row)), None) if plain else None
    if first is None or (seen is not lines and table.lines[first] > _LONGEST_PREAMBLE):
        raise InputError(f"{path}: holds no table of numbers")
    return replace(block, first=_with_damaged_rows(block, first))


def _with_damaged_rows(block: Block, first: int) -> int:
    """Begin of the block with its damaged first rows: rows with a number in them, up to a header without any."""
    table, columns, begin = block.table, block.columns, first
    rows = table.rows
    while begin > 0 and len(rows[begin - 1]) == len(rows[first]) and table.numbers(rows[begin - 1], columns):
        begin -= 1
    above = rows[begin - 1] if begin > 0 else []
    has_header = len(above) > max(columns) and not table.numbers(above, columns)
    return begin if has_header and first - begin <= 2 else first


def _header(block: Block) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns: the row above the block is that of the units where it holds nothing else.

    Raises:
        InputError: it names more or fewer columns than the block has.
    """
    table, columns = block.table, block.columns
    above = [[cell.strip().lstrip("#").strip() for cell in row] for row in table.rows[: block.first]]
    blank = tuple("" for _ in columns)
    if not above or table.numbers(above[-1], columns):
        return blank, blank
    last = above[-1]
    named = [k for k, cell in enumerate(last) if understand(cell).quantity]
    if named and (
        block.width > filled(last) > 1 or named[-1] >= max(block.width, len(table.rows[block.first]))
    ):
        raise InputError(
            f"{table.path}, line {table.lines[block.first - 1]}: names {filled(last)} columns, and the rows below hold"
            f" {block.width} cells; a decimal comma needs another mark between the columns"
        )
    is_setting = len(last) == 1 and (":" in last[0] or "=" in last[0])
    if len(last) <= max(columns) or is_setting:
        return blank, blank
    has_units = all(map(is_unit_cell, last[: block.width])) and any(
        unit_quantity(cell.strip("()[] ")) for cell in last
    )
    if not has_units:
        return tuple(last[k] for k in columns), blank
    units = tuple(last[k].strip("()[] ") for k in columns)
    names = above[-2] if len(above) > 1 and len(above[-2]) > max(columns) else []
    is_header = bool(names) and not table.numbers(names, columns[:1])
    return (tuple(names[k] for k in columns) if is_header else blank), units


def _lost(block: Block) -> Iterator[str]:
    """Which columns have the name of a quantity, and no numbers."""
    table = block.table
    for k, cell in enumerate(table.rows[block.first - 1] if block.first else ()):
        if k not in block.columns and k < block.width and understand(cell).quantity:
            yield f"column {k + 1} ({cell.strip()}) holds no numbers and is left out"


def _parsed_plain(block: Block, body: bytes, rows: int) -> FloatArray | None:
    """A small block of nothing but numbers in rows of one length; None for any other.

    To import pandas takes as long as to read some megabytes without it.
    """
    table = block.table
    if len(body) > _SMALL_BYTES or block.clocks or table.decimal_comma or table.delimiter == " ":
        return None
    lines = body.split(b"\n")
    if len(lines) != rows or {line.count(table.delimiter.encode()) for line in lines} != {block.width - 1}:
        return None
    try:
        values = np.loadtxt(
            io.BytesIO(body), delimiter=table.delimiter, usecols=block.columns, comments=None, ndmin=2
        )
    except ValueError:
        return None
    return values if len(values) == rows and np.isfinite(values).all() else None


def parsed(block: Block, body: bytes, rows: int) -> FloatArray | None:
    """Rows by a quick parser, shape (rows, n_columns); None where it stumbles over one."""
    plain = _parsed_plain(block, body, rows)
    if plain is not None:
        return plain
    import pandas as pd

    delimiter = block.table.delimiter
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            header=None,
            sep=r"\s+" if delimiter == " " else delimiter,
            dtype={k: str if k in block.clocks else np.float64 for k in block.columns},
            decimal="," if block.table.decimal_comma else ".",
            quoting=csv.QUOTE_NONE,
            na_filter=False,
            skip_blank_lines=False,
        )
        values = np.column_stack(
            [_seconds(frame[k].tolist()) if k in block.clocks else frame[k].to_numpy() for k in block.columns]
        )
    except (ValueError, KeyError):
        return None
    # A number behind the last column is one cell too many, or the mark of a decimal.
    is_beyond = bool((frame.iloc[:, block.width :] != "").to_numpy().any())
    if len(values) != rows or not np.isfinite(values).all() or is_beyond:
        return None
    return np.ascontiguousarray(values)


def parsed_cell_by_cell(
    block: Block, body: list[str], names: Sequence[str], begin: int
) -> tuple[FloatArray, Sequence[int]]:
    """The same slowly, with blank lines and quotes, and a sentence that tells the cell which is no number.

    The first of these lines is number `begin` of the file.
    """
    table = block.table
    numbers: list[int] = []
    columns: list[list[Any]] = [[] for _ in block.columns]
    for n, row in rows_of(table.path, body, table.delimiter):
        numbers.append(begin - 1 + n)
        if filled(row) > block.width:
            raise InputError(
                f"{table.path}, line {numbers[-1]}: holds {filled(row)} cells where the others hold {block.width}"
            )
        for name, column, values in zip(names, block.columns, columns, strict=True):
            cell = row[column] if column < len(row) else ""
            where = f"line {numbers[-1]}: the column {name or f'number {column + 1}'}"
            values.append(
                _clock(table, cell, where) if column in block.clocks else _value(table, cell, where)
            )
    for column, values in zip(block.columns, columns, strict=True):
        if column in block.clocks:
            try:
                values[:] = _seconds(values)
            except ValueError as error:
                reason = " ".join(str(error).split())[:100]
                raise InputError(
                    f"{table.path}: the times of column {column + 1} cannot be read ({reason})"
                ) from None
    return np.array(columns, dtype=np.float64).T, numbers


def _seconds(times: list[str]) -> FloatArray:
    """Times of a clock in seconds since the first; ValueError for what is none."""
    import pandas as pd

    if not all(map(is_clock, times)):
        raise ValueError("not all are times of a clock")
    series = pd.Series(times, dtype=str).str.strip().str.replace(",", ".")
    first = times[0].strip()
    if not has_date(first) and first[-1] not in "mM":
        lapses = pd.to_timedelta(series)
        return np.asarray((lapses - lapses.iloc[0]).dt.total_seconds(), dtype=np.float64)
    if re.match(r"\d{4}-", first):
        stamps = pd.to_datetime(series, format="ISO8601")
    else:
        stamps = pd.to_datetime(series, format="mixed", dayfirst="." in first[:3])
    return np.asarray((stamps - stamps.iloc[0]).dt.total_seconds(), dtype=np.float64)


def _clock(table: TextTable, cell: str, where: str) -> str:
    if not is_clock(cell):
        raise InputError(f"{table.path}, {where} must hold times such as 12:34:56.789, got {cell[:40]!r}")
    return cell


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
