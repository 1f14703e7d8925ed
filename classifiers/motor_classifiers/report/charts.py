"""Charts of the benchmark's page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from motor_classifiers.scoring.calibration import Reliability
from motor_classifiers.scoring.metrics import Score
from motor_env.common.pages import Axis, Chart, percent, round_ticks


def interval_chart(
    bars: Sequence[tuple[str, str, Score]], limit: float, limit_label: str, *,
    width: int = 760, left: int = 170, title: str = "",
) -> str:  # fmt: skip
    """A score of each method (name, family, score) with its interval, and the limit as a line."""
    low = min([*(score.low for _, _, score in bars), limit]) - 0.01
    high = min(1.0, max([*(score.high for _, _, score in bars), limit]) + 0.01)
    shares = Axis("", low, high, round_ticks(low, high, 6 if width > 500 else 3), percent)
    chart = Chart(
        shares,
        Axis("", 0.0, len(bars), is_reversed=True),
        size=(width, 64 + 28 * len(bars)),
        margins=(left, 54, 34, 30),
        label=title or limit_label,
    )
    chart.x_numbers(grid=True)
    x = chart.x(limit)
    chart.line("limit", (x, chart.top - 6), (x, chart.bottom))
    chart.text((x + 4, chart.top - 13), limit_label, "limit-label", "end" if x > 0.6 * width else "middle")
    for row, (name, family, score) in enumerate(bars):
        y = chart.y(row + 0.5)
        chart.text((left - 12, y + 4), name, "name", "end")
        chart.line("range", (chart.x(score.low), y), (chart.x(score.high), y))
        chart.dot(f"dot {family}", (chart.x(score.value), y), 5.5)
        chart.text((chart.x(score.high) + 8, y + 4), f"{100 * score.value:.1f}", "value")
    return chart.svg()


def reliability_chart(binned: Reliability, low: float) -> str:
    """Share of right decisions against the largest probability, with bars of one standard error.

    Args:
        binned: from `calibration.reliability`.
        low: where both axes begin.
    """
    axis = Axis("", low, 1.0, (low, 1.0))
    chart = Chart(axis, axis, size=(190, 190), margins=(34, 8, 8, 26), label="Reliability")
    chart.y_numbers()
    chart.x_numbers()
    chart.line("threshold", (chart.left, chart.bottom), (chart.right, chart.top))
    filled = binned.n_cases > 0
    confidence, shares, counts = binned.confidence[filled], binned.accuracy[filled], binned.n_cases[filled]
    chart.curve("estimate", confidence, shares)
    errors = np.sqrt(shares * (1.0 - shares) / counts)
    for sure, share, error, count in zip(confidence, shares, errors, counts, strict=True):
        x = chart.x(sure)
        chart.line("range", (x, chart.y(share + error)), (x, chart.y(share - error)))
        radius = 1.8 + 2.4 * float(np.sqrt(count / counts.max()))
        chart.dot("dot", (x, chart.y(share)), radius, f"{count:.0f} starts")
    return chart.svg()


class Line(NamedTuple):
    """A curve: label, style classes (`limit`, s0, s1, ...; `dashed`), positions and values."""

    label: str
    style: str
    x: Sequence[float]
    y: Sequence[float]


def share_axis(values: Sequence[float]) -> Axis:
    """Axis for shares, a point wider than the values."""
    low, high = min(values) - 0.01, min(1.0, max(values) + 0.01)
    return Axis("", low, high, round_ticks(low, high, 6), percent)


def line_chart(
    lines: Sequence[Line], x_axis: Axis, y_axis: Axis, *, named: bool = True, marked: bool = True
) -> str:
    """Curves over two axes.

    Args:
        lines: curves.
        x_axis: of the positions.
        y_axis: of the values.
        named: whether each line is named at its right end.
        marked: whether points are drawn, each with its values when it is pointed at.
    """
    margins = (58, 132 if named else 22, 24, 40) if y_axis.title else (52, 132 if named else 22, 12, 40)
    label = f"{y_axis.title or 'Accuracy'} against {x_axis.title}"
    chart = Chart(x_axis, y_axis, size=(520, 400), margins=margins, label=label)
    chart.y_numbers()
    chart.x_numbers()
    chart.text(((chart.left + chart.right) / 2, 394), x_axis.title, anchor="middle")
    chart.text((4, 12), y_axis.title)
    ends = _spread_out([chart.y(line.y[-1]) for line in lines], 13.0, chart.top + 4.0, chart.bottom + 14.0)
    for line, label_y in zip(lines, ends, strict=True):
        with chart.group(f"series {line.style}"):
            chart.curve("", line.x, line.y)
            for x, y in zip(line.x, line.y, strict=True) if marked else ():
                title = f"{line.label}, {x_axis.number(x)}: {y_axis.number(y)}"
                chart.dot("", (chart.x(x), chart.y(y)), 3, title)
            if named:
                tip, level = chart.x(line.x[-1]), chart.y(line.y[-1])
                chart.line("lead", (tip, level), (tip + 12, label_y))
                chart.text((tip + 15, label_y + 4), line.label, "")
    return chart.svg()


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
