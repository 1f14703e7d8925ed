"""False alarms that counting alone rules out: windows in a row that all lie beyond all healthy ones.

Of n healthy windows and m later ones of a motor that is still healthy any m are as likely to be the farthest: the last
m are with probability 1 / C(n + m, m) (Vovk, Petej & Fedorova 2021 on conformal testing). No model, no tail is needed.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from motor_env.motor.parameters import FloatArray


def windows_between_alarms(healthy: int, in_a_row: int, tests: int) -> float:
    """Least mean number of windows from one false alarm to the next, of several tests together."""
    return math.comb(healthy + in_a_row, in_a_row) / tests


@lru_cache(1024)
def fewest_in_a_row(healthy: int, windows: float, tests: int) -> int:
    """The fewest windows in a row by which false alarms are so many windows apart on average, or more."""
    return next(m for m in itertools.count(1) if windows_between_alarms(healthy, m, tests) >= windows)


def promised(healthy: int, window_s: float, windows: float, tests: int, *, adds_up: bool | None) -> str:
    """What holds of the rate of false alarms, in words.

    Args:
        healthy: number of healthy windows.
        window_s: length of one.
        windows: asked for from one false alarm to the next.
        tests: together.
        adds_up: whether evidence is added up; None where healthy windows were not compared.
    """
    in_a_row, hours = fewest_in_a_row(healthy, windows, tests), window_s / 3600.0
    counted = windows_between_alarms(healthy, in_a_row, tests) * hours
    words = f"{healthy} healthy windows of {window_s:g} s"
    if adds_up is None:
        return (
            f"{words}, which were not compared with each other: commission the motor anew for a checked rate"
        )
    by_count = (
        f"{in_a_row} windows in a row beyond all healthy ones, at most one false alarm in {_time(counted)}"
    )
    if adds_up:
        asked = _time(windows * hours)
        tails = f"one false alarm in {asked} if the fitted tails hold, as they do on these windows"
        return f"{words}: {tails}; by counting alone: {by_count}"
    return f"{words} do not follow the fitted tails, so that alarms are by counting alone: {by_count}"


def _time(hours: float) -> str:
    """A time in the largest unit that it fills."""
    sizes = {"year": 8766.0, "day": 24.0, "hour": 1.0, "minute": 1.0 / 60.0}
    unit = next((unit for unit, size in sizes.items() if hours >= size), "minute")
    shown = f"{hours / sizes[unit]:.3g}"
    return f"{shown} {unit}" + "s" * (shown != "1")


@dataclass
class Counting:
    """The healthy windows and those since, along some axes.

    Attributes:
        healthy: number of healthy windows.
        most: the farthest of them along each axis, shape (n_axes,).
        rows: how many windows in a row are beyond that now, shape (n_axes,).
    """

    healthy: int
    most: FloatArray
    rows: FloatArray

    def add(self, places: FloatArray) -> None:
        """A window's places along the axes."""
        self.rows = np.where(places > self.most, self.rows + 1.0, 0.0)

    def learn(self, places: FloatArray) -> None:
        """A healthy window's places."""
        self.healthy, self.most = self.healthy + 1, np.maximum(self.most, places)

    def alarms(self, windows: float) -> bool:
        """Whether an axis alarms at one false alarm in so many windows."""
        return bool(self.rows.max() >= fewest_in_a_row(self.healthy, windows, len(self.most)))
