"""Data sets on object storage: the few operations of `pathlib.Path` that storing and reading need, by fsspec."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from motor_env.errors import InputError


@dataclass(frozen=True, slots=True)
class RemotePath:
    """An object, or a prefix of objects, named like a path.

    Attributes:
        filesystem: fsspec's.
        path: key of the object within the file system.
    """

    filesystem: Any
    path: str

    def __str__(self) -> str:
        return str(self.filesystem.unstrip_protocol(self.path))

    def __truediv__(self, name: str) -> RemotePath:
        return RemotePath(self.filesystem, f"{self.path.rstrip('/')}/{name}")

    @property
    def name(self) -> str:
        """Last part of the key."""
        return self.path.rstrip("/").rpartition("/")[2]

    @property
    def shared(self) -> bool:
        """Whether other processes see it; memory:// is of one process."""
        return "memory" not in _protocols(self.filesystem)

    def exists(self) -> bool:
        """Whether there is an object of this name, or any below it."""
        return bool(self.filesystem.exists(self.path))

    def is_dir(self) -> bool:
        """Whether there are objects below it."""
        return bool(self.filesystem.isdir(self.path))

    def is_file(self) -> bool:
        """Whether there is an object of this name."""
        return bool(self.filesystem.isfile(self.path))

    def iterdir(self) -> Iterator[RemotePath]:
        """What is directly below."""
        for name in self.filesystem.ls(self.path, detail=False):
            yield RemotePath(self.filesystem, name)

    def glob(self, pattern: str) -> Iterator[RemotePath]:
        """What matches the pattern."""
        for name in self.filesystem.glob(f"{self.path.rstrip('/')}/{pattern}"):
            yield RemotePath(self.filesystem, name)

    def open(self, mode: str) -> Any:
        """A stream of its bytes."""
        return self.filesystem.open(self.path, mode)

    def mkdir(self, **_: bool) -> None:
        """Object storage has no folders."""

    def read_text(self) -> str:
        """The content of a text object."""
        return bytes(self.filesystem.cat_file(self.path)).decode()

    def upload(self, local: Path) -> None:
        """Put a local file; on object storage it appears whole or not at all.

        Raises:
            InputError: the file system is read only.
        """
        try:
            self.filesystem.put_file(str(local), self.path)
        except NotImplementedError:
            raise InputError(f"{self} cannot be written: its file system is read only") from None

    def unlink(self, *, missing_ok: bool) -> None:
        """Remove the object."""
        if not missing_ok or self.is_file():
            self.filesystem.rm_file(self.path)


Folder = Path | RemotePath


@contextmanager
def whole_file(target: Folder) -> Iterator[Path]:
    """A local file to write, which appears as `target` when the block ends well, whole or not at all."""
    if isinstance(target, RemotePath):
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder) / target.name
            yield local
            target.upload(local)
        return
    temporary = target.with_name(f".{target.name}.partial")
    try:
        yield temporary
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def folder_of(where: str | Path | RemotePath) -> Folder:
    """The folder that a plain path or a URL such as `s3://bucket/prefix` names; `file://` is a local folder.

    Raises:
        InputError: no such protocol, the package for it is not installed, or the storage does not answer.
    """
    if not isinstance(where, str) or "://" not in where:
        return where if isinstance(where, RemotePath) else Path(where)
    try:
        from fsspec.core import url_to_fs

        filesystem, path = url_to_fs(where)
    except (ImportError, ValueError) as error:
        raise InputError(f"{where} cannot be used: {' '.join(str(error).split())}") from error
    if "file" in _protocols(filesystem):
        return Path(path)
    filesystem.invalidate_cache()  # another process may have written since
    try:
        filesystem.exists(path)
    except Exception as error:  # no credentials, no network: drivers' errors have no common base
        raise InputError(f"{where} cannot be reached: {' '.join(str(error).split())}") from error
    return RemotePath(filesystem, path)


def _protocols(filesystem: Any) -> tuple[str, ...]:
    names = filesystem.protocol
    return (names,) if isinstance(names, str) else tuple(names)
