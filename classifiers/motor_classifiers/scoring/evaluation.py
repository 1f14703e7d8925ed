"""A fitted model judged on a data set, beside the Bayes limit on the same cases."""

from __future__ import annotations

from typing import Any

from sklearn.base import BaseEstimator

from motor_classifiers.estimators.own_methods import answered
from motor_classifiers.scoring.calibration import calibration_scores
from motor_classifiers.scoring.judging import best_probabilities, expected_severity, in_recipe_order
from motor_classifiers.scoring.metrics import compare, resampling_weights, root_mean_square, scores
from motor_classifiers.scoring.results import SCORES, comparison_fields, score_fields
from motor_datasets.arrays import Dataset
from motor_env.errors import InputError
from motor_env.simulation.recipes import Recipe


def evaluate_model(model: BaseEstimator, recipe: Recipe, test: Dataset, seed: int) -> dict[str, Any]:
    """Scores of a fitted model on a data set, beside the Bayes limit for the recipe that the cases came from.

    Raises:
        InputError: the data set has other channels or another time axis than the model's recipe, or a class that it
            does not know.
    """
    theirs = test.recipe
    if (theirs.timing, theirs.channels) != (recipe.timing, recipe.channels):
        raise InputError("the data set has another time axis or other channels than the model was trained on")
    if theirs.class_names != recipe.class_names:
        raise InputError(
            f"the data set has the classes {', '.join(theirs.class_names)}, the model {', '.join(recipe.class_names)}"
        )
    weights = resampling_weights(len(test), seed, groups=test.motor_id)
    probabilities = in_recipe_order(model, answered(model, test.X), recipe)
    limit = best_probabilities(theirs, test.X)
    right = limit.argmax(axis=1) == test.class_index
    decided = probabilities.argmax(axis=1)
    calibration = calibration_scores(probabilities, test.class_index)
    severity_error = expected_severity(recipe, probabilities) - test.severity
    return {
        "n_test": len(test),
        **score_fields(recipe, scores(recipe, test.class_index, decided, weights)),
        "severity_rmse": root_mean_square(severity_error, weights).value,
        "log_loss": calibration.log_loss,
        "ece": calibration.ece,
        "bayes_accuracy": float(right.mean()),
        "bayes_log_loss": calibration_scores(limit, test.class_index).log_loss,
        "bayes_is_estimate": theirs.field is not None,
        **comparison_fields(compare(decided == test.class_index, right, weights)),
    }


def evaluation_lines(recipe: Recipe, scored: dict[str, Any]) -> list[str]:
    """What `evaluate_model` found, for a terminal: scores, the check against the limit, the confusion matrix."""
    lines = []
    for name in SCORES:
        if scored[name] is not None:
            low, high = scored[f"{name}_low"], scored[f"{name}_high"]
            lines.append(f"  {name.replace('_', ' '):22} {scored[name]:7.4f}   {low:.4f} to {high:.4f}")
    kind = "its estimate" if scored["bayes_is_estimate"] else "Bayes limit"
    lines.append(f"  {kind + ' accuracy':22} {scored['bayes_accuracy']:7.4f}   on the same cases")
    below = [100.0 * scored[name] for name in ("below_bayes", "below_bayes_low", "below_bayes_high")]
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
