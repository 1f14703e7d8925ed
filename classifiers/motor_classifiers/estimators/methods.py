"""The methods of the benchmark by name, each an estimator for a recipe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

from motor_classifiers.estimators.confirmation import ThresholdConfirmationClassifier
from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection
from motor_classifiers.estimators.networks.perceptron import PerceptronClassifier
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.networks.resnet import ResNetClassifier
from motor_classifiers.estimators.rule_statistics import RuleStatistics
from motor_env.simulation.recipes import Recipe

Make = Callable[[Recipe, int], BaseEstimator]


@dataclass(frozen=True, slots=True)
class Method:
    """One method.

    Attributes:
        name: as on the command line.
        family: threshold, scikit-learn or torch.
        title: what it is, for a person.
        make: estimator for a recipe and a random state.
        seconds: about what training and judging 2,000 starts each at 10 kHz takes on one core, for progress bars.
        from_stream: whether it draws its own training starts from the recipe without end.
    """

    name: str
    family: str
    title: str
    make: Make
    seconds: float
    from_stream: bool = False

    def train(self, model: BaseEstimator, X: Any, y: Any) -> BaseEstimator:
        """Fit an estimator of this method: on the recipe's stream where it has one, else on the given cases."""
        return model.fit_stream() if self.from_stream else model.fit(X, y)


def _physical(recipe: Recipe) -> FeatureUnion:
    return FeatureUnion([("physical", PhysicalFeatures(recipe)), ("residual", ResidualProjection(recipe, 6))])


def _pipeline(*steps: tuple[str, BaseEstimator]) -> Pipeline:
    return Pipeline(list(steps))


def _boosting(seed: int) -> BaseEstimator:
    """Shallow trees; alone they are far too sure of themselves (docs/classifiers.md)."""
    trees = HistGradientBoostingClassifier(
        learning_rate=0.03, max_iter=150, max_leaf_nodes=7, min_samples_leaf=10, random_state=seed
    )
    return CalibratedClassifierCV(trees, method="temperature", cv=3, ensemble=False)


ESTIMATE = "posterior-network"
"""The method that stands for the limit where the likelihood has no closed form."""

METHODS = {
    method.name: method
    for method in (
        Method(
            "threshold",
            "threshold",
            "Confirmation by thresholds: Kalman residual, M of N, bank of fault filters",
            lambda recipe, seed: ThresholdConfirmationClassifier(recipe),
            4.0,
        ),
        Method(
            "rules",
            "threshold",
            "Statistics of the decision rules and matched tests, logistic regression for their thresholds",
            lambda recipe, seed: _pipeline(
                ("features", RuleStatistics(recipe)),
                ("scale", StandardScaler()),
                ("classify", LogisticRegression(C=100.0, max_iter=5000)),
            ),
            3.0,
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
            5.0,
        ),
        Method(
            "physical-logistic",
            "scikit-learn",
            "Fitted motor parameters and residual, logistic regression",
            lambda recipe, seed: _pipeline(
                ("features", _physical(recipe)),
                ("scale", StandardScaler()),
                ("classify", LogisticRegression(max_iter=1000)),
            ),
            5.0,
        ),
        Method(
            "physical-svm",
            "scikit-learn",
            "Fitted motor parameters and residual, support vector machine, probabilities by Platt's method",
            lambda recipe, seed: _pipeline(
                ("features", _physical(recipe)),
                ("scale", StandardScaler()),
                ("classify", CalibratedClassifierCV(SVC(), method="sigmoid", cv=5, ensemble=False)),
            ),
            6.0,
        ),
        Method(
            "physical-boosting",
            "scikit-learn",
            "Fitted motor parameters and residual, gradient boosting with temperature",
            lambda recipe, seed: _pipeline(
                ("features", _physical(recipe)),
                ("classify", _boosting(seed)),
            ),
            15.0,
        ),
        Method(
            "physical-forest",
            "scikit-learn",
            "Fitted motor parameters and residual, random forest",
            lambda recipe, seed: _pipeline(
                ("features", _physical(recipe)),
                ("classify", RandomForestClassifier(200, min_samples_leaf=3, random_state=seed)),
            ),
            6.0,
        ),
        Method(
            "residual-qda",
            "scikit-learn",
            "Kalman residual along the signal's directions, quadratic discriminant analysis",
            lambda recipe, seed: _pipeline(
                ("features", ResidualProjection(recipe, 6)),
                ("scale", PCA(whiten=True)),  # field effects move all directions together
                # Without tolerances a class has a millionth of the variance of all; that is no lack of rank.
                ("classify", QuadraticDiscriminantAnalysis(tol=1e-12)),
            ),
            1.0,
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
            2.0,
        ),
        Method(
            "network",
            "torch",
            "Kalman residual along the signal's directions, perceptron",
            lambda recipe, seed: PerceptronClassifier(recipe, random_state=seed),
            6.0,
        ),
        Method(
            ESTIMATE,
            "torch",
            "Amortised posterior: a perceptron that learns from an endless stream of the recipe's own starts",
            lambda recipe, seed: PosteriorNetwork(recipe, random_state=seed),
            30.0,
            from_stream=True,
        ),
        Method(
            "residual-network",
            "torch",
            "Raw waveform, convolutional residual network that knows nothing of motors",
            lambda recipe, seed: ResNetClassifier(recipe, random_state=seed),
            30.0,
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
