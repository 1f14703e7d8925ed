"""The benchmark's figures as files: JSON and CSV, one row a method and setting, and the page beside them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from motor_classifiers.estimators.own_methods import find_method
from motor_classifiers.scoring.metrics import Score, Scores
from motor_classifiers.scoring.score import ClassResult, Results
from motor_env.simulation.recipes import Recipe

SCORES = tuple(name for name in Scores._fields if name not in ("recall", "confusion"))
"""Scores with an interval, as they stand in the rows."""


def _number(value: float) -> float | None:
    """JSON knows no nan."""
    return None if math.isnan(value) else value


def _interval_fields(name: str, score: Score) -> dict[str, float | None]:
    names = (name, f"{name}_low", f"{name}_high")
    return dict(zip(names, map(_number, score), strict=True))


def score_fields(recipe: Recipe, method: ClassResult) -> dict[str, Any]:
    """Scores of a method as fields of a row."""
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
    """What stands in every row of a task: the best possible on the same cases."""
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
    """The comparison with the limit as fields of a row; differences are the limit's accuracy minus the method's."""
    against = method.against_limit
    return {
        **_interval_fields("below_bayes", Score(*(points / 100.0 for points in against.difference))),
        "only_method_right": against.only_first,
        "only_bayes_right": against.only_second,
        "p_above_bayes": against.p_above,
    }


def result_rows(every: Sequence[Results]) -> list[dict[str, Any]]:
    """One row a method and setting; the limit is a method of its own name."""
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
    """Family of a method: threshold, scikit-learn, torch, own or peer."""
    return "peer" if method.answer.origin else find_method(method.name).family


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Rows without what has parts of its own (recalls, confusion matrix)."""
    columns = dict.fromkeys(
        name for row in rows for name, value in row.items() if not isinstance(value, list | dict)
    )
    text = io.StringIO()
    writer = csv.DictWriter(text, list(columns), extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
