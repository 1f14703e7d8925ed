"""Columns of a table as the quantities of a recording: recognised by their headers, or named by the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.headers import (
    NUMBERED,
    QUANTITIES,
    SI,
    UNITS,
    ColumnChoice,
    Meaning,
    understand,
    unit_key,
    unit_quantity,
)
from motor_env.recordings.text.settings import Table

_NONE = "none"
_SMALL = {"time": "ms", "current": "mA", "voltage": "mV", "speed": "rpm"}
_MANY_WHOLE = (
    20  # different whole numbers: counts of a converter or of a clock, not a voltage that is 0 or 12
)


class Column(NamedTuple):
    """A quantity: its values in SI units, in words where they come from, and what is odd about them."""

    values: FloatArray
    origin: str
    warning: str = ""


def recognise(
    path: Path, table: Table, choices: Sequence[ColumnChoice] = ()
) -> tuple[dict[str, Column], tuple[str, ...]]:
    """The quantities of a table, `time` and `current` among them, and the names of the columns that are not used.

    Raises:
        InputError: one of these two is missing, two columns look alike, or a column's unit cannot be told; the sentence
            names the option that helps.
    """
    meanings = [understand(name, unit) for name, unit in zip(table.names, table.units, strict=True)]
    found: dict[str, Column] = {}
    taken: set[int] = set()
    for choice in choices:
        if choice.sampling_rate_hz is not None:
            found["time"] = _even(table, 0.0, 1.0 / choice.sampling_rate_hz, "as asked")
        elif choice.column.lower() != _NONE:
            k = _place(path, table, meanings, choice)
            taken.add(k)
            found[choice.quantity] = _chosen(path, table, meanings[k], k, choice)
    chosen = {choice.quantity for choice in choices}
    if not any(table.names) and not choices and table.values.shape[1] == 2 and not any(table.units):
        meanings = [Meaning("time", 1.0, "", ""), Meaning("current", 1.0, "", "")]
    free = [k for k in range(len(meanings)) if k not in taken]
    told = {meanings[k].quantity for k in free} - chosen
    if "current" not in found and "current" not in told:
        raise _no_current(path, table, meanings, free)
    first: dict[str, int] = {}
    for k in free:
        quantity = meanings[k].quantity
        if quantity in first:
            one, other = (_name(table, i) for i in (first[quantity], k))
            none = f", or --column {quantity}=none" if quantity not in ("time", "current") else ""
            raise InputError(
                f"{path}: the columns {one} and {other} both look like the {quantity};"
                f" say which: --column {quantity}={one}{none}"
            )
        if quantity is not None and quantity in told:
            first[quantity] = k
            found[quantity] = _column(path, table, meanings[k], k, quantity)
    counter = next((k for k, meaning in enumerate(meanings) if meaning.unit == NUMBERED), None)
    if "time" not in found:
        found["time"] = _counted(path, table, counter)
    unused = tuple(_name(table, k) for k in free if k not in first.values() and k != counter)
    return {quantity: found[quantity] for quantity in QUANTITIES if quantity in found}, unused


def _place(path: Path, table: Table, meanings: Sequence[Meaning], choice: ColumnChoice) -> int:
    """Which column is meant: by its header, with or without its unit, or by its number in the file."""
    wanted = (choice.text, choice.column)
    lower = [text.lower() for text in wanted]
    for spelling, texts in (
        (table.names, wanted),
        ([name.lower() for name in table.names], lower),
        ([meaning.name.lower() for meaning in meanings], lower),
    ):
        for name in texts:
            if spelling.count(name) > 1:
                raise InputError(f"{path}: several columns are named {name}; give the number of one of them")
            if name in spelling:
                return spelling.index(name)
    if choice.column.isdecimal() and int(choice.column) in table.numbers:
        return table.numbers.index(int(choice.column))
    names = ", ".join(filter(None, table.names)) or f"{len(table.numbers)} without a name"
    raise InputError(f"{path}: there is no column {choice.column}; there are {names}")


def _chosen(path: Path, table: Table, meaning: Meaning, k: int, choice: ColumnChoice) -> Column:
    if table.names[k] == choice.text != choice.column:  # a header with * or : in it
        choice = replace(choice, unit=None, scale=None, offset=0.0)
    quantity, unit, scale = choice.quantity, choice.unit, choice.scale
    stated, warning = unit_quantity(meaning.unit), ""
    if unit is not None:
        measured = unit_quantity(unit) or quantity
        factor = UNITS[measured][unit_key(unit)]
        if stated and (stated, meaning.factor) != (measured, factor):
            warning = f"the header of column {_name(table, k)} says {meaning.unit}, and --column says {unit}"
        elif unit == SI[quantity] and scale is None and _holds_counts(table, k):
            warning = (
                f"column {_name(table, k)} holds whole numbers, as a converter's counts: are they {unit}?"
            )
        stated, meaning = measured, Meaning(quantity, factor, unit, meaning.name)
    elif meaning.unit == NUMBERED and quantity == "time":
        return _counted(path, table, k)
    elif scale is None and stated not in (None, quantity):
        raise InputError(
            f"{path}: the column {_name(table, k)} is in {meaning.unit}; say how many {SI[quantity]} that is:"
            f" {_example(quantity, _name(table, k))}"
        )
    column = _column(path, table, meaning, k, quantity, is_scaled=scale is not None)
    per = f" {SI[quantity]}/{SI[stated]}" if stated else ""
    words = "" if scale is None else f", times {scale:g}{per}"
    if choice.offset:
        words += f", {'plus' if choice.offset > 0.0 else 'minus'} {abs(choice.offset):g} {SI[quantity]}"
    values = (1.0 if scale is None else scale) * column.values + choice.offset
    return Column(values, column.origin + words, warning)


def _column(
    path: Path, table: Table, meaning: Meaning, k: int, quantity: str, *, is_scaled: bool = False
) -> Column:
    """A column in the unit of its header; without unit and scale it is taken as SI, unless it holds counts."""
    header = f" ({table.names[k]})" if table.names[k] else ""
    unit = (
        f" in {meaning.unit}" if meaning.unit and meaning.unit.lower() not in table.names[k].lower() else ""
    )
    origin = f"column {table.numbers[k]}{header}{unit}"
    if not is_scaled and not unit_quantity(meaning.unit):
        if _holds_counts(table, k) and quantity != "duty":
            name = _name(table, k)
            raise InputError(
                f"{path}: the column {name} holds whole numbers, and no unit is stated: name it"
                f' (--column "{quantity}={name}:{_SMALL[quantity]}") or give a scale ({_example(quantity, name)})'
            )
        origin += f", no unit stated, taken as {SI[quantity]}"
    return Column(meaning.factor * table.values[:, k], origin)


def _holds_counts(table: Table, k: int) -> bool:
    values = table.values[:, k] * table.averaged  # sums of whole numbers are whole
    is_whole = np.abs(values - np.round(values)) <= 1e-6 * (table.averaged > 1)
    return bool(np.all(is_whole)) and len(np.unique(values)) > _MANY_WHOLE


def _name(table: Table, k: int) -> str:
    """What the user may call a column."""
    name = table.names[k]
    return name if name and table.names.count(name) == 1 else str(table.numbers[k])


def _example(quantity: str, name: str) -> str:
    if quantity == "current":
        return f'--column "current={name}*10" for a probe of 100 mV/A'
    return f'--column "{quantity}={name}*2.5+0"'


def _even(table: Table, begin_s: float, interval_s: float, reason: str) -> Column:
    middles: FloatArray = (
        np.arange(len(table.values), dtype=np.float64) + 0.5
    ) * table.averaged - 0.5  # of what was averaged
    return Column(begin_s + interval_s * middles, f"{1.0 / interval_s:.6g} samples a second, {reason}")


def _counted(path: Path, table: Table, counter: int | None) -> Column:
    """The time of a file that counts its samples, or only says how far apart they are."""
    unknown = [k for k, name in enumerate(table.names) if understand(name, table.units[k]).quantity is None]
    if table.interval_s is None or (counter is None and unknown):
        hint = f'name it: --column "time={_name(table, unknown[0])}:s", or ' if unknown else ""
        raise _missing(path, table, "time_s", f"{hint}say --sampling-rate HZ")
    begin_s = table.begin_s
    if counter is not None:
        begin_s += table.interval_s * (table.values[0, counter] - 0.5 * (table.averaged - 1))
        is_off = np.abs(np.diff(table.values[:, counter]) - table.averaged) > 1e-6 * table.averaged
        if is_off.any():
            bad = int(np.argmax(is_off)) + 1
            raise InputError(
                f"{path}, {table.where} {table.lines[bad]}: the column {_name(table, counter)} must count by one,"
                f" got {table.values[bad, counter]:g} after {table.values[bad - 1, counter]:g}"
            )
    elif table.samples is not None and table.samples // table.averaged != len(table.values):
        raise InputError(
            f"{path}: holds {len(table.values)} rows and says that there are {table.samples}; no column tells which"
        )
    return _even(table, begin_s, table.interval_s, "as the file says above its numbers")


def _no_current(path: Path, table: Table, meanings: Sequence[Meaning], free: Sequence[int]) -> InputError:
    """What to do about a file without a column of the current among those that are not taken."""
    fitting = [k for k in free if meanings[k].unit != NUMBERED and meanings[k].quantity in (None, "voltage")]
    hint = "--column current=..."
    if fitting:
        name = _name(table, fitting[-1])
        hint = _example("current", name)
        if _holds_counts(table, fitting[-1]):
            hint = f'--column "current={name}*0.0132-6.76" with the scale and the offset of the converter\'s counts'
        elif unit_quantity(meanings[fitting[-1]].unit) is None:
            hint = f'--column "current={name}:A" (or :mA), or {hint}'
    return _missing(path, table, "current_a", f"name it: {hint}")


def _missing(path: Path, table: Table, column: str, hint: str) -> InputError:
    names = ", ".join(repr(name[:30]) for name in table.names[:8])
    found = names if any(table.names) else f"{len(table.names)} columns without a header"
    where = f"{path}, {table.where} {max(table.lines[0] - 1, 1)}"
    return InputError(f"{where}: the column {column} is missing, found {found}; {hint}")
