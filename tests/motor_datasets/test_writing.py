"""Interrupted, killed, on a full disk, shared among workers, behind URLs: the bytes stay the same, or one sentence."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fsspec.registry import known_implementations
from small_sets import SHARD_BYTES, SHORT, SMALL_SHARDS, Stopped, assert_goes_on, files_of, interrupted
from upath import UPath

from motor_datasets import generate, generate_dataset, load
from motor_datasets.cli import main
from motor_env import InputError

OPTIONS = ["generate", "bench", "--cases", "30", "--seed", "2", "--duration-s", "0.01"]
GENERATE = [sys.executable, "-c", SMALL_SHARDS, "generate", "bench", "--seed", "3"]


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", SHARD_BYTES)


@pytest.mark.usefixtures("small_shards")
@pytest.mark.parametrize("after", [1, 9])
def test_an_interrupted_generation_ends_byte_identical(tmp_path: Path, after: int) -> None:
    generate_dataset(SHORT, 400, 1, tmp_path / "whole")
    interrupted(tmp_path / "cut", 400, after)
    # What a kill leaves beside whole files: a partial file, and a damaged one.
    (tmp_path / "cut/data/.test-000001.parquet.partial").write_bytes(b"half")
    first = min((tmp_path / "cut/data").glob("*.parquet"))
    first.write_bytes(first.read_bytes()[:1000])
    assert_goes_on(tmp_path / "cut", 400, files_of, tmp_path / "whole")
    assert len(files_of(tmp_path / "whole")) > 12


@pytest.mark.usefixtures("small_shards")
def test_a_full_disk_leaves_whole_files_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    generate_dataset(SHORT, 200, 1, tmp_path / "whole")
    write, written = pq.write_table, list[Path]()

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
    command, out, killed = [*GENERATE, "--cases", "6000"], tmp_path / "cut", 0
    subprocess.run([*command, "--out", str(tmp_path / "whole")], check=True)
    whole, rng = files_of(tmp_path / "whole"), np.random.default_rng(1)
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


def with_mark(mark: str) -> list[int]:
    """Processes that have this in their environment."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark.encode() in (process / "environ").read_bytes():
                found.append(int(process.name))
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "SIGKILL"])
def test_workers_end_with_their_parent(tmp_path: Path, number: signal.Signals) -> None:
    mark = uuid.uuid4().hex
    command = [*GENERATE, "--cases", "200000", "--out", str(tmp_path / "set"), "--workers", "2"]
    environment = {**os.environ, "MARK_OF_THIS_TEST": mark}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
    until = time.monotonic() + 90.0
    while len(list((tmp_path / "set/data").glob("[!.]*.parquet"))) < 2 and time.monotonic() < until:
        time.sleep(0.05)
    assert len(with_mark(mark)) >= 3
    process.send_signal(number)
    _, said = process.communicate(timeout=60)  # would wait for all that hold the pipe
    until = time.monotonic() + 30.0
    while with_mark(mark) and time.monotonic() < until:
        time.sleep(0.05)
    assert with_mark(mark) == []
    if number == signal.SIGTERM:
        assert process.returncode == 128 + signal.SIGTERM
        assert b"Traceback" not in said
        assert list((tmp_path / "set").rglob(".*.partial")) == []


def objects_of(url: str) -> dict[str, bytes]:
    memory, root = fsspec.core.url_to_fs(url)
    return {path.removeprefix(f"{root}/"): memory.cat_file(path) for path in memory.find(root)}


@pytest.fixture
def url() -> Iterator[str]:
    memory, name = fsspec.filesystem("memory"), f"/{uuid.uuid4().hex}"
    memory.makedirs(name)
    yield f"memory:/{name}/set"
    memory.rm(name, recursive=True)


@pytest.mark.usefixtures("small_shards")
def test_objects_are_the_files_also_when_interrupted(tmp_path: Path, url: str) -> None:
    generate_dataset(SHORT, 200, 1, tmp_path / "set")
    interrupted(url, 200, 4)
    begun = objects_of(url)
    assert sorted(begun)[-1] == "unfinished.json"
    assert len(begun) == 5
    fsspec.filesystem("memory").pipe_file(f"{url}/{min(begun)}", begun[min(begun)][:1000])  # cut short
    assert_goes_on(url, 200, objects_of, tmp_path / "set")
    for split in (None, "test"):
        there, here = load(url, split), load(tmp_path / "set", split)
        assert np.array_equal(there.X, here.X)
        assert np.array_equal(there.case_id, here.case_id)


def test_the_manifest_is_put_last(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    put: list[str] = []
    memory = type(fsspec.filesystem("memory"))

    def noting(call: Callable[..., Any], argument: int) -> Callable[..., Any]:
        def noted(*given: Any) -> Any:
            put.append(given[argument].partition("/set/")[2])
            return call(*given)

        return noted

    for name, argument in (("pipe_file", 1), ("put_file", 2)):
        monkeypatch.setattr(memory, name, noting(getattr(memory, name), argument))
    generate_dataset(SHORT, 30, 1, url)
    assert put[0] == "unfinished.json"
    assert put[-3:] == ["README.md", "croissant.json", "dataset.json"]
    assert len(set(put)) == 7
    assert "unfinished.json" not in objects_of(url)


@pytest.mark.usefixtures("small_shards")
def test_worker_processes_put_the_same(tmp_path: Path) -> None:
    """fsspec's own local file system stands in for a storage that all workers see."""
    there = UPath((tmp_path / "there").as_uri(), auto_mkdir=True)
    generate_dataset(SHORT, 100, 1, tmp_path / "here")
    generate_dataset(SHORT, 100, 1, there, workers=2)
    assert files_of(tmp_path / "there") == files_of(tmp_path / "here")


def test_every_command_takes_a_url(tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str]) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    for place in (str(here), there.as_uri(), url):
        assert main([*OPTIONS, "--out", place]) == 0
        for command in (["verify", place], ["describe", place]):
            assert main(command) == 0
    before = objects_of(url)
    assert before == files_of(here) == files_of(there)
    assert main(["export", url, str(tmp_path / "a.npz")]) == 0
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert np.array_equal(archive["X"], load(here).X)
    assert main([*OPTIONS, "--out", url]) == 2
    assert "not overwritten" in capsys.readouterr().err
    assert objects_of(url) == before


def test_verify_tells_what_is_wrong_behind_a_url(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*OPTIONS, "--out", url]) == 0
    memory, content = fsspec.filesystem("memory"), bytearray(objects_of(url)["data/train-000000.parquet"])
    content[500] ^= 1
    memory.pipe_file(f"{url}/data/train-000000.parquet", bytes(content))
    memory.rm_file(f"{url}/data/test-000000.parquet")
    memory.pipe_file(f"{url}/data/extra.parquet", b"")
    capsys.readouterr()
    assert main(["verify", url]) == 1
    found = sorted(capsys.readouterr().out.splitlines())
    assert main(["verify", url, "--json"]) == 1
    assert sorted(json.loads(capsys.readouterr().out)) == found
    for words, sentence in zip(
        (("extra", "foreign"), ("test", "missing"), ("train", "damaged")), found, strict=True
    ):
        assert all(word in sentence for word in words)


def deny(*_: Any) -> bool:
    raise Stopped("no credentials")


HERE = "--seed 1 --out {here}"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (f"generate nope --cases 3 {HERE}", "recipe must be one of"),
        (f"generate bench --cases 0 {HERE}", "cases must be >= 1"),
        (f"generate bench --cases 3 --channels current,torque {HERE}", "torque"),
        (f"generate bench --cases 3 --sampling-rate-hz -1 {HERE}", "sampling_rate_hz must be"),
        (f"generate bench --cases 3 --motor none.toml {HERE}", "none.toml"),
        ("generate bench --cases 3 --seed 1 --out nowhere://a/b", "nowhere"),
        ("generate bench --cases 3 --seed 1 --out nodriver://a/b", "Install no_such_package"),
        ("generate bench --cases 3 --seed 1 --out {url} --workers 2", "workers must be 1"),
        ("verify {url}", "is no data set"),
        ("generate bench --cases 3 --seed 1 --out {url}", "cannot be reached: no credentials"),
    ],
)
def test_wrong_use_is_one_sentence_and_leaves_nothing(
    command: str,
    words: str,
    url: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = {"class": "no_such_package.FileSystem", "err": "Install no_such_package to use nodriver"}
    monkeypatch.setitem(known_implementations, "nodriver", driver)
    if "credentials" in words:
        monkeypatch.setattr(type(fsspec.filesystem("memory")), "exists", deny)
    assert main(command.format(url=url, here=tmp_path / "set").split()) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_local_folders_need_no_fsspec(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] in ("fsspec", "upath")]:
        monkeypatch.setitem(sys.modules, name, None)
    assert main([*OPTIONS, "--out", str(tmp_path / "set")]) == 0
    assert main(["verify", str(tmp_path / "set")]) == 0
