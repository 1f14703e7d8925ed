"""First fits of a fleet, kept in a file as they come: a fleet that was stopped goes on where it was."""

from __future__ import annotations

import json
import os
from hashlib import sha256
from pathlib import Path
from typing import IO

from pydantic import TypeAdapter

from motor_env.errors import InputError
from motor_env.files import read_file
from motor_env.fleet.first import First, Reading

_MARK = "motor-env fleet"
_LARGEST_BYTES = 2_000_000_000
_FIRST: TypeAdapter[First] = TypeAdapter(First)


class Kept:
    """First fits by file, in memory and, where a path is given, in a file of JSON lines.

    A fit counts only as long as its file has the size and the time that it had, and is read as it was.

    Args:
        path: of the file; None for none.
        reading: how the records are read.

    Raises:
        InputError: the file is another's, or damaged before its last line.
    """

    def __init__(self, path: Path | None, reading: Reading) -> None:
        self.path = path
        self.reading = sha256(repr(reading).encode()).hexdigest()[:16]
        self.found: dict[str, First] = {}
        self.file: IO[str] | None = None
        if path is not None and path.exists():
            self._read(path)

    def _read(self, path: Path) -> None:
        content = bytes(read_file(path, _LARGEST_BYTES))
        *lines, last = content.split(b"\n")
        head = self._head().encode()
        # The first line may have been cut short by the end of the process, too.
        if (lines[0] if lines else head[: len(last)]) != (head if lines else last):
            raise InputError(f"{path}: holds no fits of records that were read like these; give another file")
        for number, line in enumerate(lines[1:], 2):
            try:
                row = json.loads(line)
                self.found[str(row["record"])] = _FIRST.validate_python(row["first"])
            except (ValueError, LookupError, TypeError, RecursionError):
                raise InputError(f"{path}: line {number} is no kept fit; give another file") from None
        if last:
            os.truncate(path, len(content) - len(last))

    def _head(self) -> str:
        return json.dumps({"kept by": _MARK, "reading": self.reading})

    def __enter__(self) -> Kept:
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.file = self.path.open("a", encoding="utf-8")
            if not self.found and self.path.stat().st_size == 0:
                print(self._head(), file=self.file, flush=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self.file is not None:
            self.file.close()

    def __contains__(self, path: Path) -> bool:
        return _record(path) in self.found

    def __getitem__(self, path: Path) -> First:
        return self.found[_record(path)]

    def add(self, path: Path, first: First) -> None:
        """Keep a fit."""
        self.found[_record(path)] = first
        if self.file is not None:
            row = {"record": _record(path), "first": first._asdict()}
            print(json.dumps(row), file=self.file, flush=True)


def _record(path: Path) -> str:
    """A file's name, size and time."""
    try:
        stat = path.stat()
    except OSError:
        return str(path)
    return f"{path} {stat.st_size} {stat.st_mtime_ns}"
