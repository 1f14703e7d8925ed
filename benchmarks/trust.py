"""Print the tables of docs/trust.md, and draw its charts: `python benchmarks/trust.py [SECTION...]`.

Sections: calibration, conformal, other, early, shifts; all by default, some twenty minutes on one idle core.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from shifts import shift_scores, textbook_shifts
from sklearn.base import BaseEstimator
from tables import print_table

from motor_classifiers.estimators.methods import METHODS, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.severity_density import severity_recipe
from motor_classifiers.scoring.calibration import calibration_scores, plot_reliability
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.trust import network_for
from motor_classifiers.scoring.unknown_faults import (
    DISTANCE,
    FALSE_ALARM_RATES,
    UNKNOWN_FAULTS,
    ForeignFault,
    foreign_scores,
)
from motor_classifiers.scoring.verdict_times import (
    FIXED_TIME,
    STOPPING_RULE,
    VerdictTime,
    accuracy_by_moment,
    moments,
    probabilities_by_moment,
    race,
    stopping_rows,
)
from motor_classifiers.wrappers.conformal import ConformalIntervals, ConformalSets, measured_coverage
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


def percent(*shares: float, digits: int = 1) -> str:
    """Shares in per cent, with commas between; the unit where it is one."""
    text = ", ".join(f"{100.0 * share:.{digits}f}" for share in shares)
    return f"{text} %" if len(shares) == 1 else text


def interval(value: float, low: float, high: float) -> str:
    """A share and its interval, in per cent."""
    return f"{100.0 * value:.2f} % ({100.0 * low:.2f} to {100.0 * high:.2f})"


Table = tuple[str, tuple[str, ...], Iterable[Iterable[str]]]
"""Title, names of the columns, rows."""


def calibration(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Calibration beside the limit's, and a reliability diagram of each setting."""
    for setting, recipe in SETTINGS.items():
        test = cases(recipe, TEST, n_cases)
        probabilities = {
            "limit": class_probabilities(recipe, test.X),
            "posterior network": ordered(network(recipe), test.X, recipe),
            "residual-qda, 2,000 starts": ordered(trained("residual-qda", recipe, 2000), test.X, recipe),
        }
        scores = {name: calibration_scores(p, test.class_index) for name, p in probabilities.items()}
        rate_khz = recipe.timing.sampling_rate_hz / 1e3
        plot_reliability(scores, IMAGES / f"reliability-{rate_khz:g}khz.svg")
        best = scores["limit"]
        for name, got in scores.items():
            yield (
                setting, name, f"{got.accuracy:.4f}", f"{got.ece:.4f}",
                f"{got.ece - best.ece:+.4f}", f"{got.brier:.4f}", f"{got.log_loss:.4f}",
                f"{100.0 * (got.log_loss / best.log_loss - 1.0):+.2f} %",
            )  # fmt: skip


def conformal_sets(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Coverage of sets, marginal and label-conditional."""
    for setting, recipe in SETTINGS.items():
        known, test = cases(recipe, CALIBRATE, n_cases), cases(recipe, TEST, n_cases)
        models = {"posterior network": network(recipe), "residual-qda": trained("residual-qda", recipe, 2000)}
        for name, model in models.items():
            held_out, new = ordered(model, known.X, recipe), ordered(model, test.X, recipe)
            for each in (False, True):
                sets = ConformalSets.calibrate(held_out, known.class_index, label_conditional=each).sets(new)
                got = measured_coverage(sets, test.class_index)
                yield (
                    setting, name, "in each class" if each else "overall",
                    percent(got.overall), percent(*got.by_class), f"{got.mean_size:.2f}", percent(got.empty),
                )  # fmt: skip


def conformal_intervals(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Coverage of 90 % intervals of severity, the network's own and conformal ones."""
    for setting, recipe in SETTINGS.items():
        drawn = severity_recipe(recipe)
        for fault_class in drawn.classes:
            kind = str(fault_class.kind)
            one = replace(drawn, classes=(fault_class,))
            known, test = cases(one, CALIBRATE, n_cases), cases(one, TEST, n_cases)
            before, own = (
                np.column_stack(network(recipe).predict_severity(part.X, kind)[2:]) for part in (known, test)
            )
            widened = ConformalIntervals.calibrate(before, known.severity).widen(own)
            shares = (
                ((low <= test.severity) & (test.severity <= high)).mean() for low, high in (own.T, widened.T)
            )
            widths = (np.diff(intervals).mean() for intervals in (own, widened))
            yield (
                setting, kind,
                *(percent(share) for share in shares), *(f"{100.0 * width:.2f}" for width in widths),
            )  # fmt: skip


FOREIGN = (
    *UNKNOWN_FAULTS,
    ForeignFault("resistance -15 %", resistance=0.85),
    ForeignFault("inertia -25 %", inertia=0.75),
    ForeignFault("supply +10 %", supply=1.1),
    ForeignFault("friction -40 %", friction=0.6),
)


def other(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Foreign faults told by distance and by confidence; the threshold is set on other motors."""
    for name, rate_hz in (("bench", 1_000.0), ("bench-full", 1_000.0), ("bench", 10_000.0)):
        recipe = bench(rate_hz, name=name)
        count = n_cases if (name, rate_hz) == ("bench", 1_000.0) else n_cases // 2
        confidences: dict[str, Callable[[Any], FloatArray]] = {"limit": partial(class_probabilities, recipe)}
        if name == "bench":
            confidences["network"] = network(recipe).predict_proba
        got = foreign_scores(
            recipe, confidences, FOREIGN, seed=SEED, first_case=TEST,
            n_threshold=count // 2, n_known=count, n_foreign=count // 4,
        )  # fmt: skip
        for fault in got["faults"]:
            areas = [fault["auroc"].get(by) for by in (DISTANCE, "limit", "network")]
            yield (
                name, f"{rate_hz / 1e3:g} kHz", fault["fault"],
                *("" if area is None else f"{area:.4f}" for area in areas),
                percent(fault["called_other"]), percent(got["false_alarms"], digits=2),
            )  # fmt: skip
        if (name, rate_hz) == ("bench", 1_000.0):
            plot_roc(got["faults"][: len(UNKNOWN_FAULTS)], "limit", IMAGES / "other-roc.svg")


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


def out_of_range(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
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


def early(n_cases: int = 3000) -> Iterator[Table]:
    """Accuracy by what was seen, the stopping rule, and the sequential rules on the same axis."""
    recipe = bench(10_000.0)
    seen = moments(recipe.timing)
    test, train = cases(recipe, TEST, n_cases), cases(recipe, TRAIN, 5_000)
    probabilities = probabilities_by_moment(recipe, SEED, train, test)
    accuracy = {name: accuracy_by_moment(told, test.class_index) for name, told in probabilities.items()}
    yield (
        "Accuracy by what was seen",
        ("seen", *accuracy),
        (
            (f"{1e3 * t:g} ms", *(f"{shares[n]:.4f}" for shares in accuracy.values()))
            for n, t in enumerate(seen.time_s)
        ),
    )
    yield (
        "Stopping rule",
        ("stated error", "probabilities of", "error of those that stopped", "stopped", "mean time", "accuracy of all"),
        (
            (
                percent(row["stated"], digits=0), row["probabilities_of"],
                interval(row["error"], row["error_low"], row["error_high"]),
                percent(row["stopped"]), f"{1e3 * row['mean_time_s']:.1f} ms", f"{row['accuracy']:.4f}",
            )
            for row in stopping_rows(probabilities, test.class_index, seen.time_s)
        ),
    )  # fmt: skip
    bearing = FaultClass(FaultKind.BEARING, 0.25)
    curves = race(recipe, bearing, seed=SEED, first_case=TEST, n_cases=n_cases, n_healthy=10_000)
    yield (
        "Bearing +25 % or none: mean time on faulty motors and share of wrong verdicts",
        ("method", "time: errors"),
        (
            (name, ", ".join(f"{1e3 * point.time_s:.0f} ms: {percent(point.wrong)}" for point in points))
            for name, points in curves.items()
        ),
    )
    plot_race(curves)


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


def shifts(n_cases: int = 2000) -> Iterable[Iterable[str]]:
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


SECTIONS: dict[str, Callable[[], Iterator[Table]]] = {
    "calibration": lambda: iter([(
        "Calibration",
        ("setting", "method", "accuracy", "ECE", "over limit's", "Brier", "log-loss", "over limit's"),
        calibration(),
    )]),
    "conformal": lambda: iter([(
        "Conformal sets, 90 %",
        ("setting", "method", "promised", "coverage", "by class", "mean size", "empty"),
        conformal_sets(),
    ), (
        "Intervals of severity, 90 %, width in points",
        ("setting", "kind", "network's coverage", "conformal", "network's width", "conformal"),
        conformal_intervals(),
    )]),
    "other": lambda: iter([(
        "Foreign faults",
        ("recipe", "rate", "fault", "AUROC of distance", "of the limit's confidence", "of the network's",
         "called other", "false alarms"),
        other(),
    ), (
        "Out of range",
        ("setting", "fault", "kind right", "out of range", "other", "severity"),
        out_of_range(),
    )]),
    "early": early,
    "shifts": lambda: iter([(
        "Shifts",
        ("recipe", "method", "conditions", "accuracy", "limit", "ECE", "coverage", "set size", "other"),
        shifts(),
    )]),
}  # fmt: skip


def main() -> None:
    """Print the sections asked for."""
    asked = sys.argv[1:] or list(SECTIONS)
    unknown = [name for name in asked if name not in SECTIONS]
    if unknown:
        sys.exit(f"section must be one of {', '.join(SECTIONS)}, got {unknown[0]!r}")
    for title, names, rows in chain.from_iterable(SECTIONS[name]() for name in asked):
        print_table(title, names, rows)


if __name__ == "__main__":
    main()
