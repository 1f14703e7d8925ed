"""Score answers to a task beside the best possible answers to the same cases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from motor_classifiers.scoring.judging import LIMIT, Answer, expected_severity
from motor_classifiers.scoring.metrics import (
    CalibrationScores,
    Comparison,
    Score,
    Scores,
    calibration_scores,
    compare,
    interval,
    resampling_weights,
    root_mean_square,
    scores,
)
from motor_classifiers.scoring.task import ClassTask, DrawnTask
from motor_env.motor.parameters import FloatArray

SIGNIFICANCE = 0.01
"""Level of the check that no method beats the limit: one-sided, shared by all comparisons of a run (Bonferroni)."""


@dataclass(frozen=True)
class Result:
    """Result of one method on one task.

    Attributes:
        costs: of each case, shape (n_test,).
        value: the task's metric; smaller is better.
        against_limit: paired comparison with the best possible; None if unknown.
    """

    name: str
    costs: FloatArray
    value: Score
    against_limit: Comparison | None


@dataclass(frozen=True)
class ClassResult(Result):
    """Result of one method on a class task.

    Attributes:
        against_limit: paired comparison with the limit's decisions.
        answer: of each case.
        scores: of the decisions, with intervals.
        calibration: of the probabilities; None for pure decisions.
        severity_rmse: root mean square error of the posterior mean severity, 0.01 for a point.
    """

    against_limit: Comparison
    answer: Answer
    scores: Scores
    calibration: CalibrationScores | None
    severity_rmse: Score


@dataclass(frozen=True, slots=True)
class Results:
    """Results of all methods on one class task.

    Attributes:
        limit: the Bayes-optimal posterior, or its estimate.
        weights: of the bootstrap, shape (1 + n_resamples, n_test).
        n_comparisons: comparisons with the limit that share `SIGNIFICANCE`.
    """

    task: ClassTask
    limit: ClassResult
    methods: tuple[ClassResult, ...]
    weights: FloatArray
    n_comparisons: int = 1

    @property
    def limit_is_estimate(self) -> bool:
        """Whether the limit is only an estimate."""
        return self.task.recipe.field is not None

    def is_above(self, method: ClassResult) -> bool:
        """Whether a method is significantly above the limit, a sign of a leak."""
        if method.answer.origin or self.limit_is_estimate:
            return False
        return method.against_limit.p_above < SIGNIFICANCE / self.n_comparisons

    @property
    def leaks(self) -> tuple[str, ...]:
        """Names of the methods significantly above the limit."""
        return tuple(method.name for method in self.methods if self.is_above(method))

    def ranked(self) -> tuple[ClassResult, ...]:
        """Return the methods, the most accurate first."""
        return tuple(sorted(self.methods, key=lambda method: -method.scores.accuracy.value))

    def difference(self, first: ClassResult, second: ClassResult) -> Comparison:
        """Compare two methods in pairs."""
        return compare(self.task, first.costs, second.costs, self.weights)


def score(
    task: DrawnTask,
    truth: NDArray[Any],
    answers: Mapping[str, NDArray[Any]],
    weights: FloatArray,
    limit: str | None = None,
) -> dict[str, Result]:
    """Score answers to the same cases.

    Args:
        task: the task.
        truth: of the task's cases.
        answers: by method, each of shape (n_test, n_columns).
        weights: from `resampling_weights`, the same for all methods.
        limit: name of the best possible answers.
    """
    costs = {name: task.costs(truth, answer) for name, answer in answers.items()}
    against = {
        name: None if limit is None else compare(task, method_costs, costs[limit], weights)
        for name, method_costs in costs.items()
    }
    return {
        name: Result(name, method_costs, interval(task.figures(method_costs, weights)), against[name])
        for name, method_costs in costs.items()
    }


def score_classes(
    task: ClassTask, answers: Mapping[str, Answer], limit: Answer, n_comparisons: int = 1
) -> Results:
    """Score probabilities of classes.

    Args:
        task: the task.
        answers: by method.
        limit: best possible answers, or their estimate.
        n_comparisons: comparisons that share the level of the check.
    """
    starts, recipe, every = task.starts(), task.recipe, {**answers, LIMIT: limit}
    weights = resampling_weights(len(starts), task.seed, groups=starts.motor_id)
    probabilities = {name: answer.probabilities for name, answer in every.items()}
    made = {}
    for name, result in score(task, starts.class_index, probabilities, weights, LIMIT).items():
        error = expected_severity(recipe, probabilities[name]) - starts.severity
        made[name] = ClassResult(
            **vars(result),
            answer=every[name],
            scores=scores(recipe, starts.class_index, every[name].decided, weights),
            calibration=calibration_scores(probabilities[name], starts.class_index)
            if every[name].is_graded
            else None,
            severity_rmse=root_mean_square(error, weights),
        )
    best = made.pop(LIMIT)
    return Results(task, best, tuple(made.values()), weights, n_comparisons)
