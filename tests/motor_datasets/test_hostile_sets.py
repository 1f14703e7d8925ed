"""Damaged sets, sets of strangers, hostile arguments: refused in one sentence, or had again; never taken for whole."""

import hashlib
import json
import math
import re
import shutil
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import damaged, deep, flips, forged, json_of, odd_places, refused, refused_or_same
from hostile_arguments import Row, public_names
from small_sets import SHARD_BYTES, SHORT, files_of, interrupted

import motor_datasets
from motor_datasets import (
    generate,
    generate_arrays,
    generate_dataset,
    load,
    parquet,
    split_of,
    stream,
    to_pandas,
    to_torch,
    to_torch_iterable,
)
from motor_datasets.cli import main

Change = Callable[[dict[str, Any]], object]
FIRST, SECOND = "data/train-000000.parquet", "data/train-000001.parquet"


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", SHARD_BYTES)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small data set."""
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    return tmp_path / "set"


def flipped(folder: Path) -> None:
    content = (folder / FIRST).read_bytes()
    (folder / FIRST).write_bytes(next(flips(content, np.random.default_rng(3), 1)))


def swapped(folder: Path) -> None:
    (folder / FIRST).rename(folder / "x")
    (folder / SECOND).rename(folder / FIRST)
    (folder / "x").rename(folder / SECOND)


@pytest.mark.parametrize("damage", [flipped, swapped, lambda folder: (folder / FIRST).unlink()])
@pytest.mark.parametrize("finished", [False, True], ids=["begun", "finished"])
def test_resume_makes_damaged_files_anew(
    tmp_path: Path, damage: Callable[[Path], None], finished: bool
) -> None:
    generate_dataset(SHORT, 200, 1, tmp_path / "whole")
    if finished:
        shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    else:
        interrupted(tmp_path / "cut", 200, 5)
    damage(tmp_path / "cut")
    generate_dataset(SHORT, 200, 1, tmp_path / "cut", resume=True)
    assert files_of(tmp_path / "cut") == files_of(tmp_path / "whole")
    assert main(["verify", str(tmp_path / "cut")]) == 0


def refusal(folder: Path) -> str:
    """The sentence with which a set is refused, loaded as by the commands."""
    for command in (["verify", str(folder)], ["export", str(folder), str(folder.parent / "x.npz")]):
        refused(partial(main, command), folder)
    return refused(lambda: load(folder), folder)


def told(folder: Path, change: Change) -> None:
    """Change the manifest, as a stranger could who knows the format."""
    manifest = json.loads((folder / "dataset.json").read_text())
    change(manifest)
    (folder / "dataset.json").write_text(json.dumps(manifest))


def first(**changes: Any) -> Change:
    """What the manifest says of the first file."""
    return lambda manifest: manifest["files"][0].update(changes)


def certified(file: Path, **changes: Any) -> Change:
    """Give the first file of a manifest the size and digest of what stands there."""
    content = file.read_bytes()
    return first(bytes=len(content), sha256=hashlib.sha256(content).hexdigest(), **changes)


def forge(folder: Path, change: Callable[[pa.Table], pa.Table], **options: Any) -> None:
    """Write another table into the first file, and say so in the manifest."""
    pq.write_table(change(pq.read_table(folder / FIRST)), folder / FIRST, **options)
    told(folder, certified(folder / FIRST))


def with_third(name: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    """The table with another value in the third row of a column."""

    def change(table: pa.Table) -> pa.Table:
        place, values = table.schema.get_field_index(name), table.column(name).to_pylist()
        values[2] = [value, *values[2][1:]] if isinstance(values[2], list) else value
        field = table.schema.field(place)
        if pa.types.is_dictionary(field.type):
            return table.set_column(place, field, pa.array(values).dictionary_encode().cast(field.type))
        return table.set_column(place, field, pa.array(values, field.type))

    return change


def shorter(table: pa.Table) -> pa.Table:
    """Samples of another length, which must not be broadcast."""
    one = pa.FixedSizeListArray.from_arrays(pa.array(np.ones(len(table), dtype=np.float32)), 1)
    return table.set_column(table.schema.get_field_index("current_a"), "current_a", one)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (with_third("class_index", 99), "is 99, which is not what its recipe bench gives"),
        (with_third("class_index", -1), "is -1, which is not what"),
        (with_third("class_index", 4), "class_name of case"),
        (with_third("class_name", "healthy2"), "class_name of case"),
        (with_third("kind", "magnet"), "kind of case"),
        (with_third("severity", math.nan), "severity of case"),
        (with_third("resistance_ohm", math.inf), "resistance_ohm of case"),
        (with_third("current_a", math.nan), "the samples of case"),
        (shorter, "other rows or columns"),
    ],
)
def test_tables_that_the_recipe_does_not_give_are_refused(
    change: Callable[[pa.Table], pa.Table], sentence: str, folder: Path
) -> None:
    """Though the digests are those of the files."""
    forge(folder, change)
    assert sentence in refused(lambda: load(folder), folder)


def many_rows(table: pa.Table) -> pa.Table:
    return table.take(np.zeros(10_000, np.int64))


def long_label(table: pa.Table) -> pa.Table:
    place = table.schema.get_field_index("split")
    rows, label = pa.array(np.zeros(len(table), np.int16)), pa.array(["train" + "x" * 20_000_000])
    return table.set_column(place, table.schema.field(place), pa.DictionaryArray.from_arrays(rows, label))


@pytest.mark.parametrize(("bomb", "rows"), [(many_rows, {"rows": 10_000}), (long_label, {})])
def test_a_file_that_unpacks_to_more_than_its_cases_is_not_read(
    bomb: Callable[[pa.Table], pa.Table], rows: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forge(folder, bomb, compression="zstd", use_dictionary=["split"])
    told(folder, first(**rows))
    monkeypatch.setattr(parquet, "_ALWAYS_READ_BYTES", 10**6)
    monkeypatch.setattr(pq.ParquetFile, "read", None)
    assert re.search(r"unpacks? to", refused(lambda: load(folder), folder))


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
    shutil.copy(folder / FIRST, secret)
    told(folder, certified(secret, path=path.format(folder=folder.parent)))
    refusal(folder)


def test_what_is_no_file_is_not_opened(folder: Path) -> None:
    path = folder / FIRST
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
    path, whole, rng = folder / "dataset.json", load(folder), np.random.default_rng(7)
    text = path.read_text()

    def same(got: Any) -> None:
        # A file left out of the list is not missed by `load`; what it names is as it was written.
        assert np.array_equal(got.X, whole.X[np.isin(whole.case_id, got.case_id)])

    sentences = []
    for _ in range(count):
        tree = json.loads(text)
        path.write_bytes(
            json_of(forged(tree, rng)).encode() if rng.random() < 0.7 else damaged(text.encode(), rng)
        )
        sentences.append(refused_or_same(lambda: load(folder), folder, same))
    assert sum(sentence != "" for sentence in sentences) > 0.5 * count


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda manifest: manifest["files"].append(manifest["files"][0]), "named twice"),
        (first(rows="x" * 5000), " ..."),
        (first(rows=[0] * 5000), " ..."),
        (lambda manifest: manifest.update(version=0), "version must be 1, got 0"),
        (lambda manifest: manifest.update(version="1"), "version must be 1, got '1'"),
        (dict.clear, "cannot be read as a data set's manifest"),
    ],
)
def test_a_manifest_that_is_none_of_ours_is_one_sentence(change: Change, sentence: str, folder: Path) -> None:
    told(folder, change)
    assert sentence in refusal(folder)


@pytest.mark.parametrize("text", ['{"format": ' + deep(), "[]", "null", ""], ids=["deep", "list", "null", ""])
def test_a_manifest_that_is_no_table_is_one_sentence(text: str, folder: Path) -> None:
    (folder / "dataset.json").write_text(text)
    refusal(folder)


CASES = np.array([3, 1, 4])


def arrays(**changes: Any) -> Any:
    given: dict[str, Any] = {"recipe": SHORT, "seed": 1, "cases": 2} | changes
    return generate_arrays(**given).X


def first_batch(**changes: Any) -> Any:
    """The samples of the first batch of a stream, if it has one."""
    given: dict[str, Any] = {"recipe": SHORT, "seed": 1, "batch_size": 4} | changes
    return [batch.X for batch in islice(stream(**given), 1)]


def split(**changes: Any) -> Any:
    given: dict[str, Any] = {"seed": 1, "motor_id": [1, 2]} | changes
    return split_of(**given)


CALLS: dict[str, Callable[..., Any]] = {"generate_arrays": arrays, "split_of": split, "stream": first_batch}
ROWS: list[tuple[str, str, Any, tuple[str, ...], tuple[Any, ...]]] = [
    *((name, "seed", 7, (), ()) for name in CALLS),
    *((name, "recipe", SHORT, (), ()) for name in ("generate_arrays", "stream")),
    ("generate_arrays", "cases", 3, (), (0, -1, 2**40, 2**62)),
    ("generate_arrays", "cases", CASES, ("one short",), ()),
    ("split_of", "motor_id", CASES, ("one short", "empty", "no samples", "more axes"), ()),
    ("stream", "batch_size", 4, (), (0, -1)),
    ("stream", "split", "train", ("None",), ()),
    ("stream", "batches", 2, ("None",), (-1,)),
    ("stream", "share", (0, 1), (), ((0, 0), (1.5, 2), (0,), 3)),
]


@pytest.mark.parametrize(("name", "argument", "good", "allows", "also"), ROWS)
def test_hostile_arguments_of_data_sets(name: str, argument: str, good: Any, allows: Any, also: Any) -> None:
    row = Row.of(name, argument, lambda value: CALLS[name](**{argument: value}), good, *allows, also=also)
    assert row.defects() == []


@pytest.mark.parametrize(("name", "good"), [("recipe", SHORT), ("cases", 4), ("seed", 1), ("workers", 1)])
def test_hostile_arguments_of_a_written_set(name: str, good: Any, tmp_path: Path) -> None:
    def generated(value: Any) -> tuple[int, int]:
        given: dict[str, Any] = {"recipe": SHORT, "cases": 4, "seed": 1, "out": tmp_path / "set", name: value}
        made = generate_dataset(**given)
        shutil.rmtree(tmp_path / "set")
        return made.cases, made.bytes

    assert Row.of("generate_dataset", name, generated, good, "-1", "0").defects() == []
    assert not list(tmp_path.iterdir())  # nothing half-written


@pytest.mark.parametrize("nothing", [None, 3, b"x", ["a"]])
def test_what_is_no_folder_and_no_data_set_is_refused(nothing: Any) -> None:
    with pytest.raises(ValueError, match="the folder must be a path or a URL, got"):
        load(nothing)
    for turn in (to_pandas, to_torch):
        with pytest.raises(TypeError, match="dataset must be of type Dataset, got"):
            turn(nothing)


def test_every_public_function_has_a_row() -> None:
    public = public_names(Path(motor_datasets.__file__).with_name("__init__.pyi"))
    elsewhere = {"Dataset", "load", "Split", "generate_dataset", "to_pandas", "to_torch", "to_torch_iterable"}
    assert public == set(CALLS) | elsewhere
    with pytest.raises(ValueError, match="batch_size must be"):
        next(iter(to_torch_iterable(SHORT, 1, 0)))
