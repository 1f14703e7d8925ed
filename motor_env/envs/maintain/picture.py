"""A logbook of one bearing: severity with what is known of it, the risk of the day, and what was done."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motor_env.envs import rendering
from motor_env.envs.maintain.kernel import FEATURES, INSPECT, REPLACE, RUN
from motor_env.envs.maintain.options import MaintainOptions
from motor_env.envs.rendering import GRID, LEFT, RIGHT, TOP, WIDTH, Frame, write, write_figures

_HEIGHT, _MIDDLE, _GAP = 400, 250, 34
_SEVERITIES = (-0.25, 1.25)
_LINES = (
    ("truth", "bearing"),
    ("estimate", "current"),
    ("mean", "estimate"),
    ("limit", "threshold"),
)
_DEEDS = {
    RUN: ("| failed", "threshold"),
    INSPECT: ("| inspected", "speed"),
    REPLACE: ("| replaced", "residual"),
}


class Logbook:
    """Remembers an episode and draws it; the screen is as wide as the whole of it.

    Args:
        options: of the environment.
    """

    def __init__(self, options: MaintainOptions) -> None:
        self.options = options
        self.clear()

    def clear(self) -> None:
        """A new episode begins."""
        self._rows: list[tuple[float, ...]] = []
        self._deeds: list[tuple[int, int]] = []
        self._cost = 0.0

    def add(
        self, observation: NDArray[np.float32], action: int, *, severity: float, failed: bool, **_: float
    ) -> None:
        """One more day: what was seen, what was done, and the truth, which only the picture shows."""
        feature = dict(zip(FEATURES, observation.tolist(), strict=True))
        if failed:
            action = RUN
            self._cost += self.options.failure_cost
        elif action != RUN:
            self._cost += self.options.inspection_cost if action == INSPECT else self.options.replacement_cost
        if failed or action != RUN:
            self._deeds.append((len(self._rows), action))
        names = ("estimate", "mean", "std", "risk")
        self._rows.append((severity / self.options.limit, *(feature[name] for name in names)))

    def draw(self) -> Frame:
        """The screen, shape (400, 640, 3)."""
        frame = rendering.blank_screen(_HEIGHT)
        severity = frame[TOP:_MIDDLE, LEFT : WIDTH - RIGHT]
        risk = frame[_MIDDLE + _GAP : _HEIGHT - 30, LEFT : WIDTH - RIGHT]
        columns = np.arange(severity.shape[1])
        for panel in (severity, risk):
            panel[:: panel.shape[0] // 4] = GRID
            panel[:, :: panel.shape[1] // 10] = GRID
        days = np.full((self.options.days + 1, 5), np.nan)
        days[: len(self._rows)] = self._rows
        truth, estimate, mean, std, failing = days[columns * len(days) // len(columns)].T
        band = np.linspace(*_SEVERITIES, severity.shape[0])[::-1, None]
        severity[np.abs(band - mean) < 2.0 * std] = GRID
        rendering.draw_trace(severity, np.where(columns % 9 < 4, 1.0, np.nan), _SEVERITIES, "threshold")
        for values, colour in ((truth, "bearing"), (estimate, "current"), (mean, "estimate")):
            rendering.draw_trace(severity, values, _SEVERITIES, colour)
        rendering.draw_trace(risk, failing, (0.0, 0.1), "residual", thick=2)
        self._write(frame)
        return frame

    def _write(self, frame: Frame) -> None:
        options = self.options
        write(frame, "bearing", (6, 8), "ink", size_px=16)
        write_figures(frame, f"day {max(len(self._rows) - 1, 0):4d}", (190, 8), "ink", size_px=16)
        write_figures(frame, f"cost {self._cost:6.1f}", (330, 8), "speed", size_px=16)
        write(frame, "severity", (6, TOP - 2), "ink", size_px=12)
        for place, (name, colour) in enumerate(_LINES):
            write(frame, name, (6, TOP + 30 + 16 * place), colour, size_px=11)
        write(frame, "risk today", (6, _MIDDLE + _GAP - 2), "ink", size_px=12)
        write_figures(frame, "0.1", (6, _MIDDLE + _GAP + 15), "dim", size_px=11)
        write(frame, f"0 to {options.days} days", (WIDTH - RIGHT - 90, _HEIGHT - 24), "dim", size_px=12)
        for place, (name, colour) in enumerate(_DEEDS.values()):
            write(frame, name, (LEFT + 90 * place, _MIDDLE + 6), colour, size_px=11)
        for day, action in self._deeds:
            x = LEFT + day * (WIDTH - LEFT - RIGHT) // (options.days + 1)
            frame[TOP:_MIDDLE:2, x : x + 2] = rendering.COLOURS[_DEEDS[action][1]]
