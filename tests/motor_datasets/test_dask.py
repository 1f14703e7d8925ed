"""The Dask backend: several worker processes, one of them killed, the same bytes."""

import filecmp
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import joblib
import pytest

from motor_datasets import folder, generate, generate_dataset
from motor_datasets.cli import main
from motor_env import Timing, load_recipe


@pytest.mark.parametrize(
    ("asked", "used"),
    [([], 1), (["--scheduler", "tcp://a:1"], 5), (["--scheduler", "tcp://a:1", "--workers", "3"], 3)],
)
def test_all_of_a_cluster_write_unless_a_number_is_asked_for(
    asked: list[str], used: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    counts = []

    @contextmanager
    def client(address: str) -> Iterator[SimpleNamespace]:
        assert address == "tcp://a:1"
        yield SimpleNamespace(nthreads=lambda: {"one": 4, "other": 1})

    def generated(*_: Any, workers: int, **__: Any) -> SimpleNamespace:
        counts.append(workers)
        return SimpleNamespace(bytes=0)

    monkeypatch.setattr(distributed, "Client", client)
    monkeypatch.setattr(joblib, "parallel_config", lambda **_: nullcontext())
    monkeypatch.setattr(folder, "generate_dataset", generated)
    assert (
        main(["generate", "bench", "--cases", "10", "--seed", "1", "--out", str(tmp_path / "set"), *asked])
        == 0
    )
    assert counts == [used]


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # a killed worker is worth a warning or two
def test_a_killed_dask_worker_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setattr(generate, "_SHARD_BYTES", 2 * 2**20)
    recipe = replace(load_recipe("bench"), timing=Timing(duration_s=0.05))
    whole = generate_dataset(recipe, 30_000, 3, tmp_path / "one")
    cluster = distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None
    )
    with cluster, distributed.Client(cluster) as client:
        victim = next(iter(client.run(os.getpid).values()))
        seen: list[int] = []

        def kill_once(count: int) -> None:
            if len(seen) == 3:
                os.kill(victim, signal.SIGKILL)
            seen.append(count)

        with joblib.parallel_config(backend="dask"):
            generate_dataset(recipe, 30_000, 3, tmp_path / "dask", workers=3, on_progress=kill_once)
    names = [entry.path for entry in whole.files] + ["dataset.json", "README.md"]
    same, different, missing = filecmp.cmpfiles(tmp_path / "one", tmp_path / "dask", names, shallow=False)
    assert (len(same), different, missing) == (len(names), [], [])
    assert len(seen) > 4
