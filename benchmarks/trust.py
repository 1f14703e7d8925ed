"""Figures, tables and charts of docs/trust.md: `python benchmarks/trust.py [PART...]`.

`sets` and `figures` are kept in benchmarks/results/trust.json, `shifts` and `powers` among the tables; `charts` draws
what is kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from cyclopts import run
from shifts import shift_scores, textbook_shifts, trained_power
from sklearn.base import BaseEstimator
from tables import keep_table
from trust_figures import network_for, set_figures, trust_figures
from trust_tables import Legend, curves_of_race, curves_of_unknown, percent

from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.scoring.judging import in_recipe_order, judge
from motor_classifiers.scoring.task import class_task
from motor_classifiers.wrappers.conformal import ConformalSets
from motor_classifiers.wrappers.outlier_detector import OutsideDetector
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.motor.parameters import FloatArray
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
    return METHODS[name].train(make_method(name, recipe, SEED), train.X, train.class_name)


def ordered(model: Any, X: Any, recipe: Recipe) -> FloatArray:
    """Probabilities in the recipe's order of classes."""
    return in_recipe_order(model, model.predict_proba(X), recipe)


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
        quick = {name: trained(name, recipe, 8000) for name in ("residual-qda", "physical-lda")}
        textbook = recipe.field is None
        first = (
            {"posterior network": network(recipe)}
            if textbook
            else {"network": trained("network", recipe, 8000)}
        )
        # The best of our quick methods stands for the limit where there is none in closed form.
        best = partial(trained, "physical-lda", count=5000)
        for name, model in (first | quick).items():
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
    """What the detector refuses under each shift, beside a test trained for it, and what it takes to be off."""
    for recipe, conditions in _moved():
        detector = OutsideDetector(recipe).fit()
        for name, changed in {"as in training": recipe, **conditions}.items():
            off = detector.likely_shift(cases(changed, TEST, n_cases).X)
            trained = trained_power(recipe, changed, SEED, np.arange(n_cases) + CALIBRATE)
            names, counts = np.unique(off[off != ""].astype(str), return_counts=True)
            most = sorted(zip(counts, names, strict=True), reverse=True)[:3]
            yield (
                recipe.name, name, percent((off != "").mean()),
                "" if changed is recipe else percent(trained),
                ", ".join(f"{what} {100.0 * count / counts.sum():.0f} %" for count, what in most),
            )  # fmt: skip


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
OF_POWERS = ("recipe", "conditions", "refused", "by a test trained for it", "said to be off")


def main(*part: Literal["sets", "figures", "shifts", "powers", "charts"], cases: int = 20_000) -> None:
    """Make the parts asked for; all by default. The largest tables rest on so many cases."""
    if "sets" in part or not part:
        keep_figures(with_sets=True)
    if "figures" in part or not part:
        keep_figures(with_sets=False)
    if "shifts" in part or not part:
        keep_table("trust", "shifts", OF_SHIFTS, shifts(cases // 10))
    if "powers" in part or not part:
        keep_table("trust", "powers", OF_POWERS, powers(cases))
    if "charts" in part or not part:
        for name, markup in kept_charts():
            (IMAGES / name).write_text(markup, encoding="utf-8")


if __name__ == "__main__":
    run(main)
