"""The manifest of a data set, `dataset.json`: recipe, seed, and every file with its size and digest.

A data set is a folder, on a disk or object storage: the manifest, the card `README.md`, and Parquet files
`data/<split>-<shard>.parquet`. The manifest is written last, when the data set is complete.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from motor_env.common.arrays import shown
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_DATA_BYTES, read_file, read_json
from motor_env.motor.parameters import require
from motor_env.simulation.named_recipes import recipe_from_dict, recipe_to_dict
from motor_env.simulation.recipes import Recipe

if TYPE_CHECKING:
    from upath import UPath


Folder: TypeAlias = "Path | UPath"


@contextmanager
def whole_file(target: Folder) -> Iterator[Path]:
    """Yield a local file; it becomes `target` if the block ends without an error.

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
    """Return the folder of a path or a URL such as `s3://bucket/prefix`; `file://` is a local folder.

    Raises:
        InputError: unknown protocol, missing package, or no answer of the storage.
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


FORMAT = "motor-datasets"
FORMAT_VERSION = 1
MANIFEST = "dataset.json"


LARGEST_MANIFEST_BYTES = 2**28
"""Largest manifest: that of a million files."""
_FILE_NAME = re.compile(r"data/(train|validation|test|shift_\w+)-\d{6}\.parquet")


@dataclass(frozen=True, slots=True)
class Entry:
    """File of a data set: name, size and digest."""

    path: str
    split: str
    rows: int
    bytes: int
    sha256: str

    def __post_init__(self) -> None:
        name = _FILE_NAME.fullmatch(self.path)
        require(name is not None, f"path must be data/SPLIT-NUMBER.parquet, got {self.path[:80]!r}")
        require(
            name is not None and name[1] == self.split,
            f"{self.path} must be of its split, got {self.split!r}",
        )
        for count in (self.rows, self.bytes):
            require(
                type(count) is int and 1 <= count <= LARGEST_DATA_BYTES,
                f"rows and bytes of {self.path} must be in 1 .. {LARGEST_DATA_BYTES}, got {count!r}",
            )
        require(
            re.fullmatch("[0-9a-f]{64}", self.sha256) is not None,
            f"sha256 of {self.path} must be 64 hexadecimal digits",
        )


@dataclass(frozen=True, slots=True)
class Manifest:
    """Manifest of a data set."""

    recipe: Recipe
    seed: int
    cases: int
    files: tuple[Entry, ...]

    def __post_init__(self) -> None:
        for name, number in (("seed", self.seed), ("cases", self.cases)):
            require(
                type(number) is int and 0 <= number < 2**64,
                f"{name} must be in 0 .. 2^64 - 1, got {number!r}",
            )
        paths = [entry.path for entry in self.files]
        require(len(set(paths)) == len(paths), "no file may be named twice")

    @property
    def bytes(self) -> int:
        """Bytes of all files."""
        return sum(entry.bytes for entry in self.files)

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits that have cases, shifts among them."""
        return tuple(dict.fromkeys(entry.split for entry in self.files))

    def as_text(self) -> str:
        """Return the content of `dataset.json`."""
        content = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "recipe": recipe_to_dict(self.recipe),
            "seed": self.seed,
            "cases": self.cases,
            "files": [asdict(entry) for entry in self.files],
        }
        return json.dumps(content, indent=1) + "\n"


def read_manifest(folder: Folder) -> Manifest:
    """Read the manifest of a data set.

    Raises:
        InputError: no data set, or one of another kind.
    """
    path = folder / MANIFEST
    content = read_json(path, LARGEST_MANIFEST_BYTES, "no such file; its folder is no data set")
    try:
        require(content["format"] == FORMAT, f"format must be {FORMAT}, got {content['format']!r}")
        version = content["version"]
        require(version == FORMAT_VERSION, f"version must be {FORMAT_VERSION}, got {version!r}")
        files = tuple(Entry(**entry) for entry in content["files"])
        return Manifest(recipe_from_dict(content["recipe"]), content["seed"], content["cases"], files)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} cannot be read as a data set's manifest: {error}") from error


def whole_content(folder: Folder, entry: Entry) -> bytes:
    """Read a file and check it against its digest.

    Raises:
        InputError: it is missing, unreadable, or has another digest.
    """
    path = folder / entry.path
    content = read_file(path, LARGEST_DATA_BYTES, "is missing")
    if hashlib.sha256(content).hexdigest() != entry.sha256:
        raise InputError(f"{path}: is damaged, its digest is not that of the manifest")
    return content


def defect(folder: Folder, entry: Entry) -> str:
    """Describe the defect of a file in a sentence; empty without one."""
    try:
        whole_content(folder, entry)
    except InputError as error:
        return str(error).removeprefix(f"{folder}/")
    return ""


def problems(folder: Folder) -> list[str]:
    """List a sentence for each file that is missing, damaged or foreign.

    Raises:
        InputError: no data set.
    """
    manifest = read_manifest(folder)
    defects = [defect(folder, entry) for entry in manifest.files]
    known = {entry.path for entry in manifest.files}
    present = {f"data/{path.name}" for path in (folder / "data").glob("*")}
    defects += [f"{name} is foreign: the manifest does not name it" for name in sorted(present - known)]
    return list(filter(None, defects))
