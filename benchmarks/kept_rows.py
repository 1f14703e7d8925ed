"""Rows of a long run, a JSON line each, kept as they come: a run that was stopped goes on where it was."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

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
