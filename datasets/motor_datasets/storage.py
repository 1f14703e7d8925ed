"""Data sets on disk: the only place that reads or writes them.

A data set is a folder: `dataset.json` (the manifest: recipe, seed, every file with its digest) and Parquet files
`data/<split>-<shard>.parquet`. A channel is a column of fixed-size lists of float32, one row a case; recipe and seed
also stand in the metadata of each file. The manifest is written last and files appear whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from motor_datasets.arrays import PARAMETERS, Dataset
from motor_datasets.splits import Split, split_of
from motor_env.console import InputError
from motor_env.parameters import Channel, require
from motor_env.recipe_file import recipe_from_dict, recipe_to_dict
from motor_env.recipes import Recipe

FORMAT = "motor-datasets"
FORMAT_VERSION = 1
MANIFEST = "dataset.json"
COLUMN_OF_CHANNEL = {Channel.CURRENT: "current_a", Channel.SPEED: "speed_rad_s"}

_SHARD_BYTES = 64 * 2**20
_ROW_GROUP_BYTES = 8 * 2**20


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One Parquet file: the cases `begin` .. `end` - 1 whose motors belong to `split`."""

    path: str
    split: str
    begin: int
    end: int
    seed: int

    @property
    def case_id(self) -> NDArray[np.int64]:
        """Case numbers of the file."""
        cases = np.arange(self.begin, self.end)
        mine: NDArray[np.int64] = cases[split_of(self.seed, cases) == self.split]
        return mine


@dataclass(frozen=True, slots=True)
class Plan:
    """What will be written where; follows from recipe, seed and number of cases alone."""

    recipe: Recipe
    seed: int
    cases: int
    files: tuple[PlannedFile, ...]

    @property
    def bytes_uncompressed(self) -> int:
        """Bytes of all samples and labels before compression."""
        return self.cases * bytes_of_case(self.recipe)


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


def bytes_of_case(recipe: Recipe) -> int:
    """Bytes of one case before compression."""
    return 4 * len(recipe.sensor.channels) * recipe.timing.n_samples + 8 * (len(PARAMETERS) + 4)


def make_plan(recipe: Recipe, cases: int, seed: int) -> Plan:
    """Lay the cases out over files.

    Raises:
        ValueError: fewer than one case, or a seed out of range.
    """
    require(cases >= 1, f"cases must be >= 1, got {cases}")
    require(0 <= seed < 2**64, f"seed must be in 0 .. 2^64 - 1, got {seed}")
    per_shard = max(1, _SHARD_BYTES // bytes_of_case(recipe))
    files = []
    for shard, begin in enumerate(range(0, cases, per_shard)):
        for split in Split:
            file = PlannedFile(
                f"data/{split}-{shard:06d}.parquet", str(split), begin, min(begin + per_shard, cases), seed
            )
            if len(file.case_id):
                files.append(file)
    return Plan(recipe, seed, cases, tuple(files))


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder under a temporary name, which becomes `out` when the block ends well and vanishes otherwise.

    Raises:
        InputError: `out` is there and is not an empty folder.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out} exists already and is not overwritten: give another folder, or remove it")
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        (temporary / "data").mkdir()
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        temporary.replace(out)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


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
        **dict.fromkeys(PARAMETERS, pa.float64()),
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
            values, indices = np.unique(getattr(dataset, field.name), return_inverse=True)
            arrays.append(
                pa.DictionaryArray.from_arrays(
                    indices.astype(np.int16), pa.array(values.tolist(), pa.string())
                )
            )
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


def write_file(folder: Path, file: PlannedFile, dataset: Dataset) -> Entry:
    """Write one file of a data set: it appears whole, under its name, or not at all."""
    target = folder / file.path
    temporary = target.with_name(f".{target.name}.partial")
    write_table(to_table(dataset), temporary)
    with temporary.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    size = temporary.stat().st_size
    temporary.replace(target)
    return Entry(file.path, file.split, len(dataset), size, digest)


def write_manifest(folder: Path, plan: Plan, entries: Sequence[Entry]) -> Manifest:
    """Write the manifest: with it the data set is complete."""
    content = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "recipe": recipe_to_dict(plan.recipe),
        "seed": plan.seed,
        "cases": plan.cases,
        "files": [asdict(entry) for entry in entries],
    }
    temporary = folder / f".{MANIFEST}.partial"
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(folder / MANIFEST)
    return Manifest(plan.recipe, plan.seed, plan.cases, tuple(entries))


def read_manifest(folder: Path) -> Manifest:
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


def read_files(folder: Path, manifest: Manifest, split: str | None = None) -> Dataset:
    """Read the files of one split, or all, ordered by case.

    Raises:
        InputError: a file is missing or cannot be read, or the split is unknown or empty.
    """
    if split is not None and split not in list(Split):
        raise InputError(f"split must be one of {', '.join(Split)}, got {split!r}")
    entries = [entry for entry in manifest.files if split in (None, entry.split)]
    if not entries:
        raise InputError(f"{folder} holds no case of split {split}")
    tables = [_read_table(folder / entry.path) for entry in entries]
    rows = sum(len(table) for table in tables)
    recipe = manifest.recipe
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
        parameters={name: values.pop(name) for name in PARAMETERS},
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


def _read_table(path: Path) -> pa.Table:
    if not path.is_file():
        raise InputError(f"{path} is missing")
    try:
        return pq.read_table(path)
    except pa.ArrowInvalid as error:
        raise InputError(f"{path} cannot be read: {error}") from error
