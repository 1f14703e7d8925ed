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


def _chain(
    features: Callable[[Recipe], BaseEstimator], *steps: tuple[str, Callable[[int], BaseEstimator]]
) -> Make:
    """A pipeline of features for a recipe, and of steps for a random state."""

    def make(recipe: Recipe, seed: int) -> BaseEstimator:
        return Pipeline([("features", features(recipe)), *((name, step(seed)) for name, step in steps)])

    return make


def _physical_and_residual(recipe: Recipe) -> FeatureUnion:
    return FeatureUnion([("physical", PhysicalFeatures(recipe)), ("residual", ResidualProjection(recipe, 6))])


def _boosting(seed: int) -> BaseEstimator:
    """Shallow trees; alone they are far too sure of themselves (docs/classifiers.md)."""
    trees = HistGradientBoostingClassifier(
        learning_rate=0.03, max_iter=150, max_leaf_nodes=7, min_samples_leaf=10, random_state=seed
    )
    return CalibratedClassifierCV(trees, method="temperature", cv=3, ensemble=False)


def _platt(seed: int) -> BaseEstimator:
    return CalibratedClassifierCV(SVC(), method="sigmoid", cv=5, ensemble=False)


_SCALE = ("scale", lambda seed: StandardScaler())
_LOGISTIC = ("classify", lambda seed: LogisticRegression(max_iter=1000))

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
            _chain(
                RuleStatistics, _SCALE, ("classify", lambda seed: LogisticRegression(C=100.0, max_iter=5000))
            ),
            3.0,
        ),
        Method(
            "physical-lda",
            "scikit-learn",
            "Fitted motor parameters, linear discriminant analysis",
            _chain(PhysicalFeatures, _SCALE, ("classify", lambda seed: LinearDiscriminantAnalysis())),
            5.0,
        ),
        Method(
            "physical-logistic",
            "scikit-learn",
            "Fitted motor parameters and residual, logistic regression",
            _chain(_physical_and_residual, _SCALE, _LOGISTIC),
            5.0,
        ),
        Method(
            "physical-svm",
            "scikit-learn",
            "Fitted motor parameters and residual, support vector machine, probabilities by Platt's method",
            _chain(_physical_and_residual, _SCALE, ("classify", _platt)),
            6.0,
        ),
        Method(
            "physical-boosting",
            "scikit-learn",
            "Fitted motor parameters and residual, gradient boosting with temperature",
            _chain(_physical_and_residual, ("classify", _boosting)),
            15.0,
        ),
        Method(
            "physical-forest",
            "scikit-learn",
            "Fitted motor parameters and residual, random forest",
            _chain(
                _physical_and_residual,
                ("classify", lambda seed: RandomForestClassifier(200, min_samples_leaf=3, random_state=seed)),
            ),
            6.0,
        ),
        Method(
            "residual-qda",
            "scikit-learn",
            "Kalman residual along the signal's directions, quadratic discriminant analysis",
            _chain(
                lambda recipe: ResidualProjection(recipe, 6),
                ("scale", lambda seed: PCA(whiten=True)),  # field effects move all directions together
                # Without tolerances a class has a millionth of the variance of all; that is no lack of rank.
                ("classify", lambda seed: QuadraticDiscriminantAnalysis(tol=1e-12)),
            ),
            1.0,
        ),
        Method(
            "raw-logistic",
            "scikit-learn",
            "Raw waveform in 20 principal components, logistic regression",
            _chain(lambda recipe: ResidualProjection(None, 20), _SCALE, _LOGISTIC),
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
