"""The benchmark's figures as files: JSON and CSV, one row a method and setting, and the page beside them."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from motor_classifiers.estimators.own_methods import find_method
from motor_classifiers.scoring.benchmark import CellResult, Judged, MethodResult
from motor_classifiers.scoring.metrics import Comparison, Score, Scores
from motor_env.simulation.recipes import Recipe

SCORES = tuple(name for name in Scores._fields if name not in ("recall", "confusion"))
"""Scores with an interval, as they stand in the rows."""


def _number(value: float | None) -> float | None:
    """JSON knows no nan."""
    return None if value is None or math.isnan(value) else value


def _interval_fields(name: str, score: Score) -> dict[str, float | None]:
    names = (name, f"{name}_low", f"{name}_high")
    return dict(zip(names, map(_number, score), strict=True))


def score_fields(recipe: Recipe, scored: Scores) -> dict[str, Any]:
    """Scores as fields of a row."""
    row: dict[str, Any] = {}
    for name in SCORES:
        row |= _interval_fields(name, getattr(scored, name))
    row["recall"] = {
        label: {name: _number(value) for name, value in recall._asdict().items()}
        for label, recall in zip(recipe.class_names, scored.recall, strict=True)
    }
    row["confusion"] = scored.confusion.tolist()
    return row


def comparison_fields(against_limit: Comparison) -> dict[str, Any]:
    """The comparison with the limit as fields of a row; differences are the limit's accuracy minus the method's."""
    return {
        "below_bayes": -against_limit.difference.value,
        "below_bayes_low": -against_limit.difference.high,
        "below_bayes_high": -against_limit.difference.low,
        "only_method_right": against_limit.only_first,
        "only_bayes_right": against_limit.only_second,
        "p_above_bayes": against_limit.p_above,
    }


def _judged_fields(recipe: Recipe, judged: Judged) -> dict[str, Any]:
    calibration, cost = judged.calibration, judged.answer
    return {
        **score_fields(recipe, judged.scores),
        **_interval_fields("severity_rmse", judged.severity_rmse),
        **{name: getattr(calibration, name, None) for name in ("log_loss", "ece", "brier")},
        "microseconds_per_transient": cost.microseconds_per_transient,
        "inference_memory_mb": cost.inference.memory_mb,
        "train_s": cost.train.seconds,
        "train_memory_mb": cost.train.memory_mb,
    }


def result_rows(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """One row a method and setting; the limit is a method of its own name."""
    rows = []
    for result in results:
        setting, recipe, limit = result.cell.as_json(), result.cell.recipe, result.limit
        of_limit = {
            "bayes_accuracy": limit.scores.accuracy.value,
            "bayes_expected_accuracy": float(limit.answer.probabilities.max(axis=1).mean()),
            "bayes_log_loss": getattr(limit.calibration, "log_loss", None),
            "bayes_ece": getattr(limit.calibration, "ece", None),
            "bayes_severity_rmse": limit.severity_rmse.value,
            "bayes_is_estimate": result.limit_is_estimate,
        }
        kind = "Bayes estimate" if result.limit_is_estimate else "Bayes limit"
        rows.append(
            {"method": kind, "family": "limit", **setting, **_judged_fields(recipe, limit), **of_limit}
        )
        rows += [
            {
                "method": method.name,
                "family": family(method),
                **setting,
                **_judged_fields(recipe, method.judged),
                **of_limit,
                **comparison_fields(method.against_limit),
                "above_bayes": method.above_limit,
                "origin": method.origin or "this run",
            }
            for method in result.methods
        ]
    return rows


def trust_document(results: Sequence[CellResult]) -> dict[str, Any]:
    """The figures on trust of the one setting that has them, and that setting."""
    reference = next(result for result in results if result.trust is not None)
    return {**reference.cell.as_json(), **(reference.trust or {})}


def family(method: MethodResult) -> str:
    """Family of a method: threshold, scikit-learn, torch, own or peer."""
    return "peer" if method.origin else find_method(method.name).family


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
