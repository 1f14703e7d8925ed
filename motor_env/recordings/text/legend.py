"""Legends in comment lines above the numbers: `%  7  8 Motor current left, right [A]: 0.1 0.2`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

_MARKS = ("%", "#", "//")
_LINE = re.compile(
    r"^\s*(?:[%#]+|//)\s*(?:col(?:umn)?s?\.?\s*)?"
    r"(?P<numbers>\d{1,4}(?:\s*(?:\.\.|,|\s)\s*\d{1,4})*)\s*[:=.)-]?\s+(?P<text>[^\W\d].*)$",
    re.IGNORECASE,
)
_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]")
_FIRST_VALUE = re.compile(r"\s+[-+]?(?:\d+\.\d*|\.\d+)\s*(?P<unit>[^\W\d]\S*)?$")  # time 0.000 sec
_FEWEST = 2  # columns of a legend: a comment that begins with a number is none


def is_comment(row: list[str]) -> bool:
    """Whether a row of cells begins as comments do."""
    return bool(row) and row[0].strip().startswith(_MARKS)


def legend_of(lines: Iterable[str], width: int) -> dict[int, tuple[str, str]]:
    """Name and unit of each column, by its place counted from 0; empty where the lines hold no legend.

    Args:
        lines: those above the numbers.
        width: columns of the file.
    """
    found: dict[int, tuple[str, str]] = {}
    spans: dict[int, int] = {}
    for match in filter(None, map(_LINE.match, lines)):
        columns = _columns(match["numbers"])
        for column, named in zip(columns, _named(match["text"], len(columns)), strict=True):
            # Of two lines that name a column the one counts that names fewer.
            if 1 <= column <= width and len(columns) <= spans.get(column, width):
                found[column - 1], spans[column] = named, len(columns)
    return found if len(found) >= _FEWEST else {}


def _columns(numbers: str) -> range | list[int]:
    """The columns of `7 8`, of `16 .. 35`, and of `19 28`, which stands for all between."""
    given = [int(number) for number in re.findall(r"\d+", numbers)]
    first, last = given[0], given[-1]
    return range(first, last + 1) if len(given) == 2 and first < last else given


def _named(text: str, count: int) -> Iterator[tuple[str, str]]:
    """A name and a unit for each of the columns of a line."""
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
