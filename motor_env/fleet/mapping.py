"""Where the fits of a fleet run: here, or in processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from motor_env.processes import end_with_parent

Map = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""As the built-in `map`."""


@contextmanager
def processes(workers: int) -> Iterator[Map]:
    """What maps a function over files: here, or in so many processes."""
    if workers > 1:
        pool = ProcessPoolExecutor(workers, initializer=end_with_parent)
        try:
            yield pool.map
        finally:
            pool.shutdown(cancel_futures=True)
    else:
        yield map
