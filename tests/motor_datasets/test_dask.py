"""The Dask backend: several worker processes, one of them killed, the same bytes."""

import filecmp
import os
import signal
from dataclasses import replace
from pathlib import Path

import joblib
import pytest

from motor_datasets import generate_dataset, layout
from motor_env import Timing, load_recipe


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # a killed worker is worth a warning or two
def test_a_killed_dask_worker_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra dask is not installed")
    monkeypatch.setattr(layout, "_SHARD_BYTES", 2 * 2**20)
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
