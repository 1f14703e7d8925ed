"""Untrusted TOML files, checked against dataclasses: one sentence for the first error."""

from __future__ import annotations

import json
import reprlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError
from pydantic_core import core_schema

from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_NOTE_BYTES, read_file
from motor_env.motor.parameters import LARGEST, SMALLEST, FloatArray, require

T = TypeVar("T")
Positive = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0.0, le=LARGEST)]
Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
_LONGEST_TEXT = 1000  # characters


def one_line(name: str, text: str) -> str:
    """Return the text if it is printable: no line breaks or escape codes, not too long; else `ValueError`."""
    require(
        text.isprintable() and len(text) <= _LONGEST_TEXT,
        f"{name} must be one line of at most {_LONGEST_TEXT} characters, got {reprlib.repr(text)}",
    )
    return text


OneLine = Annotated[str, AfterValidator(partial(one_line, "text"))]


@dataclass(frozen=True)
class ArrayOf:
    """Type of an array in a file: lists of lists of such entries."""

    entries: Any

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return core_schema.no_info_after_validator_function(_array, handler.generate_schema(self.entries))


def _array(entries: Any) -> FloatArray:
    lengths = {np.shape(entry) for entry in entries}
    require(len(lengths) <= 1, "rows must be of one length")
    return np.array(entries, dtype=np.float64)


@cache
def _adapter(cls: Any) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


def read_toml(path: Path, missing: str) -> dict[str, Any]:
    """Return the content of a TOML file.

    Args:
        path: the file.
        missing: message if there is none.

    Raises:
        InputError: no such file, not a text file (a device, a gigabyte), or not TOML.
    """
    content = read_file(path, LARGEST_NOTE_BYTES, missing)
    try:
        return tomllib.loads(content.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text (byte {error.start} is not UTF-8)") from None
    except RecursionError:
        raise InputError(f"{path}: is not TOML: nested too deep") from None
    except ValueError as error:  # a number of too many digits, too
        raise InputError(f"{path}: is not TOML: {error}") from None


def from_dict(cls: type[T], content: Mapping[str, Any], whole: str) -> T:
    """Return the dataclass that a dictionary describes.

    Types are strict; missing keys take their defaults.

    Args:
        cls: the dataclass; nested ones are checked too.
        content: of a TOML or JSON file.
        whole: name of the file in messages.

    Raises:
        ValueError: an unknown key, a value of another type or out of its range.
    """
    try:
        text = json.dumps(content, default=str)
        checked: T = _adapter(cls).validate_json(text, strict=True)  # type: ignore[arg-type]  # a class is hashable
    except ValidationError as error:
        raise ValueError(_sentence(cls, error, whole)) from None
    return checked


def _sentence(cls: type[Any], error: ValidationError, whole: str) -> str:
    # A misspelt key first: it explains why another one is missing.
    first = min(error.errors(), key=lambda entry: entry["type"] != "unexpected_keyword_argument")
    *outer, last = first["loc"] or ("",)
    if first["type"] == "unexpected_keyword_argument":
        known = ", ".join(_keys(cls, outer))
        return f"unknown key {reprlib.repr(last)} in {_place(outer) or whole}; known are {known}"
    place = _place(first["loc"]) or whole
    if first["type"] == "missing":
        return f"{place} is missing"
    message = first["msg"].removeprefix("Value error, ")
    if message.startswith("Input should "):
        return f"{place} must {message.removeprefix('Input should ')}, got {reprlib.repr(first['input'])}"
    return f"{place}: {message}"


def _place(parts: Any) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in parts).lstrip(".")


def _keys(cls: Any, parts: list[int | str]) -> list[str]:
    for part in parts:
        if isinstance(part, str):
            cls = next(_dataclasses(get_type_hints(cls)[part]))
    return [f.name for f in fields(cls)]


def _dataclasses(hint: Any) -> Any:
    """Return the dataclasses in a type such as `tuple[FaultClass, ...] | None`."""
    if is_dataclass(hint):
        yield hint
    for argument in get_args(hint):
        yield from _dataclasses(argument)


def toml_text(
    top: Mapping[str, Any], tables: Mapping[str, Mapping[str, Any] | Sequence[Mapping[str, Any]]]
) -> str:
    """Return the text of a TOML file: keys outside tables, then tables and rows of them; None is left out."""
    texts = [_lines(top)]
    for name, table in tables.items():
        if isinstance(table, Mapping):
            texts.append(f"[{name}]\n{_lines(table)}")
        else:
            texts += [f"[[{name}]]\n{_lines(row)}" for row in table]
    return "\n".join(texts)


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(
        f"{key} = {json.dumps(value, ensure_ascii=False, default=np.ndarray.tolist)}\n"
        for key, value in table.items()
        if value is not None
    )
