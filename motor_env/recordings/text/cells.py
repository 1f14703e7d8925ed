"""Cells of a text file: its delimiter, its decimal mark, its rows."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from motor_env.errors import InputError

LOOK_AHEAD = 60  # rows at the end of a file, far from any preamble, that show its form
DELIMITERS = {"\t": "tab", ";": "semicolon", ",": "comma", " ": "blank"}
_DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_CLOCK = re.compile(
    r"^\s*(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[T ]\s*)?"
    r"\d{1,2}:\d{2}:\d{2}([.,]\d+)?\s*([AaPp][Mm])?(Z|[-+]\d{2}:?\d{2})?\s*$"
)
_MOST = 0.8  # of these rows


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
        """A cell as a number; ValueError where it is none, and for a point where the decimal mark is a comma."""
        if (self.decimal_comma and "." in cell) or "_" in cell:
            raise ValueError(cell)
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


def is_clock(cell: str) -> bool:
    """Whether a cell holds the time of a clock, with or without a date."""
    return _CLOCK.match(cell) is not None


def has_date(cell: str) -> bool:
    """Whether the time of a clock has a date before it."""
    match = _CLOCK.match(cell)
    return match is not None and match[1] is not None


def cells(path: Path, lines: Sequence[str]) -> TextTable:
    """The cells of lines.

    Raises:
        InputError: they are no table.
    """
    delimiter = delimiter_of(lines)
    kept = list(rows_of(path, lines, delimiter))
    near_end = (cell for _, row in kept[-LOOK_AHEAD:] for cell in row)
    comma = delimiter != "," and any(_DECIMAL_COMMA.match(cell) for cell in near_end)
    return TextTable(path, delimiter, comma, tuple(n for n, _ in kept), tuple(row for _, row in kept))


def rows_of(path: Path, lines: Sequence[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line that is not blank.

    Raises:
        InputError: they are no table.
    """
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


def delimiter_of(lines: Sequence[str]) -> str:
    """The delimiter that stands in most lines of the end of the file; a comma where none does."""
    tail = [line for line in lines[-LOOK_AHEAD:] if line.strip()]
    frequent = (mark for mark in "\t;," if sum(mark in line for line in tail) > _MOST * len(tail))
    blanks = sum(len(line.split()) > 1 for line in tail) > _MOST * len(tail)
    return next(frequent, " " if blanks else ",")
