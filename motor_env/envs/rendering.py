"""An oscilloscope for one episode: current, speed, residual with its threshold, belief, and the onset marked.

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
WIDTH, HEIGHT = 800, 560
BACKGROUND, GRID, INK, DIM = (9, 14, 18), (27, 38, 44), (214, 226, 230), (120, 138, 146)
TRACE = {
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
PANEL_HEIGHTS = (130, 76, 130, 96)


def _colour(verdict: str) -> str:
    """Name of a verdict's colour."""
    return verdict if verdict in TRACE else "other"


@cache
def text_image(text: str, size_px: int = 13) -> FloatArray:
    """Coverage of a line of text, 0 to 1, shape (height, width)."""
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
    used = np.flatnonzero(shade.any(axis=0))
    image: FloatArray = shade[:, : (used[-1] + 2 if len(used) else 1)]
    return image


def write(frame: Frame, text: str, x: int, y: int, colour: tuple[int, int, int], size_px: int = 13) -> None:
    """Write a line of text with its upper left corner at (x, y)."""
    image = text_image(text, size_px)[: frame.shape[0] - y, : frame.shape[1] - x, None]
    part = frame[y : y + image.shape[0], x : x + image.shape[1]]
    part[:] = (part * (1.0 - image) + np.array(colour) * image).astype(np.uint8)


def write_figures(
    frame: Frame, text: str, x: int, y: int, colour: tuple[int, int, int], size_px: int = 13
) -> None:
    """The same for text that changes: character by character, each of which is drawn once and kept."""
    for place, character in enumerate(text):
        if character != " ":
            write(frame, character, x + round(0.62 * size_px * place), y, colour, size_px)


def _rows(values: FloatArray, low: float, high: float, height: int) -> NDArray[np.int64]:
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    rows: NDArray[np.int64] = np.round((1.0 - share) * (height - 1)).astype(np.int64)
    return rows


def draw_trace(
    panel: Frame, values: FloatArray, low: float, high: float, colour: tuple[int, int, int], thick: int = 1
) -> None:
    """Draw values, one to a column of the panel (a NaN is left out), as a line."""
    good = np.isfinite(values)
    rows = _rows(np.where(good, values, low), low, high, panel.shape[0])
    before = np.concatenate([rows[:1], rows[:-1]])
    before = np.where(np.concatenate([good[:1], good[:-1]]), before, rows)
    first, last = np.minimum(rows, before), np.maximum(rows, before)
    grid = np.arange(panel.shape[0])[:, None]
    inside = (grid >= first - (thick - 1)) & (grid <= last + (thick - 1)) & good
    panel[:, : len(values)][inside] = colour


class Scope:
    """Remembers an episode and draws it; the screen is as wide as the whole of it.

    Args:
        setup: of the environment.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._kinds = [kind.verdict for kind in bank_kinds(setup.options.task)]  # of the bank's filters
        self.width = WIDTH - LEFT - RIGHT
        self.n_steps = setup.options.n_steps
        self.per_column = max(1, self.n_steps // self.width)
        self._step_of_column = np.arange(self.width) * self.n_steps // self.width
        self.clear()

    def clear(self) -> None:
        """A new episode begins."""
        self.samples: list[tuple[float, ...]] = []
        self.onset_step: int | None = None
        self.step = 0
        self.verdict, self.good = "", False

    def add(self, *values: float) -> None:
        """One more step: measured and estimated current, estimated speed, voltage, residual, evidence of each kind."""
        self.samples.append(values)
        self.step += 1

    def _columns(self) -> FloatArray:
        columns = np.full((5 + MAX_BANK, self.width), np.nan)
        if self.samples:
            shown = self._step_of_column < len(self.samples)
            columns[:, shown] = np.array(self.samples)[self._step_of_column[shown]].T
        return columns

    def draw(self) -> Frame:
        """The screen, shape (HEIGHT, WIDTH, 3)."""
        frame = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
        frame[:] = BACKGROUND
        columns = self._columns()
        options, recipe = self.setup.options, self.setup.options.task
        self._head(frame)
        rest_current, rest_speed = (float(value) for value in self.setup.rest)
        noise = recipe.sensor.current_noise_a
        reach = max(8.0 * noise, 0.3 * abs(rest_current), _reach(columns[0], rest_current))
        self._panel(frame, 0, "current", "A", rest_current - reach, rest_current + reach)
        self._trace(frame, 0, columns[1], rest_current - reach, rest_current + reach, "estimate")
        self._trace(frame, 0, columns[0], rest_current - reach, rest_current + reach, "current")
        swing = max(0.05 * abs(rest_speed), _reach(columns[2], rest_speed))
        self._panel(frame, 1, "speed (filter)", "rad/s", rest_speed - swing, rest_speed + swing)
        self._trace(frame, 1, columns[2], rest_speed - swing, rest_speed + swing, "speed")
        self._panel(frame, 2, "residual", "sd", -6.0, 6.0)
        for level in (-3.0, 3.0):
            self._trace(frame, 2, np.full(self.width, level), -6.0, 6.0, "threshold", every=9)
        self._trace(frame, 2, columns[4], -6.0, 6.0, "residual")
        self._panel(frame, 3, "belief", "nats", 0.0, 12.0)
        for row, kind in zip(columns[5:], self._kinds, strict=False):
            self._trace(frame, 3, row, 0.0, 12.0, _colour(kind), thick=2)
        for place, (name, colour) in enumerate((("measured", "current"), ("filter", "estimate"))):
            write(frame, name, 6, self._box(0)[0] + 32 + 15 * place, TRACE[colour], 11)
        for place, kind in enumerate(dict.fromkeys(self._kinds)):
            write(frame, kind, 6, self._box(3)[0] + 32 + 15 * place, TRACE[_colour(kind)], 11)
        if self.onset_step is not None and self.onset_step <= self.step:
            self._mark_onset(frame)
        shown = options.n_steps * options.samples_per_step * options.dt_s
        write(frame, f"0 to {1e3 * shown:g} ms", WIDTH - RIGHT - 90, HEIGHT - 24, DIM, 12)
        return frame

    def _box(self, which: int) -> tuple[int, int]:
        top = TOP + sum(PANEL_HEIGHTS[:which]) + GAP * which
        return top, top + PANEL_HEIGHTS[which]

    def _panel(self, frame: Frame, which: int, name: str, unit: str, low: float, high: float) -> None:
        top, bottom = self._box(which)
        panel = frame[top:bottom, LEFT : WIDTH - RIGHT]
        panel[:: max(1, (bottom - top) // 4)] = GRID
        panel[:, :: self.width // 10] = GRID
        write(frame, name, 6, top - 2, INK, 12)
        write_figures(frame, f"{high:.3g} {unit}", 6, top + 15, DIM, 11)
        if which < 3:
            write_figures(frame, f"{low:.3g}", 6, bottom - 20, DIM, 11)

    def _trace(
        self,
        frame: Frame,
        which: int,
        values: FloatArray,
        low: float,
        high: float,
        colour: str,
        *,
        thick: int = 1,
        every: int = 1,
    ) -> None:
        top, bottom = self._box(which)
        if every > 1:
            values = np.where(np.arange(len(values)) % every < every // 2, values, np.nan)
        draw_trace(frame[top:bottom, LEFT : WIDTH - RIGHT], values, low, high, TRACE[colour], thick)

    def _mark_onset(self, frame: Frame) -> None:
        assert self.onset_step is not None  # noqa: S101  # the caller looked
        x = LEFT + min(self.width - 2, self.onset_step * self.width // self.n_steps)
        frame[TOP : HEIGHT - 30 : 3, x : x + 2] = TRACE["onset"]
        write(frame, "onset", min(x - 14, WIDTH - RIGHT - 40), HEIGHT - 30, TRACE["onset"], 12)

    def _head(self, frame: Frame) -> None:
        options = self.setup.options
        time_ms = 1e3 * self.step * options.samples_per_step * options.dt_s
        write(frame, "motor under watch", 6, 8, INK, 16)
        write_figures(frame, f"{time_ms:7.1f} ms", 190, 8, INK, 16)
        if self.samples:
            write_figures(frame, f"{self.samples[-1][3]:+7.2f} V", 330, 8, TRACE["speed"], 16)
        if self.verdict:
            write(frame, self.verdict, 470, 8, TRACE["current" if self.good else "threshold"], 16)


def _reach(values: FloatArray, middle: float) -> float:
    """Largest distance from the middle, so that nothing leaves the screen."""
    good = values[np.isfinite(values)]
    return 1.1 * float(np.abs(good - middle).max()) if len(good) else 0.0


class Window:
    """A window on the screen, by pygame.

    Args:
        width: in pixels.
        height: in pixels.
        frames_per_s: at most.

    Raises:
        DependencyNotInstalled: pygame is not there.
    """

    def __init__(self, width: int, height: int, frames_per_s: int) -> None:
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
