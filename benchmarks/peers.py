"""Answers of aeon's classifiers to the benchmark's starts: `make peers-anew` writes those that are kept.

`python benchmarks/peers.py --out out/peers.npz --n-test 20000 --only quant`, then
`motor-classifiers benchmark --n-test 20000 --peers out/peers.npz`. Needs `make peers`.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import cyclopts
import numpy as np
from numpy.typing import NDArray
from run import FOLDER, ONE_THREAD

from motor_classifiers.scoring.benchmark import PEERS, identity
from motor_classifiers.scoring.task import class_task
from motor_datasets.arrays import Dataset
from motor_env.common.files import replacing
from motor_env.simulation.named_recipes import named_recipe

KEPT = FOLDER / "results" / "peers.npz"
PYTHON = FOLDER.parent / ".venv-aeon" / "bin" / "python"


def command(*arguments: object) -> list[str]:
    """Command line of aeon_peers.py, in the environment where aeon lives.

    Raises:
        FileNotFoundError: the environment is not there.
    """
    if not PYTHON.exists():
        raise FileNotFoundError(f"{PYTHON} is missing: `make peers` sets it up")
    return [str(PYTHON), str(FOLDER / "aeon_peers.py"), *map(str, arguments)]


def environment() -> dict[str, str]:
    """Environment variables: one thread for everything."""
    return {**os.environ, **ONE_THREAD}


def export_starts(train: Dataset, test: Dataset, path: Path) -> None:
    """Write starts to learn from and starts to be judged, as plain arrays."""
    with replacing(path) as temporary:
        facts = {"n_classes": len(test.class_names), "recipe": test.recipe.name, "seed": test.seed}
        arrays = {name: np.array(value) for name, value in facts.items()} | identity(train, test)
        np.savez(temporary, allow_pickle=False, train_X=train.X, test_X=test.X, **arrays)


def peer_answers(train: Dataset, test: Dataset, *names: str) -> dict[str, NDArray[np.float64]]:
    """Probabilities of each class by peer, on the starts to be judged, of peers that learned from the others."""
    with tempfile.TemporaryDirectory() as folder:
        cases, target = Path(folder) / "cases.npz", Path(folder) / "answers.npz"
        export_starts(train, test, cases)
        subprocess.run(command(cases, target, *names), env=environment(), check=True)
        with np.load(target) as arrays:
            return {name: arrays[name].astype(np.float64) for name in names}


def main(
    *,
    out: Path | None = None,
    recipe: str = "bench",
    n_train: int = 2000,
    n_test: int = 2000,
    seed: int = 0,
    only: list[str] | None = None,
) -> int:
    """Export the starts, let the peers judge them, keep the answers; by default of all, and where they are kept."""
    task = class_task(named_recipe(recipe), n_train, n_test, seed)
    with tempfile.TemporaryDirectory() as folder:
        cases = Path(folder) / "cases.npz"
        export_starts(task.train(), task.starts(), cases)
        target = (out or KEPT).resolve()
        target.parent.mkdir(parents=True, exist_ok=True)
        done = subprocess.run(command(cases, target, *(only or PEERS)), env=environment(), check=False)
    return done.returncode


if __name__ == "__main__":
    raise SystemExit(cyclopts.run(main))
