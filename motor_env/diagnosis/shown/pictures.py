"""Pictures of fitted starts: of a diagnosis, of an identification, of a commissioning."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from scipy.special import stdtrit

from motor_env.console import printable
from motor_env.diagnosis.shown.report import model_words
from motor_env.diagnosis.views import Fitted
from motor_env.fitting.starts import Identified
from motor_env.motor.healthy import Healthy
from motor_env.motor.parameters import FloatArray
from motor_env.plotting import COLOUR, drawing, save, subplots

_LONGEST_TITLE = 80


def plot_identified(fit: Identified, name: str, path: Path) -> None:
    """Measured and fitted current (and speed), and their residuals.

    Raises:
        InputError: the file cannot be written.
    """
    with drawing():
        rows = 2 if fit.start.speed_rad_s is None else 4
        figure, axes = subplots(rows, height_in=3.0 + 1.6 * rows, height_ratios=(2.2, 1.0) * (rows // 2))
        _currents(axes[0], axes[1], fit, COLOUR["healthy"])
        title = f"{_title(name)}: {model_words(fit.model)}, R² {fit.r2_current:.4f}"
        axes[0].set_title(title, parse_math=False)
        axes[0].legend(loc="upper right")
        if fit.start.speed_rad_s is not None:
            time_ms, speed, fitted = _time_ms(fit), fit.start.speed_rad_s, fit.expected[:, 1]
            axes[2].plot(time_ms, speed, color=COLOUR["measured"], linewidth=1.2)
            axes[2].plot(time_ms, fitted, color=COLOUR["healthy"])
            axes[2].set_ylabel("speed (rad/s)")
            axes[3].plot(time_ms, speed - fitted, color=COLOUR["healthy"], linewidth=0.8)
            axes[3].set_ylabel("residual (rad/s)")
        axes[-1].set_xlabel("time after the start (ms)")
        figure.align_ylabels()
        save(figure, path)


def plot_commissioned(
    fits: Sequence[Fitted],
    healthy: Healthy,
    smallest: Mapping[str, float],
    rate: float,
    path: Path,
) -> None:
    """How far each quantity spreads, with the next piece's interval; above it all starts, their fits and residuals.

    Raises:
        InputError: the file cannot be written.
    """
    starts = [fit for fit in fits if isinstance(fit, Identified)]
    with drawing():
        figure, axes = subplots(
            3 if starts else 1,
            height_in=9.5 if starts else 4.0,
            sharex=False,
            height_ratios=(2.0, 1.0, 1.6) if starts else (1.0,),
        )
        if starts:
            _all_starts(axes[0], axes[1], starts)
        _spread(axes[-1], fits, healthy, rate)
        told = ", ".join(f"{kind.replace('_', ' ')} {severity:.0%}" for kind, severity in smallest.items())
        words = textwrap.wrap(f"smallest change found in 95 of 100 cases: {told}", _LONGEST_TITLE)
        axes[-1].set_xlabel("\n".join(["off the mean (%)", *words]))
        save(figure, path)


def _all_starts(top: Axes, middle: Axes, fits: Sequence[Identified]) -> None:
    """Measured and fitted currents, and the residuals below."""
    for n, fit in enumerate(fits):
        time_ms = _time_ms(fit)
        labels = ("measured", "fitted") if n == 0 else (None, None)
        top.plot(time_ms, fit.start.current_a, color=COLOUR["measured"], linewidth=0.8, label=labels[0])
        top.plot(time_ms, fit.expected[:, 0], color=COLOUR["healthy"], linewidth=1.2, label=labels[1])
        middle.plot(time_ms, fit.residual_a, linewidth=0.6, color=COLOUR["healthy"], alpha=0.6)
    top.set_ylabel("current (A)")
    top.legend(loc="upper right")
    top.set_title(f"{len(fits)} healthy starts")
    middle.set_ylabel("residual (A)")
    middle.set_xlabel("time after the start (ms)")
    middle.set_xlim(top.get_xlim())


def _spread(axes: Axes, fits: Sequence[Fitted], healthy: Healthy, rate: float) -> None:
    """A bar a quantity, the interval of the next healthy piece, and a point a piece."""
    half = -float(stdtrit(healthy.degrees_of_freedom, rate / 2.0))
    off = 100.0 * np.expm1(np.array([fit.log_values for fit in fits]) - np.log(healthy.values))
    for row in range(len(healthy.quantities)):
        width = half * math.sqrt(healthy.log_covariance[row, row])
        low, high = 100.0 * math.expm1(-width), 100.0 * math.expm1(width)
        axes.barh(row, high - low, left=low, height=0.55, color=COLOUR["healthy"], alpha=0.18)
        # Beyond the axis the bar is cut: its ends are said.
        ends = f"{low:+.0f} … {high:+.0f} %"
        axes.annotate(ends, (1.005, row), xycoords=("axes fraction", "data"), va="center", fontsize=10)
        axes.plot(off[:, row], [row] * len(fits), "o", color=COLOUR["healthy"], markersize=5)
    widths = half * np.sqrt(np.diag(healthy.log_covariance))
    room = 1.3 * max(100.0 * float(np.median(np.expm1(np.minimum(widths, 1.0)))), float(np.abs(off).max()))
    axes.set_xlim(-room, room)
    axes.set_yticks(range(len(healthy.quantities)), list(healthy.quantities))
    piece = "start" if healthy.windows is None else "window"
    axes.set_title(f"Interval of the next healthy {piece} ({1.0 - rate:.0%})")


def _title(name: str) -> str:
    return printable(name)[:_LONGEST_TITLE]


def _time_ms(fit: Identified) -> FloatArray:
    return 1e3 * (fit.start.time_s - fit.onset_s)


def _currents(top: Axes, below: Axes, fit: Identified, colour: str) -> None:
    """Measured and fitted current, and the residual below."""
    time_ms = _time_ms(fit)
    top.plot(time_ms, fit.start.current_a, color=COLOUR["measured"], linewidth=1.2, label="measured")
    top.plot(time_ms, fit.expected[:, 0], color=colour, label="fitted")
    top.set_ylabel("current (A)")
    below.plot(time_ms, fit.residual_a, color=colour, linewidth=0.8)
    below.set_ylabel("residual (A)")
