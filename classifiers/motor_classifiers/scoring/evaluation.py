"""A fitted model judged on a data set, beside the Bayes limit on the same cases."""

from __future__ import annotations

from typing import Any

from sklearn.base import BaseEstimator

from motor_classifiers.scoring.judging import Answer, answer_of
from motor_classifiers.scoring.progress import Cost
from motor_classifiers.scoring.results import SCORES, comparison_fields, limit_fields, score_fields
from motor_classifiers.scoring.score import score_classes
from motor_classifiers.scoring.task import GivenTask
from motor_datasets.arrays import Dataset
from motor_env.common.errors import InputError
from motor_env.simulation.recipes import Recipe

_UNTOLD = Cost(0.0, None)  # what answers took is not asked


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
    task = GivenTask(theirs.name, "a data set", len(test), recipe=theirs, seed=seed, given=test)
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
    """What `evaluate_model` found, for a terminal: scores, the check against the limit, the confusion matrix."""
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
