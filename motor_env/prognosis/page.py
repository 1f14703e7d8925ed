"""The trend page: one self-contained HTML file with a picture a quantity, light or dark by the reader's system."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import timedelta

import numpy as np

from motor_env.motor.parameters import FloatArray
from motor_env.pages.html import render
from motor_env.pages.svg import Axis, Chart, round_ticks
from motor_env.prognosis.trend import Forecast, Trend, forecast_words

_Z90 = 1.6448536269514722

_STATE = {"reached": "limit reached", "trending": "trending", "unknown": "not judged", "steady": "no trend"}
"""Each status in words, in the order of the page."""


def status(trend: Trend) -> str:
    """`reached`, `trending`, `steady`, or `unknown` with too few estimates or no limit."""
    if any(forecast.reached for forecast in trend.forecasts):
        return "reached"
    if any(forecast.trends for forecast in trend.forecasts):
        return "trending"
    return "steady" if trend.forecasts else "unknown"


def page(trends: Sequence[Trend], notes: Sequence[str] = (), title: str = "Trends") -> str:
    """The whole page.

    Args:
        trends: what was judged; those that reach a limit, then those that trend, come first.
        notes: what else the reader should know: files that could not be used.
        title: heading.
    """
    ranked = sorted(trends, key=lambda trend: list(_STATE).index(status(trend)))
    rows = [_row(trend) for trend in ranked]
    return render("motor_env.prognosis", "trend.html.j2", title=title, rows=rows, notes=notes)


def _row(trend: Trend) -> dict[str, str]:
    series, chosen = trend.series, leading(trend)
    when = f" since {series.start:%Y-%m-%d}" if series.start else ""
    return {
        "name": series.name,
        "status": status(trend),
        "state": _STATE[status(trend)],
        "life": "–" if chosen is None or chosen.reached else forecast_words(chosen, series.unit),
        "sentence": trend.sentence,
        "basis": f"{len(series.time)} estimates{when}; mean of the first {trend.reference:.4g}",
        "chart": _chart(trend, chosen),
    }


def leading(trend: Trend) -> Forecast | None:
    """The limit that matters: reached, or trended to, the earliest first."""
    relevant = [forecast for forecast in trend.forecasts if forecast.reached or forecast.trends]
    return min(relevant, key=lambda forecast: (not forecast.reached, forecast.life.median), default=None)


def _chart(trend: Trend, chosen: Forecast | None) -> str:
    """Estimates, limits, and where it trends the fan and the interval of the time to the limit."""
    series = trend.series
    relative = series.estimate / trend.reference
    error = _Z90 * series.standard_error / abs(trend.reference)
    ahead, mean, std = _forecast(chosen, float(series.time[-1] - series.time[0]))
    factors = [forecast.factor for forecast in trend.forecasts]
    shown = np.concatenate([relative - error, relative + error, [1.0], factors])
    low, high = float(shown.min()), float(shown.max())
    room = 0.06 * max(high - low, 1e-6)
    time = float(series.time[-1]) + ahead
    left, right = float(series.time[0]), float(time[-1])
    chart = Chart(
        _time_axis(trend, left, max(right, left + 1e-9)),
        Axis("", low - room, high + room, round_ticks(low - room, high + room), _change),
        size=(860, 300),
        margins=(64, 120, 16, 38),
        label=f"{series.name} relative to the mean of the first estimates, over time",
    )
    chart.y_numbers()
    chart.x_numbers()
    chart.text((chart.right, 296), chart.x_axis.title, anchor="end")
    for factor in factors:
        chart.across("limit", factor)
        chart.text((chart.right + 8, chart.y(factor) + 4), f"limit {_change(factor)}", "limit-name")
    if chosen is not None and len(mean):
        upper, lower = mean + _Z90 * std, mean - _Z90 * std
        chart.shape("polygon", points=chart.points([*time, *time[::-1]], [*upper, *lower[::-1]]))
        inside = (mean >= chart.y_axis.low) & (mean <= chart.y_axis.high)
        chart.curve("forecast", time[inside], mean[inside])
        _draw_life(chart, chosen, float(series.time[-1]))
    for t, value, half in zip(series.time, relative, error, strict=True):
        x = chart.x(t)
        chart.line("range", (x, chart.y(value - half)), (x, chart.y(value + half)))
        chart.dot("dot", (x, chart.y(value)), 3.2)
    return chart.svg()


def _change(factor: float) -> str:
    return f"{100.0 * (factor - 1.0):+.0f} %"


def _time_axis(trend: Trend, low: float, high: float) -> Axis:
    """Dates where they are known."""
    start, unit, ticks = trend.series.start, trend.series.unit, round_ticks(low, high, 6)
    if start is None or unit != "days":
        return Axis(unit, low, high, ticks)
    return Axis("", low, high, ticks, lambda days: f"{start + timedelta(days=days):%Y-%m-%d}")


def _forecast(chosen: Forecast | None, span: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times after the last estimate, the mean level expected then and its standard deviation."""
    if chosen is None or chosen.reached or chosen.withheld:
        return np.zeros(1), np.empty(0), np.empty(0)
    span = max(span, 1e-9)
    end = next(value for value in (chosen.life.high, chosen.life.median, span) if math.isfinite(value))
    ahead = np.linspace(0.0, min(1.08 * end, 3.0 * span), 60)
    return ahead, *chosen.wear.forecast(ahead)


def _draw_life(chart: Chart, forecast: Forecast, last: float) -> None:
    """The interval of the time to the limit, drawn on the limit."""
    y, life = chart.y(forecast.factor), forecast.life
    chart.line("life", (chart.x(last + life.low), y), (chart.x(last + life.high), y))
    if last + life.median <= chart.x_axis.high:
        chart.dot("median", (chart.x(last + life.median), y), 6)
