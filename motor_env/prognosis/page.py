"""The trend page: one self-contained HTML file with a picture a quantity, light or dark by the reader's system."""

from __future__ import annotations

import math
from datetime import timedelta

import numpy as np

from motor_env.motor.parameters import FloatArray
from motor_env.pages.svg import Axis, Chart, round_ticks
from motor_env.prognosis.trend import Forecast, Trend, describe

_Z90 = 1.6448536269514722

STATES = {"reached": "limit reached", "trending": "trending", "unknown": "not judged", "steady": "no trend"}
"""Each state in words, in the order of the page."""


def row(trend: Trend) -> dict[str, str]:
    """What the page says of a quantity."""
    series, chosen = trend.series, trend.leading
    when = f" since {series.start:%Y-%m-%d}" if series.start else ""
    return {
        "name": series.name,
        "status": trend.state,
        "state": STATES[trend.state],
        "life": "–" if chosen is None or chosen.reached else describe(chosen, series.unit),
        "sentence": trend.sentence,
        "basis": f"{len(series.time)} estimates{when}; mean of the first {trend.reference:.4g}",
        "chart": _chart(trend),
    }


def _chart(trend: Trend) -> str:
    """Estimates, limits, and where it trends the fan and the interval of the time to the limit."""
    series = trend.series
    relative = series.estimate / trend.reference
    error = _Z90 * series.standard_error / abs(trend.reference)
    factors = [forecast.factor for forecast in trend.forecasts]
    shown = np.concatenate([relative - error, relative + error, [1.0], factors])
    low, high = float(shown.min()), float(shown.max())
    room = 0.06 * max(high - low, 1e-6)
    told = trend.leading if trend.leading is not None and trend.leading.is_told else None
    left, last = float(series.time[0]), float(series.time[-1])
    ahead = 0.0 if told is None else _ahead(told, last - left)
    chart = Chart(
        _time_axis(trend, left, max(last + ahead, left + 1e-9)),
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
    if told is not None:
        _draw_forecast(chart, told, last, np.linspace(0.0, ahead, 60))
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
    if start is None:
        return Axis(unit, low, high, ticks)
    return Axis("", low, high, ticks, lambda days: f"{start + timedelta(days=days):%Y-%m-%d}")


def _ahead(told: Forecast, span: float) -> float:
    """How far behind the last estimate the forecast is drawn."""
    end = next(value for value in (told.life.high, told.life.median, span) if math.isfinite(value))
    return min(1.08 * end, 3.0 * span)


def _draw_forecast(chart: Chart, told: Forecast, last: float, ahead: FloatArray) -> None:
    """The levels expected after the last estimate, and on the limit the interval of the time until it is reached."""
    mean, std = told.wear.forecast(ahead)
    time, upper, lower = last + ahead, mean + _Z90 * std, mean - _Z90 * std
    chart.shape("polygon", points=chart.points([*time, *time[::-1]], [*upper, *lower[::-1]]))
    inside = (mean >= chart.y_axis.low) & (mean <= chart.y_axis.high)
    chart.curve("forecast", time[inside], mean[inside])
    y, life = chart.y(told.factor), told.life
    chart.line("life", (chart.x(last + life.low), y), (chart.x(last + life.high), y))
    if last + life.median <= chart.x_axis.high:
        chart.dot("median", (chart.x(last + life.median), y), 6)
