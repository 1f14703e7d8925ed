"""The part of the benchmark's page that tells how far to trust a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from motor_classifiers.estimators.methods import ESTIMATE
from motor_classifiers.report.charts import Line, line_chart, share_axis
from motor_classifiers.report.trust_tables import trust_tables
from motor_classifiers.scoring.score import Results
from motor_classifiers.scoring.trust import Figures
from motor_classifiers.scoring.unknown_faults import DISTANCE, FALSE_ALARM_RATES
from motor_env.pages.svg import Axis, percent

_STYLES = ("s1", "s8", "s2", "s4")
_TICKS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_RACE_STYLES = ("limit", "limit dashed", "s1", "s8", "s2")
_RACE_TICKS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)


def trust_section(result: Results) -> Figures | None:
    """Figures, charts and keys for the template; None where a setting has none."""
    if result.trust is None:
        return None
    return {**with_charts(result.trust, result.task.setting()), "tables": trust_tables(result.trust)}


def with_charts(figures: Figures, setting: Mapping[str, Any]) -> Figures:
    """Figures of a setting (`ClassTask.setting`), and for each section that is drawn its chart and keys."""
    drawn = dict(figures)
    for name, adds in (("unknown", _unknown), ("early", _early), ("race", _race)):
        if "reason" not in figures[name]:
            drawn[name] = {**figures[name], **adds(figures[name], setting)}
    return drawn


def _unknown(figures: Figures, _: Mapping[str, Any]) -> dict[str, Any]:
    """The curves of the last setting: at the lowest rate."""
    setting = figures["settings"][-1]
    rates = FALSE_ALARM_RATES.tolist()
    lines, keys = [], []
    for fault, style in zip(setting["faults"], _STYLES, strict=False):
        lines += [
            Line(f"{fault['fault']}, distance", style, rates, fault["roc"][DISTANCE]),
            Line(f"{fault['fault']}, confidence", f"{style} dashed", rates, fault["roc"]["limit"]),
        ]
        keys.append((style, fault["fault"]))
    axes = [Axis(f"{what} refused", 0.0, 1.0, _TICKS, percent) for what in ("known motors", "foreign faults")]
    return {
        "chart": line_chart(lines, *axes, named=False, marked=False),
        "legend": keys,
        "chart_rate_khz": setting["sampling_rate_hz"] / 1e3,
        "has_network": any(ESTIMATE in fault["auroc"] for s in figures["settings"] for fault in s["faults"]),
    }


def _early(figures: Figures, setting: Mapping[str, Any]) -> dict[str, Any]:
    time_ms = [1e3 * t for t in figures["time_s"]]
    styles = ("limit", "s1")
    lines = [
        Line(name, style, time_ms, y)
        for (name, y), style in zip(figures["accuracy"].items(), styles, strict=True)
    ]
    end = time_ms[-1]
    x_axis = Axis("ms since the step", 0.0, end, [end * share for share in _TICKS])
    y_axis = share_axis([value for line in lines for value in line.y])._replace(title="accuracy")
    return {
        "chart": line_chart(lines, x_axis, y_axis, named=False),
        "legend": [(line.style, line.label) for line in lines],
        "n_train": setting["n_train"],
    }


def _race(figures: Figures, setting: Mapping[str, Any]) -> dict[str, Any]:
    lines = []
    for (name, points), style in zip(figures["curves"].items(), _RACE_STYLES, strict=True):
        # A rule without an error on so many starts has no place on a logarithmic axis.
        seen = [point for point in points if point["wrong"] > 0.0]
        if seen:
            xs, ys = [1e3 * point["time_s"] for point in seen], [point["wrong"] for point in seen]
            lines.append(Line(name, style, xs, ys))
    end = 1e3 * setting["duration_s"]
    x_axis = Axis("mean ms to the verdict on faulty motors", 0.0, end, [end * share for share in _TICKS])
    y_axis = Axis("wrong verdicts", 0.0005, 0.6, _RACE_TICKS, percent, is_log=True)
    return {
        "chart": line_chart(lines, x_axis, y_axis, named=False),
        "legend": [(line.style, line.label) for line in lines],
    }
