"""Rates that other work on the machine disturbs little."""

import time
from collections.abc import Callable

AT_LEAST_S = 0.2


def best_rate(work: Callable[[], object], amount: float, *, rounds: int = 5) -> float:
    """Return ``amount`` per second of ``work()``: the best of some rounds, after one call that warms up.

    A round repeats the work until ``AT_LEAST_S`` has passed, so that quick work is not lost in the clock.
    """
    work()
    return max(_rate(work, amount) for _ in range(rounds))


def _rate(work: Callable[[], object], amount: float) -> float:
    start = time.perf_counter()
    repeats = 0
    elapsed = 0.0
    while elapsed < AT_LEAST_S:
        work()
        repeats += 1
        elapsed = time.perf_counter() - start
    return amount * repeats / elapsed
