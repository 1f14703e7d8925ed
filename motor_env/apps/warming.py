"""Compiling ahead: all that commands and environments use, for this machine, so that nobody has to wait for it later.

Each room has a module `warming` with its parts: small calls that have everything compiled which that part needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib import import_module

_HOMES = {
    "starts": "diagnosis",
    "Monitor and Probe": "envs",
    "Drive": "envs",
    "Maintain": "envs",
}
"""Parts, and the room in whose module `warming` the small calls of each stand."""

PARTS = tuple(_HOMES)
"""Names of the parts, the longest first where they are shared among processes in turn."""


def warm_up(
    parts: Sequence[str] | None = None, said: Callable[[str, float], None] = lambda part, seconds: None
) -> dict[str, float]:
    """Compile parts into numba's cache; what stands there already is only loaded.

    Args:
        parts: names out of `PARTS`; all of them by default. Processes may share them: each compiles its own.
        said: called after each part with its name and its seconds.

    Returns:
        Seconds that each part took.

    Raises:
        ValueError: there is no such part.
    """
    wanted = PARTS if parts is None else tuple(parts)
    if unknown := [part for part in wanted if part not in _HOMES]:
        raise ValueError(f"there is no part {unknown[0]!r}; there are {', '.join(PARTS)}")
    seconds = {}
    for part in wanted:
        begin = time.perf_counter()
        import_module(f"motor_env.{_HOMES[part]}.warming").CALLS[part]()
        seconds[part] = time.perf_counter() - begin
        said(part, seconds[part])
    return seconds
