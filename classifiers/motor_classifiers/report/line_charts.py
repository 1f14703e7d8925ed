"""Line charts of the report as inline SVG: sweeps, and curves of trust."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from motor_env.motor.parameters import FloatArray


class Line(NamedTuple):
    """A curve: label, style classes (`limit`, s0, s1, ...; `dashed`), positions and values."""

    label: str
    style: str
    x: Sequence[float]
    y: Sequence[float]


class Axis(NamedTuple):
    """An axis: what stands on it, its ends, the numbers at its ticks, and whether it is logarithmic.

    Attributes:
        title: what is drawn, with its unit; empty for none.
        low: where the axis begins.
        high: where it ends.
        ticks: drawn and named.
        is_share: whether values are shares, named in per cent.
        is_log: whether it is logarithmic.
    """

    title: str
    low: float
    high: float
    ticks: Sequence[float]
    is_share: bool = False
    is_log: bool = False

    def place(self, value: float) -> float:
        """From 0 at the begin to 1 at the end; beyond them values stay on the edge."""
        low, high, at = self.low, self.high, min(max(value, self.low), self.high)
        if self.is_log:
            low, high, at = np.log([low, high, at])
        return float((at - low) / max(high - low, 1e-9))

    def name(self, value: float) -> str:
        """A value in words."""
        return f"{100 * value:.3g} %" if self.is_share else f"{value:g}"


def ticks(low: float, high: float, about: int = 5) -> FloatArray:
    """Round numbers in a range."""
    span = max(high - low, 1e-12)
    step = 10.0 ** np.floor(np.log10(span / about))
    for factor in (1.0, 2.0, 5.0, 10.0):
        if span / (step * factor) <= about:
            step *= factor
            break
    ticks: FloatArray = (
        np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0
    )  # no -0
    return ticks


def share_axis(values: Sequence[float]) -> Axis:
    """Axis for shares, a point wider than the values."""
    low, high = min(values) - 0.01, min(1.0, max(values) + 0.01)
    return Axis("", low, high, ticks(low, high, 6).tolist(), is_share=True)


def line_chart(
    lines: Sequence[Line],
    x_axis: Axis,
    y_axis: Axis,
    *,
    width: int = 520,
    height: int = 400,
    named: bool = True,
    marked: bool = True,
) -> str:
    """Curves over two axes.

    Args:
        lines: curves.
        x_axis: of the positions.
        y_axis: of the values.
        width: of the drawing.
        height: of the drawing.
        named: whether each line is named at its right end.
        marked: whether points are drawn, each with its values when it is pointed at.
    """
    left, right, top, bottom = (
        58 if y_axis.title else 52,
        132 if named else 22,
        24 if y_axis.title else 12,
        40,
    )

    def x(value: float) -> float:
        return left + (width - left - right) * x_axis.place(value)

    def y(value: float) -> float:
        return top + (height - top - bottom) * (1.0 - y_axis.place(value))

    label = f"{y_axis.title or 'Accuracy'} against {x_axis.title}"
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">']
    parts += [
        f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        f'<text class="tick" x="{left - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{y_axis.name(tick)}</text>'
        for tick in y_axis.ticks
    ]
    parts += [
        f'<text class="tick" x="{x(tick):.1f}" y="{height - 22}" text-anchor="middle">{x_axis.name(tick)}</text>'
        for tick in x_axis.ticks
    ]
    middle = (left + width - right) / 2
    parts.append(
        f'<text class="tick" x="{middle}" y="{height - 6}" text-anchor="middle">{escape(x_axis.title)}</text>'
        f'<text class="tick" x="4" y="12">{escape(y_axis.title)}</text>'
    )
    ends = _spread_out([y(line.y[-1]) for line in lines], 13.0, top + 4.0, height - bottom + 14.0)
    for line, label_y in zip(lines, ends, strict=True):
        points = " ".join(f"{x(p):.1f},{y(v):.1f}" for p, v in zip(line.x, line.y, strict=True))
        parts.append(f'<g class="series {escape(line.style)}"><polyline points="{points}"/>')
        if marked:
            parts += [
                f'<circle cx="{x(p):.1f}" cy="{y(v):.1f}" r="3">'
                f"<title>{escape(line.label)}, {x_axis.name(p)}: {y_axis.name(v)}</title></circle>"
                for p, v in zip(line.x, line.y, strict=True)
            ]
        if named:
            tip, level = x(line.x[-1]), y(line.y[-1])
            parts.append(
                f'<polyline class="lead" points="{tip:.1f},{level:.1f} {tip + 12:.1f},{label_y:.1f}"/>'
                f'<text x="{tip + 15:.1f}" y="{label_y + 4:.1f}">{escape(line.label)}</text>'
            )
        parts.append("</g>")
    parts.append("</svg>")
    return "".join(parts)


def _spread_out(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Places near the wanted ones, `gap` apart, so that no label covers another."""
    order = np.argsort(wanted, kind="stable")
    placed = np.asarray(wanted, dtype=np.float64)[order]
    for n in range(len(placed)):
        placed[n] = max(placed[n], low if n == 0 else placed[n - 1] + gap)
    for n in range(len(placed) - 1, -1, -1):
        placed[n] = min(placed[n], high if n == len(placed) - 1 else placed[n + 1] - gap)
    result = np.empty(len(placed))
    result[order] = placed
    return [float(value) for value in result]
