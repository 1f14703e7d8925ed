"""The figures on trust as tables of text, for the benchmark's page and for docs/trust.md."""

from __future__ import annotations

from motor_classifiers.estimators.methods import ESTIMATE
from motor_classifiers.scoring.trust import Figures
from motor_classifiers.scoring.unknown_faults import DISTANCE

Table = tuple[list[str], list[list[str]]]
"""Names of the columns, and the rows."""


def percent(*shares: float, digits: int = 1) -> str:
    """Shares in per cent, with commas between; the unit where it is one."""
    text = ", ".join(f"{100.0 * share:.{digits}f}" for share in shares)
    return f"{text} %" if len(shares) == 1 else text


def trust_tables(figures: Figures) -> dict[str, Table]:
    """Tables by name; those of a section that is left out are left out, too."""
    parts = {"sets": _sets, "severity": _severity, "unknown": _unknown, "early": _early, "race": _race}
    made: dict[str, Table] = {}
    for name, tables in parts.items():
        if "reason" not in figures[name]:
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


def _severity(figures: Figures) -> dict[str, Table]:
    who = ("limit", "network")
    rows = [
        [
            one["kind"],
            *(f"{100.0 * one[each]['rmse']:.2f}" for each in who),
            *(percent(one[each]["coverage"]) for each in who),
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
    # The network may have been left out of the run.
    told = [
        by
        for by in titles
        if all(by in fault["auroc"] for one in figures["settings"] for fault in one["faults"])
    ]
    rows = [
        [
            f"{setting['sampling_rate_hz'] / 1e3:g} kHz",
            fault["fault"],
            *(f"{fault['auroc'][by]:.4f}" for by in told),
            percent(fault["called_other"]),
            percent(setting["false_alarms"], digits=2),
        ]
        for setting in figures["settings"]
        for fault in setting["faults"]
    ]
    return {"other": (["rate", "fault", *(titles[by] for by in told), "refused", "false alarms"], rows)}


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
