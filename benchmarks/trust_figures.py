"""How far to trust a verdict in the benchmark's setting: sets, unknown faults, severities, early verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score, roc_curve
from verdict_times import (
    accuracy_by_moment,
    moments,
    probabilities_by_moment,
    race,
    stopping_rows,
)

from motor_classifiers.estimators.methods import ESTIMATE
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.frozen_tasks import UNKNOWN_FAULTS, foreign_starts
from motor_classifiers.scoring.metrics import IntArray
from motor_classifiers.scoring.task import TEST_FIRST_CASE, ClassTask, judged_cases, judged_starts
from motor_classifiers.wrappers.conformal import ConformalSets, Coverage, measured_coverage
from motor_classifiers.wrappers.outlier_detector import OutsideDetector
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.inference.posterior import SeverityPrior, class_probabilities, severity_posterior
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe

Confidence = Callable[[NDArray[np.float32]], FloatArray]
"""Probabilities of transients: shape (n_cases, n_channels, n_samples) to (n_cases, n_classes)."""

DISTANCE = "distance"
"""What faults are told by beside the classifiers' confidence: the detector's distance from the recipe's starts."""

FALSE_ALARM_RATES: FloatArray = np.linspace(0.0, 1.0, 101)
"""Where curves are drawn."""

Figures = dict[str, Any]
"""What JSON can hold."""

FIRST_CASE = 2_000_000_000
"""First number of the starts judged here: neither training nor test starts of the benchmark."""

TELLING_RATE_HZ = 1_000.0
"""Rate of a second setting of the unknown faults: at 10 kHz every one of them is found."""

_PROMISED = 0.90  # coverage of sets


@dataclass(frozen=True, slots=True)
class Counts:
    """How many starts each figure rests on.

    Attributes:
        known: motors of the known classes.
        foreign: motors with each unknown fault.
        severity: motors with each kind of fault.
        early: starts of the early verdicts.
        healthy: healthy starts that set the thresholds of the sequential rules.
        steps: batches of the network where one must be trained for the second rate.
    """

    known: int = 3000
    foreign: int = 500
    severity: int = 800
    early: int = 2000
    healthy: int = 4000
    steps: int = 1000


COUNTS = Counts()


def shipped_network(recipe: Recipe) -> PosteriorNetwork | None:
    """The network that comes with the package where the recipe is its own."""
    shipped, own, _ = load_model(PRETRAINED)
    return shipped if recipe == own and isinstance(shipped, PosteriorNetwork) else None


def network_for(recipe: Recipe, random_state: int, **parameters: Any) -> PosteriorNetwork:
    """The shipped network where the recipe is its own; else one trained for it."""
    return shipped_network(recipe) or PosteriorNetwork.from_recipe(
        recipe, random_state=random_state, **parameters
    )


def halves_coverage(probabilities: FloatArray, truth: IntArray, motors: IntArray) -> Coverage:
    """Coverage of label-conditional sets where each half of the motors calibrates the other.

    A half with strange starts is covered too rarely by the other's threshold, and covers the other too often: to first
    order chance cancels in the mean, which therefore lies near the promise. The size of the sets is what differs.

    Args:
        probabilities: of starts that the model was not trained on, shape (n_cases, n_classes).
        truth: true class of each.
        motors: motor of each; all its starts stand in one half.

    Raises:
        ValueError: a half has no start of a class.
    """
    is_first = np.unique(motors, return_inverse=True)[1] % 2 == 0
    sets = np.zeros(probabilities.shape, dtype=np.bool_)
    for calibrating in (is_first, ~is_first):
        known = ConformalSets.calibrate(
            probabilities[calibrating], truth[calibrating], label_conditional=True
        )
        sets[~calibrating] = known.sets(probabilities[~calibrating], _PROMISED)
    return measured_coverage(sets, truth)


def set_figures(probabilities: Mapping[str, FloatArray], test: Dataset) -> Figures:
    """Coverage of label-conditional 90 % sets of each method, calibrated and tried on halves of the test starts.

    Args:
        probabilities: of each method, in the recipe's order of classes, shape (n_test, n_classes).
        test: the starts.
    """
    measured = {
        name: halves_coverage(own, test.class_index, test.motor_id) for name, own in probabilities.items()
    }
    rows = [
        {
            "method": name,
            "coverage": scores.overall,
            "by_class": scores.by_class.tolist(),
            "mean_size": scores.mean_size,
            "empty": scores.empty,
        }
        for name, scores in measured.items()
    ]
    return {"n_test": len(test), "promised": _PROMISED, "methods": rows}


def trust_figures(task: ClassTask) -> Figures:
    """All figures of a setting but those of the sets.

    Args:
        task: setting of textbook motors; its training starts are those of the early verdicts.
    """
    network = network_for(task.recipe, task.seed)
    return {
        "counts": asdict(COUNTS),
        "unknown": unknown_figures(task, network),
        "severity": severities(task, network),
        "early": early_figures(task),
        "race": race_figures(task),
    }


def unknown_figures(task: ClassTask, network: PosteriorNetwork) -> Figures:
    """Faults never trained on, told by the detector's distance and by confidence."""
    slow = replace(
        task.recipe, timing=replace(task.recipe.timing, sampling_rate_hz=TELLING_RATE_HZ), shifts=()
    )
    trained = network_for(slow, task.seed, steps=COUNTS.steps, with_severity=False)
    rows = []
    for recipe, own in ((task.recipe, network), (slow, trained)):
        confidences: dict[str, Confidence] = {
            "limit": partial(class_probabilities, recipe),
            ESTIMATE: own.predict_proba,
        }
        scores = foreign_scores(recipe, confidences, task.seed, COUNTS.known, COUNTS.foreign)
        rows.append({"sampling_rate_hz": recipe.timing.sampling_rate_hz, **scores})
    return {"settings": rows}


def foreign_scores(
    recipe: Recipe, confidences: Mapping[str, Confidence], seed: int, n_known: int, n_foreign: int
) -> Figures:
    """Measure how well the detector's distance, and the confidence of classifiers, tell `UNKNOWN_FAULTS`.

    Args:
        recipe: the known classes.
        confidences: classifiers by name; the smaller their largest probability, the more foreign a start.
        seed: the random seed.
        n_known: starts of known classes.
        n_foreign: starts of each foreign fault.

    Returns:
        `false_alarms`, the share of motors of the known classes that are refused, and `faults`: of each its name
        `fault`, the area under the ROC curve `auroc` and the share found at each of `FALSE_ALARM_RATES` `roc`, both by
        `DISTANCE` and by each classifier's confidence, and the share `called_other`.
    """
    detector = OutsideDetector(recipe).fit()
    numbers = judged_cases(recipe, FIRST_CASE, n_known + len(UNKNOWN_FAULTS) * n_foreign)
    known = generate_arrays(recipe, seed, numbers[:n_known]).X

    def strangeness(X: NDArray[np.float32]) -> dict[str, FloatArray]:
        unsure = {name: -classify(X).max(axis=1) for name, classify in confidences.items()}
        return {DISTANCE: -detector.decision_function(X), **unsure}

    of_known = strangeness(known)
    scored = []
    for fault, own in zip(UNKNOWN_FAULTS, numbers[n_known:].reshape(-1, n_foreign), strict=True):
        of_foreign = strangeness(foreign_starts(recipe, fault, seed, own))
        areas, curves = {}, {}
        for name, strange in of_foreign.items():
            truth = np.repeat([0, 1], [n_known, n_foreign])
            both = np.concatenate([of_known[name], strange])
            areas[name] = float(roc_auc_score(truth, both))
            false, right, _ = roc_curve(truth, both)
            curves[name] = np.round(np.interp(FALSE_ALARM_RATES, false, right), 4).tolist()
        refused = float((of_foreign[DISTANCE] > 0.0).mean())
        scored.append({"fault": fault.name, "auroc": areas, "called_other": refused, "roc": curves})
    return {"false_alarms": float((of_known[DISTANCE] > 0.0).mean()), "faults": scored}


def severities(task: ClassTask, network: PosteriorNetwork) -> Figures:
    """Severities, uniform over the range, beside the exact posterior's."""
    kinds = [
        {"kind": str(prior.kind), "largest": prior.largest}
        | severity_figures(network, task.recipe, prior, task.seed, COUNTS.severity)
        for prior in network.severity_priors_
    ]
    return {"n_cases": COUNTS.severity, "kinds": kinds}


def severity_figures(
    model: PosteriorNetwork, recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int
) -> dict[str, dict[str, float]]:
    """Judge severities, drawn uniformly over the range, of motors that have this kind of fault.

    Returns:
        Of the `network` and of the `limit`, on the same cases: `rmse`, the root mean square error, 0.01 for a point,
        and `coverage`, the share of the 90 % intervals that hold the severity.
    """
    own = replace(recipe, classes=(FaultClass(prior.kind, 0.0, severity_to=prior.largest),))
    test = generate_arrays(own, seed, np.arange(n_cases) + TEST_FIRST_CASE)
    estimated = model.predict_severity(test.X, str(prior.kind))
    exact = severity_posterior(recipe, prior, test.X)
    intervals = np.column_stack([estimated.low, estimated.high]), exact.interval(0.90)
    return {
        "network": scored_severities(estimated.mean, intervals[0], test.severity),
        "limit": scored_severities(exact.mean, intervals[1], test.severity),
    }


def scored_severities(mean: FloatArray, interval: FloatArray, truth: FloatArray) -> dict[str, float]:
    """Root mean square error of the means, and coverage of the intervals, shape (n_cases, 2)."""
    inside = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    return {"rmse": float(np.sqrt(np.square(mean - truth).mean())), "coverage": float(inside.mean())}


def early_figures(task: ClassTask) -> Figures:
    """Accuracy by what was seen, and the stopping rule."""
    recipe, seen = task.recipe, moments(task.recipe.timing)
    test = judged_starts(recipe, task.seed, FIRST_CASE, COUNTS.early)
    probabilities = probabilities_by_moment(recipe, task.seed, task.train(), test)
    return {
        "time_s": seen.time_s.tolist(),
        "accuracy": {
            name: accuracy_by_moment(own, test.class_index).tolist() for name, own in probabilities.items()
        },
        "stopping": stopping_rows(probabilities, test.class_index, seen.time_s),
    }


def race_figures(task: ClassTask) -> Figures:
    """The largest bearing fault or none, by the limit and by the sequential rules."""
    bearings = [c for c in task.recipe.classes if [part.kind for part in c.parts] == [FaultKind.BEARING]]
    fault = max(bearings, key=lambda c: c.severity)
    curves = race(
        task.recipe, FaultClass(fault.kind, fault.severity), seed=task.seed, first_case=FIRST_CASE,
        n_cases=COUNTS.early, n_healthy=COUNTS.healthy,
    )  # fmt: skip
    return {
        "severity": fault.severity,
        "curves": {name: [point._asdict() for point in points] for name, points in curves.items()},
    }
