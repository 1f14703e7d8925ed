"""What has the trends compiled: one of a few estimates."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from motor_env.prognosis.wear_fit import degradation


def _trends() -> None:
    degradation(np.arange(10.0), np.linspace(1.0, 1.1, 10), np.full(10, 0.01), 1.5, sign=1.0)


CALLS: dict[str, Callable[[], None]] = {"trends": _trends}
