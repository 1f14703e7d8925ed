"""Data sets that were damaged, or made by strangers: refused, or had again; never taken for whole."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from motor_datasets import generate_dataset, layout, load, parquet
from motor_datasets.cli import main
from motor_env.errors import InputError
from motor_env.simulation.named_recipes import RECIPES
from motor_env.simulation.recipes import Shift
from motor_env.simulation.simulate import Timing

SHORT = replace(RECIPES["bench"], timing=Timing(duration_s=0.01))


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "_SHARD_BYTES", 50_000)


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def flip(data: Path) -> None:
    """One bit in the middle of the samples."""
    path = data / "train-000000.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def swap(data: Path, other: str = "train-000001.parquet") -> None:
    (data / "train-000000.parquet").rename(data / "x")
    (data / other).rename(data / "train-000000.parquet")
    (data / "x").rename(data / other)


def swap_splits(data: Path) -> None:
    swap(data, "test-000000.parquet")


def another_seed(data: Path) -> None:
    generate_dataset(SHORT, 200, 8, data.parent.parent / "other")
    shutil.copy(data.parent.parent / "other/data/train-000000.parquet", data / "train-000000.parquet")


def ten_rows(data: Path) -> None:
    pq.write_table(pq.read_table(data / "train-000000.parquet").slice(0, 10), data / "train-000000.parquet")


def one_missing(data: Path) -> None:
    (data / "train-000000.parquet").unlink()


DAMAGES = (flip, swap, swap_splits, another_seed, ten_rows, one_missing)


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


def test_load_tells_every_flipped_bit(tmp_path: Path) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    path = tmp_path / "set/data/test-000000.parquet"
    whole = path.read_bytes()
    rng = np.random.default_rng(4)
    for place, bit in zip(rng.integers(len(whole), size=60), rng.integers(8, size=60), strict=True):
        content = bytearray(whole)
        content[place] ^= 1 << bit
        path.write_bytes(content)
        with pytest.raises(InputError, match="is damaged"):
            load(tmp_path / "set", "test")
    path.write_bytes(whole)
    assert len(load(tmp_path / "set", "test")) > 0


def told(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the manifest, as a stranger could who knows the format."""
    manifest = json.loads((folder / "dataset.json").read_text())
    change(manifest)
    (folder / "dataset.json").write_text(json.dumps(manifest))


def certified(path: Path, manifest: dict[str, Any]) -> None:
    """Give the first file of a manifest the size and digest of what stands at a path."""
    content = path.read_bytes()
    manifest["files"][0] |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def test_samples_of_another_length_are_not_broadcast(tmp_path: Path) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    path = tmp_path / "set/data/train-000000.parquet"
    table = pq.read_table(path)
    flat = pa.array(np.ones(len(table), dtype=np.float32))
    short = pa.FixedSizeListArray.from_arrays(flat, 1)
    column = table.schema.get_field_index("current_a")
    pq.write_table(table.set_column(column, "current_a", short), path)
    told(tmp_path / "set", lambda manifest: certified(path, manifest))
    with pytest.raises(InputError, match="other rows or columns"):
        load(tmp_path / "set")


def many_rows(table: pa.Table) -> pa.Table:
    return table.take(np.zeros(10_000, np.int64))


def long_label(table: pa.Table) -> pa.Table:
    place = table.schema.get_field_index("split")
    label = pa.array(["train" + "x" * 20_000_000])
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(table), np.int16)), label)
    return table.set_column(place, table.schema.field(place), column)


@pytest.mark.parametrize(("bomb", "rows"), [(many_rows, 10_000), (long_label, None)])
def test_a_file_that_unpacks_to_more_than_its_cases_is_not_read(
    bomb: Callable[[pa.Table], pa.Table], rows: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    path = tmp_path / "set/data/train-000000.parquet"
    table = bomb(pq.read_table(path))
    pq.write_table(table, path, compression="zstd", use_dictionary=["split"])

    def change(manifest: dict[str, Any]) -> None:
        certified(path, manifest)
        manifest["files"][0]["rows"] = rows or manifest["files"][0]["rows"]

    told(tmp_path / "set", change)
    monkeypatch.setattr(parquet, "_ALWAYS_READ_BYTES", 10**6)
    monkeypatch.setattr(pq.ParquetFile, "read", None)
    with pytest.raises(InputError, match=r"unpacks? to"):
        load(tmp_path / "set")


def test_a_file_larger_than_any_of_ours_is_not_read(tmp_path: Path) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    path = tmp_path / "set/data/train-000000.parquet"
    os.truncate(path, 10**10)  # all zeros, which take no room on the disk
    told(tmp_path / "set", lambda manifest: manifest["files"][0].update(bytes=10**10))
    for command in ("verify", "export"):
        assert (
            main([command, str(tmp_path / "set"), *([str(tmp_path / "x.npz")] * (command == "export"))]) == 2
        )


def test_what_does_not_fit_onto_the_disk_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10_000))
    with pytest.raises(InputError, match=r"of data do not fit onto its disk, which has 0\.0 GB left"):
        generate_dataset(SHORT, 200, 1, tmp_path / "parent/set")
    assert list(tmp_path.iterdir()) == []


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
def test_a_manifest_names_files_of_its_own_folder_only(tmp_path: Path, path: str) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    (tmp_path / "secret").mkdir()
    shutil.copy(tmp_path / "set/data/train-000000.parquet", tmp_path / "secret/x.parquet")

    def outside(manifest: dict[str, Any]) -> None:
        certified(tmp_path / "secret/x.parquet", manifest)
        manifest["files"][0]["path"] = path.format(folder=tmp_path)

    told(tmp_path / "set", outside)
    for command in (
        ["verify", str(tmp_path / "set")],
        ["export", str(tmp_path / "set"), str(tmp_path / "x.npz")],
    ):
        assert main(command) == 2
    assert not (tmp_path / "x.npz").exists()


def test_what_is_no_file_is_not_opened(tmp_path: Path) -> None:
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    path = tmp_path / "set/data/train-000000.parquet"
    for make in (os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero")):
        path.unlink(missing_ok=True)
        make(path)
        with pytest.raises(InputError, match="is missing"):
            load(tmp_path / "set")
        (path.rmdir if path.is_dir() else path.unlink)()
    path.symlink_to("/proc/self/status")  # a file by name, whose size is 0 until it is read
    with pytest.raises(InputError, match=r"is damaged|cannot be read"):
        load(tmp_path / "set")


def mutated(manifest: dict[str, Any], rng: np.random.Generator) -> str:
    """A manifest with one value at any depth replaced, or its text cut or with a changed byte."""
    values: list[Any] = [None, True, -1, 0, 1.5, 1e308, 10**400, "", "../x", [], {}, [[]], "\ud800", 2**64]
    if rng.random() < 0.3:
        text = bytearray(json.dumps(manifest).encode())
        text[rng.integers(len(text))] = rng.integers(256)
        return text[: rng.integers(len(text)) if rng.random() < 0.3 else None].decode("latin-1")
    here: Any = manifest
    while True:
        key = list(here)[rng.integers(len(here))] if isinstance(here, dict) else int(rng.integers(len(here)))
        if not isinstance(here[key], (dict, list)) or not here[key] or rng.random() < 0.2:
            break
        here = here[key]
    here[key] = values[rng.integers(len(values))]
    return json.dumps(manifest)


@pytest.mark.parametrize("count", [60, pytest.param(300, marks=pytest.mark.long)])
def test_changed_manifests_are_one_sentence_or_the_same_data(
    tmp_path: Path, count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    generate_dataset(SHORT, 30, 1, tmp_path / "set")
    path = tmp_path / "set/dataset.json"
    text, whole = path.read_text(), load(tmp_path / "set")
    rng = np.random.default_rng(7)
    refused = 0
    for _ in range(count):
        path.write_text(mutated(json.loads(text), rng), encoding="latin-1")
        try:
            got = load(tmp_path / "set")
        except InputError:
            refused += 1
        else:
            # A file left out of the list is not missed by `load`; what it names is as it was written.
            rows = np.isin(whole.case_id, got.case_id)
            assert np.array_equal(got.X, whole.X[rows])
    assert refused > 0.5 * count
    deep = '{"format": ' + "[" * 100_000
    for damaged in (deep, "[]", "3", "null", ""):
        path.write_text(damaged)
        assert main(["verify", str(tmp_path / "set")]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """A Parquet file with bytes overwritten in its pages, or in its footer, the table of what it holds."""
    data, footer = bytearray(whole), int.from_bytes(whole[-8:-4], "little") + 8
    for _ in range(int(rng.integers(1, 4))):
        low = 4 if rng.random() < 0.5 else len(data) - footer
        place, size = int(rng.integers(low, len(data) - 8)), int(rng.integers(1, 9))
        data[place : place + size] = rng.bytes(size)
    return bytes(data[: len(whole)])


READ_ALL = """
import resource, signal, sys
from motor_datasets import load
from motor_env.errors import InputError
for folder in sys.argv[1:]:
    signal.alarm(60)
    try:
        load(folder)
    except InputError as error:
        assert chr(10) not in str(error), str(error)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, folder, flush=True)
"""


@pytest.mark.parametrize("count", [20, pytest.param(300, marks=pytest.mark.long)])
def test_certified_damage_is_one_sentence_or_data(tmp_path: Path, count: int) -> None:
    """Files of strangers, whose digests are right: whatever compiled code makes of them, it ends in a sentence."""
    generate_dataset(SHORT, 30, 1, tmp_path / "set")
    rng, folders = np.random.default_rng(9), []
    for n in range(count):
        folders.append(str(shutil.copytree(tmp_path / "set", tmp_path / str(n))))
        path = tmp_path / f"{n}/data/train-000000.parquet"
        path.write_bytes(damaged(path.read_bytes(), rng))
        told(tmp_path / str(n), partial(certified, path))
    done = subprocess.run(
        [sys.executable, "-c", READ_ALL, *folders], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr[-500:] + done.stdout[-100:]
    assert max(int(line.split()[0]) for line in done.stdout.splitlines()) < 2_000_000  # kB


def test_two_shifts_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shifts of recipe bench must differ, got warm, warm"):
        replace(SHORT, shifts=(Shift("warm"), Shift("warm")))
    generate_dataset(SHORT, 30, 1, tmp_path / "set")
    told(tmp_path / "set", lambda manifest: manifest["files"].append(manifest["files"][0]))
    with pytest.raises(InputError, match="named twice"):
        load(tmp_path / "set")
