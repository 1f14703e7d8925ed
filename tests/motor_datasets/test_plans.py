"""What must never move: splits, files, manifests, batches of a stream."""

import hashlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_sets import SHORT, assert_same

from motor_datasets import (
    folder as folder_module,
    generate,
    generate_arrays,
    generate_dataset,
    split_of,
    stream,
)
from motor_datasets.generate import PlannedFile, bytes_of_case, make_plan
from motor_datasets.manifest import LARGEST_MANIFEST_BYTES, Entry, read_manifest
from motor_env import InputError, Timing, load_recipe

BENCH, FIELD = load_recipe("bench"), load_recipe("field")
LETTER = {"train": ".", "validation": "v", "test": "t"}


@pytest.mark.parametrize(
    ("seed", "first", "digest"),
    [
        (0, "..t.vt.v...v....t...ttv.....vv.t........", "0b91dad393ebb3cc"),
        (1, ".t......t.v...vtv...t....v......t...v.tv", "42fe8b4b3d8c022c"),
        (2**64 - 1, ".tv....tv.....t....v..v.....t.....v.tt.v", "84abeabb3568f8eb"),
    ],
)
def test_the_splits_are_frozen(seed: int, first: str, digest: str) -> None:
    """Motors 0 to 39 by name, and 100,000 by a digest, as all versions so far dealt them (commit aea5005)."""
    assert "".join(LETTER[name] for name in split_of(seed, np.arange(40)).tolist()) == first
    many = split_of(seed, np.arange(100_000)).tolist()
    letters = "".join({"train": "t", "validation": "v", "test": "s"}[name] for name in many)
    assert hashlib.sha256(letters.encode()).hexdigest()[:16] == digest


def test_a_case_is_in_the_split_of_its_motor() -> None:
    """Five starts of a motor go together; the same list as above, by another way."""
    recipe = replace(FIELD, timing=Timing(1_000.0, 0.002))
    got = generate_arrays(recipe, 1, np.arange(100)).split
    assert "".join(LETTER[name] for name in got) == "".join(5 * letter for letter in ".t......t.v...vtv...")


def test_files_of_32_mb_and_a_tenth_of_the_cases_for_each_shift() -> None:
    """Sizes by hand: 4 bytes a sample, 8 a number or index."""
    assert bytes_of_case(BENCH) == 4 * 1000 + 8 * (7 + 4)
    assert bytes_of_case(load_recipe("operation")) == 4 * 2 * 500 + 8 * (7 + 11 + 2 + 2 + 4)
    plan, per_file = make_plan(BENCH, 100_000, 1), 32 * 2**20 // 4088
    assert plan.bytes_uncompressed == 408_800_000
    assert [(f.path, f.split, f.begin, f.end) for f in plan.files] == [
        (f"data/{split}-{n:06d}.parquet", split, n * per_file, min((n + 1) * per_file, 100_000))
        for n in range(13)
        for split in ("train", "validation", "test")
    ]
    shifted = make_plan(FIELD, 40, 1)
    names = ("hotter", "loaded", "other_sensor", "unseen_severity", "unseen_kind")
    assert shifted.files == (
        PlannedFile("data/train-000000.parquet", "train", 0, 40),
        PlannedFile("data/test-000000.parquet", "test", 0, 40),  # of eight motors none is for validation
        *(
            PlannedFile(f"data/shift_{name}-000000.parquet", f"shift_{name}", n * 2**40, n * 2**40 + 4, name)
            for n, name in enumerate(names, start=1)
        ),
    )
    assert (shifted.cases_of_all, shifted.bytes_uncompressed) == (60, 60 * bytes_of_case(FIELD))
    assert make_plan(FIELD, 9, 1).cases_of_all == 9 + 5  # at least one a shift


@pytest.mark.parametrize("per_file", [7, 25, 55])
def test_every_file_has_a_case_and_every_case_its_file(
    per_file: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", per_file * bytes_of_case(SHORT))
    plan = make_plan(SHORT, 500, 5)
    cases = [file.case_id(SHORT, 5) for file in plan.files]
    assert sorted(np.concatenate(cases).tolist()) == list(range(500))
    for file, own in zip(plan.files, cases, strict=True):
        assert set(split_of(5, own)) == {file.split}
        assert file.end - file.begin == min(per_file, 500 - file.begin)


def test_a_plan_has_no_more_files_than_their_names_can_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", 2 * bytes_of_case(SHORT))
    assert make_plan(SHORT, 1, 2**64 - 1).cases_of_all == 1
    for cases, words in ((2**40, "fit into a million"), (2_000_001, "here 2000000 cases, got 2000001")):
        with pytest.raises(ValueError, match=words):
            make_plan(SHORT, cases, 1)


@pytest.mark.parametrize(
    ("split", "size"), [(None, 16), (None, 20), ("test", 3), ("train", 14), ("train", 45)]
)
def test_a_stream_is_the_cases_of_its_split_in_their_order(split: str | None, size: int) -> None:
    tiny, cases = replace(SHORT, timing=Timing(duration_s=0.0005), starts_per_motor=2), np.arange(4000)
    mine = cases if split is None else cases[split_of(6, cases // 2) == split]
    got = [batch.case_id.tolist() for batch in islice(stream(tiny, 6, size, split=split), 4)]
    assert got == mine[: 4 * size].reshape(4, size).tolist()
    for n, whose in enumerate(((0, 3), (1,), (2,))):
        part = stream(tiny, 6, size, split=split, batches=4, share=(n, 3))
        assert [batch.case_id.tolist() for batch in part] == [got[of] for of in whose]


@pytest.mark.parametrize("name", ["field", "operation"])
def test_many_cases_are_drawn_in_parts_without_a_seam(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = load_recipe(name)
    whole = generate_arrays(recipe, 1, range(12))
    monkeypatch.setattr("motor_datasets.generate._CASES_AT_ONCE", 5)
    assert_same(generate_arrays(recipe, 1, range(12)), whole)


def entry(**changes: Any) -> Entry:
    plain: dict[str, Any] = {
        "path": "data/train-000000.parquet", "split": "train", "rows": 3, "bytes": 1000, "sha256": "0" * 64,
    }  # fmt: skip
    return Entry(**plain | changes)


def test_a_manifest_is_what_was_written(tmp_path: Path) -> None:
    made = generate_dataset(SHORT, 60, 5, tmp_path / "set")
    told = json.loads((tmp_path / "set/dataset.json").read_text())
    assert (told["format"], told["version"], told["seed"], told["cases"]) == ("motor-datasets", 1, 5, 60)
    assert told["files"] == [asdict(one) for one in made.files]
    splits = split_of(5, np.arange(60)).tolist()
    names = ("train", "validation", "test")
    expected = [(f"data/{name}-000000.parquet", splits.count(name)) for name in names]
    assert [(one.path, one.rows) for one in made.files] == expected
    for one in made.files:
        content = (tmp_path / "set" / one.path).read_bytes()
        assert (len(content), hashlib.sha256(content).hexdigest()) == (one.bytes, one.sha256)
    assert read_manifest(tmp_path / "set") == made
    # The largest manifest that is read is one of a million files with long names and many bytes.
    places = (f"data/validation-{n}.parquet" for n in (999_998, 999_999))
    two = tuple(entry(path=path, split="validation", rows=10**6, bytes=10**8) for path in places)
    sizes = [len(replace(made, files=two[:count]).as_text()) for count in (1, 2)]
    assert sizes[1] + 10**6 * (sizes[1] - sizes[0]) < LARGEST_MANIFEST_BYTES


def test_the_disk_must_hold_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The named recipes' files have 39 to 82 % of the uncompressed size: less than 30 % free would surely not do."""
    size, place = make_plan(SHORT, 60, 1).bytes_uncompressed, tmp_path / "set"

    def free(share: float) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=share * size))

    free(0.2995)
    with pytest.raises(InputError, match=r"0\.0 GB of data do not fit onto its disk"):
        generate_dataset(SHORT, 60, 1, place)
    assert list(tmp_path.iterdir()) == []  # it was not begun
    free(0.3005)
    generate_dataset(SHORT, 60, 1, place)
    (place / "data/test-000000.parquet").unlink()
    free(0.0995)  # of three files one is missing: only that needs room
    with pytest.raises(InputError, match="do not fit"):
        generate_dataset(SHORT, 60, 1, place, resume=True)
    free(0.1005)
    generate_dataset(SHORT, 60, 1, place, resume=True)


def test_the_note_lags_by_a_thirty_second_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted generation loses no more than that; a storage writes the note whole each time, hence the lag."""
    monkeypatch.setattr(generate, "_SHARD_BYTES", 2 * bytes_of_case(SHORT))
    monkeypatch.setattr(folder_module, "_check_space", lambda *_: None)

    def written(files: list[PlannedFile], *_: Any) -> Iterator[Entry]:
        return (entry(path=file.path, split=file.split) for file in files)

    noted: list[int] = []

    def look(_: int) -> None:
        noted.append((tmp_path / "set/unfinished.json").read_text().count("\n") - 1)

    monkeypatch.setattr(folder_module, "_write_files", written)
    generate_dataset(SHORT, 100, 1, tmp_path / "set", on_progress=look)
    expected = [1]
    for count in range(2, len(noted) + 1):
        expected.append(count if count > expected[-1] + expected[-1] // 32 else expected[-1])
    assert len(noted) > 66
    assert noted == expected
