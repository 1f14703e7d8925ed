"""What a pipeline from a file may hold: types that are trusted by name, and trees and vectors that are what they say.

Compiled code follows a tree's children and counts support vectors without looking: a poisoned one would read beside the
arrays.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.pipeline import Pipeline
from sklearn.svm import SVC

from motor_env.motor.parameters import require

TRUSTED = (
    "motor_classifiers.estimators.features.PhysicalFeatures",
    "motor_classifiers.estimators.features.ResidualProjection",
    "motor_classifiers.estimators.reference_starts.RecentredStarts",
    "motor_classifiers.estimators.rule_statistics.RuleStatistics",
    "sklearn.calibration._CalibratedClassifier",
    "sklearn.calibration._SigmoidCalibration",
    "sklearn.calibration._TemperatureScaling",
    "sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor",
    "sklearn.tree._tree.Tree",
)
"""Types beyond those that skops trusts by itself."""


def check_pipeline(model: Pipeline) -> None:
    """Check what compiled code will believe.

    Raises:
        ValueError: a tree or a support vector machine whose parts do not fit.
    """
    for estimator in _estimators(model.steps[-1][1]):
        if isinstance(estimator, RandomForestClassifier):
            for grown in estimator.estimators_:
                tree = grown.tree_
                inner = tree.children_left != -1
                _check_tree(inner, tree.children_left, tree.children_right, tree.feature, tree.n_features)
        elif isinstance(estimator, HistGradientBoostingClassifier):
            for predictor in (tree for round_ in estimator._predictors for tree in round_):  # noqa: SLF001  # no public way
                nodes = predictor.nodes
                inner = nodes["is_leaf"] == 0
                width = estimator.n_features_in_
                _check_tree(inner, nodes["left"], nodes["right"], nodes["feature_idx"], width)
                require(not nodes["is_categorical"].any(), "a tree asks for a category")
        elif isinstance(estimator, SVC):
            _check_vectors(estimator)


def _estimators(final: BaseEstimator) -> Iterator[BaseEstimator]:
    if isinstance(final, CalibratedClassifierCV):
        for calibrated in final.calibrated_classifiers_:
            yield calibrated.estimator
    else:
        yield final


def _check_tree(
    inner: NDArray[np.bool_], left: NDArray[Any], right: NDArray[Any], feature: NDArray[Any], n_features: int
) -> None:
    nodes = np.arange(len(inner))
    require(len(inner) > 0, "a tree has no node")
    for child in (left[inner].astype(np.int64), right[inner].astype(np.int64)):
        later = (child > nodes[inner]) & (child < len(inner))
        require(bool(later.all()), "a tree has a child that does not exist")
    asked = feature[inner]
    require(bool(((asked >= 0) & (asked < n_features)).all()), "a tree asks for no feature")


def _check_vectors(machine: SVC) -> None:
    n_classes, n_vectors = len(machine.classes_), len(machine.support_vectors_)
    counts = machine._n_support  # noqa: SLF001  # what libsvm is given
    require(
        machine.support_vectors_.shape == (n_vectors, machine.n_features_in_)
        and counts.shape == (n_classes,)
        and bool((counts >= 0).all())
        and int(counts.sum()) == n_vectors == len(machine.support_)
        and machine._dual_coef_.shape == (n_classes - 1, n_vectors)
        and machine._intercept_.shape == (n_classes * (n_classes - 1) // 2,),
        "the parts of its support vector machine do not fit each other",
    )
