"""The figures on trust as tables and charts for docs/trust.md."""

from __future__ import annotations

import numpy as np
from trust_figures import DISTANCE, FALSE_ALARM_RATES, Figures

from motor_classifiers.estimators.methods import ESTIMATE
from motor_classifiers.report.page import Line, line_chart
from motor_env.common.pages import Axis, percent as per_cent

Table = tuple[list[str], list[list[str]]]
"""Names of the columns, and the rows."""


def percent(*shares: float, digits: int = 1) -> str:
    """Shares in per cent, with commas between; the unit where it is one."""
    text = ", ".join(f"{100.0 * share:.{digits}f}" for share in shares)
    return f"{text} %" if len(shares) == 1 else text


def trust_tables(figures: Figures) -> dict[str, Table]:
    """Tables by name."""
    parts = {"sets": _sets, "severity": _severity, "unknown": _unknown, "early": _early, "race": _race}
    made: dict[str, Table] = {}
    for name, tables in parts.items():
        made |= tables(figures[name])
    return made


def _sets(figures: Figures) -> dict[str, Table]:
    rows = [
        [
            one["method"],
            percent(one["coverage"]),
            percent(*one["by_class"]),
            f"{one['mean_size']:.2f}",
            percent(one["empty"]),
        ]
        for one in figures["methods"]
    ]
    return {"sets": (["method", "coverage", "by class", "mean size", "empty"], rows)}


def _with_error(share: float, n_cases: int) -> str:
    """A share of so many cases and its standard error, in per cent."""
    return f"{100.0 * share:.1f} ± {100.0 * np.sqrt(share * (1.0 - share) / n_cases):.1f} %"


def _severity(figures: Figures) -> dict[str, Table]:
    who = ("limit", "network")
    rows = [
        [
            one["kind"],
            *(f"{100.0 * one[each]['rmse']:.2f}" for each in who),
            *(_with_error(one[each]["coverage"], figures["n_cases"]) for each in who),
        ]
        for one in figures["kinds"]
    ]
    head = ["RMSE of the posterior mean, points", "network", "coverage of its 90 % intervals", "network"]
    return {"severities": (["kind", *head], rows)}


def _unknown(figures: Figures) -> dict[str, Table]:
    titles = {
        DISTANCE: "AUROC of distance",
        "limit": "of the limit's confidence",
        ESTIMATE: "of the network's",
    }
    rows = [
        [
            f"{setting['sampling_rate_hz'] / 1e3:g} kHz",
            fault["fault"],
            *(f"{fault['auroc'][by]:.4f}" for by in titles),
            percent(fault["called_other"]),
            percent(setting["false_alarms"], digits=2),
        ]
        for setting in figures["settings"]
        for fault in setting["faults"]
    ]
    return {"other": (["rate", "fault", *titles.values(), "refused", "false alarms"], rows)}


def _early(figures: Figures) -> dict[str, Table]:
    seen = [
        [f"{1e3 * time_s:g} ms", *(f"{share:.4f}" for share in shares)]
        for time_s, *shares in zip(figures["time_s"], *figures["accuracy"].values(), strict=True)
    ]
    stopping = [
        [
            percent(row["stated"], digits=0),
            row["probabilities_of"],
            _interval(row["error"], row["error_low"], row["error_high"]),
            percent(row["stopped"]),
            f"{1e3 * row['mean_time_s']:.1f} ms",
            f"{row['accuracy']:.4f}",
        ]
        for row in figures["stopping"]
    ]
    head = ["stated error", "probabilities of", "error of those that stopped", "stopped", "mean time"]
    return {
        "seen": (["seen", *figures["accuracy"]], seen),
        "stopping": ([*head, "accuracy of all"], stopping),
    }


def _interval(value: float | None, low: float, high: float) -> str:
    """A share and its interval, in per cent; a dash where nothing was counted."""
    if value is None:
        return "–"
    return f"{100.0 * value:.2f} % ({100.0 * low:.2f} to {100.0 * high:.2f})"


def _race(figures: Figures) -> dict[str, Table]:
    rows = [
        [name, ", ".join(f"{1e3 * point['time_s']:.0f} ms: {percent(point['wrong'])}" for point in points)]
        for name, points in figures["curves"].items()
    ]
    return {"race": (["method", "time: errors"], rows)}


_STYLES = ("s1", "s8", "s2", "s4")
_TICKS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
_RACE_STYLES = ("limit", "limit dashed", "s1", "s8", "s2")
_RACE_TICKS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
Legend = list[tuple[str, str]]
"""Style and name of each line."""


def curves_of_unknown(figures: Figures) -> tuple[str, Legend]:
    """Chart of the faults found against false alarms, of the last setting: at the lowest rate."""
    rates = FALSE_ALARM_RATES.tolist()
    lines, solid = [], []
    for fault, style in zip(figures["settings"][-1]["faults"], _STYLES, strict=False):
        lines += [
            Line(f"{fault['fault']}, distance", style, rates, fault["roc"][DISTANCE]),
            Line(f"{fault['fault']}, confidence", f"{style} dashed", rates, fault["roc"]["limit"]),
        ]
        solid.append((style, fault["fault"]))
    axes = [
        Axis(f"{what} refused", 0.0, 1.0, _TICKS, per_cent) for what in ("known motors", "foreign faults")
    ]
    keys = [(style, f"{name}, distance") for style, name in solid]
    keys += [(f"{style} dashed", f"{name}, the limit's confidence") for style, name in solid]
    return line_chart(lines, *axes, named=False, marked=False), keys


def curves_of_race(figures: Figures, duration_s: float) -> tuple[str, Legend]:
    """Chart of wrong verdicts against the time of the verdict."""
    lines = []
    for (name, points), style in zip(figures["curves"].items(), _RACE_STYLES, strict=True):
        # A rule without an error on so many starts has no place on a logarithmic axis.
        seen = [point for point in points if point["wrong"] > 0.0]
        if seen:
            xs, ys = [1e3 * point["time_s"] for point in seen], [point["wrong"] for point in seen]
            lines.append(Line(name, style, xs, ys))
    end = 1e3 * duration_s
    x_axis = Axis("mean ms to the verdict on faulty motors", 0.0, end, [end * share for share in _TICKS])
    y_axis = Axis("wrong verdicts", 0.0005, 0.6, _RACE_TICKS, per_cent, is_log=True)
    return line_chart(lines, x_axis, y_axis, named=False), [(line.style, line.label) for line in lines]
