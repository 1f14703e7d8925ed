"""What has the lab compiled: a start under each of its rules."""

from __future__ import annotations

from collections.abc import Callable

from motor_env.apps import lab


def _lab() -> None:
    for rule in lab.RULES:
        lab.simulated(lab.Settings(rule=rule))
        lab.roc(lab.Settings(rule=rule))


CALLS: dict[str, Callable[[], None]] = {"lab": _lab}
