"""Tables and charts of docs/trust.md that the benchmark does not make: `python benchmarks/trust.py [PART...]`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from cyclopts import run
from shifts import shift_scores, textbook_shifts
from sklearn.base import BaseEstimator
from tables import keep_table

from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.report.trust_tables import percent
from motor_classifiers.scoring.calibration import calibration_scores, plot_reliability
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.trust import network_for
from motor_classifiers.scoring.unknown_faults import DISTANCE, FALSE_ALARM_RATES
from motor_classifiers.scoring.verdict_times import FIXED_TIME, STOPPING_RULE, VerdictTime
from motor_classifiers.wrappers.conformal import ConformalSets
from motor_classifiers.wrappers.fault_family import family_fit
from motor_classifiers.wrappers.open_set import FaultFamilyDetector, OpenSetClassifier
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.inference.posterior import class_probabilities
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, SensorParameters
from motor_env.plotting import INK, QUIET, drawing, save, subplots
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.simulate import Timing

SEED = 0
TRAIN, CALIBRATE, TEST = 0, 500_000, 1_000_000  # first cases
IMAGES = Path(__file__).parents[1] / "docs" / "images"
KEPT = Path(__file__).parent / "results" / "trust.json"


def bench(rate_hz: float, name: str = "bench") -> Recipe:
    """A recipe at a rate."""
    return named_recipe(name, sensor=SensorParameters(current_noise_a=0.02), timing=Timing(rate_hz, 0.1))


SETTINGS = {f"{khz} kHz, 20 mA": bench(1e3 * khz) for khz in (10, 1)}


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


def draw_reliability(n_cases: int) -> None:
    """A reliability diagram of each setting."""
    for setting, recipe in SETTINGS.items():
        test = cases(recipe, TEST, n_cases)
        probabilities = {
            "limit": class_probabilities(recipe, test.X),
            "posterior network": ordered(network(recipe), test.X, recipe),
            "residual-qda, 2,000 starts": ordered(trained("residual-qda", recipe, 2000), test.X, recipe),
        }
        scores = {name: calibration_scores(p, test.class_index) for name, p in probabilities.items()}
        plot_reliability(scores, IMAGES / f"reliability-{setting.split()[0]}khz.svg")


def plot_roc(faults: list[dict[str, Any]], classifier: str, path: Path) -> None:
    """Draw how well foreign faults are told from known ones, by distance and by a classifier's confidence.

    Args:
        faults: of `foreign_scores`.
        classifier: name of the one whose confidence is drawn.
        path: file to write, SVG or PNG by its ending.
    """
    colours = ("#0b6fa4", "#d98300", "#c8442b", "#12805c", "#6b4fa0")
    with drawing():
        figure, (axes,) = subplots(1, width_in=7.5, height_in=7.0)
        axes.plot([0.0, 1.0], [0.0, 1.0], color=QUIET, linewidth=1.0)
        for n, (colour, scored) in enumerate(zip(colours, faults, strict=False)):
            for title, key, style in (("distance", DISTANCE, "-"), ("confidence", classifier, ":")):
                # Curves that lie on each other stay visible: the first are drawn wider.
                width = 2.0 + 2.0 * (len(faults) - 1 - n) * (style == "-")
                label = f"{scored['fault']}, {title}: {scored['auroc'][key]:.3f}"
                curve = scored["roc"][key]
                axes.plot(FALSE_ALARM_RATES, curve, style, color=colour, linewidth=width, label=label)
        axes.set(xlabel="known motors called other", ylabel="foreign faults called other")
        axes.set_title("Distance tells foreign faults, confidence does not")
        axes.set_ylim(0.0, 1.01)
        figure.legend(loc="outside lower center", ncols=2, fontsize=10, title="area under the curve")
        save(figure, path)


def out_of_range(n_cases: int) -> Iterable[Iterable[str]]:
    """Severities beyond the trained ones, through the wrapper around the discriminant analysis."""
    for setting, recipe in SETTINGS.items():
        count = n_cases // 8
        train = cases(recipe, TRAIN, count)
        method = make_method("residual-qda", recipe, SEED)
        model = OpenSetClassifier(method, recipe).fit(train.X, train.class_name)
        for kind, severity in (
            (FaultKind.BEARING, 0.25),
            (FaultKind.BEARING, 0.40),
            (FaultKind.BEARING, 0.60),
            (FaultKind.WINDING_CONTACT, 0.25),
            (FaultKind.WINDING_CONTACT, 0.40),
        ):
            changed = replace(recipe, classes=(FaultClass(kind, severity),))
            X = cases(changed, TEST, count // 2).X
            said = model.verdicts(X)
            is_kind = np.char.startswith(said.label.astype(str), str(kind))
            nearest = family_fit(recipe, X).severity
            yield (
                setting, f"{kind} +{100.0 * severity:g} %",
                *(percent(told.mean()) for told in (is_kind, said.out_of_range, said.is_other)),
                f"{100.0 * nearest.mean():.1f} ± {100.0 * nearest.std():.1f}",
            )  # fmt: skip


def plot_race(curves: Mapping[str, tuple[VerdictTime, ...]]) -> None:
    """Draw errors against the time of the verdict."""
    styles = {
        STOPPING_RULE: (INK, "-", "o"),
        FIXED_TIME: ("#7b8794", "--", ""),
        "SPRT": ("#0b6fa4", "-", "s"),
        "CUSUM": ("#d98300", "-", "^"),
        "GLR": ("#c8442b", "-", "v"),
    }
    with drawing():
        figure, (axes,) = subplots(1, width_in=8.0, height_in=5.0)
        for name, points in curves.items():
            colour, line, marker = styles[name]
            time_s, wrong = np.array(points).T
            axes.plot(1e3 * time_s, 100.0 * wrong, line, color=colour, marker=marker, label=name)
        axes.set_yscale("log")
        ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50)
        axes.set_yticks(ticks, [f"{tick:g} %" for tick in ticks])
        axes.set(
            xlabel="mean time to the verdict on faulty motors, ms",
            ylabel="wrong verdicts, healthy and faulty",
        )
        axes.set_title("Bearing +25 % or none, 10 kHz, 20 mA: how soon, how sure")
        axes.minorticks_off()
        axes.legend()
        save(figure, IMAGES / "early-verdicts.svg")


def shifts(n_cases: int) -> Iterable[Iterable[str]]:
    """Models under other conditions than in training."""
    field = replace(named_recipe("field"), starts_per_motor=1, healthy_starts=0)
    alone = replace(field, timing=replace(field.timing, sampling_rate_hz=1_000.0))
    for recipe, conditions in (
        (bench(1_000.0), textbook_shifts(bench(1_000.0))),
        (alone, {shift.name: alone.shifted(shift.name) for shift in alone.shifts}),
    ):
        known = cases(recipe, CALIBRATE, n_cases)
        detector = FaultFamilyDetector(recipe).fit(known.X)
        first = (
            {"network": trained("network", recipe, 8000)}
            if recipe is alone
            else {"posterior network": network(recipe)}
        )
        others = {name: trained(name, recipe, 8000) for name in ("residual-qda", "physical-lda")}
        for name, model in (first | others).items():
            columns = np.searchsorted(model.classes_, known.class_name)
            sets = ConformalSets.calibrate(model.predict_proba(known.X), columns)
            scores = shift_scores(
                model,
                recipe,
                {"as in training": recipe, **conditions},
                sets=sets,
                detector=detector if name in first else None,
                # The best of our quick methods stands for the limit where there is none in closed form.
                reference=lambda changed: trained("physical-lda", changed, 5000),
                seed=SEED,
                cases=np.arange(n_cases) + TEST,
            )
            for got in scores:
                yield (
                    recipe.name, name, got.name, f"{got.accuracy:.3f}", f"{got.limit:.3f}", f"{got.ece:.3f}",
                    percent(got.coverage), f"{got.set_size:.2f}",
                    "" if np.isnan(got.other) else percent(got.other),
                )  # fmt: skip


def draw_kept() -> None:
    """Charts of the figures that the benchmark has kept."""
    figures = json.loads(KEPT.read_bytes())
    plot_roc(figures["unknown"]["settings"][-1]["faults"], "limit", IMAGES / "other-roc.svg")
    curves = figures["race"]["curves"].items()
    plot_race({name: tuple(VerdictTime(**point) for point in points) for name, points in curves})


OF_RANGE = ("setting", "fault", "kind right", "out of range", "other", "severity")
OF_SHIFTS = ("recipe", "method", "conditions", "accuracy", "limit", "ECE", "coverage", "set size", "other")


def main(*part: Literal["range", "shifts", "reliability", "kept"], cases: int = 20_000) -> None:
    """Make the parts asked for; all by default. The largest tables rest on so many cases."""
    if "range" in part or not part:
        keep_table("trust", "range", OF_RANGE, out_of_range(cases))
    if "shifts" in part or not part:
        keep_table("trust", "shifts", OF_SHIFTS, shifts(cases // 10))
    if "reliability" in part or not part:
        draw_reliability(cases)
    if "kept" in part or not part:
        draw_kept()


if __name__ == "__main__":
    run(main)
