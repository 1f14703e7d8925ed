"""The manifest of a data set, `dataset.json`: recipe, seed, and every file with its size and digest.

A data set is a folder, on a disk or on object storage: the manifest, the card `README.md`, and Parquet files
`data/<split>-<shard>.parquet`. The manifest is written last: where it stands, the data set is complete.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass

from motor_datasets.remote import Folder
from motor_env.errors import InputError
from motor_env.motor.parameters import require
from motor_env.simulation.recipe_files import recipe_from_dict, recipe_to_dict
from motor_env.simulation.recipes import Recipe

FORMAT = "motor-datasets"
FORMAT_VERSION = 1
MANIFEST = "dataset.json"


@dataclass(frozen=True, slots=True)
class Entry:
    """A written file."""

    path: str
    split: str
    rows: int
    bytes: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a data set holds."""

    recipe: Recipe
    seed: int
    cases: int
    files: tuple[Entry, ...]

    @property
    def bytes(self) -> int:
        """Bytes of all files."""
        return sum(entry.bytes for entry in self.files)

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits that have cases, shifts among them."""
        return tuple(dict.fromkeys(entry.split for entry in self.files))

    def as_text(self) -> str:
        """The content of `dataset.json`."""
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
    """The manifest of a data set.

    Raises:
        InputError: no data set there, or one of another kind.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(f"{folder} is no data set: it has no {MANIFEST}")
    try:
        content = json.loads(path.read_text())
        require(content["format"] == FORMAT, f"format must be {FORMAT}, got {content['format']!r}")
        version = content["version"]
        require(version == FORMAT_VERSION, f"version must be {FORMAT_VERSION}, got {version!r}")
        files = tuple(Entry(**entry) for entry in content["files"])
        return Manifest(recipe_from_dict(content["recipe"]), content["seed"], content["cases"], files)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a data set's manifest: {error}") from error


def size_and_digest(path: Folder) -> tuple[int, str]:
    """Bytes of a file, and their SHA-256."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return stream.seek(0, os.SEEK_END), digest


def problems(folder: Folder) -> list[str]:
    """One sentence for each file that is missing, damaged or foreign.

    Raises:
        InputError: no data set there.
    """
    manifest = read_manifest(folder)
    defects = []
    for entry in manifest.files:
        path = folder / entry.path
        if not path.is_file():
            defects.append(f"{entry.path} is missing")
        elif size_and_digest(path) != (entry.bytes, entry.sha256):
            defects.append(f"{entry.path} is damaged: its digest is not that of the manifest")
    known = {entry.path for entry in manifest.files}
    present = {f"data/{path.name}" for path in (folder / "data").glob("*")}
    return defects + [f"{name} is foreign: the manifest does not name it" for name in sorted(present - known)]
