"""An oscilloscope for one episode: current, speed, residual with its threshold, evidence, and the onset marked.

Drawn with numpy alone, so that a frame takes a few milliseconds; text is drawn once by matplotlib and kept.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from motor_env.envs.layout import MAX_BANK
from motor_env.envs.setup import Setup, bank_kinds
from motor_env.motor.parameters import FloatArray

Frame = NDArray[np.uint8]
WIDTH, HEIGHT = 640, 448  # a film encoder's time grows with the pixels
BACKGROUND, GRID = (9, 14, 18), (27, 38, 44)
COLOURS = {
    "ink": (214, 226, 230),
    "dim": (120, 138, 146),
    "current": (70, 220, 150),
    "estimate": (240, 240, 240),
    "speed": (90, 180, 255),
    "residual": (255, 205, 90),
    "threshold": (255, 110, 90),
    "bearing": (255, 170, 60),
    "winding": (255, 95, 85),
    "magnet": (235, 130, 210),
    "other": (160, 175, 185),
    "onset": (255, 80, 120),
}
LEFT, RIGHT, TOP, GAP = 92, 20, 46, 16
PANEL_HEIGHTS = (98, 60, 98, 68)
Panel = tuple[str, str, tuple[float, float], tuple[tuple[FloatArray, str], ...]]
"""Name, unit, limits, and the traces with their colours."""


def _colour(verdict: str) -> str:
    """Name of a verdict's colour."""
    return verdict if verdict in COLOURS else "other"


def blank_screen(height: int = HEIGHT) -> Frame:
    """The background, shape (height, WIDTH, 3)."""
    return np.full((height, WIDTH, 3), BACKGROUND, dtype=np.uint8)


@cache
def text_image(text: str, colour: tuple[int, int, int], size_px: int) -> tuple[int, Frame]:
    """Draw a line of text; return the rows above its ink, and its ink, shape (height, width, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(1, len(text)) * size_px / 100.0, 2.0 * size_px / 100.0), dpi=100)
    canvas = FigureCanvasAgg(figure)
    figure.text(
        0.0,
        0.3,
        text,
        fontsize=size_px * 0.72,
        family="DejaVu Sans Mono" if len(text) == 1 else "DejaVu Sans",
        color="black",
    )
    canvas.draw()  # type: ignore[no-untyped-call]  # matplotlib's
    pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]  # matplotlib's
    shade = 1.0 - pixels[..., 0] / 255.0
    rows, columns = (np.flatnonzero(shade.any(axis=axis)) for axis in (1, 0))
    shade = shade[rows[0] : rows[-1] + 1, : columns[-1] + 1, None]
    return int(rows[0]), (np.multiply(BACKGROUND, 1.0 - shade) + colour * shade).astype(np.uint8)


def write(frame: Frame, text: str, at: tuple[int, int], colour: str, *, size_px: int) -> None:
    """Write a line of text in one of the colours, with its upper left corner at (x, y)."""
    below, image = text_image(text, COLOURS[colour], size_px)
    x, y = at[0], at[1] + below
    part = frame[y : y + image.shape[0], x : x + image.shape[1]]
    part[:] = image[: part.shape[0], : part.shape[1]]


def write_figures(frame: Frame, text: str, at: tuple[int, int], colour: str, *, size_px: int) -> None:
    """Write text that changes, character by character, each drawn once."""
    for place, character in enumerate(text):
        if character != " ":
            write(frame, character, (at[0] + round(0.62 * size_px * place), at[1]), colour, size_px=size_px)


def mark_moment(frame: Frame, x: int) -> None:
    """Mark a column across all panels."""
    frame[TOP : HEIGHT - 30 : 3, x : x + 2] = COLOURS["onset"]


def draw_trace(
    panel: Frame,
    values: FloatArray,
    limits: tuple[float, float],
    colour: str,
    *,
    thick: int = 1,
) -> None:
    """Draw values, one to a column of the panel (a NaN is left out), as a line."""
    low, high = limits
    good = np.isfinite(values)
    share = np.clip((np.where(good, values, low) - low) / (high - low), 0.0, 1.0)
    rows = np.round((1.0 - share) * (panel.shape[0] - 1)).astype(np.int64)
    before = np.concatenate([rows[:1], rows[:-1]])
    before = np.where(np.concatenate([good[:1], good[:-1]]), before, rows)
    first, last = np.minimum(rows, before), np.maximum(rows, before)
    grid = np.arange(panel.shape[0])[:, None]
    inside = (grid >= first - (thick - 1)) & (grid <= last + (thick - 1)) & good
    panel[:, : len(values)][inside] = COLOURS[colour]


class Scope:
    """Keeps an episode of Monitor or Probe and draws it."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._kinds = [kind.verdict for kind in bank_kinds(setup.options.task)]  # of the bank's filters
        self.width = WIDTH - LEFT - RIGHT
        self.n_steps = setup.options.n_steps
        self.per_column = max(1, self.n_steps // self.width)
        self._step_of_column = (np.arange(self.width) * self.n_steps // self.width).tolist()
        self.clear()

    def clear(self) -> None:
        """Begin an episode."""
        self.onset_step: int | None = None
        self.step, self._filled = 0, 0
        self._columns = np.full((5 + MAX_BANK, self.width), np.nan)
        self._voltage: float | None = None
        self.verdict, self.good = "", False

    def add(self, *values: float) -> None:
        """Add a step: measured and estimated current, estimated speed, voltage, residual, evidence of each kind."""
        while self._filled < self.width and self._step_of_column[self._filled] <= self.step:
            self._columns[:, self._filled] = values
            self._filled += 1
        self._voltage = values[3]
        self.step += 1

    def draw(self) -> Frame:
        """Draw the screen, shape (HEIGHT, WIDTH, 3)."""
        frame, top = blank_screen(), TOP
        for (name, unit, limits, traces), height in zip(self._panels(), PANEL_HEIGHTS, strict=True):
            panel = frame[top : top + height, LEFT : WIDTH - RIGHT]
            panel[:: height // 4] = GRID
            panel[:, :: self.width // 10] = GRID
            write(frame, name, (6, top - 2), "ink", size_px=12)
            write_figures(frame, f"{limits[1]:.3g} {unit}", (6, top + 15), "dim", size_px=11)
            if name != "evidence":
                write_figures(frame, f"{limits[0]:.3g}", (6, top + height - 20), "dim", size_px=11)
            for values, colour in traces:
                draw_trace(panel, values, limits, colour, thick=2 if name == "evidence" else 1)
            top += height + GAP
        self._notes(frame)
        if self.onset_step is not None and self.onset_step <= self.step:
            x = LEFT + min(self.width - 2, self.onset_step * self.width // self.n_steps)
            mark_moment(frame, x)
            write(frame, "onset", (min(x - 14, WIDTH - RIGHT - 40), HEIGHT - 30), "onset", size_px=12)
        return frame

    def _panels(self) -> tuple[Panel, ...]:
        """The panels; the limits of current and speed follow the largest deviation from rest."""
        columns, rest = self._columns[:, : self._filled], self.setup.rest
        noise = self.setup.options.task.sensor.current_noise_a
        moved = np.abs(columns[[0, 2]] - rest[:, None]).max(axis=1, initial=0.0)
        least = max(8.0 * noise, 0.3 * abs(rest[0])), 0.05 * abs(rest[1])
        reach = np.maximum(least, 1.1 * moved)
        current, speed = zip(rest - reach, rest + reach, strict=True)
        dashes = np.where(np.arange(self.width) % 9 < 4, 3.0, np.nan)
        residual = ((-dashes, "threshold"), (dashes, "threshold"), (columns[4], "residual"))
        evidence = zip(columns[5:], map(_colour, self._kinds), strict=False)
        return (
            ("current", "A", current, ((columns[1], "estimate"), (columns[0], "current"))),
            ("speed (filter)", "rad/s", speed, ((columns[2], "speed"),)),
            ("residual", "sd", (-6.0, 6.0), residual),
            ("evidence", "nats", (0.0, 12.0), tuple(evidence)),
        )

    def _notes(self, frame: Frame) -> None:
        """Write legends, time and head."""
        options, legend = self.setup.options, TOP + 32
        for place, (name, colour) in enumerate((("measured", "current"), ("filter", "estimate"))):
            write(frame, name, (6, legend + 15 * place), colour, size_px=11)
        legend += sum(PANEL_HEIGHTS[:3]) + 3 * GAP
        for place, kind in enumerate(dict.fromkeys(self._kinds)):
            write(frame, kind, (6, legend + 15 * place), _colour(kind), size_px=11)
        step_ms = 1e3 * options.samples_per_step * options.dt_s
        write(
            frame, f"0 to {self.n_steps * step_ms:g} ms", (WIDTH - RIGHT - 90, HEIGHT - 24), "dim", size_px=12
        )
        write(frame, "motor under watch", (6, 8), "ink", size_px=16)
        write_figures(frame, f"{self.step * step_ms:7.1f} ms", (160, 8), "ink", size_px=16)
        if self._voltage is not None:
            write_figures(frame, f"{self._voltage:+7.2f} V", (275, 8), "speed", size_px=16)
        if self.verdict:
            write(frame, self.verdict, (405, 8), "current" if self.good else "threshold", size_px=16)


class Window:
    """A window of `width` by `height` pixels, by pygame.

    Raises:
        DependencyNotInstalled: pygame is not there.
    """

    def __init__(self, width: int, height: int, *, frames_per_s: int) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled("render_mode human needs pygame: pip install pygame") from error
        self._pygame: Any = pygame
        pygame.display.init()
        pygame.display.set_caption("motor-env")
        self._surface = pygame.display.set_mode((width, height))
        self._clock = pygame.time.Clock()
        self._frames_per_s = frames_per_s

    def show(self, frame: Frame) -> None:
        """Show a frame, no sooner than its time."""
        self._pygame.surfarray.blit_array(self._surface, frame.swapaxes(0, 1))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(self._frames_per_s)

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()
