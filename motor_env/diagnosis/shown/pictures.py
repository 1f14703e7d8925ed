"""Pictures of fits: measured beside modelled current and speed; of a commissioning also the spread of its pieces."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from motor_env.console import printable
from motor_env.diagnosis.shown.report import quality
from motor_env.diagnosis.views import Fitted
from motor_env.fitting.operation_fit import OperationFit as Operation
from motor_env.fitting.starts.start_fit import StartFit as Identified
from motor_env.motor.parameters import FloatArray
from motor_env.plotting import COLOUR, drawing, save, subplots

_LONGEST_LINE = 60
_WIDEST = 172.0  # per cent, of an interval that the axis follows
_STYLE: dict[str, dict[str, Any]] = {
    "measured": {"color": COLOUR["measured"], "linewidth": 1.2},
    "fitted": {"color": COLOUR["healthy"], "linewidth": 1.2},
    "left over": {"color": COLOUR["healthy"], "linewidth": 0.8, "alpha": 0.8},
}
Panels = list[tuple[str, dict[str, FloatArray]]]
"""What stands on each axis, in words, and its curves by their style."""


def plot_fit(fit: Identified | Operation, name: str, path: Path) -> None:
    """Measured and fitted current and speed, and their residuals; of a log also the voltage.

    Raises:
        InputError: the file cannot be written.
    """
    words, time, panels = _panels(fit)
    heights = tuple(2.2 if "fitted" in curves else 1.0 for _, curves in panels)
    with drawing():
        figure, axes = subplots(len(panels), height_in=1.6 + 1.4 * sum(heights), height_ratios=heights)
        _draw(axes, time, panels)
        said = f"{' + '.join(fit.model) or 'textbook'}, {quality(fit.r2_current, fit.r2_speed)}"
        title = textwrap.fill(f"{printable(name)}: {said}", _LONGEST_LINE)
        axes[0].set_title(title, parse_math=False)
        axes[-1].set_xlabel(words)
        figure.align_ylabels()
        save(figure, path)


def plot_commissioned(
    fits: Sequence[Fitted],
    parameters: Mapping[str, Mapping[str, Any]],
    smallest: Mapping[str, float],
    rate: float,
    path: Path,
) -> None:
    """How far each quantity spreads, with the next piece's interval; above it all starts, their fits and residuals.

    Raises:
        InputError: the file cannot be written.
    """
    starts = [fit for fit in fits if isinstance(fit, Identified)]
    ratios = (2.0, 1.0, 1.6) if starts else (1.0,)
    with drawing():
        figure, axes = subplots(
            len(ratios), height_in=9.5 if starts else 4.0, sharex=False, height_ratios=ratios
        )
        for fit in starts:
            words, time, panels = _panels(fit)
            _draw(axes, time, panels[:2])
            axes[0].set_title(f"{len(starts)} healthy starts")
            axes[1].set(xlabel=words, xlim=axes[0].get_xlim())
        _spread(axes[-1], fits, parameters)
        axes[-1].set_title(
            f"Interval of the next healthy {'start' if starts else 'window'} ({1.0 - rate:.0%})"
        )
        told = ", ".join(f"{kind.replace('_', ' ')} {severity:.0%}" for kind, severity in smallest.items())
        words = textwrap.fill(f"smallest change found in 95 of 100 cases: {told}", _LONGEST_LINE)
        axes[-1].set_xlabel(f"off the mean (%)\n{words}")
        save(figure, path)


def _panels(fit: Identified | Operation) -> tuple[str, FloatArray, Panels]:
    """The axis of time in words, the times, and what is drawn over them. Samples that do not count are left out."""
    if isinstance(fit, Identified):
        words, time = "time after the start (ms)", 1e3 * (fit.start.time_s - fit.onset_s)
        measured = [np.where(fit.start.counted, fit.start.current_a, np.nan), fit.start.speed_rad_s]
        panels: Panels = []
    else:
        words, time = "time (s)", fit.record.dt_s * np.arange(len(fit.expected), dtype=np.float64)
        measured = [fit.record.readings[:, n] if fit.record.seen[n] else None for n in range(2)]
        panels = [("voltage (V)", {"measured": fit.record.voltage_v})]
    channels = (("current", "A"), ("speed", "rad/s"))
    for (name, unit), seen, fitted in zip(channels, measured, fit.expected.T, strict=True):
        if seen is not None:
            panels.append((f"{name} ({unit})", {"measured": seen, "fitted": fitted}))
            panels.append((f"residual ({unit})", {"left over": seen - fitted}))
    return words, time, panels


def _draw(axes: Sequence[Axes], time: FloatArray, panels: Panels) -> None:
    """Each panel on its axes."""
    for axis, (words, curves) in zip(axes, panels, strict=False):
        for style, values in curves.items():
            axis.plot(time, values, **_STYLE[style])
        axis.set_ylabel(words)
        if "fitted" in curves:
            axis.legend(
                list(curves), loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0
            )


def _spread(axes: Axes, fits: Sequence[Fitted], parameters: Mapping[str, Mapping[str, Any]]) -> None:
    """A bar a quantity, the interval of the next healthy piece, and a point a piece."""
    rows = np.arange(len(parameters))
    values = np.array([row["value"] for row in parameters.values()])
    lows, highs = 100.0 * (np.array([row["interval"] for row in parameters.values()]).T / values - 1.0)
    off = 100.0 * (np.exp([fit.log_values for fit in fits]) / values - 1.0)
    axes.barh(rows, highs - lows, left=lows, height=0.55, color=COLOUR["healthy"], alpha=0.18)
    axes.plot(off.T, rows, "o", color=COLOUR["healthy"], markersize=5)
    room = 1.3 * max(float(np.median(np.minimum(highs, _WIDEST))), float(np.abs(off).max()))
    axes.set_xlim(-room, room)
    # Beyond the axis the bar is cut: its ends are said.
    ends = [f"{low:+.0f} … {high:+.0f} %" for low, high in zip(lows, highs, strict=True)]
    axes.set_yticks(rows, [f"{name}\n{words}" for name, words in zip(parameters, ends, strict=True)])
