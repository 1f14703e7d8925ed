"""Charts of the report as inline SVG; colours are the page's variables, so they follow light and dark."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from motor_classifiers.report.line_charts import ticks
from motor_classifiers.scoring.calibration import Reliability
from motor_env.motor.parameters import FloatArray

_POINTS = 700  # of a drawn curve


class Bar(NamedTuple):
    """A row of the accuracy chart: name, value and interval, as shares."""

    label: str
    family: str
    value: float
    low: float
    high: float


def interval_chart(
    bars: Sequence[Bar], limit: float, limit_label: str, *, width: int = 760, left: int = 170, title: str = ""
) -> str:
    """A score of each method with its interval, and the limit as a line."""
    row, top = 28, 34
    low = min([*(bar.low for bar in bars), limit]) - 0.01
    high = min(1.0, max([*(bar.high for bar in bars), limit]) + 0.01)

    def x(value: float) -> float:
        return left + (width - left - 54) * (value - low) / (high - low)

    height = top + row * len(bars) + 30
    bottom = top + row * len(bars)
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title or limit_label)}">']
    for tick in ticks(low, high, 6 if width > 500 else 3):
        parts.append(f'<line class="grid" x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{top}" y2="{bottom}"/>')
        parts.append(
            f'<text class="tick" x="{x(tick):.1f}" y="{bottom + 18}" text-anchor="middle">{100 * tick:g} %</text>'
        )
    anchor = "end" if x(limit) > 0.6 * width else "middle"
    parts.append(
        f'<line class="limit" x1="{x(limit):.1f}" x2="{x(limit):.1f}" y1="{top - 6}" y2="{bottom}"/>'
    )
    parts.append(
        f'<text class="limit-label" x="{x(limit) + 4:.1f}" y="{top - 13}" text-anchor="{anchor}">'
        f"{escape(limit_label)}</text>"
    )
    for n, bar in enumerate(bars):
        y = top + row * (n + 0.5)
        parts.append(
            f'<text class="name" x="{left - 12}" y="{y + 4:.1f}" text-anchor="end">{escape(bar.label)}</text>'
        )
        parts.append(f'<line class="range" x1="{x(bar.low):.1f}" x2="{x(bar.high):.1f}" y1="{y}" y2="{y}"/>')
        parts.append(f'<circle class="dot {escape(bar.family)}" cx="{x(bar.value):.1f}" cy="{y}" r="5.5"/>')
        parts.append(
            f'<text class="value" x="{x(bar.high) + 8:.1f}" y="{y + 4:.1f}">{100 * bar.value:.1f}</text>'
        )
    parts.append("</svg>")
    return "".join(parts)


class Boxes(NamedTuple):
    """Estimates of one method: label, style class, and of each class the quantiles 5, 25, 50, 75, 95 %."""

    label: str
    style: str
    quantiles: Sequence[Sequence[float]]


def severity_chart(names: Sequence[str], truth: Sequence[float], methods: Sequence[Boxes]) -> str:
    """Estimated severities of each true class, a bar a method; the true severity as a mark."""
    width, left, right, top, thick = 760, 170, 20, 10, 13
    row = thick * len(methods) + 12
    most = [quantile for method in methods for row_ in method.quantiles for quantile in row_]
    low, high = min(0.0, *most), max(*truth, *most) * 1.03

    def x(value: float) -> float:
        return left + (width - left - right) * (value - low) / (high - low)

    height = top + row * len(names) + 40
    floor = top + row * len(names)
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="Estimated severity of each class">']
    for tick in ticks(low, high, 8):
        parts.append(f'<line class="grid" x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{top}" y2="{floor}"/>')
        parts.append(
            f'<text class="tick" x="{x(tick):.1f}" y="{floor + 18}" text-anchor="middle">{100 * tick:g}</text>'
        )
    parts.append(
        f'<text class="tick" x="{(left + width) / 2}" y="{floor + 34}" text-anchor="middle">points</text>'
    )
    for n, (name, true) in enumerate(zip(names, truth, strict=True)):
        begin = top + row * n + 6
        middle = begin + thick * len(methods) / 2
        parts.append(
            f'<text class="name" x="{left - 12}" y="{middle + 4:.1f}" text-anchor="end">{escape(name)}</text>'
        )
        for m, method in enumerate(methods):
            y = begin + thick * (m + 0.5)
            q = [x(value) for value in method.quantiles[n]]
            style = escape(method.style)
            told = f"{method.label}: median {100 * method.quantiles[n][2]:.1f} points"
            parts.append(
                f'<g class="boxes {style}"><title>{escape(told)}</title>'
                f'<line x1="{q[0]:.1f}" x2="{q[4]:.1f}" y1="{y:.1f}" y2="{y:.1f}"/>'
                f'<rect x="{q[1]:.1f}" y="{y - 4:.1f}" width="{max(q[3] - q[1], 1.5):.1f}" height="8" rx="2"/></g>'
            )
        parts.append(
            f'<line class="truth" x1="{x(true):.1f}" x2="{x(true):.1f}" y1="{begin - 2}" '
            f'y2="{begin + thick * len(methods) + 2}"/>'
        )
    parts.append("</svg>")
    return "".join(parts)


def _thin(time: FloatArray, *curves: FloatArray) -> tuple[FloatArray, ...]:
    step = max(1, len(time) // _POINTS)
    return tuple(values[::step] for values in (time, *curves))


class Trace(NamedTuple):
    """A curve: style class, time in ms and values."""

    style: str
    time_ms: FloatArray
    values: FloatArray


def trace_chart(
    traces: Sequence[Trace],
    unit: str,
    *,
    span: tuple[float, float],
    levels: Sequence[float] = (),
    mark_ms: float | None = None,
    width: int = 480,
    height: int = 150,
    with_time: bool = False,
) -> str:
    """Curves over time, horizontal thresholds as dashed lines, and a moment as a vertical mark."""
    left, right, top, bottom = 52, 10, 8, 32 if with_time else 12
    begin = min(float(trace.time_ms[0]) for trace in traces)
    end = max(float(trace.time_ms[-1]) for trace in traces)
    low, high = span

    def x(value: float) -> float:
        return left + (width - left - right) * (value - begin) / (end - begin)

    def y(value: float) -> float:
        clipped = min(max(value, low), high)
        return top + (height - top - bottom) * (high - clipped) / (high - low)

    parts = [f'<svg viewBox="0 0 {width} {height}" role="img">']
    for tick in ticks(low, high, 4):
        parts.append(
            f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        )
        parts.append(
            f'<text class="tick" x="{left - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>'
        )
    if with_time:
        for tick in ticks(begin, end, 6):
            place = f'x="{x(tick):.1f}" y="{height - 14}" text-anchor="middle"'
            parts.append(f'<text class="tick" {place}>{tick:g}</text>')
        parts.append(f'<text class="tick" x="{width - right}" y="{height - 2}" text-anchor="end">ms</text>')
    parts.append(f'<text class="tick" x="2" y="{top + 4}">{escape(unit)}</text>')
    for trace in traces:
        time, values = _thin(trace.time_ms, trace.values)
        points = " ".join(f"{x(t):.1f},{y(v):.1f}" for t, v in zip(time, values, strict=True))
        parts.append(f'<polyline class="{escape(trace.style)}" points="{points}"/>')
    for level in levels:
        at = f'y1="{y(level):.1f}" y2="{y(level):.1f}"'
        parts.append(f'<line class="threshold" x1="{left}" x2="{width - right}" {at}/>')
    if mark_ms is not None:
        parts.append(
            f'<line class="mark" x1="{x(mark_ms):.1f}" x2="{x(mark_ms):.1f}" y1="{top}" y2="{height - bottom}"/>'
        )
    parts.append("</svg>")
    return "".join(parts)


def reliability_chart(binned: Reliability, low: float) -> str:
    """Share of right decisions against the largest probability, with bars of one standard error.

    Args:
        binned: from `calibration.reliability`.
        low: where both axes begin.
    """
    size, left, bottom = 190, 34, 26

    def at(p: float, q: float) -> tuple[float, float]:
        inner = size - left - 8
        clipped = [min(max((value - low) / (1.0 - low), 0.0), 1.0) for value in (p, q)]
        return left + inner * clipped[0], 8 + (size - bottom - 8) * (1.0 - clipped[1])

    (x0, y0), (x1, y1) = at(low, low), at(1.0, 1.0)
    parts = [f'<svg viewBox="0 0 {size} {size}" role="img" aria-label="Reliability">']
    parts.append(f'<line class="threshold" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>')
    for tick in (low, 1.0):
        x, y = at(tick, tick)
        parts.append(f'<text class="tick" x="{x:.1f}" y="{size - 10}" text-anchor="middle">{tick:g}</text>')
        parts.append(f'<text class="tick" x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    seen = np.flatnonzero(binned.n_cases > 0)
    points = [at(float(binned.confidence[n]), float(binned.accuracy[n])) for n in seen]
    curve = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    parts.append(f'<polyline class="estimate" points="{curve}"/>')
    most = float(binned.n_cases.max())
    for n, (x, y) in zip(seen, points, strict=True):
        share = float(binned.accuracy[n])
        error = float(np.sqrt(share * (1.0 - share) / binned.n_cases[n]))
        above, below = at(0.0, share + error)[1], at(0.0, share - error)[1]
        parts.append(f'<line class="range" x1="{x:.1f}" x2="{x:.1f}" y1="{above:.1f}" y2="{below:.1f}"/>')
        radius = 1.8 + 2.4 * float(np.sqrt(binned.n_cases[n] / most))
        told = f"<title>{binned.n_cases[n]:.0f} starts</title>"
        parts.append(f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}">{told}</circle>')
    parts.append("</svg>")
    return "".join(parts)
