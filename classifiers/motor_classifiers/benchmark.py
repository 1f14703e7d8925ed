"""The benchmark: every method trained and judged on the same motors, beside the Bayes-optimal posterior."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # comes with scikit-learn, without types

from motor_classifiers.methods import METHODS, make_method
from motor_classifiers.metrics import Comparison, Scores, compare, resampling_weights, scores
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.console import InputError
from motor_env.files import write_text
from motor_env.parameters import FloatArray
from motor_env.posterior import class_probabilities
from motor_env.recipe_file import recipe_to_dict
from motor_env.recipes import Recipe

SIGNIFICANCE = 0.01
"""Of the check that no method beats the limit: shared among the methods (Bonferroni), one-sided."""

TRAIN_FIRST_CASE = 0
TEST_FIRST_CASE = 1_000_000_000
"""Training and test motors are different cases of one seed, so they never meet."""

_TIMING_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Options:
    """What is run.

    Attributes:
        recipe: what motors are drawn from.
        methods: names of `METHODS`.
        n_train: training motors.
        n_test: test motors.
        seed: of motors, noise, training and bootstrap.
    """

    recipe: Recipe
    methods: tuple[str, ...] = tuple(METHODS)
    n_train: int = 2000
    n_test: int = 2000
    seed: int = 0

    def __post_init__(self) -> None:
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, got {unknown[0]!r}")
        for name, least in (("n_train", 50), ("n_test", 50)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be >= {least}, got {getattr(self, name)}")


class MethodResult(NamedTuple):
    """One method on the test cases.

    Attributes:
        name: of `METHODS`.
        scores: with intervals.
        against_limit: compared in pairs with the Bayes-optimal decisions.
        above_limit: whether it is significantly better than what is possible: then something leaks.
        log_loss: mean negative log probability of the true class, in nats.
        train_s: seconds of training.
        microseconds_per_transient: of `predict_proba` on all test cases in one batch on one thread, least of three.
        decided: index of the decided class of each case.
        probabilities: shape (n_test, n_classes), in the recipe's order.
    """

    name: str
    scores: Scores
    against_limit: Comparison
    above_limit: bool
    log_loss: float
    train_s: float
    microseconds_per_transient: float
    decided: NDArray[np.int64]
    probabilities: FloatArray


class BenchmarkResult(NamedTuple):
    """All of a benchmark.

    Attributes:
        options: what was run.
        test: test cases with the truth.
        limit_probabilities: Bayes-optimal posterior of each test case.
        limit: scores of the Bayes-optimal decisions on the test cases.
        limit_log_loss: its log-loss.
        limit_microseconds: time of the posterior for a transient.
        methods: in the order asked.
    """

    options: Options
    test: Dataset
    limit_probabilities: FloatArray
    limit: Scores
    limit_log_loss: float
    limit_microseconds: float
    methods: tuple[MethodResult, ...]

    @property
    def leaks(self) -> tuple[str, ...]:
        """Names of the methods that are significantly above the limit."""
        return tuple(method.name for method in self.methods if method.above_limit)


def run_benchmark(options: Options, on_step: Callable[[str], object] = lambda _: None) -> BenchmarkResult:
    """Train and judge.

    Args:
        options: what to run.
        on_step: called with a sentence before each step; `count_steps` says how many there are.
    """
    recipe = options.recipe
    on_step(f"drawing {options.n_train} + {options.n_test} motors")
    train = generate_arrays(recipe, options.seed, np.arange(options.n_train) + TRAIN_FIRST_CASE)
    test = generate_arrays(recipe, options.seed, np.arange(options.n_test) + TEST_FIRST_CASE)
    weights = resampling_weights(options.n_test, options.seed)
    on_step("Bayes-optimal posterior of the test motors")
    begin = time.perf_counter()
    with threadpool_limits(1):
        limit_probabilities = class_probabilities(recipe, test.X)
    limit_s = time.perf_counter() - begin
    limit_decided = limit_probabilities.argmax(axis=1)
    results = []
    for name in options.methods:
        on_step(f"{name}: training and judging")
        results.append(_judge(name, options, train, test, weights, limit_decided == test.class_index))
    return BenchmarkResult(
        options=options,
        test=test,
        limit_probabilities=limit_probabilities,
        limit=scores(recipe, test.class_index, limit_decided, weights),
        limit_log_loss=_log_loss(limit_probabilities, test.class_index),
        limit_microseconds=1e6 * limit_s / options.n_test,
        methods=tuple(results),
    )


def count_steps(options: Options) -> int:
    """How often `run_benchmark` calls `on_step`."""
    return 2 + len(options.methods)


def _judge(
    name: str,
    options: Options,
    train: Dataset,
    test: Dataset,
    weights: FloatArray,
    limit_right: NDArray[np.bool_],
) -> MethodResult:
    recipe = options.recipe
    with threadpool_limits(1):
        begin = time.perf_counter()
        model = make_method(name, recipe, options.seed % 2**32).fit(train.X, train.class_name)
        train_s = time.perf_counter() - begin
        times = []
        for _ in range(_TIMING_ROUNDS):
            begin = time.perf_counter()
            raw = model.predict_proba(test.X)
            times.append(time.perf_counter() - begin)
        probabilities = in_recipe_order(model, raw, recipe)
    decided = probabilities.argmax(axis=1)
    comparison = compare(decided == test.class_index, limit_right, weights)
    return MethodResult(
        name=name,
        scores=scores(recipe, test.class_index, decided, weights),
        against_limit=comparison,
        above_limit=comparison.p_above < SIGNIFICANCE / len(options.methods),
        log_loss=_log_loss(probabilities, test.class_index),
        train_s=train_s,
        microseconds_per_transient=1e6 * min(times) / options.n_test,
        decided=decided,
        probabilities=probabilities,
    )


def in_recipe_order(model: BaseEstimator, probabilities: FloatArray, recipe: Recipe) -> FloatArray:
    """Columns of probabilities in the order of the recipe's classes; 0 for a class never trained on."""
    ordered = np.zeros((len(probabilities), len(recipe.classes)))
    names = list(recipe.class_names)
    ordered[:, [names.index(str(name)) for name in model.classes_]] = probabilities
    return ordered


def _log_loss(probabilities: FloatArray, truth: NDArray[np.int64]) -> float:
    right = probabilities[np.arange(len(truth)), truth]
    return float(-np.log(np.maximum(right, 1e-15)).mean())


def result_rows(result: BenchmarkResult) -> list[dict[str, Any]]:
    """One row a method, for results.json."""
    recipe = result.options.recipe
    return [
        {
            "recipe": recipe.name,
            "sampling_rate_hz": recipe.timing.sampling_rate_hz,
            "duration_s": recipe.timing.duration_s,
            "noise_a": recipe.sensor.current_noise_a,
            "channels": [str(channel) for channel in recipe.sensor.channels],
            "method": method.name,
            "family": METHODS[method.name].family,
            "n_train": result.options.n_train,
            "n_test": result.options.n_test,
            "seed": result.options.seed,
            **_score_fields(recipe, method.scores),
            "log_loss": method.log_loss,
            "bayes_accuracy": result.limit.accuracy.value,
            "bayes_expected_accuracy": float(result.limit_probabilities.max(axis=1).mean()),
            "bayes_log_loss": result.limit_log_loss,
            "below_bayes": -method.against_limit.difference.value,
            "below_bayes_low": -method.against_limit.difference.high,
            "below_bayes_high": -method.against_limit.difference.low,
            "p_above_bayes": method.against_limit.p_above,
            "above_bayes": method.above_limit,
            "train_s": method.train_s,
            "microseconds_per_transient": method.microseconds_per_transient,
        }
        for method in result.methods
    ]


def _score_fields(recipe: Recipe, scored: Scores) -> dict[str, Any]:
    names = ("accuracy", "macro_f1", "false_alarm_rate", "missed_detection_rate", "level_error")
    row: dict[str, Any] = {}
    for name in names:
        score = getattr(scored, name)
        for suffix, value in (("", score.value), ("_low", score.low), ("_high", score.high)):
            row[name + suffix] = None if np.isnan(value) else value
    row["recall"] = {
        label: {"value": recall.value, "low": recall.low, "high": recall.high}
        for label, recall in zip(recipe.class_names, scored.recall, strict=True)
    }
    row["confusion"] = scored.confusion.tolist()
    return row


def write_results(result: BenchmarkResult, folder: Path) -> Path:
    """Write results.json and report.html to a folder, each whole or not at all; the report's path."""
    from motor_classifiers.report import render_report

    write_text(folder / "results.json", json.dumps(result_rows(result), indent=1) + "\n")
    write_text(folder / "recipe.json", json.dumps(recipe_to_dict(result.options.recipe), indent=1) + "\n")
    report = folder / "report.html"
    write_text(
        report, render_report(result, machine=f"{platform.machine()}, Python {platform.python_version()}")
    )
    return report


def evaluate_model(model: BaseEstimator, recipe: Recipe, test: Dataset, seed: int) -> dict[str, Any]:
    """Scores of a fitted model on a data set, beside the Bayes limit for the recipe that the cases came from.

    Raises:
        InputError: the data set has other channels or another time axis than the model's recipe, or a class that it
            does not know.
    """
    theirs = test.recipe
    if (theirs.timing, theirs.sensor.channels) != (recipe.timing, recipe.sensor.channels):
        raise InputError("the data set has another time axis or other channels than the model was trained on")
    if theirs.class_names != recipe.class_names:
        raise InputError(
            f"the data set has the classes {', '.join(theirs.class_names)}, the model {', '.join(recipe.class_names)}"
        )
    weights = resampling_weights(len(test), seed)
    probabilities = in_recipe_order(model, model.predict_proba(test.X), recipe)
    limit = class_probabilities(theirs, test.X)
    right = limit.argmax(axis=1) == test.class_index
    decided = probabilities.argmax(axis=1)
    comparison = compare(decided == test.class_index, right, weights)
    return {
        "n_test": len(test),
        **_score_fields(recipe, scores(recipe, test.class_index, decided, weights)),
        "log_loss": _log_loss(probabilities, test.class_index),
        "bayes_accuracy": float(right.mean()),
        "bayes_log_loss": _log_loss(limit, test.class_index),
        "p_above_bayes": comparison.p_above,
    }
