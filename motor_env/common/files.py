"""Safe files: read only regular ones up to a size; write whole or not at all."""

from __future__ import annotations

import json
import multiprocessing
import os
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, Protocol

from motor_env.common.errors import InputError


def end_with_parent() -> None:
    """End this worker process when its parent ends, even if killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        sentinel: int | None = getattr(parent, "sentinel", None)

        def watch() -> None:
            # Workers of joblib have no sentinel to wait for, and their parent may be gone already; those of a fork
            # server have another process above them.
            while sentinel is None and os.getppid() == parent.pid:
                time.sleep(0.2)
            if sentinel is not None:
                parent.join()
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()


LARGEST_NOTE_BYTES = 1_000_000
"""Largest file written by hand, or note about files: motors, recipes, cards, seeds, methods."""
LARGEST_TABLE_BYTES = 20_000_000
"""Largest table: estimates, answers, verdicts, scores, states."""
LARGEST_DATA_BYTES = 200_000_000
"""Largest recording, model, or file of a data set."""


class Readable(Protocol):
    """Local path, or one of a storage."""

    def stat(self) -> Any:
        """Return kind and size."""

    def open(self, mode: Literal["rb"]) -> Any:
        """Open it as bytes."""


def read_file(path: Readable, largest_bytes: int, missing: str = "no such file") -> bytes:
    """Read a regular file that is not too large, never a device or a pipe.

    Args:
        path: of the file.
        largest_bytes: limit of its size.
        missing: message if there is none.

    Raises:
        InputError: no such file, not a regular one, too large, or unreadable.
    """
    try:
        status = path.stat()
        regular, size, content = stat.S_ISREG(status.st_mode), status.st_size, b""
        # What the system makes up while it is read has no size, and may never end.
        if regular and 0 < size <= largest_bytes:
            with path.open("rb") as file:
                content = bytes(file.read(largest_bytes + 1))
    except FileNotFoundError:
        raise InputError(f"{path}: {missing}") from None
    except (OSError, ValueError) as error:  # a path with a null character, too
        reason = (error.strerror or str(error)).lower() if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read ({reason})") from None
    if not regular:
        raise InputError(f"{path}: is no regular file")
    if max(size, len(content)) > largest_bytes:
        raise InputError(f"{path}: is larger than {largest_bytes / 1e6:g} MB")
    return content


def read_json(path: Readable, largest_bytes: int, missing: str = "no such file") -> Any:
    """Read a file of JSON; see `read_file`.

    Raises:
        InputError: it is unreadable, or not JSON.
    """
    content = read_file(path, largest_bytes, missing)
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:  # no text, or numbers of too many digits, too
        reason = "nested too deep" if isinstance(error, RecursionError) else error
        raise InputError(f"{path}: is not JSON ({reason})") from None


def require_own_output(folder: Path, name: str, mark: str, *, command: str) -> None:
    """Refuse a folder unless it is empty or an earlier output of the same command, as a mark in a file shows.

    Raises:
        InputError: it holds other files.
    """
    try:
        free = not folder.exists() or not any(folder.iterdir())
        ours = free or mark.encode() in read_file(folder / name, LARGEST_NOTE_BYTES)
    except (OSError, InputError):
        ours = False
    if not ours:
        words = f"is there, and {command} did not make it; give a new or empty folder"
        raise InputError(f"{folder}: {words}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path; it becomes `path` if the block ends without an error, else it is removed.

    Raises:
        InputError: the folder cannot be made or written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({(error.strerror or str(error)).lower()})") from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({(error.strerror or str(error)).lower()})") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole.

    Raises:
        InputError: the file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; its files move to `folder` if the block ends without an error.

    Raises:
        InputError: the folder cannot be made or written.
    """
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".unfinished-") as name:
            yield Path(name)
            _move_into(folder, Path(name))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({(error.strerror or str(error)).lower()})") from None
    finally:
        if is_new:
            with suppress(OSError):  # it is not empty, or was not made
                folder.rmdir()


def _move_into(folder: Path, source: Path) -> None:
    for file in sorted(source.iterdir()):
        target = folder / file.name
        if file.is_dir() and target.is_dir():
            _move_into(target, file)
        else:
            file.replace(target)


def write_examples(folder: Path) -> list[Path]:
    """Copy the package's examples (in a clone: the folder beside it); return their paths."""
    package = Path(__file__).parents[1]
    source = next(each for each in (package / "examples", package.parent / "examples") if each.is_dir())
    written = []
    for file in sorted(source.glob("*.*")):
        target = folder / file.name
        if not target.exists():
            write_text(target, file.read_text(encoding="utf-8"))
            written.append(target)
    return written
