"""Tables of README.md and docs from benchmarks/results: `python benchmarks/result_tables.py` writes them.

A test compares the pages with the files, so no figure in these tables is written by hand.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd
import reference_scores
import residual_worth
import run as speed
from tables import KEPT, kept_tables, marked, table
from trust import trust_tables

FOLDER = Path(__file__).resolve().parent
DIGESTS = FOLDER.parent / "classifiers" / "motor_classifiers" / "scoring" / "motor_bench.json"
README, DOCS = FOLDER.parent / "README.md", FOLDER.parent / "docs"
Row = dict[str, Any]

_IN_README = {
    "Bayes limit": "*the best possible: Bayes-optimal posterior*",
    "rules": "statistics of the decision rules and matched tests, logistic regression",
    "physical-logistic": "fitted motor parameters and residual, logistic regression",
    "raw-logistic": "raw waveform in 20 principal components, logistic regression",
    "posterior-network": "amortised posterior: torch network on the recipe's endless stream",
    "residual-qda": "filter residual along the signal's directions, quadratic discriminant",
    "quant": "QUANT (aeon 1.6)",
    "threshold": "Kalman filter, thresholds, M of N, bank of fault filters",
    "minirocket": "MiniRocket (aeon 1.6)",
}
_SWEPT = (
    "posterior-network",
    "physical-logistic",
    "rules",
    "residual-network",
    "threshold",
)
_LIMIT = ("Bayes limit", "Bayes estimate")
_SETTING = ["recipe", "sampling_rate_hz", "noise_a", "n_train"]


def _points(share: float, digits: int = 2) -> str:
    text = f"{100.0 * share:.{digits}f}"
    return text.replace("-", "−") if float(text) else f"{0.0:.{digits}f}"


def _quantity(value: float | None) -> str:
    if value is None:
        return ""
    return "< 1" if value < 1.0 else f"{value:.0f}" if value >= 20.0 else f"{value:.1f}"


def _ranked() -> list[Row]:
    """Rows of the default setting: the limit, then the most accurate first."""
    rows: list[Row] = json.loads((FOLDER / "results" / "classifiers.json").read_bytes())
    return sorted(rows, key=lambda row: (row["family"] != "limit", -row["accuracy"]))


def readme_table() -> str:
    """The README's table."""
    by_name = {row["method"]: row for row in _ranked()}
    rows = []
    for name in [name for name in by_name if name in _IN_README]:
        row = by_name[name]
        low, high = row["accuracy_low"], row["accuracy_high"]
        accuracy = f"{_points(row['accuracy'], 1)} % ({_points(low, 1)} to {_points(high, 1)})"
        cost = _quantity(row["microseconds_per_transient"])
        if name in _LIMIT:
            rows.append([_IN_README[name], f"*{accuracy}*", "", f"*{cost}*"])
        else:
            rows.append([_IN_README[name], accuracy, _points(row["below_bayes"]), cost])
    return table(
        ["method", "accuracy (95 % interval)", "behind the best possible, in points", "µs a start"], rows
    )


def default_table() -> str:
    """All methods in the default setting."""
    rows = []
    for row in _ranked():
        is_limit = row["method"] in _LIMIT
        below = [_points(row[f"below_bayes{end}"]) for end in ("", "_low", "_high")] if not is_limit else []
        graded = row["log_loss"] is not None
        rows.append(
            [
                row["method"],
                f"{row['accuracy']:.4f} ({row['accuracy_low']:.3f} to {row['accuracy_high']:.3f})",
                "{} ({} to {})".format(*below) if below else "",
                _points(row["bearing"], 1),
                *(f"{row[name]:.3f}" if graded else "" for name in ("log_loss", "ece")),
                _quantity(row["microseconds_per_transient"]),
                ""
                if is_limit
                else f"{row['train_s']:.1f}"
                if row["train_s"] < 20.0
                else f"{row['train_s']:.0f}",
            ]
        )
    head = "method, accuracy, below the limit, bearing, log-loss, ECE, µs a start, training s"
    return table(head.split(", "), rows)


def _sweep(wanted: str) -> Iterable[tuple[Any, Any]]:
    """Settings wanted, the highest rate of a recipe first, each with the accuracy of every method and the `limit`."""
    rows = pd.read_csv(FOLDER / "results" / "full.csv").replace({"method": dict.fromkeys(_LIMIT, "limit")})
    rows["recipe"] = pd.Categorical(rows["recipe"], ["bench", "bench-full", "paper", "field"])
    settings = rows.pivot(index=_SETTING, columns="method", values="accuracy")
    return settings.sort_index(ascending=[True, False, True, True]).query(wanted).iterrows()


def noise_table() -> str:
    """Accuracy after 2,000 training starts by recipe, rate and noise."""
    rows = [
        [
            recipe,
            f"{rate / 1e3:g} kHz",
            f"{1e3 * noise:g} mA",
            f"{'about ' * (recipe == 'field')}{one['limit']:.3f}",
            *(f"{one[name]:.3f}" for name in _SWEPT),
        ]
        for (recipe, rate, noise, _), one in _sweep("n_train == 2000")
    ]
    return table(["recipe", "rate", "noise", "limit", *_SWEPT], rows)


def field_table(name: str = "field") -> str:
    """The best possible accuracy on `field` or on `operation`."""
    got: Row = json.loads((FOLDER / "results" / f"{name}_limit.json").read_bytes())
    learned = f", learned from {got['learned']}" if got.get("learned") else ""
    control = got["control"] if learned else "posterior network"
    first, second = got["expected_accuracy_of_runs"]
    rows = {
        "the best possible accuracy, between": " and ".join(_points(end) for end in got["bracket"]),
        f"mean largest probability, {got['n_starts']} starts": _points(got["expected_accuracy"]),
        "right decisions on them": _points(got["right"]),
        f"mean largest probability, the first {got['n_twice']}, two runs": f"{_points(first)}, {_points(second)}",
        "the same decision in both runs": _points(got["same_decision"]),
        f"{control}{learned}, {got['n_of_network']} other starts": _points(got["network_accuracy"])
        + f" ± {_points(got['network_accuracy_error'])}",
        f"{'it' if learned else 'the network'} is behind, between": " and ".join(
            f"{_points(behind)} ± {_points(error)}"
            for behind, error in zip(got["network_behind"], got["network_behind_error"], strict=True)
        ),
    }
    return table(["figure", "%, or points; ± one standard error"], rows.items())


def id_digests() -> str:
    """Digest of what is kept of each environment."""
    kept = json.loads((FOLDER.parent / "tests" / "motor_env" / "envs" / "env_streams.json").read_bytes())
    rows = ([f"`{name}`", f"`{one[:16]}`"] for name, one in kept.items() if name.startswith("motor_env/"))
    return table(["id", "digest"], rows)


def task_digests() -> str:
    """Digests of the frozen tasks of motor-bench."""
    whole = json.loads(DIGESTS.read_bytes())["whole"]
    rows = (
        [f"`{name}`", *(f"`{one[part][:16]}`" for part in ("train", "test"))] for name, one in whole.items()
    )
    return table(["task", "training starts", "test cases"], rows)


def speed_tables() -> dict[str, str]:
    """Rates beside the peers', and the time that classifiers take."""
    parts = {name: speed.page_table(name) for name in speed.discover()}
    rows = [
        [_IN_README[row["method"]], _quantity(row["microseconds_per_transient"]), f"{row['train_s']:.1f}"]
        for row in sorted(_ranked(), key=lambda row: float(row["microseconds_per_transient"]))
        if row["method"] in _IN_README and row["method"] not in _LIMIT
    ]
    return parts | {"classifiers": table(["method", "µs a start", "training s"], rows)}


def pages() -> dict[Path, str]:
    """The pages with their tables made anew."""
    parts = {
        README: {
            "results": readme_table(),
            "speed": speed.page_table("envs", "MonitorInstant-v0, vector of 4096"),
        },
        DOCS / "benchmark.md": {
            "default": default_table(),
            "noise": noise_table(),
        },
    }
    for path in sorted(KEPT.glob("*.json")):
        tables = kept_tables(path.stem)
        page = DOCS / "results" / f"{path.stem}.md"
        parts[page if page.is_file() else DOCS / page.name] = {
            name: table(one["header"], one["rows"]) for name, one in tables.items()
        }
    trust = json.loads((FOLDER / "results" / "trust.json").read_bytes())
    parts.setdefault(DOCS / "trust-method.md", {}).update(
        {name: table(*made) for name, made in trust_tables(trust).items()}
    )
    parts.setdefault(DOCS / "best-possible.md", {}).update(
        {"field": field_table(), "operation": field_table("operation")}
    )
    parts[DOCS / "reference-scores.md"] = {"reference": reference_scores.table()}
    parts[DOCS / "results" / "residual.md"] = {"residual": residual_worth.table()}
    parts[DOCS / "results" / "speed.md"] = speed_tables()
    parts[DOCS / "citing.md"] = {"ids": id_digests(), "tasks": task_digests()}
    return {path: marked(path.read_text(encoding="utf-8"), tables) for path, tables in parts.items()}


if __name__ == "__main__":
    for page, text in pages().items():
        page.write_text(text, encoding="utf-8")
