"""Charts of the report as inline SVG; colours are the page's variables, so they follow light and dark."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from motor_env.parameters import FloatArray

_POINTS = 700  # of a drawn curve


class Bar(NamedTuple):
    """A row of the accuracy chart: name, value and interval, as shares."""

    label: str
    family: str
    value: float
    low: float
    high: float


def _ticks(low: float, high: float, about: int = 5) -> FloatArray:
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


def interval_chart(bars: Sequence[Bar], limit: float, limit_label: str) -> str:
    """Accuracy of each method with its interval, and the limit as a line."""
    left, width, row, top = 150, 760, 34, 34
    low = min([*(bar.low for bar in bars), limit]) - 0.01
    high = min(1.0, max([*(bar.high for bar in bars), limit]) + 0.01)

    def x(value: float) -> float:
        return left + (width - left - 70) * (value - low) / (high - low)

    height = top + row * len(bars) + 34
    bottom = top + row * len(bars)
    parts = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="Accuracy of each method">']
    for tick in _ticks(low, high, 6):
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
        parts.append(f'<circle class="dot {escape(bar.family)}" cx="{x(bar.value):.1f}" cy="{y}" r="6"/>')
        parts.append(
            f'<text class="value" x="{x(bar.high) + 8:.1f}" y="{y + 4:.1f}">{100 * bar.value:.1f}</text>'
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
    for tick in _ticks(low, high, 4):
        parts.append(
            f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        )
        parts.append(
            f'<text class="tick" x="{left - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>'
        )
    if with_time:
        for tick in _ticks(begin, end, 6):
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


def reliability_chart(confidence: FloatArray, right: FloatArray, n_bins: int = 10) -> str:
    """Share of right decisions against the largest probability, in bins of equal count."""
    size, left, bottom = 190, 34, 26
    order = np.argsort(confidence, kind="stable")

    def at(p: float, q: float) -> tuple[float, float]:
        inner = size - left - 8
        return left + inner * p, 8 + (size - bottom - 8) * (1.0 - q)

    low = max(0.0, float(np.floor(10.0 * min(float(confidence.min()), 0.9))) / 10.0)

    def scale(value: float) -> float:
        return (value - low) / (1.0 - low)

    (x0, y0), (x1, y1) = at(0.0, 0.0), at(1.0, 1.0)
    parts = [f'<svg viewBox="0 0 {size} {size}" role="img" aria-label="Reliability">']
    parts.append(f'<line class="threshold" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>')
    for tick in (low, 1.0):
        x, y = at(scale(tick), scale(tick))
        parts.append(f'<text class="tick" x="{x:.1f}" y="{size - 10}" text-anchor="middle">{tick:g}</text>')
        parts.append(f'<text class="tick" x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    points = []
    for part in np.array_split(order, n_bins):
        x, y = at(scale(float(confidence[part].mean())), max(0.0, scale(float(right[part].mean()))))
        points.append((x, y))
    parts.append(
        '<polyline class="estimate" points="' + " ".join(f"{x:.1f},{y:.1f}" for x, y in points) + '"/>'
    )
    parts += [f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>' for x, y in points]
    parts.append("</svg>")
    return "".join(parts)
