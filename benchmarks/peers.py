"""Answers of aeon's classifiers to the benchmark's starts: `make peers-anew` writes those that the package ships.

`python benchmarks/peers.py --out out/peers.npz --n-test 20000 --only quant`, then
`motor-classifiers benchmark --n-test 20000 --peers out/peers.npz`. Needs `make peers`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

from run import FOLDER, ONE_THREAD

from motor_classifiers.scoring.judging import Cell
from motor_classifiers.scoring.peers import PEERS, export_starts, shipped_peers
from motor_env.simulation.named_recipes import named_recipe

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


def main() -> int:
    """Export the starts, let the peers judge them, keep the answers."""
    parser = argparse.ArgumentParser(description="Answers of aeon's classifiers to the benchmark's starts.")
    parser.add_argument("--out", metavar="FILE", type=Path, default=shipped_peers())
    parser.add_argument("--recipe", default="bench")
    parser.add_argument("--n-train", type=int, default=2000)
    parser.add_argument("--n-test", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", metavar="NAME", action="append", choices=list(PEERS))
    options = parser.parse_args()
    cell = Cell(named_recipe(options.recipe), options.n_train, options.n_test, options.seed)
    with tempfile.TemporaryDirectory() as folder:
        cases = Path(folder) / "cases.npz"
        export_starts(cell.train(), cell.test(), cases)
        names = options.only or list(PEERS)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        done = subprocess.run(command(cases, options.out.resolve(), *names), env=environment(), check=False)
    return done.returncode


if __name__ == "__main__":
    raise SystemExit(main())
