"""The methods of the benchmark by name, each an estimator for a recipe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sklearn.base import BaseEstimator
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import StandardScaler

from motor_classifiers.features import PhysicalFeatures, ResidualProjection
from motor_classifiers.networks import NetworkClassifier
from motor_classifiers.threshold import ConfirmationClassifier
from motor_env.recipes import Recipe

Make = Callable[[Recipe, int], BaseEstimator]


@dataclass(frozen=True, slots=True)
class Method:
    """One method.

    Attributes:
        name: as on the command line.
        family: threshold, scikit-learn or torch.
        title: what it is, for a person.
        make: estimator for a recipe and a random state.
    """

    name: str
    family: str
    title: str
    make: Make


def _physical(recipe: Recipe) -> FeatureUnion:
    return FeatureUnion([("physical", PhysicalFeatures(recipe)), ("residual", ResidualProjection(recipe, 6))])


def _pipeline(*steps: tuple[str, BaseEstimator]) -> Pipeline:
    return Pipeline(list(steps))


METHODS = {
    method.name: method
    for method in (
        Method(
            "threshold",
            "threshold",
            "Confirmation by thresholds: Kalman residual, M of N, bank of fault filters",
            lambda recipe, seed: ConfirmationClassifier(recipe),
        ),
        Method(
            "physical-lda",
            "scikit-learn",
            "Fitted motor parameters, linear discriminant analysis",
            lambda recipe, seed: _pipeline(
                ("features", PhysicalFeatures(recipe)),
                ("scale", StandardScaler()),
                ("classify", LinearDiscriminantAnalysis()),
            ),
        ),
        Method(
            "physical-forest",
            "scikit-learn",
            "Fitted motor parameters and residual, random forest",
            lambda recipe, seed: _pipeline(
                ("features", _physical(recipe)),
                ("classify", RandomForestClassifier(200, min_samples_leaf=3, random_state=seed)),
            ),
        ),
        Method(
            "residual-qda",
            "scikit-learn",
            "Kalman residual along the signal's directions, quadratic discriminant analysis",
            lambda recipe, seed: _pipeline(
                ("features", ResidualProjection(recipe, 6)),
                ("scale", StandardScaler()),
                ("classify", QuadraticDiscriminantAnalysis()),
            ),
        ),
        Method(
            "raw-logistic",
            "scikit-learn",
            "Raw waveform in 20 principal components, logistic regression",
            lambda recipe, seed: _pipeline(
                ("reduce", ResidualProjection(None, 20)),
                ("scale", StandardScaler()),
                ("classify", LogisticRegression(max_iter=1000)),
            ),
        ),
        Method(
            "network",
            "torch",
            "Kalman residual along the signal's directions, perceptron",
            lambda recipe, seed: NetworkClassifier(recipe, random_state=seed),
        ),
    )
}
"""Every method by name, in the order of the tables."""


def make_method(name: str, recipe: Recipe, random_state: int) -> BaseEstimator:
    """Unfitted estimator of a method.

    Raises:
        ValueError: no such method; the sentence lists those that exist.
    """
    if name not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {name!r}")
    return METHODS[name].make(recipe, random_state)
