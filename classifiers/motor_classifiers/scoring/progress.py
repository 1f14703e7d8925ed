"""Time and memory of a piece of work.

Standard library only: benchmarks/aeon_peers.py uses it in another environment.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

_Answer = TypeVar("_Answer")
_PROCESS = Path("/proc/self")


class Cost(NamedTuple):
    """What a piece of work took.

    Attributes:
        seconds: processor time; of work on one thread the time that it takes on an idle machine.
        memory_mb: largest memory of the process beyond what it held before, in MB of a million bytes; None where the
            system does not tell (only Linux forgets an older peak on request).
    """

    seconds: float
    memory_mb: float | None


def with_cost(work: Callable[[], _Answer]) -> tuple[_Answer, Cost]:
    """Do the work; what it returns and what it took."""
    before = _fresh_peak_mb()
    begin = time.process_time()
    answer = work()
    seconds = time.process_time() - begin
    return answer, Cost(seconds, None if before is None else max(0.0, _peak_mb() - before))


def _fresh_peak_mb() -> float | None:
    """Forget the largest memory so far; what the process holds now."""
    try:
        (_PROCESS / "clear_refs").write_text("5")
        return _peak_mb()
    except OSError:
        return None


def _peak_mb() -> float:
    lines = (_PROCESS / "status").read_text().splitlines()
    return next(1024e-6 * float(line.split()[1]) for line in lines if line.startswith("VmHWM"))
