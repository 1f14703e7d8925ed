"""Hostile arguments of public functions, and the one check of what becomes of them.

A row is one argument of one public name, with a good value of it. From the good value follow the cells: the same
numbers in another dress (read-only, big-endian, a list), which must give the same to the bit; and what is no such value
(NaN, masked, text, the wrong shape), which must be refused: a ValueError or a TypeError, one sentence of our own.

    @pytest.mark.parametrize("row", ROWS, ids=str)
    def test_hostile(row):
        assert row.defects() == []
"""

from __future__ import annotations

import ast
import dataclasses
import math
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import Any, Self

import numpy as np

SECONDS = 10.0
"""A cell that takes longer does not end."""

PACKAGES = ("motor_env", "motor_datasets", "motor_classifiers")

FOREIGN = (
    "numba", "nopython", "numpy", "np.", "ufunc", "broadcast", "operand", "ndarray", "array(", "setting an array",
    "could not convert", "cannot convert", "cannot reshape", "truth value", "unsupported", "not supported between",
    "has no attribute", "object is not", "must be real number, not", "too large to convert", "cannot be interpreted",
    "math domain", "core dimension", "unhashable", "positional argument", "invalid literal", "singular", "iterable",
    "out of bounds", "inhomogeneous", "subscriptable", "casting", "integer argument", "input should", "pydantic",
)  # fmt: skip
"""Words of the libraries and of the interpreter: a user who reads them is told nothing about the argument."""

SAME, REFUSED, MISSING, EITHER = "same", "refused", "missing", "either"
"""What a cell must give: what the good value gives; a refusal; what NaN in its place gives; a refusal or no NaN."""

Cell = tuple[str, Any, str]


@dataclasses.dataclass(frozen=True)
class Row:
    """One argument of a public name.

    Attributes:
        name: the public name.
        argument: what is hostile.
        call: the name's call, with everything else good.
        good: a good value: an array, a float, an int, or anything else.
        allows: cells that may give something, as well as be refused (such as "empty", or "nan" of what may be missing).
        also: further hostile values, to be refused.
    """

    name: str
    argument: str
    call: Callable[[Any], Any]
    good: Any
    allows: frozenset[str] = frozenset()
    also: tuple[Any, ...] = ()

    @classmethod
    def of(
        cls,
        name: str,
        argument: str,
        call: Callable[[Any], Any],
        good: Any,
        *allows: str,
        also: Iterable[Any] = (),
    ) -> Self:
        """A row; `allows` by name, "missing" for all ways in which a reading is said to be missing."""
        return cls(name, argument, call, good, frozenset(allows), tuple(also))

    def __str__(self) -> str:
        return f"{self.name}-{self.argument}"

    def cells(self) -> Iterator[Cell]:
        """Label, value and what must come of it."""
        if isinstance(self.good, np.ndarray):
            yield from _arrays(self.good)
        elif isinstance(self.good, bool):
            yield from _no_numbers()
        elif isinstance(self.good, int):
            yield from _wholes(self.good)
        elif isinstance(self.good, float):
            yield from _numbers(self.good)
        else:
            yield from _objects(self.good)
        for n, value in enumerate(self.also):
            yield f"own {n}", value, REFUSED

    def defects(self) -> list[str]:
        """What is wrong with the cells, one line each; none for a good row."""
        expected = values_of(self.call(self.good))
        at_missing: list[Any] | None = None
        found = []
        for label, value, must in self.cells():
            if label in self.allows:
                must = EITHER
            elif must == MISSING and "missing" not in self.allows:
                must = REFUSED
            result, refusal = outcome(self.call, value)
            if result is None:
                wrong = refusal if must != SAME else refusal or "is refused"
            elif must == REFUSED:
                wrong = f"is taken, and gives {result!r:.80}"
            elif must == SAME:
                wrong = "" if equal(values_of(result), expected) else "gives something else"
            elif must == MISSING:
                at_missing = values_of(result) if at_missing is None else at_missing
                wrong = "" if equal(values_of(result), at_missing) else "gives something else than NaN does"
            else:
                wrong = "gives NaN" if any(_has_nan(each) for each in values_of(result)) else ""
            found += [f"{self}, {label}: {wrong}"] * (wrong != "")
        return found


def outcome(call: Callable[[Any], Any], value: Any, seconds: float = SECONDS) -> tuple[Any, str]:
    """The result, and no complaint; or None, and what is wrong with the refusal: nothing for one good sentence."""
    try:
        with ending(seconds):
            return (call(value),), ""
    except Exception as error:  # noqa: BLE001  # whatever comes is judged
        return None, complaint(error)


def complaint(error: BaseException) -> str:
    """What is wrong with an error as the answer to a hostile argument; empty for a good one."""
    sentence, kind = str(error), type(error)
    if kind not in (ValueError, TypeError) and not (
        isinstance(error, ValueError) and kind.__module__.partition(".")[0] in PACKAGES
    ):
        return f"{kind.__name__}: {sentence:.100}"
    if not sentence or "\n" in sentence or len(sentence) > 1100:
        return f"no one sentence: {sentence[:100]!r}"
    foreign = [word for word in FOREIGN if word in sentence.lower()]
    if foreign:
        return f"{kind.__name__} with a word of others ({foreign[0]}): {sentence:.100}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    parts = set(Path(last.filename).parts)
    if not parts & set(PACKAGES) or "tests" in parts or "raise" not in _statement(last):
        place = f"{Path(last.filename).name}:{last.lineno}"
        return f"{kind.__name__} that is not raised by us but at {place}: {sentence:.100}"
    return ""


def _statement(frame: traceback.FrameSummary) -> str:
    lines = Path(frame.filename).read_text(encoding="utf-8").splitlines()
    return " ".join(lines[max((frame.lineno or 1) - 3, 0) : frame.lineno])


@contextmanager
def ending(seconds: float) -> Iterator[None]:
    """Raise `TimeoutError` in what does not end."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"did not end in {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def values_of(result: Any) -> list[Any]:
    """All that a result holds, flat: arrays, numbers, text."""
    if dataclasses.is_dataclass(result) and not isinstance(result, type):
        return values_of([getattr(result, f.name) for f in dataclasses.fields(result)])
    if isinstance(result, dict):
        return values_of(list(result.values()))
    if isinstance(result, tuple | list):
        return [value for part in result for value in values_of(part)]
    return [result]


def equal(one: list[Any], other: list[Any]) -> bool:
    """Whether two results hold the same, to the bit."""
    return len(one) == len(other) and all(_same(a, b) for a, b in zip(one, other, strict=True))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray | float | int) and isinstance(b, np.ndarray | float | int):
        a, b = np.asarray(a), np.asarray(b)
        return a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fc"))
    return not isinstance(a, str) or bool(a == b)


def _has_nan(value: Any) -> bool:
    is_number = isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")
    return is_number and bool(np.isnan(value).any())


def public_names(stub: Path) -> set[str]:
    """What a stub of a package lists."""
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    imports = (node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom))
    return {alias.asname or alias.name for node in imports for alias in node.names}


def _at(good: np.ndarray[Any, Any], entry: Any, dtype: Any = None) -> np.ndarray[Any, Any]:
    """The array with one entry, in its middle, replaced."""
    changed = good.astype(dtype or np.result_type(good.dtype, np.float64))
    changed[np.unravel_index(good.size // 2, good.shape)] = entry
    return changed


def _arrays(good: np.ndarray[Any, Any]) -> Iterator[Cell]:
    read_only, strided = good.copy(), np.repeat(good, 2, axis=-1)[..., ::2]
    read_only.flags.writeable = False
    room = np.empty(good.nbytes + 1, dtype=np.uint8)
    unaligned = room[1:].view(good.dtype).reshape(good.shape)
    unaligned[...] = good
    yield "read-only", read_only, SAME
    yield "big-endian", good.astype(good.dtype.newbyteorder(">")), SAME
    yield "column order", np.asfortranarray(good), SAME
    yield "strided", strided, SAME
    yield "unaligned", unaligned, SAME
    yield "list", good.tolist(), SAME
    yield "tuple", tuple(good.tolist()), SAME
    yield "objects", good.astype(object), SAME
    yield "no mask", np.ma.array(good), SAME
    yield "subclass", good.view(np.recarray), SAME
    wild = _at(good, 3e8)
    masked = np.ma.array(wild, mask=wild != good)
    yield "nan", _at(good, np.nan), MISSING
    yield "masked", masked, MISSING
    yield "masked rows", [masked[n] for n in range(len(masked))], MISSING
    yield "None inside", _at(good, None, object), MISSING
    yield "masked objects", np.ma.array(wild.astype(object), mask=wild != good), MISSING
    yield "inf", _at(good, np.inf), REFUSED
    yield "-inf", _at(good, -np.inf), REFUSED
    yield "huge", _at(good, 1e300), REFUSED
    yield "-huge", _at(good, -1e200), REFUSED
    yield "tiny", _at(good, 5e-324), EITHER
    yield "large", _at(good, 3e30), EITHER
    yield "empty", np.zeros(0), REFUSED
    yield "no samples", good[..., :0], REFUSED
    yield "one short", good[..., :-1], REFUSED
    yield "0-d", np.array(1.0), REFUSED
    yield "more axes", good[None, None, None], REFUSED
    if good.ndim > 1 and good.shape[-1] != good.shape[-2]:
        yield "swapped axes", np.swapaxes(good, -1, -2), REFUSED
    yield "ragged", [[1.0, 2.0], [3.0]], REFUSED
    yield "bools", good > 0, REFUSED
    yield "complex", good + 1j, REFUSED
    yield "dates", np.zeros(good.shape, dtype="datetime64[s]"), REFUSED
    yield "durations", np.zeros(good.shape, dtype="timedelta64[s]"), REFUSED
    yield "strings", good.astype(str), REFUSED
    yield "objects that are none", np.full(good.shape, object()), REFUSED
    yield "beyond floats", _at(good, 10**400, object), REFUSED
    for entry in (
        np.True_,
        np.complex128(1 + 2j),
        np.timedelta64(1, "s"),
        np.datetime64(1, "s"),
        bytearray(b"1"),
    ):
        yield f"objects with a {type(entry).__name__}", _at(good, entry, object), REFUSED
    yield "list with a bool", _at(good, True, object).tolist(), REFUSED
    endless: list[Any] = []
    endless.append(endless)
    yield "endless", endless, REFUSED
    yield "text", "abc", REFUSED
    yield "dictionary", {"a": 1}, REFUSED
    yield "set", {1.0}, REFUSED
    yield "function", len, REFUSED


def _no_numbers() -> Iterator[Cell]:
    yield "nan", math.nan, MISSING
    yield "inf", math.inf, REFUSED
    yield "-inf", -math.inf, REFUSED
    yield "None", None, MISSING
    yield "text", "abc", REFUSED
    yield "digits", "1", REFUSED
    yield "bytes", b"1", REFUSED
    yield "complex", 1 + 2j, REFUSED
    yield "date", np.datetime64(1, "s"), REFUSED
    yield "duration", np.timedelta64(1, "s"), REFUSED
    yield "masked", np.ma.masked, MISSING
    yield "masked 0-d", np.ma.array(1, mask=True), MISSING
    yield "empty", np.zeros(0), REFUSED
    yield "empty list", [], REFUSED
    yield "several", np.ones(3), REFUSED
    yield "beyond floats", 10**400, REFUSED
    yield "-beyond floats", -(10**400), REFUSED
    yield "of too many digits to write", 10**5000, REFUSED
    yield "dictionary", {"a": 1}, REFUSED
    yield "object", object(), REFUSED
    yield "function", len, REFUSED


def _numbers(good: float) -> Iterator[Cell]:
    yield "0-d", np.array(good), SAME
    yield "big-endian", np.array(good, dtype=">f8"), SAME
    yield "NumPy's", np.float64(good), SAME
    yield "long", np.longdouble(good), SAME
    yield from _no_numbers()
    yield "bool", True, REFUSED
    yield "huge", 1e300, REFUSED
    for value in (10**30, 1e99, 5e-324, 0.0, -1.0):
        yield f"{value:.3g}", value, EITHER


def _wholes(good: int) -> Iterator[Cell]:
    yield "NumPy's", np.int64(good), SAME
    yield "unsigned", np.uint32(good), SAME
    yield "0-d", np.array(good), SAME
    yield "big-endian", np.array(good, dtype=">i8"), SAME
    yield "of an enumeration", IntEnum("Some", {"GOOD": good}).GOOD, SAME  # type: ignore[attr-defined]
    yield from _no_numbers()
    yield "bool", True, REFUSED
    yield "half", good + 0.5, REFUSED
    yield "beyond 64 bits", 2**70, REFUSED
    yield "-1", -1, EITHER
    yield "0", 0, EITHER
    yield "-beyond 64 bits", -(2**70), REFUSED


def _objects(good: Any) -> Iterator[Cell]:
    for label, value, must in _no_numbers():
        if not isinstance(value, type(good)):
            yield label, value, must
    yield "its type", type(good), REFUSED
