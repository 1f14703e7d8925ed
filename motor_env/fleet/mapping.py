"""Where the fits of a fleet run: here, in processes, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from motor_env.errors import require_extra
from motor_env.processes import end_with_parent

Map = Callable[[Callable[[Any], Any], Sequence[Any]], Iterable[Any]]
"""As the built-in `map`."""


@contextmanager
def processes(workers: int, scheduler: str | None = None) -> Iterator[Map]:
    """What maps a function over files: here, in processes, or on the workers of a Dask cluster.

    Args:
        workers: processes, without a cluster.
        scheduler: address of the cluster's scheduler.
    """
    if scheduler is not None:
        require_extra("distributed", "dask")
        from distributed import Client

        with Client(scheduler) as client:
            yield lambda job, files: (future.result() for future in client.map(job, list(files), pure=False))
    elif workers > 1:
        pool = ProcessPoolExecutor(workers, initializer=end_with_parent)
        try:
            yield pool.map
        finally:
            pool.shutdown(cancel_futures=True)
    else:
        yield map
