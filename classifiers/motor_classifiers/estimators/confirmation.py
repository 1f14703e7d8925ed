"""The filter's confirmation by thresholds (paper, Figure 1) as an estimator."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import (
    fitting_recipe,
    flat_cases,
    labelled_cases,
    severities_of,
    with_channels,
)
from motor_env.detection.confirmation import ThresholdConfirmation
from motor_env.motor.faults import HEALTHY
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe


class ConfirmationClassifier(ClassifierMixin, BaseEstimator):
    """`motor_env.detection.confirmation.ThresholdConfirmation` behind scikit-learn's interface.

    Args:
        recipe: whose filters compare. Without one, the mean training case of each class stands in for its filter's
            prediction, and the class `healthy`, or else the first one, is the one to be left.
        false_alarm_rate: share of healthy cases that may alarm; by default the threshold with most correct
            decisions on the training cases.

    Attributes:
        classes_: labels.
        rule_: the tuned rule.
        templates_: mean training cases, shape (n_classes, n_features_in_); None with a recipe.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(self, recipe: Recipe | None = None, false_alarm_rate: float | None = None) -> None:
        self.recipe = recipe
        self.false_alarm_rate = false_alarm_rate

    def fit(self, X: Any, y: Any) -> Self:
        """Tune windows, M, N, threshold and weights.

        Raises:
            ValueError: labels that the recipe does not know, no healthy case, or shapes that do not fit.
        """
        flat, labels = labelled_cases(self, X, y)
        if self.recipe is None:
            healthy = self.classes_.tolist().index(HEALTHY) if HEALTHY in self.classes_ else 0
            self.templates_: FloatArray | None = np.stack(
                [flat[labels == n].mean(axis=0) for n in range(len(self.classes_))]
            )
            self.rule_ = ThresholdConfirmation.tune_on_residuals(
                self._from_templates(flat), labels, healthy, false_alarm_rate=self.false_alarm_rate
            )
            return self
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        severities_of(recipe, self.classes_)
        self.templates_ = None
        self.rule_ = ThresholdConfirmation.tune(
            recipe,
            with_channels(flat, recipe),
            self._recipe_index()[labels],
            false_alarm_rate=self.false_alarm_rate,
        )
        return self

    def predict_proba(self, X: Any) -> FloatArray:
        """Probability of each class, shape (n_cases, n_classes).

        Near its threshold the rule's decision and its graded probabilities can disagree: then the decision's class and
        the most probable one change places, so that `predict` is the rule and the largest probability alike.
        """
        check_is_fitted(self)
        flat = flat_cases(self, X, reset=False)
        if self.recipe is None:
            result = self.rule_.decide_on_residuals(self._from_templates(flat))
            columns = np.arange(len(self.classes_))
        else:
            recipe = fitting_recipe(self.recipe, flat.shape[1])
            result = self.rule_.decide(with_channels(flat, recipe), recipe.nominal_voltage_v)
            columns = self._recipe_index()
        graded = result.probabilities.copy()
        rows = np.arange(len(flat))
        largest = graded.argmax(axis=1)
        top = graded[rows, largest].copy()
        graded[rows, largest] = graded[rows, result.class_index]
        graded[rows, result.class_index] = top
        chosen = graded[:, columns]
        probabilities: FloatArray = chosen / chosen.sum(axis=1, keepdims=True)
        return probabilities

    def predict(self, X: Any) -> NDArray[Any]:
        """The rule's decision, shape (n_cases,)."""
        most = self.predict_proba(X).argmax(axis=1)
        decided: NDArray[Any] = self.classes_[most]
        return decided

    def _from_templates(self, flat: FloatArray) -> FloatArray:
        residual: FloatArray = (flat - np.asarray(self.templates_)[:, None])[..., None]
        return residual

    def _recipe_index(self) -> NDArray[np.int64]:
        names = list(self.recipe.class_names) if self.recipe is not None else []
        return np.array([names.index(str(name)) for name in self.classes_])
