"""Figures, tables and charts of docs/trust-method.md: `python benchmarks/trust.py [PART...]`.

`sets` and `figures` are kept in benchmarks/results/trust.json, `shifts` and `powers` among the tables; `charts` draws
what is kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
from cyclopts import run
from sklearn.base import BaseEstimator
from tables import keep_table
from trust_figures import (
    DISTANCE,
    FALSE_ALARM_RATES,
    Figures,
    check,
    network_for,
    set_figures,
    shift_scores,
    textbook_shifts,
    trust_figures,
)

from motor_classifiers.estimators.methods import ESTIMATE, METHODS, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.report.page import Line, line_chart
from motor_classifiers.scoring.judging import judge
from motor_classifiers.scoring.task import class_task
from motor_classifiers.wrappers.conformal import ConformalSets
from motor_classifiers.wrappers.outlier_detector import OutsideDetector
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.common.pages import Axis, percent as per_cent
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import Timing

SEED = 0
TRAIN, CALIBRATE, TEST = 0, 500_000, 1_000_000  # first cases
IMAGES = Path(__file__).parents[1] / "docs" / "images"
KEPT = Path(__file__).parent / "results" / "trust.json"


def bench(rate_hz: float) -> Recipe:
    """The recipe `bench` at a rate."""
    return named_recipe("bench", timing=Timing(rate_hz, 0.1))


def cases(recipe: Recipe, first: int, count: int) -> Dataset:
    """Starts of the one seed of all tables; different first cases never meet."""
    return generate_arrays(recipe, SEED, np.arange(count) + first)


@cache
def network(recipe: Recipe) -> PosteriorNetwork:
    """The shipped network where the recipe is its own; else one trained on the recipe's stream."""
    return network_for(recipe, SEED)


@cache
def trained(name: str, recipe: Recipe, count: int) -> BaseEstimator:
    """A method of the benchmark, trained on so many starts."""
    train = cases(recipe, TRAIN, count)
    return make_method(name, recipe, SEED).fit(train.X, train.class_name)


def _moved() -> Iterable[tuple[Recipe, dict[str, Recipe]]]:
    """The recipes of the tables of shifts, and what they are moved to."""
    field = replace(named_recipe("field"), starts_per_motor=1, healthy_starts=0)
    alone = replace(field, timing=replace(field.timing, sampling_rate_hz=1_000.0))
    yield bench(1_000.0), textbook_shifts(bench(1_000.0))
    yield alone, {shift.name: alone.shifted(shift.name) for shift in alone.shifts}


def shifts(n_cases: int) -> Iterable[Iterable[str]]:
    """Models under other conditions than in training."""
    for recipe, conditions in _moved():
        known = cases(recipe, CALIBRATE, n_cases)
        detector = OutsideDetector(recipe).fit()
        textbook = recipe.field is None
        first = (
            {"posterior network": network(recipe)}
            if textbook
            else {"network": trained("network", recipe, 8000)}
        )
        # The best of our quick methods stands for the limit where there is none in closed form.
        best = partial(trained, "physical-lda", count=5000)
        for name, model in (first | {"physical-lda": trained("physical-lda", recipe, 8000)}).items():
            columns = np.searchsorted(model.classes_, known.class_name)
            sets = ConformalSets.calibrate(model.predict_proba(known.X), columns)
            scores = shift_scores(
                model,
                recipe,
                {"as in training": recipe, **conditions},
                sets=sets,
                detector=detector,
                reference=best,
                seed=SEED,
                cases=np.arange(n_cases) + TEST,
            )
            for got in scores:
                after = (got.answered_accuracy, got.answered_ece)
                yield (
                    recipe.name, name, got.name, f"{got.accuracy:.3f}", f"{got.limit:.3f}", f"{got.ece:.3f}",
                    percent(got.coverage), f"{got.set_size:.2f}",
                    *("" if got.refused == 1.0 else f"{value:.3f}" for value in after),
                )  # fmt: skip


def powers(n_cases: int) -> Iterable[Iterable[str]]:
    """What the detector refuses under each shift, and what it takes to be off."""
    for recipe, conditions in _moved():
        detector = OutsideDetector(recipe).fit()
        for name, changed in {"as in training": recipe, **conditions}.items():
            off = detector.what_is_off(cases(changed, TEST, n_cases).X)
            names, counts = np.unique(off[off != ""].astype(str), return_counts=True)
            most = sorted(zip(counts, names, strict=True), reverse=True)[:3]
            yield (
                recipe.name, name, percent((off != "").mean()),
                ", ".join(f"{what} {100.0 * count / counts.sum():.0f} %" for count, what in most),
            )  # fmt: skip


Table = tuple[list[str], list[list[str]]]
"""Names of the columns, and the rows."""


def percent(*shares: float, digits: int = 1) -> str:
    """Shares in per cent, with commas between; the unit where it is one."""
    text = ", ".join(f"{100.0 * share:.{digits}f}" for share in shares)
    return f"{text} %" if len(shares) == 1 else text


def trust_tables(figures: Figures) -> dict[str, Table]:
    """Tables by name."""
    parts = {"sets": _sets, "severity": _severity, "unknown": _unknown, "early": _early}
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
    return {"stopping": ([*head, "accuracy of all"], stopping)}


def _interval(value: float | None, low: float, high: float) -> str:
    """A share and its interval, in per cent; a dash where nothing was counted."""
    if value is None:
        return "–"
    return f"{100.0 * value:.2f} % ({100.0 * low:.2f} to {100.0 * high:.2f})"


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


STYLE = """svg { background: #fff; font: 12px system-ui, sans-serif; } text { fill: #1d2733; }
.tick { fill: #5d6b7a; font-size: 11px; } .grid { stroke: #e3e8ee; } .limit { --own: #c62828; } .s1 { --own: #0b6fa4; }
.s2 { --own: #12805c; } .s8 { --own: #c05a00; } polyline, .key { fill: none; stroke: var(--own); stroke-width: 1.8; }
circle { fill: var(--own); } .dashed polyline, .dashed .key { stroke-dasharray: 5 4; }"""


def stand_alone(chart: str, legend: Legend) -> str:
    """A chart of the benchmark's page as a file of its own, its keys below it."""
    height = 408 + 18 * len(legend)
    keys = "".join(
        f'<g class="{style}"><line class="key" x1="58" y1="{y}" x2="88" y2="{y}"/>'
        f'<text x="96" y="{y + 4}">{name}</text></g>'
        for y, (style, name) in zip(range(412, height, 18), legend, strict=True)
    )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 520 {height}"><style>{STYLE}</style>'
    return f"{head}{chart}{keys}</svg>\n".replace(
        '<svg viewBox="0 0 520 400"', '<svg width="520" height="400" viewBox="0 0 520 400"'
    )


def kept_charts() -> Iterable[tuple[str, str]]:
    """File name and markup of each chart of the kept figures."""
    kept = json.loads(KEPT.read_bytes())
    yield "other-roc.svg", stand_alone(*curves_of_unknown(kept["unknown"]))
    yield "early-verdicts.svg", stand_alone(*curves_of_race(kept["race"], kept["duration_s"]))


def keep_figures(*, with_sets: bool) -> None:
    """Measure the sets of all methods anew, or all other figures, and keep them."""
    task = class_task(bench(10_000.0))
    kept = json.loads(KEPT.read_bytes())
    if with_sets:
        answers = {name: judge(name, task) for name in METHODS}
        graded = {name: one.probabilities for name, one in answers.items() if one.is_graded}
        kept["sets"] = set_figures({"limit": task.best(task.test().X), **graded}, task.starts())
    else:
        kept |= task.setting() | trust_figures(task)
    KEPT.write_text(json.dumps(kept, indent=1, allow_nan=False) + "\n", encoding="utf-8")


OF_SHIFTS = (
    "recipe", "method", "conditions", "accuracy", "limit", "ECE", "coverage", "set size", "accuracy of the answered",
    "their ECE",
)  # fmt: skip
OF_POWERS = ("recipe", "conditions", "refused", "said to be off")


def main(*part: Literal["sets", "figures", "shifts", "powers", "charts"], cases: int = 20_000) -> None:
    """Make the parts asked for; all by default. The largest tables rest on so many cases."""
    check()
    if "sets" in part or not part:
        keep_figures(with_sets=True)
    if "figures" in part or not part:
        keep_figures(with_sets=False)
    if "shifts" in part or not part:
        keep_table("trust-method", "shifts", OF_SHIFTS, shifts(cases // 10))
    if "powers" in part or not part:
        keep_table("trust-method", "powers", OF_POWERS, powers(cases))
    if "charts" in part or not part:
        for name, markup in kept_charts():
            (IMAGES / name).write_text(markup, encoding="utf-8")


if __name__ == "__main__":
    run(main)
