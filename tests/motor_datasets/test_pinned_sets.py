"""What must never move: splits, files, batches of a stream; and what a data set says of itself."""

import hashlib
import json
import shutil
import tracemalloc
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from small_sets import SHORT, assert_same

from motor_datasets import (
    folder as folder_module,
    generate,
    generate_arrays,
    generate_dataset,
    load,
    parquet,
    split_of,
    stream,
)
from motor_datasets.arrays import columns
from motor_datasets.card import croissant, data_card, describe, draw_sheet
from motor_datasets.cli import main
from motor_datasets.generate import PlannedFile, bytes_of_case, make_plan
from motor_datasets.manifest import LARGEST_MANIFEST_BYTES, Entry, Manifest, read_manifest
from motor_env import InputError, Recipe, Timing, load_recipe

BENCH, FIELD = load_recipe("bench"), load_recipe("field")
LETTER = {"train": ".", "validation": "v", "test": "t"}


@pytest.mark.parametrize(
    ("seed", "first", "digest"),
    [
        (0, "..t.vt.v...v....t...ttv.....vv.t........", "0b91dad393ebb3cc"),
        (1, ".t......t.v...vtv...t....v......t...v.tv", "42fe8b4b3d8c022c"),
        (3, ".t........vttv..v...t..t...v..v.t..v....", "f7d3d828a3cdea11"),
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
    got = generate_arrays(recipe, 1, np.arange(100)).split.reshape(20, 5)
    assert ["".join(LETTER[name] for name in row) for row in got.tolist()] == [
        5 * letter for letter in ".t......t.v...vtv..."
    ]


def test_files_of_32_mb_and_a_tenth_of_the_cases_for_each_shift() -> None:
    """Sizes by hand: 4 bytes a sample, 8 a number or index."""
    assert bytes_of_case(BENCH) == 4 * 1000 + 8 * (7 + 4) == 4088
    assert bytes_of_case(load_recipe("operation")) == 4 * 2 * 500 + 8 * (7 + 11 + 2 + 2 + 4)
    plan = make_plan(BENCH, 100_000, 1)
    per_file = 32 * 2**20 // 4088
    assert plan.bytes_uncompressed == 408_800_000
    assert [(f.path, f.split, f.begin, f.end) for f in plan.files] == [
        (f"data/{split}-{n:06d}.parquet", split, n * per_file, min((n + 1) * per_file, 100_000))
        for n in range(13)
        for split in ("train", "validation", "test")
    ]
    shifted = make_plan(FIELD, 40, 1)
    assert shifted.files[:2] == (
        PlannedFile("data/train-000000.parquet", "train", 0, 40),
        PlannedFile("data/test-000000.parquet", "test", 0, 40),  # of eight motors none is for validation
    )
    assert shifted.files[2:] == tuple(
        PlannedFile(f"data/shift_{name}-000000.parquet", f"shift_{name}", n * 2**40, n * 2**40 + 4, name)
        for n, name in enumerate(
            ("hotter", "loaded", "other_sensor", "unseen_severity", "unseen_kind"), start=1
        )
    )
    assert shifted.cases_of_all == 60
    assert shifted.bytes_uncompressed == 60 * bytes_of_case(FIELD)
    assert make_plan(FIELD, 9, 1).cases_of_all == 9 + 5  # at least one a shift


def test_every_file_has_a_case_and_every_case_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    for per_file in (7, 20, 25, 39, 40, 55):
        monkeypatch.setattr(generate, "_SHARD_BYTES", per_file * bytes_of_case(SHORT))
        plan = make_plan(SHORT, 500, 5)
        cases = [file.case_id(SHORT, 5) for file in plan.files]
        assert all(len(one) for one in cases)
        assert sorted(np.concatenate(cases).tolist()) == list(range(500))
        for file, own in zip(plan.files, cases, strict=True):
            assert set(split_of(5, own)) == {file.split}
            assert file.end - file.begin == min(per_file, 500 - file.begin)
    monkeypatch.setattr(generate, "_SHARD_BYTES", 4000 * bytes_of_case(FIELD))
    shifts = [file for file in make_plan(FIELD, 50_000, 0).files if file.shift == "loaded"]
    first = 2 * 2**40
    assert [(f.begin - first, f.end - first) for f in shifts] == [(0, 4000), (4000, 5000)]
    assert shifts[1].case_id(FIELD, 0).tolist() == list(range(first + 4000, first + 5000))


def test_numbers_at_their_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    assert make_plan(SHORT, 1, 2**64 - 1).cases_of_all == 1
    wrong = (
        (0, 1, ">= 1"),
        (2**40, 1, "fit into a million"),
        (1, -1, "a whole number"),
        (1, 2**64, "a whole"),
    )
    for cases, seed, must in wrong:
        with pytest.raises(ValueError, match=must):
            make_plan(SHORT, cases, seed)
    monkeypatch.setattr(generate, "_SHARD_BYTES", 2 * bytes_of_case(SHORT))
    with pytest.raises(ValueError, match="here 2000000 cases, got 2000001"):
        make_plan(SHORT, 2_000_001, 1)
    monkeypatch.setattr(generate, "_MOST_SHARDS", 3)
    assert len(make_plan(SHORT, 6, 1).files) >= 3
    assert np.array_equal(generate_arrays(SHORT, 7, 1).X, generate_arrays(SHORT, 7, [0]).X)
    with pytest.raises(ValueError, match="cases must be >= 1, got 0"):
        generate_arrays(SHORT, 7, 0)
    with pytest.raises(ValueError, match="at least one case"):
        generate_arrays(SHORT, 7, [])


@pytest.mark.parametrize(
    ("split", "size"), [(None, 16), (None, 20), ("test", 3), ("train", 14), ("train", 45)]
)
def test_a_stream_is_the_cases_of_its_split_in_their_order(split: str | None, size: int) -> None:
    tiny = replace(SHORT, timing=Timing(duration_s=0.0005), starts_per_motor=2)
    cases = np.arange(4000)
    mine = cases if split is None else cases[split_of(6, cases // 2) == split]
    got = list(islice(stream(tiny, 6, size, split=split), 4))
    assert [len(batch) for batch in got] == [size] * 4
    assert np.concatenate([batch.case_id for batch in got]).tolist() == mine[: 4 * size].tolist()
    shared = [list(stream(tiny, 6, size, split=split, batches=4, share=(n, 3))) for n in range(3)]
    assert [[batch.case_id[0] for batch in part] for part in shared] == [
        [got[n].case_id[0] for n in whose] for whose in ((0, 3), (1,), (2,))
    ]
    with pytest.raises(ValueError, match="batch_size must be >= 1"):
        next(stream(tiny, 6, 0))
    assert len(next(stream(tiny, 6, 1))) == 1


@pytest.mark.parametrize("name", ["field", "operation"])
def test_many_cases_are_drawn_in_parts_without_a_seam(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = load_recipe(name)
    whole = generate_arrays(recipe, 1, range(12))
    monkeypatch.setattr("motor_datasets.generate._CASES_AT_ONCE", 5)
    assert_same(generate_arrays(recipe, 1, range(12)), whole)


def test_what_is_drawn_beside_the_measurements_takes_no_more_memory_for_more_cases(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("motor_datasets.generate._CASES_AT_ONCE", 64)
    recipe, beside = load_recipe("operation"), []
    generate_arrays(recipe, 1, 64)
    for cases in (64, 640):
        tracemalloc.start()
        made = generate_arrays(recipe, 1, cases)
        kept, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert made.X.nbytes < kept
        beside.append(peak - kept)
    assert beside[1] < 1.3 * beside[0]


def entry(**changes: Any) -> Entry:
    plain: dict[str, Any] = {
        "path": "data/train-000000.parquet",
        "split": "train",
        "rows": 3,
        "bytes": 1000,
        "sha256": "0" * 64,
    }
    return Entry(**plain | changes)


def test_entries_and_manifests_at_their_bounds() -> None:
    for name in ("rows", "bytes"):
        for count in (1, 200_000_000):
            assert getattr(entry(**{name: count}), name) == count
        for count in (0, 200_000_001):
            with pytest.raises(ValueError, match="rows and bytes"):
                entry(**{name: count})
    for path in ("data/train-00000.parquet", "data/train-0000000.parquet"):
        with pytest.raises(ValueError, match="path must be"):
            entry(path=path)
    for digest in (63 * "0", 65 * "0"):
        with pytest.raises(ValueError, match="64 hexadecimal"):
            entry(sha256=digest)
    other = entry(path="data/test-000000.parquet", split="test", bytes=234)
    more = entry(path="data/train-000001.parquet", bytes=1)
    manifest = Manifest(BENCH, 2**64 - 1, 0, (entry(), other, more))
    assert manifest.bytes == 1235
    assert manifest.splits == ("train", "test")
    for numbers in ((2**64, 0), (-1, 0), (0, 2**64), (0, -1)):
        with pytest.raises(ValueError, match="must be in 0"):
            Manifest(BENCH, *numbers, ())


def test_a_manifest_is_what_was_written(tmp_path: Path) -> None:
    made = generate_dataset(SHORT, 60, 5, tmp_path / "set")
    told = json.loads((tmp_path / "set/dataset.json").read_text())
    assert (told["format"], told["version"], told["seed"], told["cases"]) == ("motor-datasets", 1, 5, 60)
    assert told["files"] == [asdict(one) for one in made.files]
    splits = split_of(5, np.arange(60)).tolist()
    assert [(one.path, one.rows) for one in made.files] == [
        (f"data/{name}-000000.parquet", splits.count(name)) for name in ("train", "validation", "test")
    ]
    for one in made.files:
        content = (tmp_path / "set" / one.path).read_bytes()
        assert (len(content), hashlib.sha256(content).hexdigest()) == (one.bytes, one.sha256)
    assert read_manifest(tmp_path / "set") == made
    # The largest manifest that is read is one of a million files with long names and many bytes.
    places = (f"data/validation-{n}.parquet" for n in (999_998, 999_999))
    two = tuple(entry(path=path, split="validation", rows=10**6, bytes=10**8) for path in places)
    sizes = [len(replace(made, files=two[:count]).as_text()) for count in (1, 2)]
    assert sizes[1] + 10**6 * (sizes[1] - sizes[0]) < LARGEST_MANIFEST_BYTES


def test_row_groups_are_of_the_stated_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = parquet.to_table(generate_arrays(SHORT, 1, 40))
    parquet.write_table(table, tmp_path / "whole.parquet")
    assert (
        pq.ParquetFile(tmp_path / "whole.parquet").num_row_groups == 1
    )  # 8 MB hold thousands of short cases
    monkeypatch.setattr(parquet, "_ROW_GROUP_BYTES", table.nbytes // 4 + 1)
    parquet.write_table(table, tmp_path / "parts.parquet")
    groups = pq.ParquetFile(tmp_path / "parts.parquet").metadata
    assert [groups.row_group(n).num_rows for n in range(groups.num_row_groups)] == [10, 10, 10, 10]
    assert groups.row_group(0).column(groups.num_columns - 1).compression == "ZSTD"


def test_a_file_unpacks_to_twice_its_cases_and_an_overhead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    (one,) = (each for each in read_manifest(tmp_path / "set").files if each.split == "test")
    metadata = pq.ParquetFile(tmp_path / "set" / one.path).metadata
    unpacked = sum(metadata.row_group(n).total_byte_size for n in range(metadata.num_row_groups))
    size = one.rows * bytes_of_case(SHORT)
    assert unpacked < size + 2**20  # what is read of ours is far from the bound
    for least, fits in ((unpacked - 2 * size, True), (unpacked - 2 * size - 1, False)):
        monkeypatch.setattr(parquet, "_OVERHEAD", least)
        if fits:
            assert len(load(tmp_path / "set", "test")) == one.rows
        else:
            with pytest.raises(
                InputError, match=f"unpacks to {unpacked:,} bytes, more than {one.rows} cases have"
            ):
                load(tmp_path / "set", "test")
    monkeypatch.undo()
    monkeypatch.setattr(parquet, "_ALWAYS_READ_BYTES", 0)
    for times, fits in ((size / one.bytes, True), (0.999 * size / one.bytes, False)):
        monkeypatch.setattr(parquet, "_MOST_TIMES", times)
        if fits:
            load(tmp_path / "set", "test")
        else:
            with pytest.raises(InputError, match="are no data set of ours"):
                load(tmp_path / "set", "test")


def test_the_disk_must_hold_three_tenths_of_the_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The named recipes' files have 39 to 82 % of the uncompressed size: less than 30 % free would surely not do."""
    size = make_plan(SHORT, 60, 1).bytes_uncompressed
    for share, fits in ((0.2995, False), (0.3005, True)):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=share * size: SimpleNamespace(free=free))
        if fits:
            generate_dataset(SHORT, 60, 1, tmp_path / "set")
        else:
            with pytest.raises(InputError, match=r"0\.0 GB of data do not fit onto its disk"):
                generate_dataset(SHORT, 60, 1, tmp_path / "set")
            assert list(tmp_path.iterdir()) == []  # it was not begun
    (tmp_path / "set/data/test-000000.parquet").unlink()
    # Of three files one is missing: only that needs room.
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0.0995 * size))
    with pytest.raises(InputError, match="do not fit"):
        generate_dataset(SHORT, 60, 1, tmp_path / "set", resume=True)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0.1005 * size))
    generate_dataset(SHORT, 60, 1, tmp_path / "set", resume=True)


def test_the_note_lags_by_a_thirty_second_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupted generation loses no more than that; a storage writes the note whole each time, hence the lag."""
    monkeypatch.setattr(generate, "_SHARD_BYTES", 2 * bytes_of_case(SHORT))
    monkeypatch.setattr(folder_module, "_check_space", lambda *_: None)

    def written(files: list[PlannedFile], *_: Any) -> Iterator[Entry]:
        return (entry(path=file.path, split=file.split) for file in files)

    lags: list[int] = []

    def look(_: int) -> None:
        lines = (tmp_path / "set/unfinished.json").read_text().count("\n")
        lags.append(len(lags) + 1 - (lines - 1))

    monkeypatch.setattr(folder_module, "_write_files", written)
    generate_dataset(SHORT, 100, 1, tmp_path / "set", on_progress=look)
    assert len(lags) > 66
    assert lags[:32] == [0] * 32
    expected, noted = [], 0
    for count in range(1, len(lags) + 1):
        if count > noted + noted // 32:
            noted = count
        expected.append(count - noted)
    assert lags == expected


def test_a_dry_run_tells_cases_by_the_time_of_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(folder_module, "seconds_per_case", lambda recipe, seed: 0.25)
    out = str(tmp_path / "set")
    command = ["generate", "field", "--cases", "400", "--seed", "1", "--out", out, "--dry-run"]
    assert main([*command, "--workers", "4", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {
        "out": out, "recipe": "field", "seed": 1, "cases": 400, "cases_of_shifts": 200,
        "classes": list(FIELD.class_names), "channels": ["current"], "samples": 1200, "files": 8,
        "bytes_uncompressed": 600 * bytes_of_case(FIELD), "seconds": 600 * 0.25 / 4,
    }  # fmt: skip
    assert main(command) == 0
    size = 600 * bytes_of_case(FIELD) / 1e6
    assert capsys.readouterr().out == (
        f"would write 400 cases and 200 of shifts of 1200 samples in 8 files to {out}:"
        f" {size:.1f} MB before compression, some 150.0 s\n"
    )


def test_the_card_counts_and_names_its_size() -> None:
    recipe = load_recipe("operation")
    files = (
        entry(rows=700, bytes=1_250_000),
        entry(path="data/train-000001.parquet", rows=50, bytes=1_250_000),
        entry(path="data/test-000000.parquet", split="test", rows=249, bytes=10_000),
    )
    card = data_card(Manifest(recipe, 9, 999, files))
    assert "| train | 750 |\n| test | 249 |\n" in card
    assert "999 cases in\n3 files, 2.5 MB." in card
    assert "seed 9. One row a case" in card
    assert "Simulated records of motors at work" in card
    assert "| `voltage_v` | number | V | level of the supply |" in card
    assert (
        "configs:\n- config_name: default\n  data_files:\n  - split: train\n    path: data/train-*.parquet\n"
        in card
    )
    for rows, category in (
        (999, "n<1K"), (1000, "1K<n<10K"), (9999, "1K<n<10K"), (10**4, "10K<n<100K"), (10**5, "100K<n<1M"),
        (10**6, "1M<n<10M"), (10**7 - 1, "1M<n<10M"), (10**7, "n>10M"),
    ):  # fmt: skip
        plain = data_card(Manifest(BENCH, 0, 1, (entry(rows=rows),)))
        assert f"license: mit\nsize_categories:\n- {category}\n" in plain
        assert "where measured, `speed_rad_s`. No motor" in plain


def test_croissant_tells_types_units_and_counts() -> None:
    told = json.loads(croissant(Manifest(BENCH, 9, 12, (entry(rows=12, bytes=77),))))
    assert told["name"] == "motor-bench-9"
    assert told["citeAs"] == "motor-env, recipe bench, seed 9, 12 cases"
    assert told["distribution"][0]["contentSize"] == "77 B"
    (records,) = told["recordSet"]
    assert (records["@id"], records["description"]) == ("train-000000", "12 cases of split train.")
    fields = {field["name"].removeprefix("train-000000/"): field for field in records["field"]}
    kinds = {"text": "sc:Text", "whole": "sc:Integer", "number": "sc:Float", "samples": "sc:Float"}
    for column in columns(BENCH):
        assert fields[column.name]["dataType"] == kinds[column.kind]
        assert fields[column.name].get("repeated", False) is (column.kind == "samples")
    assert fields["resistance_ohm"]["description"] == "winding resistance without the fault, in ohm"
    assert fields["severity"]["description"] == "relative size of the fault, 0.25 for 25 %"
    assert fields["current_a"]["description"] == "measured current, 1000 samples at 10000 Hz, in A"


def test_a_recipe_is_described_in_its_units() -> None:
    """Numbers as docs/recipes.md gives them: shares in per cent, the rest in SI."""
    lines = describe(load_recipe("bench-full")).splitlines()
    assert lines[0] == "recipe bench-full"
    for line in (
        "  resistance_ohm = 2.18",
        "supply: step to 12 V",
        "  friction: 2 %",
        "  bearing_25: 11.1 %, bearing 25 %",
        "  noise_100: 11.1 %, noise 100 %",
        "starts of each motor: 1; healthy reference starts among them: 0",
        "samples: 1000 at 10000 Hz, 0 s before the step and 0.1 s after it",
        "channels: current; current noise 0.02 A",
        "  severity [1]: relative size of the fault, 0.25 for 25 %",
        "  current_a [A]: measured current, 1000 samples at 10000 Hz",
    ):
        assert line in lines, line
    ranged = replace(
        BENCH, classes=(BENCH.classes[0], replace(BENCH.classes[1], severity=0.05, severity_to=0.3))
    )
    assert any(line.endswith(": 50 %, bearing 5 % to 30 %") for line in describe(ranged).splitlines())
    field = describe(FIELD).splitlines()
    assert "  ramp_s: 0 to 0.0005, each start" in field
    assert "  coulomb_ratio: 0.3 to 0.4, each motor" in field
    assert "  adc_bits = 12" in field
    assert "shifts: hotter, loaded, other_sensor, unseen_severity, unseen_kind" in field
    work = describe(load_recipe("operation")).splitlines()
    assert (
        "supply: up to 12 V, each of these profiles as often: steps, reversals, staircase, binary, sine, speed_loop"
        in work
    )
    assert "  hold_s: 0.02 to 0.1, log-uniform, each start" in work


@pytest.mark.parametrize(("duration_s", "end_ms"), [(0.05, 25.0), (0.01, 10.0)])
def test_a_sheet_shows_four_starts_of_each_class(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, duration_s: float, end_ms: float
) -> None:
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    recipe: Recipe = replace(BENCH, timing=Timing(10_000.0, duration_s), classes=BENCH.classes[:2])
    draw_sheet(recipe, 3, tmp_path / "sheet.png")
    data = generate_arrays(recipe, 3, 160)
    above, below = np.array(drawn[0].axes).reshape(2, 2)
    half = data.time_s > 0.5 * data.time_s[-1]
    for column, name in enumerate(recipe.class_names):
        rows = np.flatnonzero(data.class_name == name)[:4]
        for axis, part in ((above[column], slice(None)), (below[column], half)):
            lines = axis.get_lines()
            assert len(lines) == 4
            for line, row in zip(lines, rows, strict=True):
                np.testing.assert_allclose(line.get_xdata(), 1e3 * data.time_s[part])
                np.testing.assert_array_equal(line.get_ydata(), data.X[row, 0, part])
    assert above[0].get_xlim() == pytest.approx((0.1, end_ms))
