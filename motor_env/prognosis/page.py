"""The trend page: one self-contained HTML file with a picture a quantity, light or dark by the reader's system."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import timedelta
from html import escape

import numpy as np

from motor_env.motor.parameters import FloatArray
from motor_env.prognosis.trend import Forecast, Trend, describe

_WIDTH, _HEIGHT = 860.0, 300.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 64.0, 120.0, 16.0, 38.0
_Z90 = 1.6448536269514722

_STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1f2933; --quiet: #66727f; --grid: #e4e7eb; --card: #f7f9fb;
  --point: #0b6fa4; --fan: #d98300; --limit: #c8442b; --good: #12805c; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181d; --ink: #e6eaee; --quiet: #98a4b0; --grid: #2a3138;
  --card: #1b2127; --point: #58b4e6; --fan: #f0a63a; --limit: #ff7a63; --good: #4cc79a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 940px; padding: 28px 20px 60px; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; } h2 { font-size: 1.15rem; margin: 0; }
p { margin: .35rem 0; } .quiet { color: var(--quiet); font-size: .9rem; }
section { background: var(--card); border: 1px solid var(--grid); border-radius: 10px; padding: 16px 18px;
  margin: 18px 0; }
section.trending { border-left: 5px solid var(--fan); } section.reached { border-left: 5px solid var(--limit); }
section.steady { border-left: 5px solid var(--good); }
svg { display: block; width: 100%; height: auto; margin-top: 8px; } svg text { font-size: 13px; fill: var(--quiet); }
svg .limit-name { fill: var(--limit); font-weight: 600; } table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 5px 10px 5px 0; border-bottom: 1px solid var(--grid); } th { font-weight: 600; }
"""


def status(trend: Trend) -> str:
    """`reached`, `trending`, `steady`, or `unknown` with too few estimates."""
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
    order = ("reached", "trending", "unknown", "steady")
    ranked = sorted(trends, key=lambda trend: order.index(status(trend)))
    rows = "".join(
        f"<tr><td>{escape(trend.series.name)}</td><td>{_word(status(trend))}</td><td>{escape(_life_cell(trend))}</td></tr>"
        for trend in ranked
    )
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    remarks = f"<section><h2>Not used</h2><ul>{items}</ul></section>" if items else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>"
        '<p class="quiet">Points: estimates with ±1.64 standard errors, relative to the mean of the first ones. '
        "Where there is a drift, the band holds 90 % of the levels expected.</p>"
        f"<table><tr><th>Quantity</th><th>State</th><th>Time to the limit</th></tr>{rows}</table>"
        f"{''.join(_section(trend) for trend in ranked)}{remarks}</body></html>\n"
    )


def _word(state: str) -> str:
    return {"reached": "limit reached", "trending": "trending", "steady": "no trend", "unknown": "too few"}[
        state
    ]


def _life_cell(trend: Trend) -> str:
    chosen = leading(trend)
    return "–" if chosen is None or chosen.reached else describe(chosen.life, trend.series.unit)


def leading(trend: Trend) -> Forecast | None:
    """The limit that matters: reached, or trended to, the earliest first."""
    told = [forecast for forecast in trend.forecasts if forecast.reached or forecast.trends]
    return min(told, key=lambda forecast: (not forecast.reached, forecast.life.median), default=None)


def _section(trend: Trend) -> str:
    series = trend.series
    when = f" since {series.start:%Y-%m-%d}" if series.start else ""
    meta = f"{len(series.time)} estimates{when}; reference {trend.reference:.4g}"
    return (
        f'<section class="{status(trend)}"><h2>{escape(series.name)}</h2><p>{escape(trend.sentence)}.</p>'
        f'<p class="quiet">{escape(meta)}</p>{_picture(trend)}</section>'
    )


def _picture(trend: Trend) -> str:
    """Inline SVG: estimates, limits, and where it trends the fan and the interval of the time to the limit."""
    series, chosen = trend.series, leading(trend)
    relative = series.estimate / trend.reference
    error = _Z90 * series.standard_error / abs(trend.reference)
    first, last = float(series.time[0]), float(series.time[-1])
    span = max(last - first, 1e-9)
    end, ahead, mean, std = last, np.empty(0), np.empty(0), np.empty(0)
    if chosen is not None and not chosen.reached:
        ends = [value for value in (chosen.life.high, chosen.life.median, span) if math.isfinite(value)]
        end = last + min(1.08 * ends[0], 3.0 * span)
        ahead = np.linspace(0.0, end - last, 60)
        mean, std = chosen.wear.forecast(ahead)
    factors = [forecast.factor for forecast in trend.forecasts]
    shown = np.concatenate([relative - error, relative + error, [1.0], factors])
    if len(mean):
        capped = np.clip(mean, float(shown.min()), float(shown.max()))
        shown = np.append(shown, capped)
    low, high = float(shown.min()), float(shown.max())
    room = 0.06 * max(high - low, 1e-6)
    axes = _Axes(first, end, low - room, high + room)
    parts = [axes.frame(series.unit, series.start)]
    for factor in factors:
        y = axes.y(factor)
        parts.append(
            f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="var(--limit)" '
            f'stroke-dasharray="6 4" stroke-width="1.5"/><text class="limit-name" x="{_WIDTH - _RIGHT + 8}" '
            f'y="{y + 4:.1f}">limit {100.0 * (factor - 1.0):+.0f} %</text>'
        )
    if len(mean):
        parts.append(_fan(axes, last + ahead, mean, _Z90 * std))
        if chosen is not None:
            parts.append(_interval(axes, chosen, last))
    for t, value, bar in zip(series.time, relative, error, strict=True):
        x = axes.x(float(t))
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{axes.y(value - bar):.1f}" y2="{axes.y(value + bar):.1f}" '
            f'stroke="var(--point)" stroke-opacity=".4"/><circle cx="{x:.1f}" cy="{axes.y(value):.1f}" r="3.2" '
            'fill="var(--point)"/>'
        )
    label = escape(f"{series.name} relative to its reference over time")
    return f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


class _Axes:
    """Pixels of data, grid and tick labels."""

    def __init__(self, left: float, right: float, low: float, high: float) -> None:
        self.left, self.right, self.low, self.high = left, max(right, left + 1e-9), low, high

    def x(self, value: float) -> float:
        share = (value - self.left) / (self.right - self.left)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        share = (value - self.low) / (self.high - self.low)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)

    def frame(self, unit: str, start: object) -> str:
        """Grid and ticks; dates where they are known."""
        parts = []
        for value in _ticks(self.low, self.high, 5):
            y = self.y(value)
            parts.append(
                f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="var(--grid)"/>'
                f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{100.0 * (value - 1.0):+.0f} %</text>'
            )
        for value in _ticks(self.left, self.right, 6):
            text = f"{value:g}"
            if start is not None and unit == "days":
                text = f"{start + timedelta(days=value):%Y-%m-%d}"  # type: ignore[operator]  # a datetime
            parts.append(
                f'<text x="{self.x(value):.1f}" y="{_HEIGHT - _BOTTOM + 18}" text-anchor="middle">{text}</text>'
            )
        name = "" if start is not None and unit == "days" else escape(unit)
        parts.append(f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 4}" text-anchor="end">{name}</text>')
        return "".join(parts)


def _ticks(low: float, high: float, about: int) -> FloatArray:
    raw = max(high - low, 1e-12) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if power * m >= raw)
    count = np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1, dtype=np.float64)
    return count * step


def _fan(axes: _Axes, time: FloatArray, mean: FloatArray, half: FloatArray) -> str:
    upper = [f"{axes.x(t):.1f},{axes.y(m + h):.1f}" for t, m, h in zip(time, mean, half, strict=True)]
    lower = [f"{axes.x(t):.1f},{axes.y(m - h):.1f}" for t, m, h in zip(time, mean, half, strict=True)]
    line = " ".join(f"{axes.x(t):.1f},{axes.y(m):.1f}" for t, m in zip(time, mean, strict=True))
    plot = f'x="{_LEFT}" y="{_TOP}" width="{_WIDTH - _LEFT - _RIGHT}" height="{_HEIGHT - _TOP - _BOTTOM}"'
    return (
        f'<clipPath id="plot"><rect {plot}/></clipPath><g clip-path="url(#plot)">'
        f'<polygon points="{" ".join(upper + lower[::-1])}" fill="var(--fan)" fill-opacity=".18"/>'
        f'<polyline points="{line}" fill="none" stroke="var(--fan)" stroke-width="2"/></g>'
    )


def _interval(axes: _Axes, forecast: Forecast, last: float) -> str:
    """The interval of the time to the limit, drawn on the limit."""
    y, life = axes.y(forecast.factor), forecast.life
    begin, end = axes.x(last + life.low), axes.x(min(last + life.high, axes.right))
    parts = [
        f'<line x1="{begin:.1f}" x2="{end:.1f}" y1="{y:.1f}" y2="{y:.1f}" stroke="var(--fan)" stroke-width="5"/>'
    ]
    if last + life.median <= axes.right:
        parts.append(f'<circle cx="{axes.x(last + life.median):.1f}" cy="{y:.1f}" r="6" fill="var(--fan)"/>')
    return "".join(parts)
