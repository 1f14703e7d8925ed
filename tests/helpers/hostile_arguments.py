"""Hostile arguments of public functions, and the one check of what becomes of them.

A row is one argument of one public name, with a good value of it. From the good value follow the cells: the same
numbers in another dress (read-only, big-endian, a list), which must give the same to the bit; and what is no such value
(NaN, masked, text, the wrong shape), which must be refused: a ValueError or a TypeError, one sentence of our own.

    ROWS = rows("smooth", kalman=TWO, result=Good(RESULT, also=(None,)))

    @pytest.mark.parametrize("row", ROWS, ids=str)
    def test_hostile(row):
        assert row.defects() == []
"""

import ast
import dataclasses
import math
import traceback
from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any, Self

import numpy as np

import motor_env

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


class Good:
    """A good value of an argument, cells that may give something as well as be refused, and further hostile values.

    Cells are allowed by name, "missing" for all ways in which a reading is said to be missing.
    """

    def __init__(self, value: Any, *allows: str, also: Iterable[Any] = ()) -> None:
        self.value, self.allows, self.also = value, allows, tuple(also)


@dataclasses.dataclass(frozen=True)
class Row:
    """One argument of a public name: its call with everything else good, and what is good."""

    name: str
    argument: str
    call: Callable[[Any], Any]
    good: Good

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
        """A row of its own."""
        return cls(name, argument, call, Good(good, *allows, also=also))

    def __str__(self) -> str:
        return f"{self.name}-{self.argument}"

    def cells(self) -> Iterator[Cell]:
        """Label, value and what must come of it."""
        good = self.good.value
        makers: dict[type, Callable[[Any], Iterator[Cell]]]
        makers = {np.ndarray: _arrays, bool: lambda _: _no_numbers(), int: _wholes, float: _numbers}
        make = next((make for kind, make in makers.items() if isinstance(good, kind)), _objects)
        yield from make(good)
        for n, value in enumerate(self.good.also):
            yield f"own {n}", value, REFUSED

    def defects(self) -> list[str]:
        """What is wrong with the cells, one line each; none for a good row."""
        expected, at_missing, found = values_of(self.call(self.good.value)), None, []
        for label, value, must in self.cells():
            if label in self.good.allows:
                must = EITHER
            elif must == MISSING and "missing" not in self.good.allows:
                must = REFUSED
            result, wrong = outcome(self.call, value)
            values = values_of(result)
            if result is None:
                wrong = wrong or "is refused" * (must == SAME)
            elif must == REFUSED:
                wrong = f"is taken, and gives {result!r:.80}"
            elif must == SAME:
                wrong = "" if equal(values, expected) else "gives something else"
            elif must == MISSING:
                at_missing = at_missing or values
                wrong = "" if equal(values, at_missing) else "gives something else than NaN does"
            elif any(_has_nan(each) for each in values):
                wrong = "gives NaN"
            found += [f"{self}, {label}: {wrong}"] * (wrong != "")
        return found


def rows(name: str, call: Callable[..., Any] | None = None, /, **arguments: Any) -> list[Row]:
    """A row for each argument of a call, all others good; unless told otherwise, that of the name in `motor_env`."""
    made = call or getattr(motor_env, name)
    told = {key: given if isinstance(given, Good) else Good(given) for key, given in arguments.items()}
    values = {key: good.value for key, good in told.items()}

    def alone(key: str) -> Callable[[Any], Any]:
        return lambda value: made(**values | {key: value})

    return [Row(name, key, alone(key), good) for key, good in told.items()]


def outcome(call: Callable[[Any], Any], value: Any) -> tuple[Any, str]:
    """The result, and no complaint; or None, and what is wrong with the refusal: nothing for one good sentence."""
    try:
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
    endless: list[Any] = []
    endless.append(endless)
    hostile: dict[str, Any] = {
        "ragged": [[1.0, 2.0], [3.0]],
        "bools": good > 0,
        "complex": good + 1j,
        "strings": good.astype(str),
        "dates": np.zeros(good.shape, dtype="datetime64[s]"),
        "durations": np.zeros(good.shape, dtype="timedelta64[s]"),
        "objects that are none": np.full(good.shape, object()),
        "beyond floats": _at(good, 10**400, object),
        "list with a bool": _at(good, True, object).tolist(),
        "endless": endless,
        "text": "abc",
        "dictionary": {"a": 1},
        "set": {1.0},
        "function": len,
    }
    for label, value in hostile.items():
        yield label, value, REFUSED
    for entry in (
        np.True_,
        np.complex128(1 + 2j),
        np.timedelta64(1, "s"),
        np.datetime64(1, "s"),
        bytearray(b"1"),
    ):
        yield f"objects with a {type(entry).__name__}", _at(good, entry, object), REFUSED


def _no_numbers() -> Iterator[Cell]:
    missing: dict[str, Any] = {"nan": math.nan, "None": None, "masked": np.ma.masked}
    for label, value in missing.items():
        yield label, value, MISSING
    yield "masked 0-d", np.ma.array(1, mask=True), MISSING
    hostile: dict[str, Any] = {
        "inf": math.inf,
        "-inf": -math.inf,
        "text": "abc",
        "digits": "1",
        "bytes": b"1",
        "complex": 1 + 2j,
        "date": np.datetime64(1, "s"),
        "duration": np.timedelta64(1, "s"),
        "several": np.ones(3),
        "empty": np.zeros(0),
        "empty list": [],
        "dictionary": {"a": 1},
        "object": object(),
        "function": len,
        "beyond floats": 10**400,
        "-beyond floats": -(10**400),
        "of too many digits to write": 10**5000,
    }
    for label, value in hostile.items():
        yield label, value, REFUSED


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
