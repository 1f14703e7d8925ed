"""Tables out of text, workbooks, .mat, .npy, .npz and Parquet. None of them may run code.

Compiled parsers crash on some damaged files, and a small file may unpack to gigabytes: MATLAB, HDF5, workbooks and
Parquet are parsed in a process of their own (`array_parser`), with limits of memory and time.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.common.errors import InputError, require_extra
from motor_env.common.files import LARGEST_DATA_BYTES, LARGEST_TABLE_BYTES, read_file
from motor_env.diagnosis.readers import array_parser
from motor_env.diagnosis.readers.headers import understand
from motor_env.diagnosis.readers.text_block import FEWEST_SAMPLES, MOST_COLUMNS, Table, TextTable, cells
from motor_env.diagnosis.readers.text_numbers import NULL_SHARE, large_block, whole_block, with_nulls
from motor_env.motor.parameters import FloatArray

LARGEST_WHOLE_BYTES = 50_000_000
"""Size of a text up to which it is read whole; a longer one is read in pieces."""
ENDINGS = (
    *(".csv", ".txt", ".tsv", ".dat", ".log", ".asc", ".lvm", ".mat", ".h5", ".hdf5", ".npy", ".npz"),
    *(".parquet", ".pq", ".tdms", ".xlsx", ".xlsm"),
)
"""Endings of files in a folder that are recordings; a file that is named may have any other."""
_CONTROL = bytes(code for code in range(32) if code not in (9, 10, 11, 12, 13))
_CONTROL_SHARE = 0.01  # more control characters than that are no text
_MOST_STRAY = 5  # cells that are told
_WIDE = (b"\xff\xfe", b"\xfe\xff")
_FOREIGN = {  # how they begin, and what helps
    b"PK\x03\x04": "an archive; a workbook must be named .xlsx, other archives unpacked",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook; save it as .xlsx or CSV",
    b"\x89HDF": "HDF5, which must be named .mat, .h5 or .hdf5",
    b"TDSm": "LabVIEW's TDMS, which must be named .tdms",
}
_SECONDS = 30.0  # for what is parsed elsewhere
_SINGLE = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}


def read_table(path: Path, wanted: Sequence[str] = ()) -> Table:
    """Read a table of numbers.

    Args:
        path: of the file.
        wanted: columns that must not be left out.

    Raises:
        InputError: the file is missing, empty, too large or of no kind that can be read; a cell holds no number.
    """
    size, averaged = 0, 1
    with suppress(OSError):  # it is told when the file is opened
        size = path.stat().st_size if path.is_file() else 0
    match path.suffix.lower():
        case ".parquet" | ".pq" if size:  # of any length, for it is read in pieces
            require_extra("pyarrow", "datasets")
            arrays, averaged = _arrays(_parse_in_subprocess(path, b"", "Parquet", str(path)))
        case ".mat" | ".h5" | ".hdf5":
            content, kind = _content(path), "MATLAB"
            if content.startswith((b"\x89HDF", b"MATLAB 7.3 MAT-file")):
                require_extra("h5py", "files")
                kind = "HDF5"
            arrays, averaged = _arrays(_parse_in_subprocess(path, content, kind))
        case ".xlsx" | ".xlsm":
            content = _content(path)
            require_extra("openpyxl", "files")
            text, stray = json.loads(_parse_in_subprocess(path, content, "workbook"))
            table, words = whole_block(path, text), ", ".join(repr(cell[:20]) for cell in stray[:_MOST_STRAY])
            return replace(
                table, remarks=(*table.remarks, *[f"ignored, for they stand apart: {words}"] * bool(stray))
            )
        case ".tdms":
            content = _content(path)
            require_extra("nptdms", "files")
            arrays, averaged = _arrays(_parse_in_subprocess(path, content, "TDMS"))
            if sum(understand(name).quantity == "time" for name in arrays) > 1:  # one of its own counts more
                arrays.pop(array_parser.WAVEFORM_TIME, None)
        case ".npy" | ".npz":
            arrays = _numpy(path, _content(path))
        case _ if size > LARGEST_WHOLE_BYTES:
            return large_block(path)
        case _:
            content = _content(path)
            return with_nulls(whole_block(path, _decoded(path, content)), _nulls(content))
    return _columns(path, arrays, averaged, wanted)


def read_text_table(path: Path) -> TextTable:
    """Read a text file as a table of cells.

    Raises:
        InputError: the file is missing, empty or too large, or no text.
    """
    return cells(path, _decoded(path, _content(path, LARGEST_TABLE_BYTES)).splitlines())


def _content(path: Path, largest: int = LARGEST_DATA_BYTES) -> bytes:
    content = read_file(path, largest)
    if not content or content.isspace():
        raise InputError(f"{path}: is empty")
    return content


def _decoded(path: Path, content: bytes) -> str:
    """Decode text in UTF-8, UTF-16, or an old scope's code page."""
    _refuse_foreign(path, content)
    wide = content[:2] in _WIDE
    whole = content.rstrip(b"\0")  # a power cut may leave any number of them
    if _nulls(whole) < NULL_SHARE * len(whole):
        content = content if wide else whole.replace(b"\0", b"")
    for encoding in ["utf-16"] if wide else ["utf-8-sig", "cp1252"]:
        with suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            plain = text.encode() if wide else content
            control = len(plain) - len(plain.translate(None, _CONTROL))
            if control <= _CONTROL_SHARE * len(text) and "\0" not in text:
                return text
    raise InputError(
        f"{path}: is not text, and its ending is none of .mat, .h5, .npy, .npz, .parquet, .tdms, .xlsx"
    )


def _nulls(content: bytes) -> int:
    """Count the bytes of 0 in a text that is not UTF-16."""
    return 0 if content[:2] in _WIDE else content.count(0)


def _refuse_foreign(path: Path, content: bytes) -> None:
    for begin, words in _FOREIGN.items():
        if content.startswith(begin):
            raise InputError(f"{path}: is {words}")


def _parse_in_subprocess(path: Path, content: bytes, kind: str, *more: str) -> bytes:
    """Parse a file in a subprocess, with limits of memory and time; return what it prints."""
    if kind not in ("HDF5", "TDMS") and content[:2] != b"PK":
        _refuse_foreign(path, content)
    # -P: modules of this folder must not hide others of the same name.
    command = [sys.executable, "-P", array_parser.__file__, kind, *more]
    try:
        done = subprocess.run(  # noqa: S603  # our own interpreter and file; what it parses is data
            command,
            input=content,
            capture_output=True,
            timeout=_SECONDS,
            env=os.environ | _SINGLE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise _unreadable(path, kind, f"it takes longer than {_SECONDS:g} s") from None
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip().splitlines() if done.returncode == 1 else []
        raise _unreadable(path, kind, [f"its parser crashed with status {done.returncode}", *words][-1])
    return done.stdout


def _arrays(said: bytes) -> tuple[dict[str, Any], int]:
    """Return arrays by name, and how many rows are averaged to one."""
    head, _, body = said.partition(b"\n")
    averaged, shapes = json.loads(head)
    ends = np.cumsum([np.prod(shape) for _, shape in shapes], dtype=np.int64)
    parts = np.split(np.frombuffer(body, np.float64), ends)[: len(shapes)]
    return {name: part.reshape(shape) for (name, shape), part in zip(shapes, parts, strict=True)}, averaged


def _numpy(path: Path, content: bytes) -> dict[str, Any]:
    try:
        if content[:2] == b"PK":
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                array_parser.check_count(sum(member.file_size for member in archive.infolist()) // 8)
        loaded = np.load(io.BytesIO(content), allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            members = {name: loaded[name] for name in loaded.files}
            return {name: array for name, array in members.items() if isinstance(array, np.ndarray)}
        return (
            {name: loaded[name] for name in loaded.dtype.names} if loaded.dtype.names else {"array": loaded}
        )
    except Exception as error:  # noqa: BLE001  # a damaged file makes NumPy raise anything, zipfile's errors among them
        raise _unreadable(path, "NumPy", error) from None


def _unreadable(path: Path, kind: str, reason: object) -> InputError:
    short = " ".join(str(reason).split())[:100]
    return InputError(f"{path}: is not a {kind} file that can be read ({short})")


def _columns(path: Path, arrays: dict[str, Any], averaged: int, wanted: Sequence[str]) -> Table:
    """Return the table of the arrays of one length, a wanted one's or the most frequent, and of a matrix's columns."""
    numbers: dict[str, FloatArray] = {
        name: np.squeeze(given).astype(np.float64)
        for name, given in arrays.items()
        if given.dtype.kind in "fiub" and given.size > 1
    }
    flat: dict[str, FloatArray] = {}
    for name, squeezed in numbers.items():
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
    there = {None, *(understand(name).quantity for name in flat)}
    for name, values in others.items():
        if name in wanted or (understand(name).quantity not in there and len(values) >= FEWEST_SAMPLES):
            raise InputError(f"{path}: {name} has {len(values)} values where the others have {length}")
    values = np.column_stack(list(flat.values()))
    bad = np.argwhere(np.isinf(values))
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{path}, row {row * averaged + 1}: the column {list(flat)[column]} must hold finite numbers,"
            f" got {values[row, column]}"
        )
    return Table(
        tuple("" if "#" in name else name for name in flat),
        values,
        range(1, length * averaged + 1, averaged),
        ("",) * len(flat),
        tuple(range(1, len(flat) + 1)),
        where="row",
        remarks=(f"left out, for their lengths: {', '.join(others)}",) if others else (),
        averaged=averaged,
    )
