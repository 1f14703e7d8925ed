"""Columns of a table as the quantities of a recording: recognised by headers, or named by the user."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_env.common.errors import InputError
from motor_env.diagnosis.readers.headers import (
    LARGE_CURRENT_A,
    LARGEST_CURRENT_A,
    NUMBERED,
    QUANTITIES,
    SI,
    UNITS,
    ColumnChoice,
    Meaning,
    follows,
    has_counts,
    is_channel,
    is_no_unit,
    is_other,
    kinds_named,
    name_parts,
    understand,
    unit_key,
    unit_quantity,
)
from motor_env.diagnosis.readers.noise import filled
from motor_env.diagnosis.readers.text_block import Table
from motor_env.motor.parameters import FloatArray

_SCALE = "SCALE is how many A a volt is, 10 for a probe of 100 mV/A"
_OFFSET = "SCALE and OFFSET are those of the converter's counts, such as *0.0132-6.76"
_OR_COUNTS = "UNIT is A or mA; a converter's counts need"
_READING = "SCALE is how many A a reading of 1 is, 10 for a probe of 100 mV/A"
_UNIT = "UNIT is A or mA"
_MOST_NAMED = 8
_NONE = "none"
_SMALL = {"time": "ms", "current": "mA", "voltage": "mV", "speed": "rpm"}
_NO_UNIT = "no unit stated"
_SLOW_S, _LONG_S = 0.005, 20.0  # a time in ms looks like this
_DAY_S, _COUNTER_BITS = 86_400.0, (16, 24, 31, 32)
_ON_STEPS = 5.0  # usual steps at most, where a counter begins anew
_DENSEST = 0.9  # of a step of the rounding: times further apart hardly repeat


@dataclass(frozen=True, slots=True)
class Suggestions:
    """Sentences that suggest the option which names a table's column.

    Attributes:
        path: of the file.
        table: its columns.
        meanings: of their headers.
        chosen: columns that are named already, by their quantities.
    """

    path: Path
    table: Table
    meanings: Sequence[Meaning]
    chosen: Mapping[str, int]

    def name(self, k: int) -> str:
        """Return what the user may call a column."""
        name = self.table.names[k]
        return name if name and self.table.names.count(name) == 1 else str(self.table.numbers[k])

    def can_be(self, quantity: str, k: int) -> bool:
        """Return whether a column can be what is asked."""
        return self._is_named(quantity, self.meanings[k]) and self._is_ranged(quantity, k)

    def _is_named(self, quantity: str, meaning: Meaning) -> bool:
        measured = unit_quantity(meaning.unit)
        is_probe = quantity == "current" and measured == "voltage"
        if meaning.unit == NUMBERED or not (measured or is_no_unit(meaning.unit)):
            return False
        if measured == quantity:
            return not is_other(meaning.name, quantity)
        said = kinds_named(meaning.name)
        is_open = is_channel(meaning.name) and said == {"voltage"}
        return (is_probe or measured is None) and (is_open or not is_other(meaning.name, quantity, said))

    def _is_ranged(self, quantity: str, k: int) -> bool:
        values = self.table.values[:, k]
        rises = bool((values[1:] >= values[:-1]).all())
        if quantity == "time":
            return rises and values[-1] > values[0]
        return quantity != "current" or not (
            rises
            or self._largest_a(k) > LARGEST_CURRENT_A
            or any(follows(values, self.table.values[:, other], of) for of, other in self._known(k))
        )

    def ambiguous(self, quantity: str, columns: Sequence[int]) -> str:
        """Return the sentence for columns that look alike."""
        fitting = self._nearest_in_name([k for k in columns if self.can_be(quantity, k)])
        options = [f"--column {_quoted(f'{quantity}={self.name(k)}')}" for k in fitting[:_MOST_NAMED]]
        if quantity not in ("time", "current"):
            options.append(f"--column {quantity}=none")
        names = [self.name(k) for k in columns]
        listed = f"{', '.join(names[:-1])} and {names[-1]}"
        which = f"say which: {' or '.join(options)}" if options else f"none of them can be a {quantity}"
        both = "both" if len(names) == 2 else "all"
        return f"{self.path}: the columns {listed} {both} look like the {quantity}; {which}"

    def missing_current(self, free: Collection[int]) -> str:
        """Return the sentence for a file without a current."""
        fitting = self._nearest_in_name([k for k in free if self.can_be("current", k)])
        said = [k for k in fitting if "current" in kinds_named(self.meanings[k].name)]
        if not fitting:
            hint = "none of the others can be a current, by name, unit and range"
        elif said:
            forms = [self._form(k, is_said=True) for k in said[:_MOST_NAMED]]
            hint = "name it: " + " or ".join(f"--column {_quoted(form)}" for form, _ in forms)
            hint += "".join(dict.fromkeys(words and f" ({words})" for _, words in forms))
        elif len(fitting) == 1:
            form, words = self._form(fitting[0], is_said=False)
            hint = f"if {self.name(fitting[0])} is the current, say --column {_quoted(form)} ({words})"
        else:
            first = self._form(fitting[0], is_said=False)
            form, words = (
                text.replace(f"current={self.name(fitting[0])}", "current=COLUMN") for text in first
            )
            names = ", ".join(map(self.name, fitting[:_MOST_NAMED]))
            hint = f'say --column "{form}", where COLUMN is one of {names}, and {words}'
        return self.missing("current_a", hint)

    def missing(self, column: str, hint: str) -> str:
        """Return the sentence for a column that is not there."""
        table = self.table
        names = ", ".join(repr(name[:30]) for name in table.names[:_MOST_NAMED])
        header = names if any(table.names) else f"{len(table.names)} columns without a header"
        where = f"{self.path}, {table.where} {max(table.lines[0] - 1, 1)}"
        return f"{where}: the column {column} is missing, found {header}; {hint}"

    def scale(self, quantity: str, k: int) -> str:
        """Return the option for a column in another quantity's unit."""
        words = _SCALE if quantity == "current" else f"SCALE is how many {SI[quantity]} one of its units is"
        return f"--column {_quoted(f'{quantity}={self.name(k)}*SCALE')}, where {words}"

    def times(self) -> str:
        """Return the option for a column that may be the time; empty where none can be."""
        fitting = [k for k in range(len(self.meanings)) if self._is_free(k) and self.can_be("time", k)]
        options = [f"--column {_quoted(f'time={self.name(k)}:UNIT')}" for k in fitting[:_MOST_NAMED]]
        return f"name it: {' or '.join(options)} (UNIT is s, ms or us), or " if options else ""

    def _is_free(self, k: int) -> bool:
        return k not in self.chosen.values() and self.meanings[k].quantity is None

    def _form(self, k: int, *, is_said: bool) -> tuple[str, str]:
        """Return the option that makes a column the current, and what its blanks are."""
        name, has_unit = f"current={self.name(k)}", unit_quantity(self.meanings[k].unit)
        if has_unit == "voltage":
            return f"{name}*SCALE", _SCALE
        if has_unit == "current":
            return name, ""
        if has_counts(self.table.values[:, k], self.table.averaged):
            scaled = f"{name}*SCALE+OFFSET"
            if is_channel(self.meanings[k].name):
                return scaled, _OFFSET
            return f"{name}:UNIT", f'{_OR_COUNTS} --column "{scaled}", such as *0.0132-6.76'
        if is_said:
            is_large = float(np.max(np.abs(self.table.values[:, k]))) > LARGEST_CURRENT_A
            return (f"{name}:mA", "") if is_large else (f"{name}:A", "or :mA")
        return (f"{name}*SCALE", _READING) if is_channel(self.meanings[k].name) else (f"{name}:UNIT", _UNIT)

    def _largest_a(self, k: int) -> float:
        """Return the least that a column's largest reading can be in A; 0 where a scale is needed."""
        unit = unit_quantity(self.meanings[k].unit)
        if unit == "voltage" or has_counts(self.table.values[:, k], self.table.averaged):
            return 0.0
        factor = self.meanings[k].factor if unit else 1e-3
        return factor * float(np.max(np.abs(self.table.values[:, k])))

    def _known(self, k: int) -> list[tuple[str, int]]:
        known = [(of, other) for of, other in self.chosen.items() if other != k]
        return known + [
            (meaning.quantity, other)
            for other, meaning in enumerate(self.meanings)
            if other != k and meaning.quantity in ("time", "voltage", "speed", "duty") and meaning.quantity
        ]

    def _nearest_in_name(self, columns: list[int]) -> list[int]:
        """Return the columns whose names share the most words with those of the columns already chosen."""
        parts = [set(name_parts(self.meanings[k].name)) for k in self.chosen.values()]
        shared = [sum(len(own & set(name_parts(self.meanings[k].name))) for own in parts) for k in columns]
        return [k for k, count in zip(columns, shared, strict=True) if count == max(shared)]


def _quoted(option: str) -> str:
    return f'"{option}"' if any(mark in option for mark in " *#()[]") else option


class Column(NamedTuple):
    """A quantity: SI values, their origin in words, and warnings."""

    values: FloatArray
    origin: str
    warning: str = ""


def recognise(
    path: Path, table: Table, choices: Sequence[ColumnChoice] = ()
) -> tuple[dict[str, Column], tuple[str, ...]]:
    """Recognise the quantities of a table, `time` and `current` included; return them and the unused columns' names.

    A missing value is NaN; where the time is missing, all others are.

    Raises:
        InputError: one of these two is missing, two columns look alike, or a unit is unknown.
    """
    meanings = [understand(name, unit) for name, unit in zip(table.names, table.units, strict=True)]
    missing = np.isnan(table.values)
    table = replace(table, values=_whole(table.values))
    columns: dict[str, Column] = {}
    chosen: dict[str, int] = {}
    suggested = Suggestions(path, table, meanings, chosen)
    for choice in choices:
        if choice.sampling_rate_hz is not None:
            columns["time"] = _even(table, 0.0, 1.0 / choice.sampling_rate_hz, "as asked")
        elif choice.column.lower() != _NONE:
            k = chosen[choice.quantity] = _place(path, table, meanings, choice)
            columns[choice.quantity] = _chosen(suggested, k, choice)
    if not any(table.names) and not choices and table.values.shape[1] == 2 and not any(table.units):
        meanings[:] = [Meaning("time", 1.0, "", ""), Meaning("current", 1.0, "", "")]
    free = [k for k in range(len(meanings)) if k not in chosen.values()]
    named = {meanings[k].quantity for k in free} - {choice.quantity for choice in choices}
    if "current" not in columns and "current" not in named:
        raise InputError(suggested.missing_current(free))
    places = dict(chosen)
    for quantity in dict.fromkeys(meanings[k].quantity for k in free):
        if quantity is not None and quantity in named:
            candidates = [k for k in free if meanings[k].quantity == quantity]
            if quantity == "time" and len(candidates) > 1:  # what does not rise is no time axis
                rising = [k for k in candidates if suggested.can_be(quantity, k)]
                candidates = rising if len(rising) == 1 else candidates
            if len(candidates) > 1:
                raise InputError(suggested.ambiguous(quantity, candidates))
            columns[quantity] = _column(suggested, meanings[candidates[0]], candidates[0], quantity)
            places[quantity] = candidates[0]
    counter = next((k for k, meaning in enumerate(meanings) if meaning.unit == NUMBERED), None)
    if "time" not in columns:
        columns["time"] = _counted(suggested, counter)
    if "time" in places:
        columns["time"] = _timed(columns["time"], missing[:, places["time"]])
        columns["time"] = _unwrapped(columns["time"])
    columns["time"] = _unrounded(columns["time"])
    _ask_for_unit(suggested, columns, places)
    _refuse_no_current(path, columns)
    unused = tuple(suggested.name(k) for k in free if k not in places.values() and k != counter)
    _restore(path, columns, places, missing)
    return {quantity: columns[quantity] for quantity in QUANTITIES if quantity in columns}, unused


def _whole(values: FloatArray) -> FloatArray:
    """Fill missing values; with whole numbers in columns of counts."""
    if not np.isnan(values).any():
        return values
    with np.errstate(invalid="ignore"):  # a file may hold a signalling NaN
        is_whole = np.array([np.array_equal(column, np.round(column), equal_nan=True) for column in values.T])
    full = np.stack([filled(column) for column in values.T], axis=1)
    return np.where(is_whole, np.round(full), full)


def _timed(time: Column, missing: NDArray[np.bool_]) -> Column:
    """Extrapolate a time where it is missing at begin and end."""
    known = np.flatnonzero(~missing)
    if len(known) in (0, 1, len(missing)):
        return time
    places, pace = np.arange(len(missing)), np.median(np.diff(time.values[known]) / np.diff(known))
    nearest = np.clip(places, known[0], known[-1])
    return time._replace(values=time.values + pace * (places - nearest))


def _restore(
    path: Path, columns: dict[str, Column], places: Mapping[str, int], missing: NDArray[np.bool_]
) -> None:
    """Make the missing values of each quantity NaN again, all of them where the time is missing."""
    untimed = missing[:, places["time"]] if "time" in places else np.zeros(len(missing), dtype=np.bool_)
    for quantity in sorted(places.keys() - {"time"}):  # a set's order changes from run to run
        lost = missing[:, places[quantity]] | untimed
        if lost.any():
            values, origin, warning = columns[quantity]
            if lost.all():
                raise InputError(f"{path}: the {quantity} ({origin}) has no value")
            words = f"{origin}, {np.count_nonzero(lost)} of {len(lost)} values missing"
            columns[quantity] = Column(np.where(lost, np.nan, values), words, warning)


def _ask_for_unit(suggested: Suggestions, columns: Mapping[str, Column], places: Mapping[str, int]) -> None:
    """Ask for the unit of a time that names none and, taken as s, runs as slowly as ms or us may."""
    steps = np.diff(columns["time"].values)
    if _NO_UNIT in columns["time"].origin and "speed" not in columns:
        step_s, whole_s = float(np.median(steps)), float(np.ptp(columns["time"].values))
        if step_s >= _SLOW_S and whole_s >= _LONG_S:
            name = suggested.name(places["time"])
            options = (f"--column {_quoted(f'time={name}:{unit}')}" for unit in ("ms", "us", "s"))
            raise InputError(
                f"{suggested.path}: the time ({name}) names no unit, and in s its samples are {step_s:.4g} s apart:"
                f" name it: {' or '.join(options)}"
            )


def _unwrapped(time: Column) -> Column:
    """Go on counting where a counter of microseconds and the like began at 0 again."""
    values, steps = time.values, np.diff(time.values)
    back, on = steps < 0.0, steps[steps > 0.0]
    if not back.any() or not len(on):
        return time
    most, before = _ON_STEPS * float(np.median(on)), values[:-1][back]
    sizes = [_DAY_S, *(2.0**bits * unit for unit in (1.0, 1e-3, 1e-6) for bits in _COUNTER_BITS)]
    for size in sizes:
        is_on = (steps[back] + size > 0.0) & (steps[back] + size <= most)
        is_top = size == _DAY_S or any(
            ((top - most <= before) & (before < top)).all() for top in (size, 0.5 * size)
        )
        if is_on.all() and is_top:
            words = f"{time.origin}, whose counter begins anew after {size:.10g} s: continued"
            return time._replace(values=values + size * np.append(0.0, np.cumsum(back)), origin=words)
    return time


def _unrounded(time: Column) -> Column:
    """Spread a time evenly whose values repeat by rounding."""
    if (spread := evenly_rounded(time.values)) is None:
        return time
    values, rate_hz, rounding_s = spread
    words = f"its times repeat, being rounded to {rounding_s:.6g} s: taken as {rate_hz:.6g} samples a second"
    return Column(values, f"{time.origin}; {words}", time.warning)


def _refuse_no_current(path: Path, columns: dict[str, Column]) -> None:
    """Refuse a current that no motor draws, or that is computed from another column."""
    current, origin, _ = columns["current"]
    largest = float(np.max(np.abs(current)))
    if largest > LARGEST_CURRENT_A:
        raise InputError(
            f"{path}: the current ({origin}) reaches {largest:.4g} A, which is no reading of a motor"
            f" (at most {LARGEST_CURRENT_A:g} A): is it in another unit, or another quantity?"
        )
    for quantity, column in columns.items():
        if quantity != "current" and follows(current, column.values, quantity):
            raise InputError(
                f"{path}: the current ({origin}) is a linear function of the {quantity} ({column.origin}), without any"
                " noise: name a column that was measured"
            )


def _place(path: Path, table: Table, meanings: Sequence[Meaning], choice: ColumnChoice) -> int:
    """Find the column that is meant by header or number."""
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
    if names := ", ".join(filter(None, table.names)):
        raise InputError(f"{path}: there is no column {choice.column}; there are {names}")
    raise InputError(
        f"{path}: there is no column {choice.column}; the {len(table.numbers)} columns have no names, and numbers are"
        f" none: use the column's number, such as --column {choice.quantity}={table.numbers[0]}"
    )


def _chosen(suggested: Suggestions, k: int, choice: ColumnChoice) -> Column:
    table, meaning, name = suggested.table, suggested.meanings[k], suggested.name(k)
    if table.names[k] == choice.text != choice.column:  # a header with * or : in it
        choice = replace(choice, unit=None, scale=None, offset=0.0)
    quantity, unit, scale = choice.quantity, choice.unit, choice.scale
    stated, warnings = unit_quantity(meaning.unit), []
    if unit is not None:
        measured = unit_quantity(unit) or quantity
        factor = UNITS[measured][unit_key(unit)]
        if stated and (stated, meaning.factor) != (measured, factor):
            warnings.append(f"the header of column {name} says {meaning.unit}, and --column says {unit}")
        elif unit == SI[quantity] and scale is None and has_counts(table.values[:, k], table.averaged):
            warnings.append(f"column {name} holds whole numbers, as a converter's counts: are they {unit}?")
        stated, meaning = measured, Meaning(quantity, factor, unit, meaning.name)
    elif meaning.unit == NUMBERED and quantity == "time":
        return _counted(suggested, k)
    elif scale is None and stated not in (None, quantity):
        raise InputError(
            f"{suggested.path}: the column {name} is in {meaning.unit}; if it is the {quantity}, say"
            f" {suggested.scale(quantity, k)}"
        )
    column = _column(suggested, meaning, k, quantity, is_scaled=scale is not None)
    per = f" {SI[quantity]}/{SI[stated]}" if stated else ""
    words = "" if scale is None else f", times {scale:g}{per}"
    if choice.offset:
        words += f", {'plus' if choice.offset > 0.0 else 'minus'} {abs(choice.offset):g} {SI[quantity]}"
    values = (1.0 if scale is None else scale) * column.values + choice.offset
    if is_other(meaning.name, quantity) and not is_channel(meaning.name):
        warnings.append(f"by its name, column {name} is no {quantity}")
    if quantity == "current" and (largest := float(np.max(np.abs(values)))) > LARGE_CURRENT_A:
        warnings.append(
            f"column {name} gives a current of {largest:.4g} A: are its unit and its scale right?"
        )
    return Column(values, column.origin + words, "; ".join(warnings))


def _column(
    suggested: Suggestions, meaning: Meaning, k: int, quantity: str, *, is_scaled: bool = False
) -> Column:
    """Convert a column by its unit; without unit and scale it is SI, unless it holds counts."""
    table, name = suggested.table, suggested.name(k)
    header = f" ({table.names[k]})" if table.names[k] else ""
    unit = (
        f" in {meaning.unit}" if meaning.unit and meaning.unit.lower() not in table.names[k].lower() else ""
    )
    origin = f"column {table.numbers[k]}{header}{unit}"
    if not is_scaled and not unit_quantity(meaning.unit):
        if has_counts(table.values[:, k], table.averaged) and quantity != "duty":
            raise InputError(
                f"{suggested.path}: the column {name} holds whole numbers, and no unit is stated: name it"
                f' (--column "{quantity}={name}:{_SMALL[quantity]}") or give a scale'
                f' (--column "{quantity}={name}*SCALE+OFFSET")'
            )
        origin += f", {_NO_UNIT}, taken as {SI[quantity]}"
    return Column(meaning.factor * table.values[:, k], origin)


def _even(table: Table, begin_s: float, interval_s: float, reason: str) -> Column:
    # The middles of what was averaged.
    middles: FloatArray = (np.arange(len(table.values), dtype=np.float64) + 0.5) * table.averaged - 0.5
    return Column(begin_s + interval_s * middles, f"{1.0 / interval_s:.6g} samples a second, {reason}")


def _counted(suggested: Suggestions, counter: int | None) -> Column:
    """Make the time of a file that counts its samples or tells their interval."""
    path, table = suggested.path, suggested.table
    unknown = any(meaning.quantity is None for meaning in suggested.meanings)
    if table.interval_s is None or (counter is None and unknown):
        raise InputError(suggested.missing("time_s", f"{suggested.times()}say --sampling-rate HZ"))
    begin_s = table.begin_s
    if counter is not None:
        begin_s += table.interval_s * (table.values[0, counter] - 0.5 * (table.averaged - 1))
        is_off = np.abs(np.diff(table.values[:, counter]) - table.averaged) > 1e-6 * table.averaged
        if is_off.any():
            bad = int(np.argmax(is_off)) + 1
            raise InputError(
                f"{path}, {table.where} {table.lines[bad]}: the column {suggested.name(counter)} must count by one,"
                f" got {table.values[bad, counter]:g} after {table.values[bad - 1, counter]:g}"
            )
    elif table.samples is not None and table.samples // table.averaged != len(table.values):
        raise InputError(
            f"{path}: holds {len(table.values)} rows and says that there are {table.samples}; no column tells which"
        )
    return _even(table, begin_s, table.interval_s, "as the file says above its numbers")


@np.errstate(over="ignore", invalid="ignore")
def evenly_rounded(time_s: FloatArray) -> tuple[FloatArray, float, float] | None:
    """Spread times evenly that repeat because they were rounded.

    Returns:
        times, rate in Hz, and the step of the rounding; None where they do not repeat, or not by rounding.
    """
    steps = np.diff(time_s)
    rising = steps[steps > 0.0]
    if not len(rising) or (steps < 0.0).any() or (steps > 0.0).all():
        return None
    rounding_s = float(np.min(rising))
    count = np.arange(len(time_s), dtype=np.float64) - 0.5 * (len(time_s) - 1)
    middle_s = float(np.mean(time_s))
    interval_s = float(count @ (time_s - middle_s) / (count @ count))
    if interval_s > _DENSEST * rounding_s or float(np.max(rising)) > 1.01 * rounding_s:
        return None

    def spread(dt_s: float) -> float:
        return float(np.ptp(time_s - count * dt_s)) / rounding_s

    if spread(interval_s) > 1.1:
        return None
    rates = (float(f"{1.0 / interval_s:.{digits}g}") for digits in range(1, 6))
    rate_hz = next((rate for rate in rates if spread(1.0 / rate) <= 1.001), 1.0 / interval_s)
    return middle_s + count / rate_hz, rate_hz, rounding_s
