"""The posterior over the classes of motors at work, from a fit, put right by the exact likelihood.

Around its fit a motor is nearly linear: given a class, its other coordinates are normal, and cut to their box. A few
draws from there are simulated exactly and weighted by what the linear motor has wrong (importance sampling). How many
draws count says when not to believe the result.
"""

from __future__ import annotations

import numpy as np
from scipy.special import softmax

from motor_env.inference.class_model import ClassModel
from motor_env.inference.field_posterior import Effort, Linear, linearised, sampled_evidence
from motor_env.inference.work_features import WorkFit, work_fit
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

_QUICK = Effort(draws=24, most_rounds=4, enough=8.0)
_HOPELESS = 3.5  # log ratio to the best class beyond which a class is not sampled
_OF_FIT = 4.0  # effective draws that the fit's own log probability is worth
_INSIDE = 0.02  # distance from the box at which the motor is made linear


def refined_probabilities(
    recipe: Recipe, cases: FloatArray, rng: np.random.Generator, effort: Effort = _QUICK
) -> tuple[FloatArray, FloatArray]:
    """Posterior of each class, and the effective number of draws behind it (Kish 1965), both (n_cases, n_classes).

    A case of which the fit is sure is left to the fit; such classes have no draws. Below 8 effective draws do not
    believe a probability.

    Args:
        recipe: one with a table `duty` and faults that change the motor.
        cases: shape (n_cases, n_channels, n_samples), the applied voltage last.
        rng: of the draws.
        effort: for each class that is not out of the question.
    """
    fitted = work_fit(recipe, cases)
    logs, effective = fitted.log_probability.copy(), np.zeros_like(fitted.log_probability)
    for n, case in enumerate(cases):
        likely = np.flatnonzero(logs[n] > logs[n].max() - _HOPELESS)
        if len(likely) > 1:
            begun = [_begun(recipe, fitted, n, index, case) for index in likely]
            found = np.array([sampled_evidence(*each, rng, effort=effort) for each in begun])
            effective[n, likely] = found[:, 1]
            sampled = found[:, 0] + np.log(recipe.class_probabilities[likely])
            # Both are known up to a constant of the case; the fit's counts as so many draws more.
            share = found[:, 1] / (found[:, 1] + _OF_FIT)
            offset = np.average(sampled - logs[n, likely], weights=np.exp(logs[n, likely]))
            logs[n, likely] += share * (sampled - offset - logs[n, likely])
    probabilities: FloatArray = softmax(logs, axis=1)
    return probabilities, effective


def _begun(
    recipe: Recipe, fitted: WorkFit, n: int, index: np.intp, case: FloatArray
) -> tuple[ClassModel, FloatArray, Linear]:
    """A class, what was measured, and the motor made linear where the fit of all severities puts the class."""
    model = ClassModel(recipe, recipe.classes[index], case[-1])
    n_kinds = fitted.positions.shape[1]
    rest, kinds = slice(None, -n_kinds), slice(-n_kinds, None)
    precision = np.linalg.inv(fitted.covariance[n])
    away = fitted.positions[index] - fitted.values[n, kinds]
    at = fitted.values[n, rest] - np.linalg.solve(precision[rest, rest], precision[rest, kinds] @ away)
    low, high = model.box
    measured = case[:-1].reshape(-1)
    return model, measured, linearised(model, measured, np.clip(at, low + _INSIDE, high - _INSIDE))
