"""How soon a verdict can be had: stopping rules at several stated errors, and the sequential rules on the same axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from motor_classifiers.estimators.methods import make_method
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.task import judged_starts
from motor_classifiers.wrappers.early import EarlyClassifier, limit_by_samples, stop_when_sure, stopping_score
from motor_datasets.arrays import Dataset
from motor_env.detection.rules import Cusum, Glr, Rule, Sprt
from motor_env.detection.rules.tolerant import TolerantFilter
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.simulate import Timing

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
