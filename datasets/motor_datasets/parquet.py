"""Parquet files of a data set: a channel is a column of fixed-size lists of float32, one row a case.

Recipe and seed also stand in the metadata of each file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motor_datasets.arrays import COLUMN_OF_CHANNEL, LABELS, Dataset, columns, parameter_names
from motor_datasets.generate import Split, bytes_of_case
from motor_datasets.manifest import FORMAT, FORMAT_VERSION, Entry, Folder, Manifest, whole_content
from motor_env.common.arrays import is_one_of, shown
from motor_env.common.errors import InputError, require_extra
from motor_env.simulation.named_recipes import recipe_to_dict
from motor_env.simulation.recipes import Recipe

require_extra("pyarrow", "datasets")
import pyarrow as pa  # noqa: E402  # the sentence comes first
import pyarrow.parquet as pq  # noqa: E402

_ROW_GROUP_BYTES = 8 * 2**20
_ALWAYS_READ_BYTES = 2**27
_MOST_TIMES = 50  # that data unpack to more than this is no measurement; the recipes' reach 7
_OVERHEAD = 2**20  # headers of pages, dictionaries


def _schema(recipe: Recipe, seed: int) -> pa.Schema:
    sample = pa.field("element", pa.float32(), nullable=False)
    types = {
        "text": pa.dictionary(pa.int16(), pa.string()),
        "whole": pa.int64(),
        "number": pa.float64(),
        "samples": pa.list_(sample, recipe.timing.n_samples),
    }
    metadata = {
        FORMAT: json.dumps({"version": FORMAT_VERSION, "seed": seed, "recipe": recipe_to_dict(recipe)})
    }
    fields = [pa.field(column.name, types[column.kind], nullable=False) for column in columns(recipe)]
    return pa.schema(fields, metadata)


def to_table(dataset: Dataset) -> pa.Table:
    """Return the data set as an Arrow table."""
    schema = _schema(dataset.recipe, dataset.seed)
    values: dict[str, Any] = {name: getattr(dataset, name) for name in LABELS} | dict(dataset.parameters)
    arrays = []
    samples = {COLUMN_OF_CHANNEL[channel]: n for n, channel in enumerate(dataset.recipe.channels)}
    for field in schema:
        if field.name in samples:
            flat = pa.array(np.ascontiguousarray(dataset.X[:, samples[field.name]]).reshape(-1))
            arrays.append(pa.FixedSizeListArray.from_arrays(flat, type=field.type))
        elif pa.types.is_dictionary(field.type):
            arrays.append(pa.array(values[field.name]).dictionary_encode().cast(field.type))
        else:
            arrays.append(pa.array(values[field.name], field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table as Parquet: zstd 1, samples split by byte, dictionaries for labels only."""
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


def read_files(folder: Folder, manifest: Manifest, split: str | None = None) -> Dataset:
    """Read the files of one split, or train, validation and test, ordered by case.

    Raises:
        InputError: a file is missing or unreadable, or the split is unknown or empty.
    """
    if split is not None and not is_one_of(split, [*Split, *manifest.splits]):
        raise InputError(f"split must be one of {', '.join(manifest.splits)}, got {shown(split)}")
    wanted = set(Split) if split is None else {split}
    entries = [entry for entry in manifest.files if entry.split in wanted]
    if not entries:
        raise InputError(f"{folder} holds no case of split {split}")
    recipe = manifest.recipe
    if split is not None and split.startswith("shift_"):
        recipe = recipe.shifted(split.removeprefix("shift_"))
    row_bytes = bytes_of_case(recipe)
    stored, unpacked = sum(e.bytes for e in entries), sum(e.rows for e in entries) * row_bytes
    if unpacked > max(_ALWAYS_READ_BYTES, _MOST_TIMES * stored):
        raise InputError(
            f"{folder}: {stored / 1e6:.3g} MB that unpack to {unpacked / 1e6:,.0f} MB are no data set of ours"
        )
    schema = _schema(recipe, manifest.seed)
    tables = [_read_table(folder, entry, schema, row_bytes) for entry in entries]
    rows = sum(len(table) for table in tables)
    X = np.empty((rows, len(recipe.channels), recipe.timing.n_samples), dtype=np.float32)
    labels = pa.concat_tables(
        table.drop_columns([COLUMN_OF_CHANNEL[c] for c in recipe.channels]) for table in tables
    )
    row = 0
    for table in tables:
        for n, channel in enumerate(recipe.channels):
            column = table.column(COLUMN_OF_CHANNEL[channel]).combine_chunks()
            X[row : row + len(table), n] = column.flatten().to_numpy().reshape(len(table), -1)
        row += len(table)
    values = {name: _column(labels, name) for name in labels.column_names}
    _require_agreement(folder, recipe, values, X)
    dataset = Dataset(
        X=X,
        parameters={name: values.pop(name) for name in parameter_names(recipe)},
        recipe=recipe,
        seed=manifest.seed,
        **values,
    )
    order = np.argsort(dataset.case_id, kind="stable")
    return dataset if (np.diff(order) == 1).all() else dataset.select(order)


def _require_agreement(
    folder: Folder, recipe: Recipe, values: dict[str, NDArray[Any]], X: NDArray[np.float32]
) -> None:
    """Refuse labels that do not belong to the recipe, and invalid numbers, whatever the digests."""
    index = values["class_index"]
    is_class = (index >= 0) & (index < len(recipe.classes))
    known = np.where(is_class, index, 0)
    kinds = np.array([fault_class.label_kind for fault_class in recipe.classes])
    of_labels = {
        "class_index": ~is_class,
        "class_name": values["class_name"] != np.array(recipe.class_names)[known],
        "kind": values["kind"] != kinds[known],
    }
    of_numbers = {name: ~np.isfinite(values[name]) for name in (*parameter_names(recipe), "severity")}
    of_numbers["the samples"] = ~np.isfinite(X).all(axis=(1, 2))
    for name, bad in (of_labels | of_numbers).items():
        if bad.any():
            n, why = int(bad.argmax()), "must be finite numbers"
            if name in of_labels:
                why = f"is {values[name][n]!s:.80}, which is not what its recipe {recipe.name} gives"
            raise InputError(f"{folder}: {name} of case {values['case_id'][n]} {why}")


def _column(table: pa.Table, name: str) -> NDArray[Any]:
    column = table.column(name).combine_chunks()
    if pa.types.is_dictionary(column.type):
        column = np.array(column.dictionary.to_pylist())[column.indices.to_numpy()]
    values: NDArray[Any] = np.asarray(column)
    return values


def _read_table(folder: Folder, entry: Entry, schema: pa.Schema, row_bytes: int) -> pa.Table:
    path = folder / entry.path
    try:
        file = pq.ParquetFile(pa.BufferReader(whole_content(folder, entry)))
        if file.metadata.num_rows != entry.rows or not file.schema_arrow.equals(schema):
            raise InputError(f"{path} holds other rows or columns than its manifest and recipe say")
        unpacked = sum(file.metadata.row_group(n).total_byte_size for n in range(file.num_row_groups))
        if unpacked > 2 * entry.rows * row_bytes + _OVERHEAD:
            raise InputError(f"{path} unpacks to {unpacked:,} bytes, more than {entry.rows} cases have")
        table = file.read(use_threads=False)  # a thread that stumbles over damage may abort the interpreter
        table.validate(full=True)  # text that is none, labels beyond their list
        return table
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
