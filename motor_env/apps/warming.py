"""Compiling ahead: all that commands and environments use, for this machine, so that nobody has to wait for it later.

Each room has a module `small_calls`: calls that have everything compiled which a part of it needs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib import import_module

_HOMES = {
    "Monitor and Probe": "envs.offline",
    "logs of a motor at work": "diagnosis",
    "starts": "diagnosis",
    "data sets and classifiers": "inference",
    "Drive": "envs.offline",
    "policies": "envs.offline",
    "Maintain": "envs.offline",
    "lab": "apps",
}
"""Parts, and the room whose module has the small calls of each."""

PARTS = tuple(_HOMES)
"""Names of the parts, those that take longest first."""


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
    from motor_env.motor.compiled import in_silence

    seconds = {}
    for part in wanted:
        begin = time.perf_counter()
        with in_silence():
            import_module(f"motor_env.{_HOMES[part]}.small_calls").CALLS[part]()
        seconds[part] = time.perf_counter() - begin
        said(part, seconds[part])
    return seconds
