"""Base of classifiers around another one."""

from __future__ import annotations

from typing import Any

from sklearn.base import BaseEstimator, MetaEstimatorMixin, clone
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LogisticRegression
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import ProbabilityClassifier, flat_cases
from motor_env.motor.parameters import FloatArray, require


class ClassifierWrapper(MetaEstimatorMixin, ProbabilityClassifier):
    """Classifier around another one, `estimator`, fitted as `estimator_`; a logistic regression by default."""

    estimator: Any
    estimator_: BaseEstimator

    @property
    def wrapped_model(self) -> BaseEstimator:
        """The fitted model inside."""
        inner = self.estimator_
        return inner.estimator if isinstance(inner, FrozenEstimator) else inner

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the inner model's probability of each class, shape (n_cases, n_classes)."""
        check_is_fitted(self)
        probabilities: FloatArray = self.estimator_.predict_proba(flat_cases(self, X, reset=False))
        return probabilities

    def _take_over(self, fitted: BaseEstimator) -> None:
        self.estimator_, self.classes_, self.n_features_in_ = fitted, fitted.classes_, fitted.n_features_in_


def unfitted(estimator: BaseEstimator | None) -> BaseEstimator:
    """Return an unfitted copy of a wrapper's classifier; a logistic regression without one."""
    return LogisticRegression(max_iter=1000) if estimator is None else clone(estimator)


def innermost(model: BaseEstimator) -> BaseEstimator:
    """Return the fitted model inside all wrappers."""
    while isinstance(model, ClassifierWrapper):
        model = model.wrapped_model
    return model


def check_share(name: str, value: Any) -> None:
    """Raise `ValueError` unless a value of a file is a number between 0 and 1."""
    inside = isinstance(value, float) and 0.0 < value < 1.0
    require(inside, f"{name} must lie between 0 and 1, got {value!r}")
