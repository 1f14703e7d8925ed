"""Arrays out of binary files: MATLAB, NumPy, Parquet. None of them may run code.

Compiled parsers of involved formats crash on some damaged files, and a small file may unpack to gigabytes: MATLAB and
Parquet are parsed in a process of their own (`array_parser`), with limits of memory and time.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.errors import InputError, require_extra
from motor_env.recordings import array_parser

BINARY = (".mat", ".npy", ".npz", ".parquet", ".pq")
_PARQUET = (".parquet", ".pq")
_SECONDS = 30.0
_SINGLE = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}


def is_parquet(path: Path) -> bool:
    """Whether a file is Parquet by its ending: of any length, for it is read in pieces."""
    return path.suffix.lower() in _PARQUET


def read_parquet(path: Path) -> tuple[dict[str, Any], int]:
    """Columns of a Parquet file by name, and how many of its rows are averaged to one.

    Raises:
        InputError: it is not what its ending says, or unpacks to more than can be read.
    """
    require_extra("pyarrow", "datasets")
    return _parsed_elsewhere(path, b"", "Parquet", str(path))


def read_arrays(path: Path, content: bytes) -> dict[str, Any] | None:
    """Arrays of a binary file by name; None where its ending is that of no such file.

    Raises:
        InputError: it is not what its ending says, or unpacks to more than can be read.
    """
    match path.suffix.lower():
        case ".mat":
            if content[:19] == b"MATLAB 7.3 MAT-file":
                raise _unreadable(path, "MATLAB", "it is of version 7.3; save it with -v7")
            return _parsed_elsewhere(path, content, "MATLAB")[0]
        case ".npy" | ".npz":
            return _numpy(path, content)
    return None


def _parsed_elsewhere(path: Path, content: bytes, kind: str, *more: str) -> tuple[dict[str, Any], int]:
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
        crash = f"its parser crashed with status {done.returncode}"
        words = done.stderr.decode(errors="replace").strip().splitlines() if done.returncode == 1 else []
        raise _unreadable(path, kind, words[-1] if words else crash)
    end = done.stdout.index(b"\n") + 1
    averaged, shapes = json.loads(done.stdout[:end])
    arrays, begin = {}, end
    for name, shape in shapes:
        size = int(np.prod(shape))
        arrays[name] = np.frombuffer(done.stdout[begin : begin + 8 * size], np.float64).reshape(shape)
        begin += 8 * size
    return arrays, averaged


def _numpy(path: Path, content: bytes) -> dict[str, Any]:
    try:
        if content[:2] == b"PK":
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                array_parser.check_count(sum(member.file_size for member in archive.infolist()) // 8)
        loaded = np.load(io.BytesIO(content), allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            return {name: loaded[name] for name in loaded.files}
        return (
            {name: loaded[name] for name in loaded.dtype.names} if loaded.dtype.names else {"array": loaded}
        )
    except Exception as error:  # noqa: BLE001  # a damaged file makes NumPy raise anything, zipfile's errors among them
        raise _unreadable(path, "NumPy", error) from None


def _unreadable(path: Path, kind: str, reason: object) -> InputError:
    short = " ".join(str(reason).split())[:100]
    return InputError(f"{path}: is not a {kind} file that can be read ({short})")
