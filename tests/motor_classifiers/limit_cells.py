"""A posterior network beside the exact posterior, for the tests of networks."""

from typing import Any

import numpy as np

from motor_classifiers import PosteriorNetwork

# Reaches in: a network's scores are the benchmark's, one by one; public are only whole evaluations.
from motor_classifiers.scoring.calibration import calibration_scores
from motor_classifiers.scoring.judging import in_recipe_order
from motor_classifiers.scoring.metrics import IntArray
from motor_classifiers.scoring.trust import severity_figures
from motor_datasets import generate_arrays
from motor_env import Recipe, class_probabilities, excess_over_limit
from motor_env.motor.parameters import FloatArray

FIRST_CASE = 1_000_000_000

Row = dict[str, Any]


def _scores(prefix: str, probabilities: FloatArray, truth: IntArray) -> Row:
    scored = calibration_scores(probabilities, truth)
    return {f"{prefix}{name}": getattr(scored, name) for name in ("log_loss", "ece")}


def limit_cell(model: PosteriorNetwork, recipe: Recipe, n_cases: int, n_severities: int = 0) -> Row:
    """Judge a model on fresh cases of a recipe, beside the exact posterior on the same cases.

    Args:
        model: fitted; it may have been trained for another noise than the recipe's.
        recipe: what the cases are drawn from; its likelihood must be known (no `field`).
        n_cases: test cases for the classes.
        n_severities: test cases for the severities of each kind.
    """
    seed = 4
    test = generate_arrays(recipe, seed, np.arange(n_cases) + FIRST_CASE)
    limit = class_probabilities(recipe, test.X)
    own = in_recipe_order(model, model.predict_proba(test.X), recipe)
    above = excess_over_limit(limit, test.class_index, own.argmax(axis=1))
    severities: Row = {}
    for prior in model.severity_priors_ if n_severities > 0 else ():
        judged = severity_figures(model, recipe, prior, seed, n_severities)
        beside = {f"limit_{name}": value for name, value in judged["limit"].items()}
        severities[str(prior.kind)] = {**judged["network"], **beside}
    return {
        **_scores("", own, test.class_index),
        **_scores("limit_", limit, test.class_index),
        "excess": above.excess,
        "excess_standard_error": above.standard_error,
        "severities": severities,
    }
