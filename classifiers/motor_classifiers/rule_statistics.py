"""The decision rules' statistics as features: with a classifier behind them their thresholds are learned from cases."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.cases import fitting_recipe, flat_cases, with_channels
from motor_env.faults import FaultKind
from motor_env.marginal import MatchedTest
from motor_env.parameters import FloatArray
from motor_env.recipes import Recipe
from motor_env.rules import Cusum, Rule, nis_rule
from motor_env.rules.tolerant import TolerantFilter

_SHIFT = (
    0.2  # of the CUSUMs, in standard deviations of the noise: between a bearing of 10 % and of 25 % at 20 mA
)
_RULES: dict[str, Rule] = {"nis": nis_rule(), "cusum": Cusum(_SHIFT, two_sided=True)}


class RuleStatistics(TransformerMixin, BaseEstimator):
    """Largest statistic over the transient of a NIS rule and a CUSUM, and a matched test for each fault of the recipe.

    All see the residual whitened for the recipe's tolerances, so that healthy motors give the same distribution
    whatever the recipe. A linear classifier on the matched tests is the bank of filters to first order in the
    tolerances.

    Args:
        recipe: nominal motor, tolerances, faults, sensor and timing; without one, the paper's motor at 10 kHz.

    Attributes:
        filter_: filter and whitening.
        tests_: `MatchedTest` of each class with one constant fault of the motor.
        feature_names_: names of the columns.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(self, recipe: Recipe | None = None) -> None:
        self.recipe = recipe

    def fit(self, X: Any, y: Any = None) -> Self:
        """Prepare filter and tests; there is nothing to learn from the cases."""
        flat = flat_cases(self, X, reset=True, min_features=2)
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        self.filter_ = TolerantFilter.of(recipe)
        single = [c for c in recipe.classes if len(c.faults) == 1 and c.kind is not FaultKind.NOISE]
        self.tests_ = [MatchedTest.of(recipe, c.faults[0]) for c in single]
        self.feature_names_ = (*_RULES, *(f"matched_{c.name}" for c in single))
        return self

    def transform(self, X: Any) -> FloatArray:
        """Statistics of each case, shape (n_cases, n_statistics)."""
        check_is_fitted(self)
        flat = flat_cases(self, X, reset=False)
        measured = with_channels(flat, fitting_recipe(self.recipe, flat.shape[1]))
        white = self.filter_.white(measured)
        largest = [rule.statistic(white).max(axis=-1) for rule in _RULES.values()]
        return np.column_stack([*largest, *(test.statistic(measured) for test in self.tests_)])

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Names of the columns."""
        check_is_fitted(self)
        return np.array(self.feature_names_, dtype=object)
