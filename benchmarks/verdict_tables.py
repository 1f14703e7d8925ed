"""Tables of verdicts: numbered cases are made and judged, in processes, and what was said in each cell is counted.

A cell is what its cases were, in words: a profile, a motor, a fault. Case n depends on a seed and n alone, so a count
goes on where its file ends, whatever the number of workers. `kept_rows` does so for rows of any kind.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from cyclopts import Parameter

from motor_env.diagnosis.verdict.judgement import JudgedRecording

Job = TypeVar("Job")
Row = dict[str, Any]


def kept_rows(
    one: Callable[[Job], Row],
    jobs: Mapping[Any, Job],
    key: Callable[[Row], Hashable],
    workers: int,
    file: Path | None,
) -> list[Row]:
    """The rows that a file holds, and those of the other jobs, in the order in which they came.

    Args:
        one: makes the row of a job.
        jobs: by what they depend on.
        key: the same of a row.
        workers: processes.
        file: of the rows; None: nothing is kept.
    """
    file = file or Path(tempfile.mkdtemp()) / "rows.jsonl"
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    done = {key(row) for row in rows}
    left = [job for name, job in jobs.items() if name not in done]
    with ProcessPoolExecutor(workers) as pool, file.open("a", encoding="utf-8") as out:
        for row in pool.map(one, left):
            rows.append(row)
            print(json.dumps(row), file=out, flush=True)
            print(f"\r{len(rows)} of {len(jobs)}", end="", file=sys.stderr, flush=True)
    return rows


Cell = tuple[str, ...]
Said = list[tuple[Cell, str]]
"""What was said in one case: cells and verdicts."""


def verdict_names(found: JudgedRecording) -> str:
    """The verdict, and the further faults that it names."""
    return " + ".join(sorted([found.verdict, *(fault.verdict for fault in found.also)]))


def words_of(verdicts: Counter[str]) -> str:
    """Verdicts and their numbers, the most frequent first."""
    return ", ".join(f"{verdict} {n}" for verdict, n in verdicts.most_common())


@Parameter(name="*")
@dataclass(frozen=True)
class How:
    """Options of every script.

    Attributes:
        workers: processes.
        rows: file of a JSON line a case; those that it holds are not judged again.
    """

    workers: int = 1
    rows: Path | None = None


HERE = How()


@dataclass
class Counts:
    """How often each verdict was given in each cell.

    Attributes:
        cells: verdicts by cell, in the order in which they came.
    """

    cells: dict[Cell, Counter[str]] = field(default_factory=dict)

    def __getitem__(self, begin: Cell) -> Counter[str]:
        """Verdicts of all cells that begin with these words."""
        parts = (verdicts for cell, verdicts in self.cells.items() if cell[: len(begin)] == begin)
        return sum(parts, Counter[str]())

    def by(self, *places: int) -> dict[Cell, Counter[str]]:
        """Verdicts by some of the words of the cells."""
        out: dict[Cell, Counter[str]] = {}
        for cell, verdicts in self.cells.items():
            out.setdefault(tuple(cell[place] for place in places), Counter()).update(verdicts)
        return out


def _row(number: int, judge: Callable[[int], Said], of: Mapping[str, Any]) -> Row:
    return {"number": number, "of": of, "said": judge(number)}


def counted(
    judge: Callable[[int], Said],
    cases: int,
    how: How = HERE,
    *,
    of: Mapping[str, Any] | None = None,
) -> Counts:
    """Judge cases and count what is said.

    Args:
        judge: what is said in the case of a number.
        cases: how many, from number 0 on.
        how: processes, and the file.
        of: what the cases depend on beside their number.

    Raises:
        ValueError: the file holds other cases.
    """
    of = of or {}

    def number_of(row: Row) -> int:
        if row["of"] != of:
            raise ValueError(f"{how.rows} holds cases of {row['of']}, not of {of}: name another file")
        return int(row["number"])

    jobs = {number: number for number in range(cases)}
    counts = Counts()
    for row in kept_rows(partial(_row, judge=judge, of=of), jobs, number_of, how.workers, how.rows):
        for cell, verdict in row["said"]:
            counts.cells.setdefault(tuple(cell), Counter())[verdict] += 1
    return counts


def _parity(number: int) -> Said:
    return [(("of three", str(number % 3)), "odd" if number % 2 else "even")]


def check() -> None:
    """Assert that a count goes on from its file, whatever the number of workers, and from no other's."""
    with tempfile.TemporaryDirectory() as folder:
        rows = Path(folder) / "rows.jsonl"
        whole, first = counted(_parity, 20), counted(_parity, 7, How(rows=rows), of={"seed": 1})
        assert sum(verdicts.total() for verdicts in first.cells.values()) == 7
        more = counted(_parity, 20, How(workers=2, rows=rows), of={"seed": 1})
        assert more.cells == whole.cells
        assert more.by(0) == {("of three",): {"even": 10, "odd": 10}}


if __name__ == "__main__":
    check()
