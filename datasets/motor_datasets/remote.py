"""Where data sets lie: a local folder, or a URL such as `s3://bucket/prefix` by universal_pathlib and fsspec."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from motor_env.common.arrays import shown
from motor_env.common.errors import InputError
from motor_env.motor.parameters import require

if TYPE_CHECKING:
    from upath import UPath

Folder: TypeAlias = "Path | UPath"


@contextmanager
def whole_file(target: Folder) -> Iterator[Path]:
    """A local file to write, which appears as `target` when the block ends well, whole or not at all.

    Raises:
        InputError: the storage is read only.
    """
    if isinstance(target, Path):
        temporary = target.with_name(f".{target.name}.partial")
        try:
            yield temporary
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
        return
    with tempfile.TemporaryDirectory() as folder:
        local = Path(folder) / target.name
        yield local
        try:
            target.fs.put_file(str(local), target.path)
        except NotImplementedError:
            raise InputError(f"{target} cannot be written: its file system is read only") from None


def folder_of(where: str | Folder) -> Folder:
    """The folder that a plain path or a URL such as `s3://bucket/prefix` names; `file://` is a local folder.

    Raises:
        InputError: no such protocol, the package for it is not installed, or the storage does not answer.
    """
    if not isinstance(where, str):
        require(hasattr(where, "iterdir"), f"the folder must be a path or a URL, got {shown(where)}")
        return where
    if "://" not in where:
        return Path(where)
    try:
        from upath import UPath

        folder = UPath(where)
        if folder.protocol in ("file", "local"):
            return Path(folder.path)
        filesystem = folder.fs
    except (ImportError, ValueError) as error:
        raise InputError(f"{where} cannot be used: {' '.join(str(error).split())}") from error
    filesystem.invalidate_cache()  # another process may have written since
    try:
        folder.exists()
    except Exception as error:  # no credentials, no network: drivers' errors have no common base
        raise InputError(f"{where} cannot be reached: {' '.join(str(error).split())}") from error
    return folder
