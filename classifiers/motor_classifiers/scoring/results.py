"""Scores as rows of JSON and CSV, one a method and setting; and scores of one fitted model on a data set."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from sklearn.base import BaseEstimator

from motor_classifiers.estimators.methods import find_method
from motor_classifiers.scoring.judging import Answer, Cost, answer_of
from motor_classifiers.scoring.metrics import Score, Scores
from motor_classifiers.scoring.score import ClassResult, Results, score_classes
from motor_classifiers.scoring.task import GivenTask
from motor_datasets.arrays import Dataset
from motor_env.common.arrays import instance, whole
from motor_env.common.errors import InputError
from motor_env.simulation.recipes import Recipe

SCORES = tuple(name for name in Scores._fields if name not in ("recall", "confusion"))
"""Scores with an interval."""


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def _interval_fields(name: str, score: Score) -> dict[str, float | None]:
    names = (name, f"{name}_low", f"{name}_high")
    return dict(zip(names, map(_number, score), strict=True))


def score_fields(recipe: Recipe, method: ClassResult) -> dict[str, Any]:
    """Return a method's scores as fields of a row."""
    row: dict[str, Any] = {}
    for name in SCORES:
        row |= _interval_fields(name, getattr(method.scores, name))
    row["recall"] = {
        label: {name: _number(value) for name, value in recall._asdict().items()}
        for label, recall in zip(recipe.class_names, method.scores.recall, strict=True)
    }
    row["confusion"] = method.scores.confusion.tolist()
    row |= _interval_fields("severity_rmse", method.severity_rmse)
    return row | {name: getattr(method.calibration, name, None) for name in ("log_loss", "ece", "brier")}


def limit_fields(results: Results) -> dict[str, Any]:
    """Return the fields of the limit in every row of a task."""
    limit = results.limit
    return {
        "bayes_accuracy": limit.scores.accuracy.value,
        "bayes_expected_accuracy": float(limit.answer.probabilities.max(axis=1).mean()),
        "bayes_log_loss": getattr(limit.calibration, "log_loss", None),
        "bayes_ece": getattr(limit.calibration, "ece", None),
        "bayes_severity_rmse": limit.severity_rmse.value,
        "bayes_is_estimate": results.limit_is_estimate,
    }


def comparison_fields(method: ClassResult) -> dict[str, Any]:
    """Return the comparison with the limit as fields; differences are the limit's accuracy minus the method's."""
    against = method.against_limit
    return {
        **_interval_fields("below_bayes", Score(*(points / 100.0 for points in against.difference))),
        "only_method_right": against.only_first,
        "only_bayes_right": against.only_second,
        "p_above_bayes": against.p_above,
    }


def result_rows(every: Sequence[Results]) -> list[dict[str, Any]]:
    """Return one row a method and setting, with the limit as a method."""
    rows = []
    for results in every:
        setting, recipe, of_limit = results.task.setting(), results.task.recipe, limit_fields(results)
        kind = "Bayes estimate" if results.limit_is_estimate else "Bayes limit"
        rows.append(
            {"method": kind, "family": "limit", **setting, **_own_fields(recipe, results.limit), **of_limit}
        )
        rows += [
            {
                "method": method.name,
                "family": family(method),
                **setting,
                **_own_fields(recipe, method),
                **of_limit,
                **comparison_fields(method),
                "above_bayes": results.is_above(method),
                "origin": method.answer.origin or "this run",
            }
            for method in results.methods
        ]
    return rows


def _own_fields(recipe: Recipe, method: ClassResult) -> dict[str, Any]:
    answer = method.answer
    return {
        **score_fields(recipe, method),
        "microseconds_per_transient": answer.microseconds_per_transient,
        "inference_memory_mb": answer.inference.memory_mb,
        "train_s": answer.train.seconds,
        "train_memory_mb": answer.train.memory_mb,
    }


def family(method: ClassResult) -> str:
    """Return the family of a method: threshold, scikit-learn, torch, own or peer."""
    return "peer" if method.answer.origin else find_method(method.name).family


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Format rows as CSV, without recalls and confusion matrix."""
    columns = dict.fromkeys(
        name for row in rows for name, value in row.items() if not isinstance(value, list | dict)
    )
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


_UNTOLD = Cost(0.0, None)  # what answers took is not asked


def evaluate_model(model: BaseEstimator, recipe: Recipe, test: Dataset, seed: int) -> dict[str, Any]:
    """Score a fitted model on a data set, beside the Bayes limit of its recipe.

    Raises:
        InputError: other channels, time axis or classes than the model's recipe.
    """
    instance("model", model, BaseEstimator)
    instance("recipe", recipe, Recipe)
    instance("test", test, Dataset)
    whole("seed", seed)
    of_data = test.recipe
    if (of_data.timing, of_data.channels) != (recipe.timing, recipe.channels):
        raise InputError("the data set has another time axis or other channels than the model was trained on")
    if of_data.class_names != recipe.class_names:
        raise InputError(
            f"the data set has the classes {', '.join(of_data.class_names)}, the model {', '.join(recipe.class_names)}"
        )
    task = GivenTask(of_data.name, "a data set", len(test), recipe=of_data, seed=seed, given=test)
    model_says, best = (
        Answer(probabilities, _UNTOLD, _UNTOLD)
        for probabilities in (answer_of(model, recipe, test.X), task.best(test.X))
    )
    results = score_classes(task, {"model": model_says}, best)
    (own,) = results.methods
    return {
        "n_test": len(test),
        **score_fields(recipe, own),
        **limit_fields(results),
        **comparison_fields(own),
    }


def evaluation_lines(recipe: Recipe, scored: dict[str, Any]) -> list[str]:
    """Format the result of `evaluate_model`: scores, the check against the limit, the confusion matrix."""
    lines = []
    for name in SCORES:
        if scored[name] is not None:
            low, high = scored[f"{name}_low"], scored[f"{name}_high"]
            lines.append(f"  {name.replace('_', ' '):22} {scored[name]:7.4f}   {low:.4f} to {high:.4f}")
    kind = "its estimate" if scored["bayes_is_estimate"] else "Bayes limit"
    lines.append(f"  {kind + ' accuracy':22} {scored['bayes_accuracy']:7.4f}   on the same cases")
    below = [
        round(100.0 * scored[name], 2) + 0.0  # no -0.00
        for name in ("below_bayes", "below_bayes_low", "below_bayes_high")
    ]
    lines.append(
        f"  below it by {below[0]:.2f} percentage points ({below[1]:.2f} to {below[2]:.2f}, paired): only the model is "
        f"right on {scored['only_method_right']} cases, only the limit on {scored['only_bayes_right']}; "
        f"one-sided p {scored['p_above_bayes']:.3f}"
    )
    width = max(len(name) for name in recipe.class_names)
    lines += ["", f"  {'truth (row), decision (column)':{width}}"]
    numbered = enumerate(zip(recipe.class_names, scored["confusion"], strict=True), start=1)
    lines.append(f"  {'':{width + 3}}" + "".join(f"{n:7}" for n in range(1, len(recipe.classes) + 1)))
    lines += [
        f"  {n} {name:{width + 1}}" + "".join(f"{count:7}" for count in row) for n, (name, row) in numbered
    ]
    return lines
