"""Block of numbers in a text file: its cells, header or legend, and the instrument's settings beside it."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.headers import UNITS, is_unit_cell, understand, unit_key, unit_quantity
from motor_env.motor.parameters import FloatArray

MOST_COLUMNS = 1_000
CUT_OFF = "the last line is cut off and left out"
CLOCK = re.compile(  # the time of a clock, with or without a date
    r"^\s*(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}[T ]\s*)?"
    r"\d{1,2}:\d{2}:\d{2}([.,]\d+)?\s*([AaPp][Mm])?(Z|[-+]\d{2}:?\d{2})?\s*$"
)
_LOOK_AHEAD = 60  # rows at the end of a file, far from any preamble, that show its form
_MOST = 0.8  # of these rows
_LONGEST_PREAMBLE = 10_000  # lines
FEWEST_SAMPLES = 20
_DELIMITERS = {"\t": "tab", ";": "semicolon", ",": "comma", " ": "blank"}
_DECIMAL_COMMA = re.compile(r"^\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*$")
_SPLIT_DECIMAL = re.compile(r"^0\d+$")  # 1,05 between commas
_ARROW = " -> "  # between the clock of Arduino's serial monitor and what was printed
_MARKS = ("%", "#", "//")
_LINE = re.compile(
    r"^\s*(?:[%#]+|//)\s*(?:col(?:umn)?s?\.?\s*)?"
    r"(?P<numbers>\d{1,4}(?:\s*(?:\.\.|,|\s)\s*\d{1,4})*)\s*[:=.)-]?\s+(?P<text>[^\W\d].*)$",
    re.IGNORECASE,
)
_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]")
_FIRST_VALUE = re.compile(r"\s+[-+]?(?:\d+\.\d*|\.\d+)\s*(?P<unit>[^\W\d]\S*)?$")  # time 0.000 sec
_FEWEST = 2  # columns of a legend: a comment that begins with a number is none
_BESIDE = 30  # rows beside which an old scope writes its settings
_SETTING = re.compile(r"(?:^|[\s:=])([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Zµμ/]*)")
_INTERVAL = re.compile(r"^(sampl\w* (interval|period)|time interval|x?increment|clock)$")
_RATE = re.compile(r"^sampl\w* (rate|frequency)$")
_SAMPLES = re.compile(r"^(size|record length|memory length)$")
_BEGIN = re.compile(r"^x?start$")
_HERTZ = {"": 1.0, "hz": 1.0, "sa/s": 1.0, "khz": 1e3, "ksa/s": 1e3, "mhz": 1e6, "msa/s": 1e6}


def as_number(text: str) -> float:
    """Return a number; ValueError for what only Python takes for one: 1_0, and digits beyond ASCII."""
    if "_" in text or not text.isascii():
        raise ValueError(f"no number: {text!r}")
    return float(text)


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

    def number(self, cell: str) -> float | None:
        """Return a cell as a number; None where it is none, or has the wrong decimal mark."""
        if self.decimal_comma and "." in cell:
            return None
        try:
            return as_number(cell.replace(",", ".") if self.decimal_comma else cell)
        except ValueError:
            return None

    def numbers(self, row: list[str], columns: Sequence[int]) -> int:
        """Count the columns that hold a number in a row."""
        return sum(column < len(row) and self.number(row[column]) is not None for column in columns)


@dataclass(frozen=True, slots=True)
class Block:
    """Place and form of a block of numbers in its file.

    Attributes:
        table: the file's cells, or those of its beginning and its end.
        first: row of the table where they begin.
        begin: line of the file where they begin.
        columns: which columns hold numbers, and times of a clock.
        clocks: those of a clock among them.
        width: cells of a row, without empty ones at its end.
        names: header of each column, else empty strings.
        units: unit of each column out of a row of units, else empty strings.
        remarks: on the form.
        arrow: delimiter in place of the arrow after the clock of Arduino's serial monitor; empty without one.
    """

    table: TextTable
    first: int
    begin: int
    columns: tuple[int, ...]
    clocks: tuple[int, ...]
    width: int
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    arrow: str = ""


def filled(row: Sequence[str]) -> int:
    """Count the cells up to the last that is not empty."""
    return max((k + 1 for k, cell in enumerate(row) if cell.strip()), default=0)


def cells(path: Path, lines: Sequence[str]) -> TextTable:
    """Split lines into cells."""
    delimiter = _delimiter_of(lines)
    kept = list(rows_of(path, lines, delimiter))
    near_end = [cell for _, row in kept[-_LOOK_AHEAD:] for cell in row]
    comma = any(map(_DECIMAL_COMMA.match, near_end))
    comma &= delimiter != "," or not any("." in cell for cell in near_end)  # quoted thousands
    return TextTable(path, delimiter, comma, tuple(n for n, _ in kept), tuple(row for _, row in kept))


def rows_of(path: Path, lines: Sequence[str], delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each line that is not blank; InputError where they are no table."""
    if delimiter == " ":
        yield from ((n, row) for n, line in enumerate(lines, 1) if (row := line.split()))
        return
    reader = csv.reader(lines, delimiter=delimiter)
    try:
        yield from ((reader.line_num, row) for row in reader if any(map(str.strip, row)))
    except csv.Error as error:
        raise InputError(f"{path}: is not a table ({error})") from None


def _delimiter_of(lines: Sequence[str]) -> str:
    """Return the delimiter of most lines at the file's end; else a comma."""
    tail = [line for line in lines[-_LOOK_AHEAD:] if line.strip()]
    frequent = (mark for mark in "\t;," if sum(mark in line for line in tail) > _MOST * len(tail))
    blanks = sum(len(line.split()) > 1 for line in tail) > _MOST * len(tail)
    return next(frequent, " " if blanks else ",")


def block_of(path: Path, lines: list[str], has_end: bool) -> Block:
    """Find the numbers in lines, and their form by the beginning and the end of the file.

    Args:
        path: of the file.
        lines: its lines; blank ones at the end and a last one that is cut off are taken away, and arrows replaced.
        has_end: whether the last line is whole.

    Raises:
        InputError: there are none, or only after a preamble of 10,000 lines.
    """
    while lines and not lines[-1].strip():
        lines.pop()
    remarks = []
    near_end = lines[-_LOOK_AHEAD:-1]
    if not has_end and near_end and len(lines[-1]) < min(map(len, near_end)):
        lines.pop()
        remarks.append(CUT_OFF)
    arrow = ""
    if near_end and all(_ARROW in line for line in near_end):
        arrow = _delimiter_of([line.partition(_ARROW)[2] for line in near_end])
        lines[:] = [line.replace(_ARROW, arrow, 1) for line in lines]
    block = _numbers_in(path, lines)
    names, units = _header(block)
    table = block.table
    remarks += [f"delimiter {_DELIMITERS[table.delimiter]}"] * (table.delimiter != ",")
    remarks += ["decimal comma"] * table.decimal_comma
    remarks += [f"numbers begin in line {block.begin}"] * (block.begin > 2)
    above = table.rows[block.first - 1] if block.first else []
    remarks += [
        f"column {k + 1} ({cell.strip()}) holds no numbers and is left out"
        for k, cell in enumerate(above[: block.width])
        if k not in block.columns and understand(cell).quantity
    ]
    return replace(block, names=names, units=units, remarks=tuple(remarks), arrow=arrow)


def _numbers_in(path: Path, lines: list[str]) -> Block:
    """Return the block without its header."""
    end = max(len(lines) - _LOOK_AHEAD, _LONGEST_PREAMBLE)
    table = cells(path, [*lines[:_LONGEST_PREAMBLE], *lines[end:]])
    rows, count = table.rows, len(table.rows)
    tail = rows[-min(_LOOK_AHEAD, max(count // 2, min(count - 1, FEWEST_SAMPLES), 1)) :]
    width = max(map(len, tail), default=0)
    if width > MOST_COLUMNS:
        raise InputError(f"{path}: has {width} columns; at most {MOST_COLUMNS} can be read")
    # The columns of a scope that writes its settings beside the first samples are empty or text at the end.
    most = 0.5 * len(tail)
    clocks = [
        k for k in range(width) if sum(k < len(row) and bool(CLOCK.match(row[k])) for row in tail) > most
    ]
    plain = [k for k in range(width) if sum(table.numbers(row, [k]) for row in tail) > most]
    in_tail = [cell.strip() for row in tail for cell in row]
    if (
        table.delimiter == ","
        and any(map(_SPLIT_DECIMAL.match, in_tail))
        and not any("." in cell for cell in in_tail)
    ):
        raise InputError(f"{path}: decimal commas need another mark between the columns than a comma")
    full = (
        n
        for n, row in enumerate(rows)
        if table.numbers(row, plain) == len(plain)
        and all(k < len(row) and CLOCK.match(row[k]) for k in clocks)
    )
    first = next(full, None) if plain else None
    if first is None or (end > _LONGEST_PREAMBLE and table.lines[first] > _LONGEST_PREAMBLE):
        raise InputError(f"{path}: holds no table of numbers")
    columns = tuple(sorted([*clocks, *plain]))
    first = _with_damaged_rows(table, columns, first)
    typical = int(np.median([filled(row) for row in tail]))
    return Block(table, first, table.lines[first], columns, tuple(clocks), typical)


def _with_damaged_rows(table: TextTable, columns: Sequence[int], first: int) -> int:
    """Return the begin of the block with damaged first rows."""
    rows, begin = table.rows, first
    while (
        begin > 0
        and len(rows[begin - 1]) == len(rows[first])
        and table.numbers(rows[begin - 1], columns)
        and not is_comment(rows[begin - 1])
    ):
        begin -= 1
    above = rows[begin - 1] if begin > 0 else []
    has_header = len(above) > max(columns) and not table.numbers(above, columns)
    return begin if has_header and first - begin <= 2 else first


def _header(block: Block) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return names and units of the columns, out of a legend in comments, else of the rows above."""
    table, columns = block.table, block.columns
    comments = (table.delimiter.join(row) for row in table.rows[: block.first] if is_comment(row))
    if legend := legend_of(comments, block.width):
        named_units = [legend.get(k, ("", "")) for k in columns]
        return tuple(name for name, _ in named_units), tuple(unit for _, unit in named_units)
    above = [[cell.strip().lstrip("#").strip() for cell in row] for row in table.rows[: block.first]]
    before, last = [[], [], *above][-2:]
    blank = ("",) * len(columns)
    if table.numbers(last, columns):
        return blank, blank
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
    units = tuple(last[k].strip("()[] ") for k in columns)
    has_units = all(map(is_unit_cell, last[: block.width])) and any(
        unit_quantity(cell.strip("()[] ")) for cell in last
    )
    if not has_units:
        return tuple(last[k] for k in columns), blank
    is_header = len(before) > max(columns) and not table.numbers(before, columns[:1])
    return (tuple(before[k] for k in columns) if is_header else blank), units


def is_comment(row: list[str]) -> bool:
    """Return whether a row of cells begins as comments do."""
    return bool(row) and row[0].strip().startswith(_MARKS)


def legend_of(lines: Iterable[str], width: int) -> dict[int, tuple[str, str]]:
    """Return name and unit of each column from 0, out of `%  7  8 Motor current left, right [A]`; else empty."""
    legend: dict[int, tuple[str, str]] = {}
    spans: dict[int, int] = {}
    for match in filter(None, map(_LINE.match, lines)):
        columns = _columns(match["numbers"])
        for column, named in zip(columns, _named(match["text"], len(columns)), strict=True):
            # Of two lines that name a column the one counts that names fewer.
            if 1 <= column <= width and len(columns) <= spans.get(column, width):
                legend[column - 1], spans[column] = named, len(columns)
    return legend if len(legend) >= _FEWEST else {}


def _columns(numbers: str) -> range | list[int]:
    """Return the columns of `7 8`, `16 .. 35` and `19 28`, all between."""
    given = [int(number) for number in re.findall(r"\d+", numbers)]
    first, last = given[0], given[-1]
    return range(first, last + 1) if len(given) == 2 and first < last else given


def _named(text: str, count: int) -> Iterator[tuple[str, str]]:
    """Yield name and unit of each column of a line."""
    text = text.partition(":")[0].partition("=")[0].strip()
    units = _UNIT.search(text)
    listed = [unit.strip() for unit in units[1].split(",")] if units else []
    name = _UNIT.sub("", text).strip(" ,")
    if not listed and (value := _FIRST_VALUE.search(name)):
        name, listed = name[: value.start()], [value["unit"] or ""]
    # The last word before the first comma is the first label: `Motor current left, right`.
    first, *labels = [part.strip() for part in name.split(",")]
    stem, _, label = first.rpartition(" ")
    labels = [label, *labels] if stem else [first, *labels]
    for k in range(count):
        unit = listed[k] if len(listed) == count else listed[0] if len(listed) == 1 else ""
        if count == 1:
            yield name, unit
        elif len(labels) == count:
            yield f"{stem} {labels[k]}".strip(), unit
        else:
            yield f"{name} {k + 1}", unit


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of numbers as they stand in a file.

    Attributes:
        names: header of each column, else empty strings.
        values: shape (n_rows, n_columns), NaN where there is none; times of a clock in seconds since the first.
        lines: of the rows in the file, for error messages; row numbers for binary files.
        units: of the columns where they stand elsewhere than in headers, else empty strings.
        numbers: of each column in the file, counted from 1.
        where: the word for the lines: line or row.
        remarks: on the file's form.
        begin_s, interval_s, samples: the time axis, by the instrument's settings; None where they do not say.
        averaged: number of rows of the file whose mean is one row here.
    """

    names: tuple[str, ...]
    values: FloatArray
    lines: Sequence[int]
    units: tuple[str, ...]
    numbers: tuple[int, ...]
    where: str = "line"
    remarks: tuple[str, ...] = ()
    begin_s: float = 0.0
    interval_s: float | None = None
    samples: int | None = None
    averaged: int = 1


def table_of(block: Block, values: FloatArray, lines: Sequence[int], averaged: int = 1) -> Table:
    """Return the table of a block's numbers, with the instrument's settings above or beside them.

    Args:
        block: where they stand.
        values: shape (n_rows, n_columns).
        lines: where each row stands in the file.
        averaged: number of rows of the file whose mean is one row here.
    """
    settings = dict(_settings(block))
    numbered = {key: match for key, text in settings.items() if (match := _SETTING.search(text))}

    def first(pattern: re.Pattern[str], factors: Mapping[str, float]) -> float | None:
        fitting = (match for key, match in numbered.items() if pattern.match(key))
        usable = (
            float(match[1]) * factors[unit] for match in fitting if (unit := unit_key(match[2])) in factors
        )
        return next((value for value in usable if value > 0.0 or pattern is _BEGIN), None)

    interval, rate = first(_INTERVAL, {"": 1.0, **UNITS["time"]}), first(_RATE, _HERTZ)
    samples = first(_SAMPLES, {"": 1.0})
    return Table(
        block.names,
        values,
        lines,
        _units(block, settings),
        tuple(k + 1 for k in block.columns),
        remarks=block.remarks,
        begin_s=first(_BEGIN, {"": 1.0}) or 0.0,
        interval_s=interval if interval or not rate else 1.0 / rate,
        samples=None if samples is None else round(samples),
        averaged=averaged,
    )


def _settings(block: Block) -> Iterator[tuple[str, str]]:
    """Yield name and text of each setting beside or above the numbers."""
    table, first = block.table, block.first
    beside = min(block.columns)
    rows = [*table.rows[:first], *(row[:beside] for row in table.rows[first : first + _BESIDE])]
    mark = "," if table.decimal_comma else "."
    for row in rows:
        words = [cell.strip(" #\t").replace(mark, ".") for cell in row]
        name, rest = words[0] if words else "", ",".join(words[1:])
        if not rest.strip(","):
            name, _, rest = name.replace("=", ":", 1).partition(":")
        yield name.strip(" :").lower(), " " + rest
    if first > 1:
        upper, lower = table.rows[first - 2 : first]
        yield from (
            (upper[k].strip().lower(), " " + lower[k].replace(mark, "."))
            for k in range(block.width, min(len(upper), len(lower)))
        )


def _units(block: Block, settings: Mapping[str, str]) -> tuple[str, ...]:
    """Return the columns' units, out of the settings where headers have none."""
    text = settings.get("vertical units", settings.get("units", "")).strip()
    stated = dict(re.findall(r"(\w+):\s*(\w+)", text))
    listed = [cell.strip() for cell in text.split(",")]
    alone = listed[0] if len([cell for cell in listed if cell]) == 1 else ""

    def unit(place: int, column: int) -> str:
        name, own = block.names[place], block.units[place]
        meaning = understand(name, own)
        if column in block.clocks:
            return "s"
        if meaning.unit:
            return own
        if meaning.quantity == "time" or (not name and place == 0 and len(block.names) > 1):
            return settings.get("horizontal units", "").strip(" ,") or own
        # The first cell of the setting is its name.
        by_place = listed[column - 1] if not stated and 0 < column <= len(listed) else ""
        return stated.get(name, by_place or (alone if len(block.names) <= 2 else "")) or own

    return tuple(unit(place, column) for place, column in enumerate(block.columns))
