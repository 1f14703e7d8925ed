"""Measure motor-env against its peers: `make bench`, or `python benchmarks/run.py --only filter`.

`make bench BENCH_ARGS=--keep` on a machine that does nothing else, then `python benchmarks/result_tables.py`, make
docs/results/speed.md anew.

Every module ``bench_*.py`` beside this file offers ``run() -> list[Result]``. Each runs in a process of its
own with all thread pools at 1, and both sides of a ratio are measured in that one process.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tables import table

FOLDER = Path(__file__).resolve().parent
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    ),
    "1",
)
KEPT = FOLDER / "results" / "speed.json"
Row = dict[str, Any]
AT_LEAST_S = 0.2


@dataclass(frozen=True)
class Result:
    """Two rates of the same work, measured in one process, and the ratio promised.

    Rates are work per second (samples, steps, cases): larger is better.
    """

    name: str
    ours: float
    peer: float
    peer_name: str
    bar: float

    def as_row(self) -> Row:
        """Return the fields and what follows from them, as written to bench.json."""
        ratio = self.ours / self.peer
        return {**asdict(self), "ratio": ratio, "holds": ratio >= self.bar}


def best_rate(work: Callable[[], object], amount: float, *, rounds: int = 5) -> float:
    """Return ``amount`` per second of ``work()``: the best of some rounds, after one call that warms up.

    A round repeats the work until ``AT_LEAST_S`` has passed, so that quick work is not lost in the clock.
    """
    work()
    return max(_rate(work, amount) for _ in range(rounds))


def _rate(work: Callable[[], object], amount: float) -> float:
    start, repeats, elapsed = time.perf_counter(), 0, 0.0
    while elapsed < AT_LEAST_S:
        work()
        repeats += 1
        elapsed = time.perf_counter() - start
    return amount * repeats / elapsed


def discover() -> list[str]:
    """Names of the benchmarks: ``bench_filter.py`` is ``filter``."""
    return sorted(path.stem.removeprefix("bench_") for path in FOLDER.glob("bench_*.py"))


def measure_here(name: str, answer: Path) -> None:
    """Run one benchmark in this process and leave its rows in a file."""
    results = importlib.import_module(f"bench_{name}").run()
    answer.write_text(json.dumps([result.as_row() for result in results]))


def measure_apart(name: str) -> list[Row] | None:
    """Run one benchmark in a process of its own; None if it failed."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "rows.json"
        command = [
            sys.executable,
            str(Path(__file__).resolve()),
            "--measure-here",
            name,
            "--out",
            str(answer),
        ]
        finished = subprocess.run(command, env={**os.environ, **ONE_THREAD}, check=False)
        if finished.returncode != 0:
            return None
        rows: list[Row] = json.loads(answer.read_text())
    return rows


def cells(row: Row) -> list[str]:
    """A row of the table."""
    rates = (f"{row['ours']:.3g}", f"{row['peer']:.3g}", row["peer_name"])
    rounded = float(f"{row['ratio']:.3g}")
    ratio = (f"{rounded:,g} x", f"{row['bar']:g} x", "holds" if row["holds"] else "MISSED")
    return [row["name"], *rates, *ratio]


def page_table(name: str, rows_of: str = "") -> str:
    """What is kept of a benchmark, or only of what `rows_of` begins the name of."""
    kept = json.loads(KEPT.read_bytes()) if KEPT.is_file() else []
    shown = [
        [row["name"], *(f"{float(f'{row[who]:.3g}'):,.0f}" for who in ("ours", "peer")), *cells(row)[3:5]]
        for row in kept
        if row["bench"] == name and row["name"].startswith(rows_of)
    ]
    if not shown:
        return "Not measured yet."
    return table(("what", "ours a second", "peer a second", "peer", "ratio"), shown)


def main() -> int:
    """Measure, print the table, write the file. Exit status 1 if a benchmark failed to run."""
    parser = argparse.ArgumentParser(description="Measure motor-env against its peers.")
    parser.add_argument(
        "--only", metavar="NAME", action="append", choices=discover(), help="one of: %(choices)s"
    )
    parser.add_argument("--out", metavar="FILE", type=Path, default=Path("out/bench.json"))
    parser.add_argument("--keep", action="store_true", help="keep the rows for the page on speed, too")
    parser.add_argument("--measure-here", metavar="NAME", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure_here:
        measure_here(options.measure_here, options.out)
        return 0

    rows: list[Row] = []
    failed: list[str] = []
    for name in options.only or discover():
        print(f"measuring {name} ...", file=sys.stderr, flush=True)
        measured = measure_apart(name)
        if measured is None:
            failed.append(name)
        else:
            rows += [{"bench": name, **row} for row in measured]

    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(rows, indent=2) + "\n")
    if options.keep:
        new = {row["bench"] for row in rows}
        old = json.loads(KEPT.read_bytes()) if KEPT.is_file() else []
        kept = [row for row in old if row["bench"] not in new] + rows
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    print(table(("what", "ours /s", "peer /s", "peer", "ratio", "bar", ""), map(cells, rows)))
    print(f"\nwritten: {options.out}")
    for name in failed:
        print(f"FAILED: bench_{name} (see above)", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
