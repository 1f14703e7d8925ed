"""An oscilloscope for one episode: current, speed, residual with its threshold, evidence, and the onset marked.

Drawn with numpy alone, so that a frame takes a few milliseconds; text is drawn once by matplotlib and kept.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from motor_env.envs.kernel import MAX_BANK
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
    "healthy": (90, 190, 230),
    "noise": (175, 140, 255),
    "magnet": (235, 130, 210),
    "other": (160, 175, 185),
    "onset": (255, 80, 120),
}
LEFT, RIGHT, TOP, GAP = 92, 20, 46, 16
PANEL_HEIGHTS = (98, 60, 98, 68)


def _colour(verdict: str) -> str:
    """Name of a verdict's colour."""
    return verdict if verdict in COLOURS else "other"


def blank_screen(height: int = HEIGHT) -> Frame:
    """The background, shape (height, WIDTH, 3)."""
    return np.full((height, WIDTH, 3), BACKGROUND, dtype=np.uint8)


@cache
def text_image(text: str, colour: tuple[int, int, int], size_px: int) -> tuple[int, Frame]:
    """A line of text on the background, shape (height, width, 3), cut to its ink; how far down that begins."""
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
    """Write text that changes, character by character: each is drawn once and kept."""
    for place, character in enumerate(text):
        if character != " ":
            write(frame, character, (at[0] + round(0.62 * size_px * place), at[1]), colour, size_px=size_px)


def mark_moment(frame: Frame, x: int) -> None:
    """An upright mark across all panels."""
    frame[TOP : HEIGHT - 30 : 3, x : x + 2] = COLOURS["onset"]


def draw_trace(
    panel: Frame,
    values: FloatArray,
    limits: tuple[float, float],
    colour: str,
    *,
    thick: int = 1,
    skip: int = 0,
) -> None:
    """Draw values, one to a column of the panel (a NaN is left out), as a line; the first `skip` only join it."""
    low, high = limits
    good = np.isfinite(values)
    share = np.clip((np.where(good, values, low) - low) / (high - low), 0.0, 1.0)
    rows = np.round((1.0 - share) * (panel.shape[0] - 1)).astype(np.int64)
    before = np.concatenate([rows[:1], rows[:-1]])
    before = np.where(np.concatenate([good[:1], good[:-1]]), before, rows)
    first, last = np.minimum(rows, before), np.maximum(rows, before)
    grid = np.arange(panel.shape[0])[:, None]
    inside = (grid >= first - (thick - 1)) & (grid <= last + (thick - 1)) & good
    panel[:, skip : len(values)][inside[:, skip:]] = COLOURS[colour]


class Scope:
    """Remembers an episode and draws it; the screen is as wide as the whole of it.

    What has been drawn stays, and only new columns are added, until a value leaves its panel and the scale changes.

    Args:
        setup: of the environment.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._kinds = [kind.verdict for kind in bank_kinds(setup.options.task)]  # of the bank's filters
        self.width = WIDTH - LEFT - RIGHT
        self.n_steps = setup.options.n_steps
        self.per_column = max(1, self.n_steps // self.width)
        self._step_of_column = (np.arange(self.width) * self.n_steps // self.width).tolist()
        rest_current, rest_speed = (float(value) for value in setup.rest)
        noise = setup.options.task.sensor.current_noise_a
        self._rest = (rest_current, rest_speed)
        self._least = (max(8.0 * noise, 0.3 * abs(rest_current)), 0.05 * abs(rest_speed))
        self.clear()

    def clear(self) -> None:
        """A new episode begins."""
        self.onset_step: int | None = None
        self.step, self._filled, self._drawn = 0, 0, 0
        self._columns = np.full((5 + MAX_BANK, self.width), np.nan)
        self._reach = self._least  # how far current and speed go from where they rest
        self._frame: Frame | None = None
        self._voltage: float | None = None
        self.verdict, self.good = "", False

    def add(self, *values: float) -> None:
        """One more step: measured and estimated current, estimated speed, voltage, residual, evidence of each kind."""
        while self._filled < self.width and self._step_of_column[self._filled] <= self.step:
            self._columns[:, self._filled] = values
            self._filled += 1
            reach = tuple(
                max(old, 1.1 * abs(value - rest))
                for old, value, rest in zip(self._reach, (values[0], values[2]), self._rest, strict=True)
            )
            if reach != self._reach:
                self._reach, self._frame = (reach[0], reach[1]), None
        self._voltage = values[3]
        self.step += 1

    def draw(self) -> Frame:
        """The screen, shape (HEIGHT, WIDTH, 3)."""
        if self._frame is None:
            self._frame, self._drawn = self._empty_screen(), 0
        frame, first = self._frame, self._drawn
        if self._filled > first:
            self._traces(frame, first)
            self._drawn = self._filled
        frame[: TOP - 6] = self._blank
        self._head(frame)
        if self.onset_step is not None and self.onset_step <= self.step:
            self._mark_onset(frame)
        return frame.copy()

    def _empty_screen(self) -> Frame:
        frame = blank_screen()
        self._blank = frame[: TOP - 6].copy()
        (rest_current, rest_speed), (reach, swing) = self._rest, self._reach
        self._panel(frame, 0, "current", "A", (rest_current - reach, rest_current + reach))
        self._panel(frame, 1, "speed (filter)", "rad/s", (rest_speed - swing, rest_speed + swing))
        self._panel(frame, 2, "residual", "sd", (-6.0, 6.0))
        dashes = np.where(np.arange(self.width) % 9 < 4, 3.0, np.nan)
        for level in (-dashes, dashes):
            self._trace(frame, 2, level, (-6.0, 6.0), "threshold")
        self._panel(frame, 3, "evidence", "nats", (0.0, 12.0))
        for place, (name, colour) in enumerate((("measured", "current"), ("filter", "estimate"))):
            write(frame, name, (6, self._box(0)[0] + 32 + 15 * place), colour, size_px=11)
        for place, kind in enumerate(dict.fromkeys(self._kinds)):
            write(frame, kind, (6, self._box(3)[0] + 32 + 15 * place), _colour(kind), size_px=11)
        shown = self.n_steps * self.setup.options.samples_per_step * self.setup.options.dt_s
        write(frame, f"0 to {1e3 * shown:g} ms", (WIDTH - RIGHT - 90, HEIGHT - 24), "dim", size_px=12)
        return frame

    def _traces(self, frame: Frame, first: int) -> None:
        """The columns that are new, joined to the one before."""
        columns = self._columns[:, : self._filled]
        (rest_current, rest_speed), (reach, swing) = self._rest, self._reach
        current = (rest_current - reach, rest_current + reach)
        self._trace(frame, 0, columns[1], current, "estimate", first=first)
        self._trace(frame, 0, columns[0], current, "current", first=first)
        self._trace(frame, 1, columns[2], (rest_speed - swing, rest_speed + swing), "speed", first=first)
        self._trace(frame, 2, columns[4], (-6.0, 6.0), "residual", first=first)
        for row, kind in zip(columns[5:], self._kinds, strict=False):
            self._trace(frame, 3, row, (0.0, 12.0), _colour(kind), thick=2, first=first)

    def _box(self, which: int) -> tuple[int, int]:
        top = TOP + sum(PANEL_HEIGHTS[:which]) + GAP * which
        return top, top + PANEL_HEIGHTS[which]

    def _panel(self, frame: Frame, which: int, name: str, unit: str, limits: tuple[float, float]) -> None:
        (low, high), (top, bottom) = limits, self._box(which)
        panel = frame[top:bottom, LEFT : WIDTH - RIGHT]
        panel[:: max(1, (bottom - top) // 4)] = GRID
        panel[:, :: self.width // 10] = GRID
        write(frame, name, (6, top - 2), "ink", size_px=12)
        write_figures(frame, f"{high:.3g} {unit}", (6, top + 15), "dim", size_px=11)
        if which < 3:
            write_figures(frame, f"{low:.3g}", (6, bottom - 20), "dim", size_px=11)

    def _trace(
        self,
        frame: Frame,
        which: int,
        values: FloatArray,
        limits: tuple[float, float],
        colour: str,
        *,
        thick: int = 1,
        first: int = 0,
    ) -> None:
        top, bottom = self._box(which)
        joined = max(0, first - 1)
        panel = frame[top:bottom, LEFT + joined : WIDTH - RIGHT]
        if joined < len(values):
            draw_trace(panel, values[joined:], limits, colour, thick=thick, skip=first - joined)

    def _mark_onset(self, frame: Frame) -> None:
        assert self.onset_step is not None  # noqa: S101  # the caller looked
        x = LEFT + min(self.width - 2, self.onset_step * self.width // self.n_steps)
        mark_moment(frame, x)
        write(frame, "onset", (min(x - 14, WIDTH - RIGHT - 40), HEIGHT - 30), "onset", size_px=12)

    def _head(self, frame: Frame) -> None:
        options = self.setup.options
        time_ms = 1e3 * self.step * options.samples_per_step * options.dt_s
        write(frame, "motor under watch", (6, 8), "ink", size_px=16)
        write_figures(frame, f"{time_ms:7.1f} ms", (160, 8), "ink", size_px=16)
        if self._voltage is not None:
            write_figures(frame, f"{self._voltage:+7.2f} V", (275, 8), "speed", size_px=16)
        if self.verdict:
            write(frame, self.verdict, (405, 8), "current" if self.good else "threshold", size_px=16)


class Window:
    """A window on the screen, by pygame.

    Args:
        width: in pixels.
        height: in pixels.
        frames_per_s: at most.

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
