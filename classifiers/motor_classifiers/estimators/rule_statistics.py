"""The decision rules' statistics as features: with a classifier behind them their thresholds are learned from cases."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, with_channels
from motor_classifiers.estimators.features import affine_map
from motor_env.detection.rules import Cusum, Rule, nis_rule
from motor_env.detection.rules.tolerant import TolerantFilter
from motor_env.inference.whitening import MatchedTest
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

# Of the CUSUMs, in standard deviations of the noise: between a bearing of 10 % and of 25 % at 20 mA.
_SHIFT = 0.2
_AT_ONCE = 512  # cases filtered at a time
_RULES: dict[str, Rule] = {"nis": nis_rule(), "cusum": Cusum(_SHIFT, two_sided=True)}


class RuleStatistics(TransformerMixin, BaseEstimator):
    """Statistics of the decision rules over a whole transient, and a matched test for each fault of the recipe.

    The largest NIS, the largest CUSUM, and the mean NIS (the test of consistency, Bar-Shalom, Li & Kirubarajan 2001,
    ch. 5.4) as logarithms, log(1 + x): a winding fault makes them thousands of times those of a healthy motor. All see
    the residual whitened for the recipe's tolerances, so that healthy motors give the same distribution whatever the
    recipe. A linear classifier on the matched tests is the bank of filters to first order in the tolerances.

    Args:
        recipe: nominal motor, tolerances, faults, sensor and timing; without one, the paper's motor at 10 kHz.

    Attributes:
        weights_: of the matched tests, which are affine in what is measured, shape (n_tests, n_features_in_).
        offset_: shape (n_tests,).
        feature_names_: names of the columns.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(self, recipe: Recipe | None = None) -> None:
        self.recipe = recipe

    def fit(self, X: Any, y: Any = None) -> Self:
        """Prepare the tests; there is nothing to learn from the cases."""
        flat = flat_cases(self, X, reset=True, min_features=2)
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        single = [
            c for c in recipe.classes if len(c.faults) == 1 and c.kind is not None and c.kind.motor_powers
        ]
        tests = [MatchedTest.from_recipe(recipe, c.faults[0]) for c in single]
        self.weights_, self.offset_ = affine_map(
            recipe,
            lambda measured: np.column_stack(
                [np.empty((len(measured), 0)), *(t.statistic(measured) for t in tests)]
            ),
        )
        self.feature_names_ = [*_RULES, "mean_nis", *(f"matched_{c.name}" for c in single)]
        return self

    def transform(self, X: Any) -> FloatArray:
        """Statistics of each case, shape (n_cases, n_statistics)."""
        check_is_fitted(self)
        flat = flat_cases(self, X, reset=False)
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        measured = with_channels(flat, recipe)
        begins = range(0, len(flat), _AT_ONCE)
        levels = np.concatenate([_levels(recipe, measured[begin : begin + _AT_ONCE]) for begin in begins])
        return np.column_stack([levels, flat @ self.weights_.T + self.offset_])

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Names of the columns."""
        check_is_fitted(self)
        return np.array(self.feature_names_, dtype=object)


def _levels(recipe: Recipe, measured: FloatArray) -> FloatArray:
    """Logarithms of the rules' largest statistics and of the mean NIS, shape (n_cases, n_rules + 1)."""
    white = _filter(recipe).white(measured)
    largest = [rule.statistic(white).max(axis=-1) for rule in _RULES.values()]
    levels: FloatArray = np.log1p([*largest, np.square(white).mean(axis=(1, 2))]).T
    return levels


@lru_cache(maxsize=4)
def _filter(recipe: Recipe) -> TolerantFilter:
    """Filter and whitening: all of it follows from the recipe, so no model holds it."""
    return TolerantFilter.from_recipe(recipe)
