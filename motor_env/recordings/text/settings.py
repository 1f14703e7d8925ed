"""What an instrument says above or beside its numbers: units, and how far its samples lie apart."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from motor_env.motor.parameters import FloatArray
from motor_env.recordings.headers import UNITS, understand, unit_key
from motor_env.recordings.text.block import Block

_BESIDE = 30  # rows beside which an old scope writes its settings
_SETTING = re.compile(r"(?:^|[\s:=])([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zA-Zµμ/]*)")
_INTERVAL = re.compile(r"^(sampl\w* (interval|period)|time interval|x?increment|clock)$")
_RATE = re.compile(r"^sampl\w* (rate|frequency)$")
_SAMPLES = re.compile(r"^(size|record length|memory length)$")
_BEGIN = re.compile(r"^x?start$")
_HERTZ = {"": 1.0, "hz": 1.0, "sa/s": 1.0, "khz": 1e3, "ksa/s": 1e3, "mhz": 1e6, "msa/s": 1e6}


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of numbers as they stand in a file.

    Attributes:
        names: header of each column, empty strings where there is none.
        values: shape (n_rows, n_columns), NaN where there is none; times of a clock in seconds since the first.
        lines: where each row stands in the file, for error messages; row numbers for binary files.
        units: unit of each column where it stands elsewhere than in its header, else empty strings.
        numbers: of each column in the file, counted from 1.
        where: the word for the lines: line or row.
        remarks: what was found out about the file's form.
        begin_s: time of the first sample, as the settings above the numbers say.
        interval_s: time between two samples, as the settings say; None where they do not.
        samples: number of samples, as the settings say; None where they do not.
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
    """The table of a block's numbers, with what the instrument says above or beside them.

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
    """Name and text of each setting: rows above the header, columns beside it, columns beside the numbers."""
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
    """Units of the columns, out of the settings where they have none in their headers."""
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
