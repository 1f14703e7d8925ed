"""The drive's screen: speed and profile, current and voltage, temperature, severity, over the whole episode."""

from __future__ import annotations

import numpy as np

from motor_env.envs import rendering
from motor_env.envs.drive.drawing import BEARING
from motor_env.envs.drive.options import LABELS
from motor_env.envs.drive.setup import DriveSetup
from motor_env.envs.rendering import GRID, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Frame, write, write_figures
from motor_env.motor.parameters import FloatArray

GAP = 18
SHOWN = ("speed", "current", "voltage", "temperature", "severity", "scale")


class DriveScreen:
    """Remembers an episode and draws it; it shows the truth, which the agent does not see.

    Args:
        setup: of the environment.
    """

    def __init__(self, setup: DriveSetup) -> None:
        self.setup = setup

    def begin(self, profile: FloatArray) -> None:
        """A new episode with that profile."""
        self._profile = profile[1 : self.setup.options.n_steps + 1].copy()
        self._rows: list[list[float]] = []
        self._kind = self._onset = 0

    def add(self, lanes: np.void) -> None:
        """The block after a step, whose first lane is shown."""
        row = [lanes[name].item(0) for name in SHOWN]
        # What a decision shows is its last period.
        self._rows += [row] * self.setup.options.steps_per_decision
        self._kind, self._onset = int(lanes["kind"].item(0)), int(lanes["onset"].item(0))

    def draw(self) -> Frame:
        """The screen, shape (HEIGHT, WIDTH, 3)."""
        options, frame = self.setup.options, rendering.blank_screen()
        speed, current, voltage, heat, severity, scale = np.array(self._rows).reshape(-1, len(SHOWN)).T
        asked = self._profile.copy()
        asked[: len(scale)] *= scale
        failure = options.failure_severity[max(self._kind - 1, 0)]
        panels = (
            ("speed", "rad/s", options.top_speed_rad_s, ((asked, "estimate"), (speed, "speed"))),
            ("voltage", "V", options.voltage_limit_v, ((voltage, "residual"),)),
            ("current", "A", options.current_limit_a, ((current, "current"),)),
            (
                "winding",
                "K",
                options.burn_k,
                ((np.full(len(asked), options.warm_k), "threshold"), (heat, "winding")),
            ),
            ("severity", "", failure, ((severity, "bearing" if self._kind == BEARING else "winding"),)),
        )
        height = (HEIGHT - TOP - 30) // len(panels) - GAP
        for place, (name, unit, most, traces) in enumerate(panels):
            top = TOP + place * (height + GAP)
            panel = frame[top : top + height, LEFT : WIDTH - RIGHT]
            panel[:: height // 2] = GRID
            write(frame, name, (6, top), "ink", size_px=12)
            write_figures(frame, f"{most:.3g} {unit}", (6, top + 16), "dim", size_px=11)
            for values, colour in traces:
                rendering.draw_trace(panel, self._columns(values, panel.shape[1]), (0.0, 1.1 * most), colour)
        self._head(frame, LABELS[self._kind])
        return frame

    def _columns(self, values: FloatArray, width: int) -> FloatArray:
        """One value a column of the screen, as far as there are values."""
        at = np.arange(width) * self.setup.options.n_steps // width
        return values[at[at < len(values)]]

    def _head(self, frame: Frame, label: str) -> None:
        options, steps = self.setup.options, len(self._rows)
        write(frame, "drive", (6, 8), "ink", size_px=16)
        write_figures(frame, f"{steps * options.period_s:6.2f} s", (80, 8), "ink", size_px=16)
        last = dict(zip(SHOWN, self._rows[-1] if self._rows else (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), strict=True))
        if last["scale"] < 1.0:
            write(frame, "limps", (200, 8), "residual", size_px=16)
        if last["severity"] > 0.0:
            write(frame, label.replace("_", " "), (300, 8), "threshold", size_px=16)
            x = LEFT + self._onset * (WIDTH - LEFT - RIGHT) // options.n_steps
            rendering.mark_moment(frame, x)
        write(frame, f"0 to {options.horizon_s:g} s", (WIDTH - RIGHT - 80, HEIGHT - 24), "dim", size_px=12)
