"""Tables of docs/trust.md from benchmarks/results/trust.json, which `motor-classifiers benchmark` writes."""

from __future__ import annotations

from typing import Any

from tables import table

Figures = dict[str, Any]


def percent(*shares: float, digits: int = 1) -> str:
    """Shares in per cent, with commas between; the unit where it is one."""
    text = ", ".join(f"{100.0 * share:.{digits}f}" for share in shares)
    return f"{text} %" if len(shares) == 1 else text


def interval(value: float, low: float, high: float) -> str:
    """A share and its interval, in per cent."""
    return f"{100.0 * value:.2f} % ({100.0 * low:.2f} to {100.0 * high:.2f})"


def _sets(figures: Figures) -> str:
    rows = (
        [
            one["method"],
            percent(one["coverage"]),
            percent(*one["by_class"]),
            f"{one['mean_size']:.2f}",
            percent(one["empty"]),
        ]
        for one in figures["sets"]["methods"]
    )
    return table(["method", "coverage", "by class", "mean size", "empty"], rows)


def _severities(figures: Figures) -> str:
    rows = (
        [
            one["kind"],
            *(f"{100.0 * one[who]['rmse']:.2f}" for who in ("limit", "network")),
            *(percent(one[who]["coverage"]) for who in ("limit", "network")),
        ]
        for one in figures["severity"]["kinds"]
    )
    return table(
        [
            "kind",
            "RMSE of the posterior mean, points",
            "network",
            "coverage of its 90 % intervals",
            "network",
        ],
        rows,
    )


def _foreign(figures: Figures) -> str:
    rows = (
        [
            f"{setting['sampling_rate_hz'] / 1e3:g} kHz",
            fault["fault"],
            *(f"{fault['auroc'][by]:.4f}" for by in ("distance", "limit", "posterior-network")),
            percent(fault["called_other"]),
            percent(setting["false_alarms"], digits=2),
        ]
        for setting in figures["unknown"]["settings"]
        for fault in setting["faults"]
    )
    head = ["rate", "fault", "AUROC of distance", "of the limit's confidence", "of the network's"]
    return table([*head, "called other", "false alarms"], rows)


def _seen(figures: Figures) -> str:
    early = figures["early"]
    rows = zip(early["time_s"], *early["accuracy"].values(), strict=True)
    return table(
        ["seen", *early["accuracy"]],
        ([f"{1e3 * time_s:g} ms", *(f"{share:.4f}" for share in shares)] for time_s, *shares in rows),
    )


def _stopping(figures: Figures) -> str:
    rows = (
        [
            percent(row["stated"], digits=0),
            row["probabilities_of"],
            interval(row["error"], row["error_low"], row["error_high"]),
            percent(row["stopped"]),
            f"{1e3 * row['mean_time_s']:.1f} ms",
            f"{row['accuracy']:.4f}",
        ]
        for row in figures["early"]["stopping"]
    )
    head = ["stated error", "probabilities of", "error of those that stopped", "stopped", "mean time"]
    return table([*head, "accuracy of all"], rows)


def _race(figures: Figures) -> str:
    rows = (
        [name, ", ".join(f"{1e3 * point['time_s']:.0f} ms: {percent(point['wrong'])}" for point in points)]
        for name, points in figures["race"]["curves"].items()
    )
    return table(["method", "time: errors"], rows)


def trust_tables(figures: Figures) -> dict[str, str]:
    """Tables by the name of their place in the page."""
    return {
        "sets": _sets(figures),
        "severities": _severities(figures),
        "other": _foreign(figures),
        "seen": _seen(figures),
        "stopping": _stopping(figures),
        "race": _race(figures),
    }
