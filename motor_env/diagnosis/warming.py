"""What has the fit of a start, and its diagnosis, compiled: one small start of the paper's motor."""

from __future__ import annotations

from collections.abc import Callable

CALLS: dict[str, Callable[[], None]] = {"starts": lambda: None}
