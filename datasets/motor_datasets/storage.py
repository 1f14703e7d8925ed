"""Data sets on disk: the only place that reads or writes them.

A data set is a folder: `dataset.json` (the manifest: recipe, seed, every file with its digest) and Parquet files
`data/<split>-<shard>.parquet`. A channel is a column of fixed-size lists of float32, one row a case; recipe and seed
also stand in the metadata of each file. The manifest is written last and files appear whole or not at all.
A folder is a local path, or a prefix on object storage (`remote`); there a file is made locally and then put.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from motor_datasets.arrays import Dataset, parameter_names
from motor_datasets.card import data_card
from motor_datasets.layout import Plan, PlannedFile
from motor_datasets.remote import Folder, RemotePath
from motor_datasets.splits import Split
from motor_env.errors import InputError
from motor_env.motor.parameters import Channel, require
from motor_env.simulation.recipe_files import recipe_from_dict, recipe_to_dict
from motor_env.simulation.recipes import Recipe

FORMAT = "motor-datasets"
FORMAT_VERSION = 1
MANIFEST = "dataset.json"
CARD = "README.md"
COLUMN_OF_CHANNEL = {Channel.CURRENT: "current_a", Channel.SPEED: "speed_rad_s"}

UNFINISHED = "unfinished.json"
_ROW_GROUP_BYTES = 8 * 2**20


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


def open_folder(out: Folder, plan: Plan, *, resume: bool) -> Manifest | None:
    """Make or reopen the folder of a data set; the manifest, if it is finished already.

    A note `unfinished.json` says what is being made; it goes when the manifest comes.

    Raises:
        InputError: the folder holds something that is not overwritten.
    """
    note = out / UNFINISHED
    wanted = (
        json.dumps({"recipe": recipe_to_dict(plan.recipe), "seed": plan.seed, "cases": plan.cases}) + "\n"
    )
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        _make_folders(out)
        _write_whole(note, wanted.encode())
        return None
    if not resume:
        hint = "add --resume to finish it" if note.is_file() else "give another folder, or remove it"
        raise InputError(f"{out} exists already and is not overwritten: {hint}")
    if (out / MANIFEST).is_file():
        manifest = read_manifest(out)
        if (manifest.recipe, manifest.seed, manifest.cases) != (plan.recipe, plan.seed, plan.cases):
            raise InputError(f"{out} holds another data set and is not overwritten: give another folder")
        _remove(note)
        return manifest
    # Killed before the note was whole: the folder holds nothing but its beginnings.
    names = {path.name for path in out.iterdir()}
    only_begun = names <= {"data", f".{UNFINISHED}.partial"} and not any((out / "data").glob("*"))
    if not only_begun and (not note.is_file() or note.read_text() != wanted):
        raise InputError(f"{out} holds something other than this data set unfinished, and is not touched")
    _make_folders(out)
    _write_whole(note, wanted.encode())
    if isinstance(out, Path):
        for partial in out.rglob(".*.partial"):
            partial.unlink()
    return None


def _make_folders(out: Folder) -> None:
    if isinstance(out, Path):  # object storage has none
        (out / "data").mkdir(parents=True, exist_ok=True)


def _remove(path: Folder) -> None:
    if isinstance(path, RemotePath):
        path.unlink()
    else:
        path.unlink(missing_ok=True)


def _write_whole(path: Folder, content: bytes) -> None:
    if isinstance(path, RemotePath):
        path.write_bytes(content)
        return
    temporary = path.with_name(f".{path.name}.partial")
    with temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)


def _open(path: Folder) -> Any:
    return path.open() if isinstance(path, RemotePath) else path.open("rb")


def _size(path: Folder) -> int:
    return path.size() if isinstance(path, RemotePath) else path.stat().st_size


def _digest(path: Folder) -> str:
    with _open(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def existing_entry(folder: Folder, file: PlannedFile) -> Entry | None:
    """The file that an interrupted generation left whole; None if there is none."""
    path = folder / file.path
    if not path.is_file():
        return None
    try:
        with _open(path) as stream:
            rows = pq.read_metadata(stream).num_rows
    except pa.ArrowInvalid:
        return None
    return Entry(file.path, file.split, rows, _size(path), _digest(path))


def finish_folder(folder: Folder, plan: Plan, entries: Sequence[Entry]) -> Manifest:
    """Write the card and then the manifest: with it the data set is complete."""
    manifest = Manifest(plan.recipe, plan.seed, plan.cases, tuple(entries))
    content = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "recipe": recipe_to_dict(plan.recipe),
        "seed": plan.seed,
        "cases": plan.cases,
        "files": [asdict(entry) for entry in entries],
    }
    _write_whole(folder / CARD, data_card(manifest).encode())
    _write_whole(folder / MANIFEST, (json.dumps(content, indent=1) + "\n").encode())
    _remove(folder / UNFINISHED)
    return manifest


def problems(folder: Folder) -> list[str]:
    """One sentence for each file that is missing, damaged or foreign.

    Raises:
        InputError: no data set there.
    """
    manifest = read_manifest(folder)
    found = []
    for entry in manifest.files:
        path = folder / entry.path
        if not path.is_file():
            found.append(f"{entry.path} is missing")
        elif _size(path) != entry.bytes or _digest(path) != entry.sha256:
            found.append(f"{entry.path} is damaged: its digest is not that of the manifest")
    known = {entry.path for entry in manifest.files}
    present = {f"data/{path.name}" for path in (folder / "data").glob("*")}
    found += [f"{name} is foreign: the manifest does not name it" for name in sorted(present - known)]
    return found


def _schema(recipe: Recipe, seed: int) -> pa.Schema:
    sample = pa.field("element", pa.float32(), nullable=False)
    text = pa.dictionary(pa.int16(), pa.string())
    columns = {
        "case_id": pa.int64(),
        "motor_id": pa.int64(),
        "split": text,
        "class_name": text,
        "class_index": pa.int64(),
        "kind": text,
        "severity": pa.float64(),
        **dict.fromkeys(parameter_names(recipe), pa.float64()),
        **{
            COLUMN_OF_CHANNEL[channel]: pa.list_(sample, recipe.timing.n_samples)
            for channel in recipe.sensor.channels
        },
    }
    metadata = {
        FORMAT: json.dumps({"version": FORMAT_VERSION, "seed": seed, "recipe": recipe_to_dict(recipe)})
    }
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in columns.items()], metadata)


def to_table(dataset: Dataset) -> pa.Table:
    """The data set as an Arrow table, samples as fixed-size lists."""
    schema = _schema(dataset.recipe, dataset.seed)
    labels = {name: getattr(dataset, name) for name in ("case_id", "motor_id", "class_index", "severity")}
    columns: dict[str, Any] = {**labels, **dataset.parameters}
    arrays = []
    samples = {COLUMN_OF_CHANNEL[channel]: n for n, channel in enumerate(dataset.recipe.sensor.channels)}
    for field in schema:
        if field.name in samples:
            flat = pa.array(np.ascontiguousarray(dataset.X[:, samples[field.name]]).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        elif pa.types.is_dictionary(field.type):
            arrays.append(pa.array(getattr(dataset, field.name)).dictionary_encode().cast(field.type))
        else:
            arrays.append(pa.array(columns[field.name], field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table as the data sets' Parquet: zstd 1, samples split by byte, dictionaries for labels only."""
    samples = [
        f"{field.name}.list.element" for field in table.schema if pa.types.is_fixed_size_list(field.type)
    ]
    text = [field.name for field in table.schema if pa.types.is_dictionary(field.type)]
    rows = max(1, _ROW_GROUP_BYTES * max(len(table), 1) // max(table.nbytes, 1))
    pq.write_table(
        table,
        path,
        row_group_size=rows,
        compression="zstd",
        compression_level=1,
        use_dictionary=text,
        use_byte_stream_split=samples,
        write_statistics=False,
    )


def write_file(folder: Folder, file: PlannedFile, dataset: Dataset) -> Entry:
    """Write one file of a data set: it appears whole, under its name, or not at all.

    Raises:
        InputError: it cannot be written, the disk is full for example.
    """
    if isinstance(folder, RemotePath):
        with tempfile.TemporaryDirectory() as name:
            local = Path(name)
            _make_folders(local)
            entry = write_file(local, file, dataset)
            (folder / file.path).upload(local / file.path)
        return entry
    target = folder / file.path
    temporary = target.with_name(f".{target.name}.partial")
    dataset = replace(dataset, split=np.full(len(dataset), file.split))
    try:
        write_table(to_table(dataset), temporary)
        digest, size = _digest(temporary), temporary.stat().st_size
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            why = (os.strerror(error.errno) if error.errno else str(error)).lower()
            raise InputError(f"{target} cannot be written: {why}; what is whole stays, resume it") from error
        raise
    return Entry(file.path, file.split, len(dataset), size, digest)


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
        require(
            content["version"] == FORMAT_VERSION,
            f"version must be {FORMAT_VERSION}, got {content['version']!r}",
        )
        files = tuple(Entry(**entry) for entry in content["files"])
        return Manifest(recipe_from_dict(content["recipe"]), content["seed"], content["cases"], files)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} cannot be read as a data set's manifest: {error}") from error


def read_files(folder: Folder, manifest: Manifest, split: str | None = None) -> Dataset:
    """Read the files of one split, or train, validation and test, ordered by case.

    Raises:
        InputError: a file is missing or cannot be read, or the split is unknown or empty.
    """
    if split is not None and split not in (*Split, *manifest.splits):
        raise InputError(f"split must be one of {', '.join(manifest.splits)}, got {split!r}")
    wanted = set(Split) if split is None else {split}
    entries = [entry for entry in manifest.files if entry.split in wanted]
    if not entries:
        raise InputError(f"{folder} holds no case of split {split}")
    tables = [_read_table(folder / entry.path) for entry in entries]
    rows = sum(len(table) for table in tables)
    recipe = manifest.recipe
    if split is not None and split.startswith("shift_"):
        recipe = recipe.shifted(split.removeprefix("shift_"))
    X = np.empty((rows, len(recipe.sensor.channels), recipe.timing.n_samples), dtype=np.float32)
    labels = pa.concat_tables(
        table.drop_columns([COLUMN_OF_CHANNEL[c] for c in recipe.sensor.channels]) for table in tables
    )
    row = 0
    for table in tables:
        for n, channel in enumerate(recipe.sensor.channels):
            column = table.column(COLUMN_OF_CHANNEL[channel]).combine_chunks()
            X[row : row + len(table), n] = column.flatten().to_numpy().reshape(len(table), -1)
        row += len(table)
    values = {name: _column(labels, name) for name in labels.column_names}
    dataset = Dataset(
        X=X,
        parameters={name: values.pop(name) for name in parameter_names(recipe)},
        recipe=recipe,
        seed=manifest.seed,
        **values,
    )
    order = np.argsort(dataset.case_id, kind="stable")
    return dataset if (np.diff(order) == 1).all() else dataset.select(order)


def _column(table: pa.Table, name: str) -> NDArray[Any]:
    column = table.column(name).combine_chunks()
    if pa.types.is_dictionary(column.type):
        return np.array(column.cast(pa.string()).to_pylist())
    values: NDArray[Any] = column.to_numpy()
    return values


def _read_table(path: Folder) -> pa.Table:
    if not path.is_file():
        raise InputError(f"{path} is missing")
    try:
        if isinstance(path, RemotePath):
            with path.open() as stream:
                return pq.read_table(stream)
        return pq.read_table(path)
    except pa.ArrowInvalid as error:
        raise InputError(f"{path} cannot be read: {error}") from error


def seconds_per_case(recipe: Recipe, seed: int) -> float:
    """Time to make and write one case here, measured on a thousand."""
    from motor_datasets.generate import generate_arrays

    count = 1024
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.parquet"
        write_table(to_table(generate_arrays(recipe, seed, 8)), path)  # compiles, or loads what was compiled
        start = time.perf_counter()
        write_table(to_table(generate_arrays(recipe, seed, count)), path)
        return (time.perf_counter() - start) / count
