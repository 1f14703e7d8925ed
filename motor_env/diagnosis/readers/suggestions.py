"""What a refusal suggests: only columns that can be what is asked, by name, unit and range.

An option is whole where name or unit of a column say what it holds. Else it has blanks in capitals (UNIT, SCALE,
COLUMN), which only the user can fill.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from motor_env.diagnosis.readers.headers import (
    LARGEST_CURRENT_A,
    NUMBERED,
    SI,
    Meaning,
    follows,
    has_counts,
    is_channel,
    is_no_unit,
    is_other,
    kinds_named,
    name_parts,
    unit_quantity,
)
from motor_env.diagnosis.readers.text_block import Table

_SCALE = "SCALE is how many A a volt is, 10 for a probe of 100 mV/A"
_OFFSET = "SCALE and OFFSET are those of the converter's counts, such as *0.0132-6.76"
_OR_COUNTS = "UNIT is A or mA; a converter's counts need"
_READING = "SCALE is how many A a reading of 1 is, 10 for a probe of 100 mV/A"
_UNIT = "UNIT is A or mA"
_MOST_NAMED = 8


@dataclass(frozen=True, slots=True)
class Suggestions:
    """What may be suggested for a table.

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
        """Return the sentence for columns that look alike; each that can be the quantity is offered."""
        fitting = self._beside([k for k in columns if self.can_be(quantity, k)])
        options = [f"--column {_quoted(f'{quantity}={self.name(k)}')}" for k in fitting[:_MOST_NAMED]]
        if quantity not in ("time", "current"):
            options.append(f"--column {quantity}=none")
        names = [self.name(k) for k in columns]
        alike = f"{', '.join(names[:-1])} and {names[-1]}"
        which = f"say which: {' or '.join(options)}" if options else f"none of them can be a {quantity}"
        both = "both" if len(names) == 2 else "all"
        return f"{self.path}: the columns {alike} {both} look like the {quantity}; {which}"

    def missing_current(self, free: Collection[int]) -> str:
        """Return the sentence for a file without a column of the current among the free ones."""
        fitting = self._beside([k for k in free if self.can_be("current", k)])
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
        """Return the option for a column that may be the time, with `or` behind it; empty where none can be."""
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

    def _beside(self, columns: list[int]) -> list[int]:
        """Return columns of the motor of which one is chosen already, where the file has several motors."""
        parts = [set(name_parts(self.meanings[k].name)) for k in self.chosen.values()]
        shared = [sum(len(own & set(name_parts(self.meanings[k].name))) for own in parts) for k in columns]
        return [k for k, count in zip(columns, shared, strict=True) if count == max(shared)]


def _quoted(option: str) -> str:
    return f'"{option}"' if any(mark in option for mark in " *#()[]") else option
