"""Archives of model files, within stated sizes."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from motor_classifiers.estimators.cases import Arrays
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_DATA_BYTES, read_file
from motor_env.motor.parameters import require

LARGEST_TEXT_BYTES = 32_000_000
"""Longest JSON text, as its value takes up to forty times the memory."""
_CENTRAL_ENTRY = b"PK\x01\x02"
MOST_MEMBERS = 50_000
"""Most members of an archive; a forest of 200 trees has 600."""


def unpacked(content: bytes) -> dict[str, bytes]:
    """Unpack the members of an archive.

    Raises:
        ValueError: too many or too large members, or another compression than zip's own.
        zipfile.BadZipFile, zlib.error: damaged.
    """
    require(content.count(_CENTRAL_ENTRY) <= MOST_MEMBERS, f"it has more than {MOST_MEMBERS} members")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        methods = {member.compress_type for member in members}
        # The other methods unpack a whole member before its size is looked at.
        require(methods <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}, "it is packed by an unknown method")
        require(
            sum(member.file_size for member in members) <= LARGEST_DATA_BYTES,
            f"it unpacks to more than {LARGEST_DATA_BYTES // 1_000_000} MB",
        )
        return {member.filename: _read(archive, member) for member in members}


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a NumPy archive by name.

    Raises:
        InputError: no such file, too large, or other content.
    """
    content = read_file(path, LARGEST_DATA_BYTES)
    try:
        return {
            name.removesuffix(".npy"): np.lib.format.read_array(io.BytesIO(member), allow_pickle=False)
            for name, member in unpacked(content).items()
        }
    except Exception as error:  # noqa: BLE001  # a damaged file makes NumPy raise anything
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: is no NumPy archive, or damaged ({reason})") from None


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    with archive.open(member) as file:
        content = file.read(member.file_size)
    require(len(content) == member.file_size, f"{member.filename[:40]!r} is cut short")
    return content


def packed(members: dict[str, bytes]) -> bytes:
    """Return an uncompressed archive of members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def parsed(text: bytes | str, **options: Any) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: too long, no JSON, or not a number.
        RecursionError: too deep.
    """
    require(len(text) <= LARGEST_TEXT_BYTES, f"a text is longer than {LARGEST_TEXT_BYTES // 1_000_000} MB")
    return json.loads(text, parse_constant=_no_number, **options)


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def digest(head: str, arrays: Arrays) -> str:
    """Return the SHA-256 of a head and of arrays with their names, types and shapes."""
    total = hashlib.sha256(head.encode())
    for name, values in sorted(arrays.items()):
        total.update(f"\n{name} {values.dtype.str} {values.shape}\n".encode())
        total.update(np.ascontiguousarray(values).tobytes())
    return total.hexdigest()
