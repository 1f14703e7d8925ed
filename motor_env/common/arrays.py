"""Check numbers and arrays of callers: a bad value raises `ValueError` with one sentence.

Compiled loops check nothing, so every public function checks its arguments here first.

Example:
    >>> from motor_env.common.arrays import numbers
    >>> numbers("voltage_v", [12.0, float("nan")], ("n_samples",))
    Traceback (most recent call last):
    ...
    ValueError: voltage_v must be finite, got nan at [1]
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

LARGEST_NUMBER = 1e100
"""Largest magnitude of a number: beyond it, its square nears the largest float."""

Shape = tuple[int | str, ...]
"""Lengths of axes; a word stands for any length, "..." at the front for any axes."""

_KINDS = {"b": "bools", "c": "complex numbers", "m": "durations", "M": "dates", "U": "text", "S": "text"}
_NO_REALS = (
    str,
    bytes,
    bytearray,
    bool,
    complex,
    np.bool_,
    np.complexfloating,
    np.datetime64,
    np.timedelta64,
)
_WHOLE = 2**63 - 1
_DOUBLE, _SINGLE = np.dtype(np.float64), np.dtype(np.float32)


def numbers(
    name: str,
    values: Any,
    shape: Shape | None = None,
    *,
    missing: bool = False,
    single: bool = False,
    least: float | None = None,
) -> NDArray[np.float64]:
    """Convert values to a contiguous float64 array; copy them only if they are none.

    Args:
        name: of the argument.
        values: of the caller.
        shape: required shape, no axis of length 0; None for any.
        missing: whether NaN, None and masked values are allowed: they become NaN.
        single: whether float32 stays float32.
        least: lower bound of the values.

    Raises:
        ValueError: no real numbers, another shape, or a value that is not finite.
    """
    if type(values) is float and not shape and abs(values) <= LARGEST_NUMBER:
        return np.array(values)  # the quick way of a stream
    array = real(name, values, shape, single=single)
    # One quick pass: a number that is not finite stays in the sum, and a huge one makes it huge.
    if not float(np.vdot(array, array)) <= LARGEST_NUMBER:
        bad = ~(np.abs(array.astype(np.float64)) <= LARGEST_NUMBER)
        bad &= ~(missing & np.isnan(array))
        if bad.any():
            place = np.unravel_index(int(bad.argmax()), array.shape)
            where, found = f" at [{', '.join(map(str, place))}]" if place else "", f"{array[place]:g}"
            bound = f" and at most {LARGEST_NUMBER:g}" if np.isfinite(array[place]) else ""
            if np.ma.is_masked(values):
                found = "a masked value"
            raise ValueError(f"{name} must be finite{bound}, got {found}{where}")
    if least is not None and not (array >= least).all():
        raise ValueError(f"{name} must be >= {least:g}, got {array.min():g}")
    return array


def real(name: str, values: Any, shape: Shape | None = None, *, single: bool = False) -> NDArray[np.float64]:
    """Convert as `numbers` does, but allow values that are not finite."""
    array = values if type(values) is np.ndarray else _array(name, values)
    if array.dtype is not _DOUBLE and not (single and array.dtype == _SINGLE):
        array = _doubles(name, array)
    if shape is not None and not (array.size and _fits(array.shape, shape)):
        wanted = f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})" if shape else "() (one number)"
        raise ValueError(f"{name} must have shape {wanted}, got {array.shape}")
    return array if array.flags.carray else array.copy()


def spread(name: str, values: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Convert as `numbers` does, if the result can be broadcast to `shape`."""
    array = numbers(name, values)
    if not array.ndim:
        return array
    lengths = zip(array.shape[::-1], shape[::-1], strict=False)
    if array.ndim > len(shape) or any(own not in (1, whole) for own, whole in lengths):
        raise ValueError(f"{name} must be a number or have shape {shape}, got {array.shape}")
    return array


def number(
    name: str,
    value: Any,
    *,
    above: float = -np.inf,
    least: float = -LARGEST_NUMBER,
    below: float = np.inf,
    most: float = LARGEST_NUMBER,
) -> float:
    """Return a finite number within the bounds; else raise `ValueError`."""
    found = value if isinstance(value, float) else float(real(name, value, ()))
    if least <= found <= most and above < found < below:
        return found
    bounds = ((">", above), (">=", least), ("<", below), ("<=", most))
    wanted = " and ".join(f"{sign} {bound:g}" for sign, bound in bounds if abs(bound) < LARGEST_NUMBER)
    raise ValueError(f"{name} must be {wanted or 'finite'}, got {found:g}")


def instance(name: str, value: object, kind: type | tuple[type, ...]) -> None:
    """Raise `TypeError` unless the value is of the kind, or one of the kinds."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or ".join(each.__name__ for each in kinds if each is not type(None))
        raise TypeError(f"{name} must be of type {wanted}, got {shown(value)}")


def whole(name: str, value: Any, least: int = 0, most: int = _WHOLE) -> int:
    """Return an integer within the bounds; else raise `ValueError`, also for a bool."""
    found = value
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "iu" and not np.ma.is_masked(value):
        found = value.tolist()
    if not isinstance(found, int) or isinstance(found, bool) or not least <= found <= most:
        raise ValueError(f"{name} must be a whole number in {least} .. {most}, got {shown(value)}")
    return int(found)  # not a word of an enumeration


def wholes(name: str, values: Any, least: int = 0, most: int = _WHOLE) -> NDArray[np.int64]:
    """Return integers within the bounds, of any shape; else raise `ValueError` for the first other value."""
    array = _array(name, values)
    is_good = array.dtype.kind in "iu" and (not array.size or (array.min() >= least and array.max() <= most))
    for place, entry in enumerate(() if is_good else array.reshape(-1).tolist()):
        if type(entry) is not int or not least <= entry <= most:
            where = f" at [{place}]" if array.ndim else ""
            raise ValueError(f"{name} must be whole numbers in {least} .. {most}, got {shown(entry)}{where}")
    return array.astype(np.int64)


def flags(name: str, values: Any, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return bools of a shape; else raise `ValueError`."""
    array = _array(name, values)
    if array.dtype != np.bool_ or array.shape != shape:
        raise ValueError(f"{name} must be bools of shape {shape}, got shape {array.shape}")
    return array


def is_one_of(value: Any, words: Iterable[str]) -> bool:
    """Whether the value, of any type, is one of the words."""
    return isinstance(value, str) and value in set(words)


def shown(value: Any, depth: int = 3) -> str:
    """Describe a caller's value in a few words, on one line."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        return shown(value.tolist()) if value.size < 4 else f"an array of shape {value.shape}"
    if isinstance(value, list | tuple):
        entries = [shown(entry, depth - 1) for entry in value[: 4 if depth else 0]]
        return f"[{', '.join(entries)}{', ...' * (len(value) > len(entries))}]"
    if isinstance(value, int) and value.bit_length() > 1000:
        return f"a whole number of {value.bit_length()} bits"  # Python refuses to write it
    if isinstance(value, str | bytes | int | float | complex | None):
        return reprlib.repr(value)
    kind = value if isinstance(value, type) else type(value)
    return f"{'the type' if kind is value else 'a value of type'} {kind.__name__}"


def _array(name: str, values: Any) -> NDArray[Any]:
    try:
        return np.asarray(_unmasked(values))
    except (TypeError, ValueError, OverflowError, RuntimeError):  # ragged rows, a tensor with gradients
        raise ValueError(f"{name} must be numbers, in rows of one length, got {shown(values)}") from None


def _unmasked(values: Any) -> Any:
    if isinstance(values, np.ma.MaskedArray):
        if np.ma.is_masked(values) and values.dtype.kind == "O":
            return np.where(np.ma.getmaskarray(values), np.array(None), values.data)
        is_missing = np.ma.is_masked(values) and values.dtype.kind in "fiu"
        return np.ma.filled(values.astype(np.float64), np.nan) if is_missing else values.data
    if isinstance(values, list | tuple) and set(map(type, values)) != {float}:
        found = [_unmasked(entry) for entry in values]
        bools = [
            isinstance(entry, bool | np.bool_) or (isinstance(entry, np.ndarray) and entry.dtype.kind == "b")
            for entry in found
        ]
        # NumPy makes 1.0 of a bool beside a number.
        return np.array(found, dtype=None if all(bools) else object) if any(bools) else found
    return values


def _doubles(name: str, array: NDArray[Any]) -> NDArray[np.float64]:
    is_object = array.dtype.kind == "O"
    if array.dtype.kind in "fiu" or (
        is_object and not any(isinstance(entry, _NO_REALS) for entry in array.flat)
    ):
        try:
            with np.errstate(over="ignore"):
                return array.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
    kind = shown(array) if is_object else _KINDS.get(array.dtype.kind, "something else")
    raise ValueError(f"{name} must be real numbers, got {kind}")


def _fits(own: tuple[int, ...], wanted: Shape) -> bool:
    if wanted and wanted[0] == "...":
        wanted = wanted[1:]
        own = own[-len(wanted) :]
    if len(own) != len(wanted):
        return False
    for has, need in zip(own, wanted, strict=True):  # noqa: SIM110  # a generator would take longer than the loop
        if has != need and not isinstance(need, str):
            return False
    return True
