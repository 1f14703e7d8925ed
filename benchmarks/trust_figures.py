"""How far to trust a verdict in the benchmark's setting: the figures of docs/trust-method.md, measured by trust.py.

Sets that hold the truth, unknown faults, severities, early verdicts beside sequential rules, and other conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import roc_auc_score, roc_curve

from motor_classifiers.estimators.methods import ESTIMATE, make_method
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.frozen_tasks import UNKNOWN_FAULTS, foreign_starts
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.metrics import IntArray, calibration_scores
from motor_classifiers.scoring.task import TEST_FIRST_CASE, ClassTask, judged_cases, judged_starts
from motor_classifiers.wrappers.conformal import ConformalSets, Coverage, measured_coverage
from motor_classifiers.wrappers.early import EarlyClassifier, limit_by_samples, stop_when_sure, stopping_score
from motor_classifiers.wrappers.outlier_detector import OutsideDetector
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.detection.rules import Cusum, Glr, Rule, Sprt
from motor_env.detection.rules.tolerant import TolerantFilter
from motor_env.inference.posterior import SeverityPrior, class_probabilities, severity_posterior
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe, Spread
from motor_env.simulation.simulate import Timing

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

STATED_ERRORS = (0.10, 0.05, 0.02, 0.01)
FEWEST_SAMPLES = 10  # of a moment: six directions of the signal need more than six
_SHARES = np.array([1, 2, 3, 5, 7, 10, 14, 20, 25, 30, 35, 40, 50, 60, 70, 80, 90, 100]) / 100.0
_RACE_ERRORS = (0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
_ALARM_RATES = (0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005)
_SHIFT = 0.2
"""Looked for by CUSUM and SPRT, in standard deviations of the residual of a sample."""

METHOD = "residual-qda"
"""The method beside the limit: trained in half a second, so that each moment can have its own."""

STOPPING_RULE = "stop when sure (limit)"
FIXED_TIME = "limit, fixed time"
COVERAGE = 0.90  # promised of sets


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
        sets[~calibrating] = known.sets(probabilities[~calibrating], COVERAGE)
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
    return {"n_test": len(test), "promised": COVERAGE, "methods": rows}


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


class Moments(NamedTuple):
    """When is looked at a transient.

    Attributes:
        samples: seen by then, shape (n_moments,).
        time_s: since the step of the supply.
    """

    samples: NDArray[np.int64]
    time_s: FloatArray


def moments(timing: Timing) -> Moments:
    """Up to eighteen moments from 1 to 100 % of the time after the step."""
    after_step = np.round(_SHARES * (timing.n_samples - timing.n_quiet)).astype(np.int64)
    samples = np.unique(after_step[after_step >= FEWEST_SAMPLES])
    return Moments(samples + timing.n_quiet, np.asarray(samples * timing.dt_s, dtype=np.float64))


def probabilities_by_moment(
    recipe: Recipe, seed: int, train: Dataset, test: Dataset
) -> dict[str, FloatArray]:
    """Probabilities at each of the moments, shape (n_moments, n_cases, n_classes): the limit's and `METHOD`'s.

    Args:
        recipe: what the starts were drawn from.
        seed: random state of the method.
        train: starts that the method is trained on, anew for each moment.
        test: starts to be judged.
    """
    samples = moments(recipe.timing).samples
    method = make_method(METHOD, recipe, seed)
    model = EarlyClassifier(method, tuple(samples)).fit(train.X, train.class_name)
    by_moment = model.probabilities_by_samples(test.X)
    own = [in_recipe_order(model, probabilities, recipe) for probabilities in by_moment]
    return {"limit": limit_by_samples(recipe, test.X, samples), METHOD: np.stack(own)}


def accuracy_by_moment(probabilities: FloatArray, truth: ArrayLike) -> FloatArray:
    """Accuracy at each moment from probabilities, shape (n_moments, n_cases, n_classes)."""
    shares: FloatArray = (probabilities.argmax(axis=2) == np.asarray(truth)).mean(axis=1)
    return shares


def stopping_rows(
    probabilities: Mapping[str, FloatArray], truth: ArrayLike, time_s: FloatArray
) -> list[dict[str, Any]]:
    """Score the stopping rule at each of `STATED_ERRORS` for each classifier: the fields of its `StoppingScore`.

    Args:
        probabilities: by classifier, shape (n_moments, n_cases, n_classes).
        truth: true class of each case.
        time_s: of the moments.
    """
    rows = []
    for error, (name, own) in product(STATED_ERRORS, probabilities.items()):
        score = stopping_score(stop_when_sure(own, error), truth, time_s)._asdict()
        known = {field: None if np.isnan(value) else value for field, value in score.items()}
        rows.append({"stated": error, "probabilities_of": name, **known})
    return rows


class VerdictTime(NamedTuple):
    """One setting of a rule that decides between faulty and healthy.

    Attributes:
        time_s: mean time of the verdict on faulty motors; the end of the transient where the rule stays silent.
        wrong: share of wrong verdicts, healthy and faulty motors half and half.
    """

    time_s: float
    wrong: float


def race(
    recipe: Recipe, fault: FaultClass, *, seed: int, first_case: int, n_cases: int, n_healthy: int
) -> dict[str, tuple[VerdictTime, ...]]:
    """One fault or none: time of the verdict against wrong verdicts, of the limit and of the sequential rules.

    The rules see the residual whitened for the tolerances; a rule that is silent at the end says healthy.

    Args:
        recipe: motors, sensor and timing; its classes do not count.
        fault: the fault that is there or not.
        seed: the random seed.
        first_case: of the starts that are judged; those that set the thresholds come after them.
        n_cases: starts to be judged.
        n_healthy: healthy starts that set the rules' thresholds for false alarms.
    """
    two = replace(recipe, classes=(FaultClass(), fault), shifts=())
    healthy = replace(two, classes=(FaultClass(),), healthy_starts=0)
    test = judged_starts(two, seed, first_case, n_cases)
    faulty = test.class_index == 1
    curves = _limit_curves(two, test.X, faulty)
    tolerant = TolerantFilter.from_recipe(two)
    quiet = tolerant.white(judged_starts(healthy, seed, int(test.case_id.max()) + 1, n_healthy).X)
    white = tolerant.white(test.X)
    rules: dict[str, Rule] = {
        "SPRT": Sprt(_SHIFT),
        "CUSUM": Cusum(_SHIFT),
        "GLR": Glr(FEWEST_SAMPLES, two.timing.n_samples),
    }
    for name, rule in rules.items():
        largest = rule.statistic(quiet).max(axis=1)
        statistic = rule.statistic(white)
        thresholds = (np.quantile(largest, 1.0 - rate) for rate in _ALARM_RATES)
        curves[name] = tuple(_verdict_time(statistic > level, faulty, two.timing) for level in thresholds)
    return curves


def _limit_curves(
    two: Recipe, X: NDArray[np.float32], faulty: NDArray[np.bool_]
) -> dict[str, tuple[VerdictTime, ...]]:
    seen = moments(two.timing)
    limit = limit_by_samples(two, X, seen.samples)
    stopped = [stop_when_sure(limit, error) for error in _RACE_ERRORS]
    sure = [(seen.time_s[one.moment][faulty].mean(), one.decided) for one in stopped]
    fixed = zip(seen.time_s, limit.argmax(axis=2), strict=True)
    return {
        name: tuple(VerdictTime(float(t), float((decided != faulty).mean())) for t, decided in points)
        for name, points in ((STOPPING_RULE, sure), (FIXED_TIME, fixed))
    }


def _verdict_time(above: NDArray[np.bool_], faulty: NDArray[np.bool_], timing: Timing) -> VerdictTime:
    alarm = above.any(axis=1)
    sample = np.where(alarm, above.argmax(axis=1) + 1, above.shape[1])
    time_s = (sample - timing.n_quiet) * timing.dt_s
    return VerdictTime(float(time_s[faulty].mean()), float((alarm != faulty).mean()))


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


def textbook_shifts(recipe: Recipe) -> dict[str, Recipe]:
    """Other conditions for a recipe of textbook motors; for each the exact posterior is known.

    A recipe with a field has shifts of its own (`Recipe.shifts`).
    """
    louder = replace(recipe.sensor, current_noise_a=2.0 * recipe.sensor.current_noise_a)
    names = ("supply", "resistance", "constants", "inertia", "friction")
    wider = Spread(**{name: 2.0 * getattr(recipe.spread, name) for name in names})
    # Copper gains 0.393 % a kelvin, magnets lose 0.1 %.
    hot = recipe.motor.scaled(
        resistance_ohm=1.0786, back_emf_constant_v_s_per_rad=0.98, torque_constant_n_m_per_a=0.98
    )
    between = (
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.17),
        FaultClass(FaultKind.WINDING_CONTACT, 0.17),
    )
    return {
        "20 K hotter": replace(recipe, motor=hot),
        "sensor twice as noisy": replace(recipe, sensor=louder),
        "tolerances twice as wide": replace(recipe, spread=wider),
        "severities between the levels": replace(recipe, classes=between),
        "shorted turns, 10 %": replace(recipe, classes=(FaultClass(FaultKind.WINDING_SHORT, 0.10),)),
    }


class ShiftScore(NamedTuple):
    """A model under other conditions. Kinds count, not levels: severities may be others than in training.

    Attributes:
        name: of the conditions.
        accuracy: share of cases with the right kind.
        ece: expected calibration error of the kinds' probabilities.
        coverage: share of the conformal sets that hold a class of the true kind.
        set_size: mean number of classes in a set.
        limit: the same accuracy of who knows the conditions: the exact posterior, or an estimate for a field.
        refused: share of cases that the detector refuses.
        answered_accuracy: accuracy in the other cases; nan where there is none.
        answered_ece: expected calibration error in them.
    """

    name: str
    accuracy: float
    ece: float
    coverage: float
    set_size: float
    limit: float
    refused: float
    answered_accuracy: float
    answered_ece: float


def shift_scores(
    model: Any,
    trained: Recipe,
    conditions: Mapping[str, Recipe],
    *,
    sets: ConformalSets,
    detector: OutsideDetector,
    reference: Callable[[Recipe], Any],
    seed: int,
    cases: NDArray[np.int64],
) -> tuple[ShiftScore, ...]:
    """Judge a model under conditions that it was not trained for.

    Args:
        model: fitted classifier of the classes of `trained`.
        trained: what it was trained for.
        conditions: recipes by name, with the time axis and channels of `trained`.
        sets: calibrated on cases of `trained` with the model's probabilities, its columns in the order of `classes_`.
        detector: fitted, which refuses cases.
        reference: fits a classifier for a recipe with a field, where there is no exact posterior.
        seed: of the cases.
        cases: case numbers, shape (n_cases,).
    """
    scores = []
    kind_of = {c.name: c.label_kind for c in trained.classes}
    kinds = np.array([kind_of[str(name)] for name in model.classes_])
    for name, recipe in conditions.items():
        drawn = generate_arrays(recipe, seed, cases)
        probabilities = np.asarray(model.predict_proba(drawn.X), dtype=np.float64)
        held = sets.sets(probabilities, COVERAGE)
        true = kinds == drawn.kind[:, None]
        kind_accuracy, ece = _kind_scores(probabilities, kinds, drawn.kind)
        left = detector.predict(drawn.X) > 0
        after = _kind_scores(probabilities[left], kinds, drawn.kind[left]) if left.any() else (np.nan, np.nan)
        scores.append(
            ShiftScore(
                name,
                kind_accuracy,
                ece,
                float((held & true).any(axis=1).mean()),
                float(held.sum(axis=1).mean()),
                _limit(recipe, drawn.X, drawn.kind, reference),
                1.0 - float(left.mean()),
                *after,
            )
        )
    return tuple(scores)


def _kind_scores(
    probabilities: FloatArray, kinds: NDArray[np.str_], truth: NDArray[np.str_]
) -> tuple[float, float]:
    """Accuracy and expected calibration error of the kinds' probabilities; a kind never trained on is never right."""
    names = sorted({*kinds.tolist(), *truth.tolist()})
    of_kind = np.stack([probabilities[:, kinds == name].sum(axis=1) for name in names], axis=1)
    scores = calibration_scores(of_kind, np.searchsorted(names, truth))
    return scores.accuracy, scores.ece


def _limit(
    recipe: Recipe,
    X: NDArray[np.float32],
    truth: NDArray[np.str_],
    reference: Callable[[Recipe], Any],
) -> float:
    kind_of = {c.name: c.label_kind for c in recipe.classes}
    if len(set(kind_of.values())) < 2:
        return 1.0
    if recipe.field is None:
        names, probabilities = recipe.class_names, class_probabilities(recipe, X)
    else:
        model = reference(recipe)
        names, probabilities = tuple(map(str, model.classes_)), np.asarray(model.predict_proba(X))
    return _kind_scores(probabilities, np.array([kind_of[name] for name in names]), truth)[0]


def check() -> None:
    """Assert on made probabilities what the tables of sets and severities rest on."""
    rng = np.random.default_rng(1)
    motors, truth = np.repeat(np.arange(300), 2), np.repeat(rng.integers(3, size=300), 2)
    probabilities = rng.dirichlet(np.ones(3), size=600) + 1.5 * np.eye(3)[truth] * rng.random((600, 1))
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    held = np.zeros(600, dtype=np.bool_)
    for known, label in product((motors % 2 == 0, motors % 2 == 1), range(3)):
        # The rank of split conformal prediction: the ceil(0.9 (n + 1))-th strangest of a class is still in.
        strange = np.sort(1.0 - probabilities[known & (truth == label), label])
        largest = strange[int(np.ceil(COVERAGE * (len(strange) + 1))) - 1]
        mine = ~known & (truth == label)
        held[mine] = 1.0 - probabilities[mine, label] <= largest + 1e-12
    assert np.isclose(halves_coverage(probabilities, truth, motors).overall, held.mean())
    interval = np.array([[0.0, 0.2], [0.1, 0.2], [0.1, 0.2], [0.0, 0.1]])
    got = scored_severities(np.array([0.1, 0.2, 0.3, 0.0]), interval, np.array([0.2, 0.2, 0.1, 0.2]))
    assert np.allclose([got["rmse"], got["coverage"]], [np.sqrt((0.01 + 0.04 + 0.04) / 4), 0.75])
