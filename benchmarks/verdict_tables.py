"""Tables of verdicts: numbered cases are made and judged, in processes, and what was said in each cell is counted.

A cell is what its cases were, in words: a profile, a motor, a fault. Case n depends on a seed and n alone, so a count
goes on where its file ends, whatever the number of workers.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cyclopts import Parameter

Cell = tuple[str, ...]
Said = list[tuple[Cell, str]]
"""What was said in one case: cells and verdicts."""
_BETWEEN = "; "


def words_of(verdicts: Counter[str]) -> str:
    """Verdicts and their numbers, the most frequent first."""
    return ", ".join(f"{verdict} {n}" for verdict, n in verdicts.most_common())


@Parameter(name="*")
@dataclass(frozen=True)
class How:
    """Options of every script.

    Attributes:
        workers: processes.
        out: file of the counts, from which a run goes on.
    """

    workers: int = 1
    out: Path | None = None


HERE = How()


@dataclass
class Counts:
    """How often each verdict was given in each cell.

    Attributes:
        cells: verdicts by cell, in the order in which they came.
        cases: how many cases were judged.
        of: what they depend on beside their number, such as the seed.
    """

    cells: dict[Cell, Counter[str]] = field(default_factory=dict)
    cases: int = 0
    of: Mapping[str, Any] = field(default_factory=dict)

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

    def add(self, said: Said) -> None:
        """Count one more case."""
        self.cases += 1
        for cell, verdict in said:
            self.cells.setdefault(cell, Counter())[verdict] += 1

    @classmethod
    def read(cls, path: Path | None, of: Mapping[str, Any]) -> Counts:
        """What a file holds; nothing where there is none.

        Raises:
            ValueError: it holds other cases.
        """
        if path is None or not path.is_file():
            return cls(of=of)
        kept = json.loads(path.read_bytes())
        if kept["of"] != dict(of):
            raise ValueError(f"{path} holds cases of {kept['of']}, not of {dict(of)}: name another file")
        cells = {tuple(cell.split(_BETWEEN)): Counter(verdicts) for cell, verdicts in kept["cells"].items()}
        return cls(cells, kept["cases"], of)

    def write(self, path: Path) -> None:
        """Write how often each verdict was given in each cell."""
        cells = {
            _BETWEEN.join(cell): dict(sorted(verdicts.items()))
            for cell, verdicts in sorted(self.cells.items())
        }
        kept = {"cases": self.cases, "of": dict(self.of), "cells": cells}
        path.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


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
        how: processes, and the file, which is written after each case.
        of: what the cases depend on beside their number.
    """
    counts = Counts.read(how.out, of or {})
    numbers = range(counts.cases, cases)
    with ProcessPoolExecutor(how.workers) if how.workers > 1 else nullcontext() as pool:
        for said in (pool.map if pool else map)(judge, numbers):
            counts.add(said)
            if how.out is not None:
                counts.write(how.out)
            print(f"\r{counts.cases} of {cases}", end="", file=sys.stderr, flush=True)
    return counts
