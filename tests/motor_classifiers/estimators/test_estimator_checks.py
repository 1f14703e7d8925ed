"""scikit-learn's own checks over every estimator, and what all of them must do with transients.

Skipped: check_array_api_input, for which scikit-learn wants SCIPY_ARRAY_API set; our estimators take NumPy arrays only.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sklearn.base import BaseEstimator, clone
from sklearn.utils.estimator_checks import parametrize_with_checks

from motor_classifiers import (
    ConformalClassifier,
    EarlyClassifier,
    OutsideDetector,
    PerceptronClassifier,
    PhysicalFeatures,
    PosteriorNetwork,
    ResidualProjection,
    ResNetClassifier,
    RuleStatistics,
    ThresholdConfirmationClassifier,
    TorchClassifier,
)
from motor_classifiers.estimators.reference_starts import RecentredStarts

ESTIMATORS = [
    ThresholdConfirmationClassifier(),
    ConformalClassifier(),
    EarlyClassifier(),
    OutsideDetector(),
    PerceptronClassifier(epochs=10),
    ResNetClassifier(epochs=6, stem=4, width=8),
    TorchClassifier(epochs=20),
    PosteriorNetwork(steps=40, batch_size=32, n_hidden=32),
    PhysicalFeatures(),
    ResidualProjection(),
    RecentredStarts(),
    RuleStatistics(),
]


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks(ESTIMATORS)  # type: ignore[untyped-decorator]  # scikit-learn has no types
def test_scikit_learn_checks(estimator: BaseEstimator, check: Callable[[Any], None]) -> None:
    check(estimator)


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: type(e).__name__)
def test_flattened_transients_are_the_same(estimator: BaseEstimator) -> None:
    rng = np.random.default_rng(3)
    labels = np.repeat(["healthy", "worn"], 20)
    X = rng.normal(size=(40, 2, 15)).astype(np.float32)
    X[20:] += 1.0
    before = X.copy()
    methods = ("transform", "predict_proba", "decision_function")
    method = next(name for name in methods if hasattr(estimator, name))
    if hasattr(estimator, "random_state"):
        estimator = clone(estimator).set_params(random_state=5)
    cubic = getattr(clone(estimator).fit(X, labels), method)(X)
    flat = getattr(clone(estimator).fit(X.reshape(40, -1), labels), method)(X.reshape(40, -1))
    np.testing.assert_array_equal(cubic, flat)
    np.testing.assert_array_equal(X, before)
