"""Tables out of the files that people have: text of many kinds, .mat, .npy, .npz, Parquet."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.array_files import BINARY, is_parquet, read_arrays, read_parquet
from motor_env.recordings.headers import understand
from motor_env.recordings.text.block import MOST_COLUMNS, block_of_numbers
from motor_env.recordings.text.cells import TextTable, cells
from motor_env.recordings.text.pieces import large_block
from motor_env.recordings.text.settings import Table

LARGEST_FILE_BYTES = 200_000_000
LARGEST_WHOLE_BYTES = 50_000_000
"""Of text; longer ones are read in pieces."""
_LARGEST_TEXT_BYTES = 20_000_000  # of what is kept cell by cell
_CONTROL = bytes(code for code in range(32) if code not in (9, 10, 11, 12, 13))
_CONTROL_SHARE = 0.01  # more control characters than that are no text
_FEWEST = 20


def read_table(path: Path, wanted: Sequence[str] = ()) -> Table:
    """Read a table of numbers.

    Args:
        path: of the file.
        wanted: columns that must not be left out.

    Raises:
        InputError: the file is missing, empty, too large or of no kind that can be read; a cell is no finite number.
    """
    size = _size(path)
    if is_parquet(path) and size:
        return _columns(path, *read_parquet(path), wanted)
    if path.suffix.lower() not in BINARY and size > LARGEST_WHOLE_BYTES:
        return large_block(path)
    content = _content(path)
    arrays = read_arrays(path, content)
    if arrays is None:
        text = _decoded(path, content)
        return block_of_numbers(path, text.splitlines(), text.endswith(("\n", "\r")))
    return _columns(path, arrays, 1, wanted)


def read_text_table(path: Path) -> TextTable:
    """Read a text file as a table of cells.

    Raises:
        InputError: the file is missing, empty or too large, or no text.
    """
    return cells(path, read_text(path).splitlines())


def read_text(path: Path) -> str:
    """Read a text file, whatever its code page.

    Raises:
        InputError: the file is missing, empty or too large, or no text.
    """
    return _decoded(path, _content(path, _LARGEST_TEXT_BYTES))


def _size(path: Path) -> int:
    """Bytes of a regular file; 0 of anything else, which is told when it is opened."""
    return path.stat().st_size if path.is_file() else 0


def _content(path: Path, largest: int = LARGEST_FILE_BYTES) -> bytes:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: is no regular file")
        # What the system makes up while it is read has no size, and may never end.
        content = b""
        if status.st_size:
            with path.open("rb") as file:
                content = file.read(largest + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read ({reason})") from None
    if len(content) > largest:
        raise InputError(f"{path}: is larger than {largest // 1_000_000} MB")
    if not content or content.isspace():
        raise InputError(f"{path}: is empty")
    return content


def _decoded(path: Path, content: bytes) -> str:
    """Text in UTF-8 or UTF-16, or in the code page of an old scope."""
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    encodings = ["utf-16"] if wide else ["utf-8-sig", "cp1252"]
    for encoding in encodings:
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        plain = text.encode() if wide else content
        control = len(plain) - len(plain.translate(None, _CONTROL))
        if control <= _CONTROL_SHARE * len(text) and "\0" not in text:
            return text
    raise InputError(f"{path}: is not text, and its ending is none of .mat, .npy, .npz, .parquet")


def _columns(path: Path, arrays: dict[str, Any], averaged: int, wanted: Sequence[str]) -> Table:
    """Table of the arrays of one length, that of a wanted one or the most frequent, and of the columns of a matrix.

    Raises:
        InputError: no such array, a value that is not finite, or a quantity would be lost with an array of another
            length.
    """
    flat: dict[str, FloatArray] = {}
    for name, given in arrays.items():
        if given.dtype.kind not in "fiub" or given.size < 2:
            continue
        squeezed = np.squeeze(given).astype(np.float64)
        if squeezed.ndim == 1:
            flat[name] = squeezed
        elif squeezed.ndim == 2 and min(squeezed.shape) <= MOST_COLUMNS:
            tall = squeezed if squeezed.shape[0] >= squeezed.shape[1] else squeezed.T
            flat |= {f"{name}#{k + 1}": tall[:, k] for k in range(tall.shape[1])}
    if not flat:
        raise InputError(f"{path}: holds no column of numbers")
    lengths = [len(flat[name]) for name in wanted if name in flat] or [
        len(values) for values in flat.values()
    ]
    length = max(set(lengths), key=lambda n: (lengths.count(n), n))
    others = {name: values for name, values in flat.items() if len(values) != length}
    flat = {name: values for name, values in flat.items() if len(values) == length}
    there = {understand(name).quantity for name in flat}
    for name, values in others.items():
        quantity = understand(name).quantity
        lost = quantity is not None and quantity not in there and len(values) >= _FEWEST
        if lost or name in wanted:
            raise InputError(f"{path}: {name} has {len(values)} values where the others have {length}")
    values = np.column_stack(list(flat.values()))
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        name = list(flat)[column]
        raise InputError(
            f"{path}, row {row * averaged + 1}: the column {name} must hold finite numbers, got {values[row, column]}"
        )
    names = tuple("" if "#" in name else name for name in flat)
    units, numbers = ("",) * len(names), tuple(range(1, len(names) + 1))
    remarks = (f"left out, for their lengths: {', '.join(others)}",) if others else ()
    at = range(1, length * averaged + 1, averaged)
    return Table(names, values, at, units, numbers, where="row", remarks=remarks, averaged=averaged)
