"""Pictures of fits: measured beside modelled current and speed."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from motor_env.console import printable
from motor_env.diagnosis.shown.report import quality
from motor_env.fitting.identify import Operation
from motor_env.fitting.starts.identified import Identified
from motor_env.motor.parameters import FloatArray
from motor_env.plotting import COLOUR, drawing, save, subplots

_LONGEST_LINE = 60
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
        for axis, (label, curves) in zip(axes, panels, strict=True):
            for style, values in curves.items():
                axis.plot(time, values, **_STYLE[style])
            axis.set_ylabel(label)
            if "fitted" in curves:
                axis.legend(
                    list(curves), loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0
                )
        said = f"{' + '.join(fit.model) or 'textbook'}, {quality(fit.r2_current, fit.r2_speed)}"
        title = textwrap.fill(f"{printable(name)}: {said}", _LONGEST_LINE)
        axes[0].set_title(title, parse_math=False)
        axes[-1].set_xlabel(words)
        figure.align_ylabels()
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
