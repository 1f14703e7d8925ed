"""Data sets behind URLs: the same bytes, the same refusals, one sentence where a URL cannot be used."""

import json
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from fsspec.registry import known_implementations
from small_sets import SHARD_BYTES, SHORT, Stopped, assert_goes_on, files_of, interrupted
from upath import UPath

from motor_datasets import generate, generate_dataset, load, manifest
from motor_datasets.cli import main
from motor_env import InputError

OPTIONS = ["generate", "bench", "--cases", "30", "--seed", "2", "--duration-s", "0.01"]


def objects_of(url: str) -> dict[str, bytes]:
    memory, root = fsspec.core.url_to_fs(url)
    return {path.removeprefix(f"{root}/"): memory.cat_file(path) for path in memory.find(root)}


@pytest.fixture
def url() -> Iterator[str]:
    memory = fsspec.filesystem("memory")
    name = f"/{uuid.uuid4().hex}"
    memory.makedirs(name)
    yield f"memory:/{name}/set"
    memory.rm(name, recursive=True)


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generate, "_SHARD_BYTES", SHARD_BYTES)


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
            put.append(given[argument])
            return call(*given)

        return noted

    monkeypatch.setattr(memory, "pipe_file", noting(memory.pipe_file, 1))
    monkeypatch.setattr(memory, "put_file", noting(memory.put_file, 2))
    generate_dataset(SHORT, 30, 1, url)
    names = [path.partition("/set/")[2] for path in put]
    assert names[0] == "unfinished.json"
    assert names[-3:] == ["README.md", "croissant.json", "dataset.json"]
    assert len(set(names)) == 7
    assert "unfinished.json" not in objects_of(url)


@pytest.mark.usefixtures("small_shards")
def test_worker_processes_put_the_same(tmp_path: Path) -> None:
    """fsspec's own local file system stands in for a storage that all workers see."""
    there = UPath((tmp_path / "there").as_uri(), auto_mkdir=True)
    generate_dataset(SHORT, 100, 1, tmp_path / "here")
    generate_dataset(SHORT, 100, 1, there, workers=2)
    assert files_of(tmp_path / "there") == files_of(tmp_path / "here")
    assert np.array_equal(load(there).X, load(tmp_path / "here").X)


def test_every_command_takes_a_url(tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*OPTIONS, "--out", str(tmp_path / "set")]) == 0
    assert main([*OPTIONS, "--out", url]) == 0
    before = objects_of(url)
    assert before == files_of(tmp_path / "set")
    assert main(["verify", url]) == 0
    assert main(["describe", url]) == 0
    assert main(["export", url, str(tmp_path / "a.npz")]) == 0
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert np.array_equal(archive["X"], load(tmp_path / "set").X)
    capsys.readouterr()
    assert main([*OPTIONS, "--out", url]) == 2
    assert "not overwritten" in capsys.readouterr().err
    assert objects_of(url) == before
    memory = fsspec.filesystem("memory")
    content = bytearray(before["data/train-000000.parquet"])
    content[500] ^= 1
    memory.pipe_file(f"{url}/data/train-000000.parquet", bytes(content))
    memory.rm_file(f"{url}/data/test-000000.parquet")
    memory.pipe_file(f"{url}/data/extra.parquet", b"")
    assert main(["verify", url]) == 1
    found = capsys.readouterr().out.splitlines()
    assert len(found) == 3
    assert main(["verify", url, "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == found
    for name, what in (("train-000000", "damaged"), ("test-000000", "missing"), ("extra", "foreign")):
        assert any(name in sentence and what in sentence for sentence in found)


def test_a_file_url_is_the_local_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = (tmp_path / "there").as_uri()
    assert main([*OPTIONS, "--out", str(tmp_path / "here")]) == 0
    assert main([*OPTIONS, "--out", there]) == 0
    assert files_of(tmp_path / "there") == files_of(tmp_path / "here")
    assert main(["verify", there]) == 0
    capsys.readouterr()
    assert main([*OPTIONS, "--out", there]) == 2
    assert "not overwritten" in capsys.readouterr().err


def test_a_url_that_cannot_be_used_is_one_sentence(
    url: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = {"class": "no_such_package.FileSystem", "err": "Install no_such_package to use nodriver"}
    monkeypatch.setitem(known_implementations, "nodriver", driver)
    for options, said in (
        (["--out", "nowhere://a/b"], "nowhere"),
        (["--out", "nodriver://a/b"], "Install no_such_package"),
        (["--out", url, "--workers", "2"], "workers must be 1"),
    ):
        assert main([*OPTIONS, *options]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
    assert main(["verify", url]) == 2
    assert "is no data set" in capsys.readouterr().err

    def deny(*_: Any) -> bool:
        raise Stopped("no credentials")

    monkeypatch.setattr(type(fsspec.filesystem("memory")), "exists", deny)
    assert main([*OPTIONS, "--out", url]) == 2
    error = capsys.readouterr().err
    assert "cannot be reached: no credentials" in error
    assert error.count("\n") == 1


def test_local_folders_need_no_fsspec(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['fsspec'] = None\n"
        "from motor_datasets.cli import main\n"
        f"sys.exit(main({[*OPTIONS, '--out', str(tmp_path / 'set')]!r}) or main(['verify', {str(tmp_path / 'set')!r}]))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_objects_are_of_a_stated_size(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    generate_dataset(SHORT, 30, 1, url)
    largest = max(len(content) for content in objects_of(url).values())
    for limit in ("LARGEST_DATA_BYTES", "LARGEST_MANIFEST_BYTES"):
        monkeypatch.setattr(manifest, limit, largest)
    load(url)
    for name in ("data/train-000000.parquet", "dataset.json"):
        fsspec.filesystem("memory").pipe_file(f"{url}/{name}", bytes(largest + 1))
        with pytest.raises(InputError, match=f"{name}: is larger than"):
            load(url)
