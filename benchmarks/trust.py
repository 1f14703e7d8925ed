"""Print the tables of docs/trust.md, and draw its charts: `python benchmarks/trust.py [SECTION...]`.

Sections: calibration, conformal, other, early, references, shifts; all by default, some half an hour on one idle core.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from motor_classifiers.calibration import calibration_scores, plot_reliability
from motor_classifiers.conformal import ConformalIntervals, ConformalSets, measured_coverage
from motor_classifiers.early import EarlyClassifier, limit_by_samples, stop_when_sure, stopping_score
from motor_classifiers.features import PhysicalFeatures, ResidualProjection
from motor_classifiers.networks import NetworkClassifier
from motor_classifiers.novelty import FaultFamilyDetector, OpenSetClassifier, family_fit
from motor_classifiers.posterior_network import PosteriorNetwork, severity_recipe
from motor_classifiers.reference import ReferencedProjection, referenced_probabilities, referenced_starts
from motor_classifiers.trust import (
    UNKNOWN_FAULTS,
    ForeignFault,
    foreign_starts,
    plot_roc,
    shift_scores,
    textbook_shifts,
)
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.faults import FaultKind
from motor_env.parameters import FloatArray, SensorParameters
from motor_env.posterior import class_probabilities
from motor_env.recipes import FaultClass, Recipe, named_recipe
from motor_env.rules import Cusum, Glr, Rule, Sprt
from motor_env.rules.tolerant import TolerantFilter
from motor_env.simulation import Timing

SEED = 0
TRAIN, CALIBRATE, TEST = 0, 500_000, 1_000_000  # first cases
IMAGES = Path(__file__).parents[1] / "docs" / "images"
SETTINGS = ((10_000.0, 0.02), (1_000.0, 0.02))


def bench(rate_hz: float, noise_a: float = 0.02, name: str = "bench") -> Recipe:
    """A recipe at a rate and a noise."""
    return named_recipe(name, sensor=SensorParameters(current_noise_a=noise_a), timing=Timing(rate_hz, 0.1))


def cases(recipe: Recipe, first: int, count: int) -> Dataset:
    """Starts of the one seed of all tables; different first cases never meet."""
    return generate_arrays(recipe, SEED, np.arange(count) + first)


def qda(recipe: Recipe) -> Pipeline:
    """Quadratic discriminant analysis of the residual's components."""
    # The components of starts in the field are nearly collinear.
    model = QuadraticDiscriminantAnalysis(reg_param=0.0 if recipe.field is None else 1e-3)
    return make_pipeline(ResidualProjection(recipe, 6), StandardScaler(), model)


def lda(recipe: Recipe) -> Pipeline:
    """Linear discriminant analysis of fitted parameters."""
    return make_pipeline(PhysicalFeatures(recipe), StandardScaler(), LinearDiscriminantAnalysis())


@cache
def network(recipe: Recipe) -> PosteriorNetwork:
    """The posterior network, trained on the recipe's stream."""
    return PosteriorNetwork(recipe, random_state=SEED).fit_stream()


@cache
def reference(recipe: Recipe) -> BaseEstimator:
    """Stands in for the limit where there is none in closed form: the best of our quick methods there."""
    train = cases(recipe, TRAIN, 5000)
    fitted: BaseEstimator = lda(recipe).fit(train.X, train.class_name)
    return fitted


def trained_qda(recipe: Recipe, count: int = 2000) -> BaseEstimator:
    """The discriminant analysis, trained on so many starts."""
    train = cases(recipe, TRAIN, count)
    fitted: BaseEstimator = qda(recipe).fit(train.X, train.class_name)
    return fitted


def ordered(model: Any, X: Any, recipe: Recipe) -> FloatArray:
    """Probabilities in the recipe's order of classes."""
    columns = [list(model.classes_).index(name) for name in recipe.class_names]
    probabilities: FloatArray = np.asarray(model.predict_proba(X), dtype=np.float64)[:, columns]
    return probabilities


def table(title: str, header: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Print one table, row by row as it comes."""
    names = list(header)
    print(f"\n## {title}\n\n| {' | '.join(names)} |\n|{'---|' * len(names)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def setting(rate_hz: float, noise_a: float) -> str:
    """In words."""
    return f"{rate_hz / 1e3:g} kHz, {1e3 * noise_a:g} mA"


def calibration(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Calibration beside the limit's, and the reliability diagram of the last setting."""
    for rate_hz, noise_a in SETTINGS:
        recipe = bench(rate_hz, noise_a)
        test = cases(recipe, TEST, n_cases)
        probabilities = {
            "limit": class_probabilities(recipe, test.X),
            "posterior network": ordered(network(recipe), test.X, recipe),
            "residual-qda, 2,000 starts": ordered(trained_qda(recipe), test.X, recipe),
        }
        scores = {name: calibration_scores(p, test.class_index) for name, p in probabilities.items()}
        plot_reliability(scores, IMAGES / f"reliability-{rate_hz / 1e3:g}khz.svg")
        best = scores["limit"]
        for name, got in scores.items():
            yield (
                setting(rate_hz, noise_a), name, f"{got.accuracy:.4f}", f"{got.ece:.4f}",
                f"{got.ece - best.ece:+.4f}", f"{got.brier:.4f}", f"{got.log_loss:.4f}",
                f"{100.0 * (got.log_loss / best.log_loss - 1.0):+.2f} %",
            )  # fmt: skip


def conformal_sets(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Coverage of sets, marginal and label-conditional."""
    for rate_hz, noise_a in SETTINGS:
        recipe = bench(rate_hz, noise_a)
        known, test = cases(recipe, CALIBRATE, n_cases), cases(recipe, TEST, n_cases)
        models = {"posterior network": network(recipe), "residual-qda": trained_qda(recipe)}
        for name, model in models.items():
            held_out, new = ordered(model, known.X, recipe), ordered(model, test.X, recipe)
            for each in (False, True):
                sets = ConformalSets.calibrate(held_out, known.class_index, label_conditional=each).sets(new)
                got = measured_coverage(sets, test.class_index)
                yield (
                    setting(rate_hz, noise_a), name, "in each class" if each else "overall",
                    f"{100.0 * got.overall:.1f} %",
                    ", ".join(f"{100.0 * share:.1f}" for share in got.by_class),
                    f"{got.mean_size:.2f}", f"{100.0 * got.empty:.1f} %",
                )  # fmt: skip


def conformal_intervals(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Coverage of 90 % intervals of severity, the network's own and conformal ones."""
    for rate_hz, noise_a in SETTINGS:
        recipe = bench(rate_hz, noise_a)
        drawn = severity_recipe(recipe)
        for row, fault_class in enumerate(drawn.classes):
            kind = str(fault_class.kind)
            one = replace(drawn, classes=(drawn.classes[row],))
            known, test = cases(one, CALIBRATE, n_cases), cases(one, TEST, n_cases)
            before, own = (network(recipe).predict_severity(part.X, kind) for part in (known, test))
            conformal = ConformalIntervals.calibrate(
                np.column_stack([before.low, before.high]), known.severity
            )
            intervals = np.column_stack([own.low, own.high])
            shares, widths = [], []
            for low, high in (intervals.T, conformal.widen(intervals).T):
                shares.append(((low <= test.severity) & (test.severity <= high)).mean())
                widths.append((high - low).mean())
            yield (
                setting(rate_hz, noise_a), kind, f"{100.0 * shares[0]:.1f} %", f"{100.0 * shares[1]:.1f} %",
                f"{100.0 * widths[0]:.2f}", f"{100.0 * widths[1]:.2f}",
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
        count = n_cases if (name, rate_hz) == ("bench", 1_000.0) else n_cases // 8
        known = cases(recipe, TEST, count)
        detector = FaultFamilyDetector(recipe).fit(cases(recipe, TRAIN, count // 2).X)
        scores = detector.score_samples(known.X)
        alarms = (scores < detector.offset_).mean()
        confidence = class_probabilities(recipe, known.X).max(axis=1)
        curves = {}
        for fault in FOREIGN:
            X = foreign_starts(recipe, fault, SEED, np.arange(count // 4) + TEST)
            foreign, trust = detector.score_samples(X), class_probabilities(recipe, X).max(axis=1)
            truth = np.repeat([0, 1], [len(scores), len(foreign)])
            if fault in UNKNOWN_FAULTS:
                curves[fault.name] = (foreign, trust)
            areas = (
                roc_auc_score(truth, -np.concatenate(pair))
                for pair in ((scores, foreign), (confidence, trust))
            )
            found = (foreign < detector.offset_).mean()
            yield (
                name, f"{rate_hz / 1e3:g} kHz", fault.name, *(f"{area:.4f}" for area in areas),
                f"{100.0 * found:.1f} %", f"{100.0 * alarms:.2f} %",
            )  # fmt: skip
        if (name, rate_hz) == ("bench", 1_000.0):
            plot_roc(curves, scores, confidence, IMAGES / "other-roc.svg")


def out_of_range(n_cases: int = 20_000) -> Iterable[Iterable[str]]:
    """Severities beyond the trained ones, through the wrapper around the discriminant analysis."""
    for rate_hz, noise_a in SETTINGS:
        recipe = bench(rate_hz, noise_a)
        count = n_cases // 8
        train = cases(recipe, TRAIN, count)
        model = OpenSetClassifier(qda(recipe), recipe).fit(train.X, train.class_name)
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
                setting(rate_hz, noise_a), f"{kind} +{100.0 * severity:g} %",
                f"{100.0 * is_kind.mean():.1f} %", f"{100.0 * said.out_of_range.mean():.1f} %",
                f"{100.0 * said.is_other.mean():.1f} %",
                f"{100.0 * nearest.mean():.1f} ± {100.0 * nearest.std():.1f}",
            )  # fmt: skip


SEEN_MS = (1, 2, 3, 5, 7, 10, 14, 20, 25, 30, 35, 40, 50, 60, 70, 80, 90, 100)


def early(n_cases: int = 3000) -> None:
    """Accuracy by what was seen, the stopping rule, and the sequential rules on the same axis."""
    recipe = bench(10_000.0)
    samples = tuple(10 * ms for ms in SEEN_MS)
    time_s = np.array(SEEN_MS) / 1e3
    test, train = cases(recipe, TEST, n_cases), cases(recipe, TRAIN, 5_000)
    model = EarlyClassifier(qda(recipe), samples).fit(train.X, train.class_name)
    columns = [list(model.classes_).index(name) for name in recipe.class_names]
    probabilities = {
        "limit": limit_by_samples(recipe, test.X, samples),
        "residual-qda": model.probabilities_by_samples(test.X)[..., columns],
    }
    hits = {name: (p.argmax(axis=2) == test.class_index).mean(axis=1) for name, p in probabilities.items()}
    table(
        "Accuracy by what was seen",
        ("seen", *hits),
        ((f"{ms} ms", *(f"{h[n]:.4f}" for h in hits.values())) for n, ms in enumerate(SEEN_MS)),
    )
    table(
        "Stopping rule",
        ("stated error", "probabilities of", "error of those that stopped", "stopped", "mean time", "accuracy of all"),
        _stopping_rows(probabilities, test.class_index, time_s),
    )  # fmt: skip
    _against_rules(recipe, n_cases)


def _stopping_rows(
    probabilities: dict[str, FloatArray], truth: Any, time_s: FloatArray
) -> Iterable[Iterable[str]]:
    for error in (0.10, 0.05, 0.02, 0.01):
        for name, p in probabilities.items():
            got = stopping_score(stop_when_sure(p, error), truth, time_s)
            yield (
                f"{100.0 * error:g} %", name,
                f"{100.0 * got.error:.2f} % ({100.0 * got.error_low:.2f} to {100.0 * got.error_high:.2f})",
                f"{100.0 * got.stopped:.1f} %", f"{1e3 * got.mean_time_s:.1f} ms", f"{got.accuracy:.4f}",
            )  # fmt: skip


def _against_rules(recipe: Recipe, n_cases: int) -> None:
    """A bearing +25 % or none, half and half: time of the verdict on faulty motors against the share of errors."""
    two = replace(recipe, classes=(FaultClass(), FaultClass(FaultKind.BEARING, 0.25)))
    test = cases(two, TEST, n_cases)
    faulty = test.class_index == 1
    samples = tuple(10 * ms for ms in SEEN_MS)
    time_s = np.array(SEEN_MS) / 1e3
    limit = limit_by_samples(two, test.X, samples)
    curves: dict[str, list[tuple[float, float]]] = {}
    for error in (0.2, 0.1, 0.05, 0.02, 0.01, 0.005):
        stopped = stop_when_sure(limit, error)
        wrong = (stopped.decided != test.class_index).mean()
        curves.setdefault("stop when sure (limit)", []).append(
            (1e3 * float(time_s[stopped.moment][faulty].mean()), float(wrong))
        )
    curves["limit, fixed time"] = [
        (1e3 * t, float((p.argmax(axis=1) != test.class_index).mean()))
        for t, p in zip(time_s, limit, strict=True)
    ]
    healthy = replace(two, classes=(FaultClass(),))
    tolerant = TolerantFilter.of(two)
    quiet = tolerant.white(cases(healthy, CALIBRATE, 10_000).X)
    white = tolerant.white(test.X)
    rules: dict[str, Rule] = {"SPRT": Sprt(0.2), "CUSUM": Cusum(0.2), "GLR": Glr(10, 1000)}
    for name, rule in rules.items():
        largest = np.maximum.accumulate(rule.statistic(quiet), axis=1)[:, -1]
        statistic = rule.statistic(white)
        for rate in (0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005):
            above = statistic > np.quantile(largest, 1.0 - rate)
            alarm = above.any(axis=1)
            first = np.where(alarm, above.argmax(axis=1) + 1, above.shape[1]) * two.timing.dt_s
            wrong = (alarm != faulty).mean()
            curves.setdefault(name, []).append((1e3 * float(first[faulty].mean()), float(wrong)))
    table(
        "Bearing +25 % or none: mean time on faulty motors and share of wrong verdicts",
        ("method", "time: errors"),
        (
            (name, ", ".join(f"{t:.0f} ms: {100.0 * e:.1f} %" for t, e in points))
            for name, points in curves.items()
        ),
    )
    _plot_early(curves)


def _plot_early(curves: dict[str, list[tuple[float, float]]]) -> None:
    from motor_env.plotting import INK, drawing, save, subplots

    styles = {
        "stop when sure (limit)": (INK, "-", "o"),
        "limit, fixed time": ("#7b8794", "--", ""),
        "SPRT": ("#0b6fa4", "-", "s"),
        "CUSUM": ("#d98300", "-", "^"),
        "GLR": ("#c8442b", "-", "v"),
    }
    with drawing():
        figure, (axes,) = subplots(1, width_in=8.0, height_in=5.0)
        for name, points in curves.items():
            colour, line, marker = styles[name]
            time_ms, error = np.array(points).T
            axes.plot(time_ms, 100.0 * error, line, color=colour, marker=marker, label=name)
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


def references(n_cases: int = 4000) -> Iterable[Iterable[str]]:
    """Limit and methods given k healthy starts of the same motor."""
    methods = {
        "LDA": LinearDiscriminantAnalysis(),
        "logistic regression": LogisticRegression(max_iter=2000),
        "QDA": QuadraticDiscriminantAnalysis(),
    }
    for rate_hz in (10_000.0, 1_000.0):
        recipe = bench(rate_hz)
        for k in (0, 1, 3):
            train = referenced_starts(recipe, SEED, np.arange(10_000) + TRAIN, k)
            test = referenced_starts(recipe, SEED, np.arange(n_cases) + TEST, k)
            probabilities = referenced_probabilities(recipe, test.X)
            best = probabilities.argmax(axis=1) == test.class_index
            cells = []
            for model in methods.values():
                pipeline = make_pipeline(ReferencedProjection(recipe), StandardScaler(), clone(model))
                fitted = pipeline.fit(train.X, train.class_name)
                right = fitted.predict(test.X) == test.class_name
                error = (right.astype(float) - best).std() / np.sqrt(n_cases)
                cells.append(
                    f"{right.mean():.4f} ({100.0 * (right.mean() - best.mean()):+.2f} ± {100.0 * error:.2f})"
                )
            expected = probabilities.max(axis=1)
            spread = expected.std() / np.sqrt(n_cases)
            yield (
                f"{rate_hz / 1e3:g} kHz", str(k), f"{expected.mean():.4f} ± {spread:.4f}", f"{best.mean():.4f}",
                *cells,
            )  # fmt: skip


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
        train = cases(recipe, TRAIN, 8000)
        models = {
            "network": NetworkClassifier(alone, random_state=SEED).fit(train.X, train.class_name)
            if recipe is alone
            else network(recipe),
            "residual-qda": qda(recipe).fit(train.X, train.class_name),
            "physical-lda": lda(recipe).fit(train.X, train.class_name),
        }
        for name, model in models.items():
            columns = np.searchsorted(model.classes_, known.class_name)
            sets = ConformalSets.calibrate(model.predict_proba(known.X), columns)
            scores = shift_scores(
                model,
                recipe,
                {"as in training": recipe, **conditions},
                sets=sets,
                detector=detector if name == "network" else None,
                reference=reference,
                seed=SEED,
                cases=np.arange(n_cases) + TEST,
            )
            for got in scores:
                yield (
                    recipe.name, name, got.name, f"{got.accuracy:.3f}", f"{got.limit:.3f}", f"{got.ece:.3f}",
                    f"{100.0 * got.coverage:.1f} %", f"{got.set_size:.2f}",
                    "" if np.isnan(got.other) else f"{100.0 * got.other:.1f} %",
                )  # fmt: skip


def print_calibration() -> None:
    """Section calibration."""
    header = ("setting", "method", "accuracy", "ECE", "over limit's", "Brier", "log-loss", "over limit's")
    table("Calibration", header, calibration())


def print_conformal() -> None:
    """Section conformal."""
    header = ("setting", "method", "promised", "coverage", "by class", "mean size", "empty")
    table("Conformal sets, 90 %", header, conformal_sets())
    columns = ("setting", "kind", "network's coverage", "conformal", "network's width", "conformal")
    table("Intervals of severity, 90 %, width in points", columns, conformal_intervals())


def print_other() -> None:
    """Section other."""
    header = ("recipe", "rate", "fault", "AUROC of distance", "of confidence", "called other", "false alarms")
    table("Foreign faults", header, other())
    columns = ("setting", "fault", "kind right", "out of range", "other", "severity")
    table("Out of range", columns, out_of_range())


def print_references() -> None:
    """Section references."""
    header = ("rate", "k", "limit", "hits", "LDA", "logistic regression", "QDA")
    table("Reference starts", header, references())


def print_shifts() -> None:
    """Section shifts."""
    header = ("recipe", "method", "conditions", "accuracy", "limit", "ECE", "coverage", "set size", "other")
    table("Shifts", header, shifts())


SECTIONS: dict[str, Callable[[], None]] = {
    "calibration": print_calibration,
    "conformal": print_conformal,
    "other": print_other,
    "early": early,
    "references": print_references,
    "shifts": print_shifts,
}


def main() -> None:
    """Print the sections asked for."""
    asked = sys.argv[1:] or list(SECTIONS)
    unknown = [name for name in asked if name not in SECTIONS]
    if unknown:
        sys.exit(f"section must be one of {', '.join(SECTIONS)}, got {unknown[0]!r}")
    for name in asked:
        SECTIONS[name]()


if __name__ == "__main__":
    main()
