"""Interrupted, damaged, shared among workers: the bytes stay the same, or it is said what is wrong."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from small_sets import SHARD_BYTES, SHORT, SMALL_SHARDS, assert_goes_on, files_of, interrupted

from motor_datasets import generate, generate_dataset, load
from motor_env import InputError


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", SHARD_BYTES)


@pytest.mark.usefixtures("small_shards")
@pytest.mark.parametrize("after", [1, 4, 9])
def test_an_interrupted_generation_ends_byte_identical(tmp_path: Path, after: int) -> None:
    generate_dataset(SHORT, 400, 1, tmp_path / "whole")
    interrupted(tmp_path / "cut", 400, after)
    # What a kill leaves beside whole files: a partial file, and a damaged one.
    (tmp_path / "cut/data/.test-000001.parquet.partial").write_bytes(b"half")
    first = sorted((tmp_path / "cut/data").glob("*.parquet"))[0]
    first.write_bytes(first.read_bytes()[:1000])
    assert_goes_on(tmp_path / "cut", 400, files_of, tmp_path / "whole")
    assert len(files_of(tmp_path / "whole")) > 12


@pytest.mark.usefixtures("small_shards")
def test_a_full_disk_leaves_whole_files_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    generate_dataset(SHORT, 200, 1, tmp_path / "whole")
    write = pq.write_table
    written: list[Path] = []

    def write_until_full(table: pa.Table, path: Path, **options: object) -> None:
        if len(written) == 5:
            path.write_bytes(b"PAR1")
            raise OSError(28, "No space left on device", str(path))
        written.append(path)
        write(table, path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(pq, "write_table", write_until_full)
        with pytest.raises(InputError, match=r"parquet cannot be written: no space.* resume"):
            generate_dataset(SHORT, 200, 1, tmp_path / "cut")
    assert len(list((tmp_path / "cut/data").iterdir())) == 5
    generate_dataset(SHORT, 200, 1, tmp_path / "cut", resume=True)
    assert files_of(tmp_path / "cut") == files_of(tmp_path / "whole")


@pytest.mark.long
@pytest.mark.timeout(600)
def test_killed_at_ten_moments_and_whatever_the_workers(tmp_path: Path) -> None:
    """kill -9 of the whole process group, then --resume: byte-identical to one worker left in peace."""
    command = [sys.executable, "-c", SMALL_SHARDS, "generate", "bench", "--cases", "6000", "--seed", "3"]
    subprocess.run([*command, "--out", str(tmp_path / "whole")], check=True)
    whole = files_of(tmp_path / "whole")
    out = tmp_path / "cut"
    rng = np.random.default_rng(1)
    killed = 0
    for n, target in enumerate(rng.integers(0, len(whole) - 10, 10)):
        options = ["--out", str(out), "--workers", str(1 + n % 3), "--resume"]
        process = subprocess.Popen([*command, *options], start_new_session=True)
        while process.poll() is None and len(list((out / "data").glob("*.parquet"))) < target:
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.02))  # anywhere within a file
        killed += process.poll() is None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        subprocess.run([*command, *options], check=True)
        assert files_of(out) == whole
        shutil.rmtree(out)
    assert killed >= 8


def test_other_tools_read_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hugging Face's datasets, offline and by the card; pandas, polars and DuckDB."""
    huggingface = pytest.importorskip("datasets")
    pandas = pytest.importorskip("pandas")
    polars = pytest.importorskip("polars")
    duckdb = pytest.importorskip("duckdb")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "cache"))
    generate_dataset(SHORT, 60, 1, tmp_path / "set")
    ours = load(tmp_path / "set", "test")
    theirs = huggingface.load_dataset(str(tmp_path / "set"), split="test", cache_dir=str(tmp_path / "cache"))
    assert np.array_equal(np.array(theirs["current_a"], dtype=np.float32), ours.X[:, 0])
    assert list(theirs["class_name"]) == ours.class_name.tolist()
    file = tmp_path / "set/data/test-000000.parquet"
    frame = pandas.read_parquet(file)
    assert np.array_equal(np.stack(frame["current_a"].to_list()), ours.X[:, 0])
    column = polars.read_parquet(file)["current_a"]
    assert np.array_equal(column.to_numpy(), ours.X[:, 0])
    rows = duckdb.read_parquet(str(file)).order("case_id").fetchnumpy()
    assert np.array_equal(np.stack(rows["current_a"]), ours.X[:, 0])
    assert np.array_equal(rows["severity"], ours.severity)
