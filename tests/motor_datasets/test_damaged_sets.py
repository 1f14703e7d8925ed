"""Data sets that were damaged, or made by strangers: refused, or had again; never taken for whole."""

import hashlib
import json
import math
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import Child, damaged, deep, flips, forged, json_of, odd_places, refused, refused_or_same
from small_sets import SHARD_BYTES, SHORT, files_of

from motor_datasets import generate, generate_dataset, load, parquet
from motor_datasets.cli import main
from motor_env.simulation.recipes import Shift


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", SHARD_BYTES)


def flip(data: Path) -> None:
    path = data / "train-000000.parquet"
    path.write_bytes(next(flips(path.read_bytes(), np.random.default_rng(3), 1)))


def swap(data: Path) -> None:
    (data / "train-000000.parquet").rename(data / "x")
    (data / "train-000001.parquet").rename(data / "train-000000.parquet")
    (data / "x").rename(data / "train-000001.parquet")


def one_missing(data: Path) -> None:
    (data / "train-000000.parquet").unlink()


DAMAGES = (flip, swap, one_missing)


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
@pytest.mark.parametrize("finished", [False, True], ids=["begun", "finished"])
def test_resume_makes_damaged_files_anew(
    tmp_path: Path, damage: Callable[[Path], None], finished: bool
) -> None:
    generate_dataset(SHORT, 200, 1, tmp_path / "whole")

    def stop(count: int) -> None:
        if len(list((tmp_path / "cut/data").glob("[!.]*.parquet"))) == 5 and not finished:
            raise KeyboardInterrupt

    if finished:
        generate_dataset(SHORT, 200, 1, tmp_path / "cut")
    else:
        with pytest.raises(KeyboardInterrupt):
            generate_dataset(SHORT, 200, 1, tmp_path / "cut", on_progress=stop)
    damage(tmp_path / "cut/data")
    generate_dataset(SHORT, 200, 1, tmp_path / "cut", resume=True)
    assert files_of(tmp_path / "cut") == files_of(tmp_path / "whole")
    assert main(["verify", str(tmp_path / "cut")]) == 0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small data set."""
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    return tmp_path / "set"


def first_file(folder: Path) -> Path:
    return folder / "data/train-000000.parquet"


def refusal(folder: Path) -> str:
    """The sentence with which a set is refused, loaded as by the commands."""
    commands = (["verify", str(folder)], ["export", str(folder), str(folder.parent / "x.npz")])
    for command in commands:
        refused(partial(main, command), folder)
    return refused(lambda: load(folder), folder)


def test_load_tells_every_flipped_bit(folder: Path) -> None:
    path = folder / "data/test-000000.parquet"
    whole = path.read_bytes()
    for content in flips(whole, np.random.default_rng(4), 60):
        path.write_bytes(content)
        assert "is damaged" in refused(lambda: load(folder, "test"), path)
    path.write_bytes(whole)
    assert len(load(folder, "test")) > 0


def told(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest, as a stranger could who knows the format."""
    manifest = json.loads((folder / "dataset.json").read_text())
    change(manifest)
    (folder / "dataset.json").write_text(json.dumps(manifest))


def certified(path: Path, manifest: dict[str, Any]) -> None:
    """Give the first file of a manifest the size and digest of what stands at a path."""
    content = path.read_bytes()
    manifest["files"][0] |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def test_samples_of_another_length_are_not_broadcast(folder: Path) -> None:
    path = first_file(folder)
    table = pq.read_table(path)
    flat = pa.array(np.ones(len(table), dtype=np.float32))
    short = pa.FixedSizeListArray.from_arrays(flat, 1)
    column = table.schema.get_field_index("current_a")
    pq.write_table(table.set_column(column, "current_a", short), path)
    told(folder, lambda manifest: certified(path, manifest))
    assert "other rows or columns" in refused(lambda: load(folder), path)


def relabelled(table: pa.Table, name: str, value: Any) -> pa.Table:
    """The table with another value in the third row of a column."""
    place = table.schema.get_field_index(name)
    values = table.column(name).to_pylist()
    values[2] = [value, *values[2][1:]] if isinstance(values[2], list) else value
    field = table.schema.field(place)
    kind = field.type
    column = (
        pa.array(values).dictionary_encode().cast(kind)
        if pa.types.is_dictionary(kind)
        else pa.array(values, kind)
    )
    return table.set_column(place, field, column)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("class_index", 99, "is 99, which is not what its recipe bench gives"),
        ("class_index", -1, "is -1, which is not what"),
        ("class_index", 4, "class_name of case"),
        ("class_name", "healthy2", "class_name of case"),
        ("kind", "magnet", "kind of case"),
        ("severity", math.nan, "severity of case"),
        ("resistance_ohm", math.inf, "resistance_ohm of case"),
        ("current_a", math.nan, "the samples of case"),
    ],
)
def test_labels_that_the_recipe_does_not_give_are_refused(
    name: str, value: Any, sentence: str, folder: Path
) -> None:
    """Though the digests are those of the files."""
    path = first_file(folder)
    table = pq.read_table(path)
    assert table.column("class_index").to_pylist()[2] != 4
    pq.write_table(relabelled(table, name, value), path)
    told(folder, lambda manifest: certified(path, manifest))
    assert sentence in refused(lambda: load(folder), folder)


def many_rows(table: pa.Table) -> pa.Table:
    return table.take(np.zeros(10_000, np.int64))


def long_label(table: pa.Table) -> pa.Table:
    place = table.schema.get_field_index("split")
    label = pa.array(["train" + "x" * 20_000_000])
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(table), np.int16)), label)
    return table.set_column(place, table.schema.field(place), column)


@pytest.mark.parametrize(("bomb", "rows"), [(many_rows, 10_000), (long_label, None)])
def test_a_file_that_unpacks_to_more_than_its_cases_is_not_read(
    bomb: Callable[[pa.Table], pa.Table], rows: int | None, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = first_file(folder)
    table = bomb(pq.read_table(path))
    pq.write_table(table, path, compression="zstd", use_dictionary=["split"])

    def change(manifest: dict[str, Any]) -> None:
        certified(path, manifest)
        manifest["files"][0]["rows"] = rows or manifest["files"][0]["rows"]

    told(folder, change)
    monkeypatch.setattr(parquet, "_ALWAYS_READ_BYTES", 10**6)
    monkeypatch.setattr(pq.ParquetFile, "read", None)
    assert re.search(r"unpacks? to", refused(lambda: load(folder), folder))


def test_a_file_larger_than_any_of_ours_is_not_read(folder: Path) -> None:
    os.truncate(first_file(folder), 10**10)  # all zeros, which take no room on the disk
    told(folder, lambda manifest: manifest["files"][0].update(bytes=10**10))
    refusal(folder)


@pytest.mark.parametrize(
    "path",
    [
        "../secret/x.parquet",
        "data/../../secret/x.parquet",
        "/proc/kmsg",
        "{folder}/secret/x.parquet",
        "data/sub/train-000000.parquet",
        "data/train-000000.parquet\x00",
        "",
    ],
)
def test_a_manifest_names_files_of_its_own_folder_only(folder: Path, path: str) -> None:
    secret = folder.parent / "secret/x.parquet"
    secret.parent.mkdir()
    shutil.copy(first_file(folder), secret)

    def outside(manifest: dict[str, Any]) -> None:
        certified(secret, manifest)
        manifest["files"][0]["path"] = path.format(folder=folder.parent)

    told(folder, outside)
    refusal(folder)


def test_what_is_no_file_is_not_opened(folder: Path) -> None:
    path = first_file(folder)
    for odd in odd_places(path):
        if odd == path:
            assert "is no regular file" in refused(lambda: load(folder), path)
    path.symlink_to("/proc/self/status")  # a file by name, whose size is 0 until it is read
    assert "is damaged" in refused(lambda: load(folder), path)
    for odd in odd_places(folder / "dataset.json"):
        if odd.parent == folder:
            assert "is no regular file" in refusal(folder)


@pytest.mark.parametrize("count", [60, pytest.param(300, marks=pytest.mark.long)])
def test_changed_manifests_are_one_sentence_or_the_same_data(folder: Path, count: int) -> None:
    path, whole = folder / "dataset.json", load(folder)
    text, rng = path.read_text(), np.random.default_rng(7)

    def same(got: Any) -> None:
        # A file left out of the list is not missed by `load`; what it names is as it was written.
        assert np.array_equal(got.X, whole.X[np.isin(whole.case_id, got.case_id)])

    sentences = []
    for _ in range(count):
        is_forged = rng.random() < 0.7
        content = (
            json_of(forged(json.loads(text), rng)).encode() if is_forged else damaged(text.encode(), rng)
        )
        path.write_bytes(content)
        sentences.append(refused_or_same(lambda: load(folder), folder, same))
    assert len([sentence for sentence in sentences if sentence]) > 0.5 * count
    for bad in ('{"format": ' + deep(), "[]", "3", "null", ""):
        path.write_text(bad)
        refused(lambda: main(["verify", str(folder)]), folder)


READ = """
from motor_datasets import load
def read(path):
    load(path)
    return "data"
"""


@pytest.mark.parametrize("count", [20, pytest.param(300, marks=pytest.mark.long)])
def test_certified_damage_is_one_sentence_or_data(folder: Path, count: int) -> None:
    """Files of strangers, whose digests are right: whatever compiled code makes of them, it ends in a sentence."""
    rng, path = np.random.default_rng(9), first_file(folder)
    whole = path.read_bytes()
    footer = range(len(whole) - 8 - int.from_bytes(whole[-8:-4], "little"), len(whole) - 8)  # what it holds
    with Child(READ) as child:
        for _ in range(count):
            path.write_bytes(damaged(whole, rng, most=3, kinds=("overwritten", "flipped"), focus=footer))
            told(folder, partial(certified, path))
            assert child.outcome(folder) in ("data", "refused")


def test_two_shifts_of_one_name_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="shifts of recipe bench must differ, got warm, warm"):
        replace(SHORT, shifts=(Shift("warm"), Shift("warm")))
    told(folder, lambda manifest: manifest["files"].append(manifest["files"][0]))
    assert "named twice" in refused(lambda: load(folder), folder)


@pytest.mark.parametrize("value", ["x" * 5000, [0] * 5000])
def test_a_long_value_in_a_manifest_is_not_said_whole(folder: Path, value: Any) -> None:
    told(folder, lambda manifest: manifest["files"][0].update(rows=value))
    assert refusal(folder).endswith(" ...")


@pytest.mark.parametrize("version", [0, 2, "1", None])
def test_a_manifest_of_another_version_is_refused(version: Any, tmp_path: Path) -> None:
    generate_dataset(SHORT, 10, 1, tmp_path)
    manifest = tmp_path / "dataset.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"version": version}))
    assert f"version must be 1, got {version!r}" in refused(partial(load, tmp_path), manifest)
