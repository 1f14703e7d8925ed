"""Shared style of all figures: no window, no global state of pyplot.

A figure is made and saved inside `drawing()`:

    with drawing():
        figure, (top, bottom) = subplots(2)
        top.plot(time_ms, current_a, color=COLOUR["healthy"])
        save(figure, path)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from motor_env.common.files import replacing

if TYPE_CHECKING:  # what draws nothing does not wait for matplotlib
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#1f2933"
QUIET = "#7b8794"
GRID = "#e4e7eb"

COLOUR = {
    "healthy": "#0b6fa4",
    "bearing": "#d98300",
    "winding_contact": "#c8442b",
    "winding_short": "#8c2d5f",
    "winding": "#c8442b",
    "noise": "#6b4fa0",
    "magnet": "#a3476f",
    "other": "#52606d",
    "measured": "#9fb3c8",
    "threshold": "#1f2933",
    "estimate": "#12805c",
}
"""Colour of each meaning in all figures, for colour-blind readers too."""

STYLE: dict[str, Any] = {
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.08,
    "axes.facecolor": "white",
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 13,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 9,
    "axes.labelsize": 12,
    "axes.linewidth": 0.9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.xmargin": 0.0,
    "grid.color": GRID,
    "grid.linewidth": 0.9,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 11,
    "ytick.labelsize": 11,
    "lines.linewidth": 2.0,
    "lines.solid_capstyle": "round",
    "legend.fontsize": 11,
    "legend.frameon": False,
    "text.color": INK,
    "font.family": "DejaVu Sans",
    "savefig.dpi": 150,
    "svg.hashsalt": "motor-env",  # ids that do not change from run to run
    "path.simplify": True,
}


@contextmanager
def drawing() -> Iterator[None]:
    """Apply the shared style to matplotlib within a block."""
    import matplotlib as mpl

    with mpl.rc_context(cast("Any", STYLE)):
        yield


def subplots(
    rows: int = 1,
    *,
    width_in: float = 9.0,
    height_in: float | None = None,
    sharex: bool = True,
    height_ratios: tuple[float, ...] | None = None,
) -> tuple[Figure, list[Axes]]:
    """Return a figure with one column of axes, bound to no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, 2.7 * rows if height_in is None else height_in))
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, 1, sharex=sharex, squeeze=False, height_ratios=height_ratios)
    return figure, cast("list[Axes]", np.ravel(grid).tolist())


def note(
    axes: Axes, point: tuple[float, float], text: str, offset_pt: tuple[float, float], **style: Any
) -> None:
    """Write a text at an offset in points from a data point."""
    axes.annotate(text, point, xytext=offset_pt, textcoords="offset points", **({"fontsize": 11} | style))


def end_label(axes: Axes, x: float, y: float, text: str, color: str, *, offset_pt: float = 0.0) -> None:
    """Label a curve at its right end, in its colour."""
    beside = (6.0, offset_pt)
    note(axes, (x, y), text, beside, color=color, va="center", fontweight="bold", annotation_clip=False)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG, by the ending of its name, in reproducible bytes."""
    metadata: dict[str, Any] = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with replacing(path) as unfinished:
        figure.savefig(unfinished, format=path.suffix.removeprefix("."), metadata=metadata)
