"""Methods by name, each an estimator for a recipe: built-in ones and plugins (`FILE.py:NAME`, entry points)."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC
from sklearn.utils import get_tags

from motor_classifiers.estimators.confirmation import ThresholdConfirmationClassifier
from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection, RuleStatistics
from motor_classifiers.estimators.networks.epoch_classifier import PerceptronClassifier, ResNetClassifier
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_env.common.arrays import instance, is_one_of, shown, whole
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_NOTE_BYTES, read_file
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

Make = Callable[[Recipe, int], BaseEstimator]


@dataclass(frozen=True, slots=True)
class Method:
    """Method of classification.

    Attributes:
        name: as on the command line.
        family: threshold, scikit-learn, torch or own.
        title: description.
        make: estimator for a recipe and a random state.
        seconds: rough time for 2,000 starts at 10 kHz on one core, for progress bars.
        from_stream: whether it draws its own training starts.
    """

    name: str
    family: str
    title: str
    make: Make
    seconds: float
    from_stream: bool = False


METHODS: dict[str, Method] = {}
"""Every method by name, in the order of the tables."""

ESTIMATE = "posterior-network"
"""Method that replaces the limit where the likelihood has no closed form."""


def _chain(features: BaseEstimator, *steps: BaseEstimator) -> Pipeline:
    names = ("features", "classify") if len(steps) == 1 else ("features", "scale", "classify")
    return Pipeline(list(zip(names, (features, *steps), strict=True)))


def _method(name: str, family: str, title: str, seconds: float, **options: bool) -> Callable[[Make], Make]:
    def listed(make: Make) -> Make:
        METHODS[name] = Method(name, family, title, make, seconds, **options)
        return make

    return listed


def _physical_and_residual(recipe: Recipe) -> BaseEstimator:
    if recipe.duty is not None:
        return PhysicalFeatures(recipe)
    return FeatureUnion([("physical", PhysicalFeatures(recipe)), ("residual", ResidualProjection(recipe, 6))])


@_method(
    "threshold",
    "threshold",
    "Confirmation by thresholds: Kalman residual, M of N, bank of fault filters",
    4.0,
)
def _threshold(recipe: Recipe, seed: int) -> BaseEstimator:
    return ThresholdConfirmationClassifier(recipe)


@_method(
    "rules",
    "threshold",
    "Statistics of the decision rules and matched tests, logistic regression for their thresholds",
    3.0,
)
def _rules(recipe: Recipe, seed: int) -> BaseEstimator:
    return _chain(RuleStatistics(recipe), StandardScaler(), LogisticRegression(C=100.0, max_iter=5000))


@_method("physical-lda", "scikit-learn", "Fitted motor parameters, linear discriminant analysis", 5.0)
def _lda(recipe: Recipe, seed: int) -> BaseEstimator:
    return _chain(PhysicalFeatures(recipe), StandardScaler(), LinearDiscriminantAnalysis())


@_method(
    "physical-logistic", "scikit-learn", "Fitted motor parameters and residual, logistic regression", 5.0
)
def _logistic(recipe: Recipe, seed: int) -> BaseEstimator:
    return _chain(_physical_and_residual(recipe), StandardScaler(), LogisticRegression(max_iter=1000))


@_method(
    "physical-svm",
    "scikit-learn",
    "Fitted motor parameters and residual, support vector machine, probabilities by Platt's method",
    6.0,
)
def _svm(recipe: Recipe, seed: int) -> BaseEstimator:
    platt = CalibratedClassifierCV(SVC(), method="sigmoid", cv=5, ensemble=False)
    return _chain(_physical_and_residual(recipe), StandardScaler(), platt)


@_method(
    "physical-boosting",
    "scikit-learn",
    "Fitted motor parameters and residual, gradient boosting with temperature",
    15.0,
)
def _boosting(recipe: Recipe, seed: int) -> BaseEstimator:
    trees = HistGradientBoostingClassifier(
        learning_rate=0.03, max_iter=150, max_leaf_nodes=7, min_samples_leaf=10, random_state=seed
    )
    calibrated = CalibratedClassifierCV(trees, method="temperature", cv=3, ensemble=False)
    return _chain(_physical_and_residual(recipe), calibrated)


@_method("physical-forest", "scikit-learn", "Fitted motor parameters and residual, random forest", 6.0)
def _forest(recipe: Recipe, seed: int) -> BaseEstimator:
    forest = RandomForestClassifier(200, min_samples_leaf=3, random_state=seed)
    return _chain(_physical_and_residual(recipe), forest)


@_method(
    "residual-qda",
    "scikit-learn",
    "Kalman residual along the signal's directions, quadratic discriminant analysis",
    1.0,
)
def _qda(recipe: Recipe, seed: int) -> BaseEstimator:
    # Field effects move all directions together: hence the principal components. Without tolerances a class has a
    # millionth of the variance of all; that is no lack of rank.
    quadratic = QuadraticDiscriminantAnalysis(tol=1e-12)
    return _chain(ResidualProjection(recipe, 6), PCA(whiten=True), quadratic)


@_method("raw-logistic", "scikit-learn", "Raw waveform in 20 principal components, logistic regression", 2.0)
def _raw(recipe: Recipe, seed: int) -> BaseEstimator:
    return _chain(ResidualProjection(None, 20), StandardScaler(), LogisticRegression(max_iter=1000))


@_method("network", "torch", "Kalman residual along the signal's directions, perceptron", 6.0)
def _network(recipe: Recipe, seed: int) -> BaseEstimator:
    return PerceptronClassifier(recipe, random_state=seed)


@_method(
    ESTIMATE,
    "torch",
    "Amortised posterior: a perceptron that learns from an endless stream of the recipe's own starts",
    30.0,
    from_stream=True,
)
def _posterior(recipe: Recipe, seed: int) -> BaseEstimator:
    return PosteriorNetwork(recipe, random_state=seed)


@_method(
    "residual-network",
    "torch",
    "Raw waveform, convolutional residual network that knows nothing of motors",
    30.0,
)
def _resnet(recipe: Recipe, seed: int) -> BaseEstimator:
    return ResNetClassifier(recipe, random_state=seed)


AT_WORK = (
    "physical-lda",
    "physical-logistic",
    "physical-svm",
    "physical-boosting",
    "physical-forest",
    "raw-logistic",
    "residual-network",
)
"""Methods that accept motors at work, too."""


def make_method(name: str, recipe: Recipe, random_state: int) -> BaseEstimator:
    """Unfitted scikit-learn estimator of a method, by its name; its `fit` trains what the benchmark's tables train.

    Raises:
        ValueError: no such method; the sentence lists those that exist.
    """
    if not is_one_of(name, METHODS):
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {shown(name)}")
    instance("recipe", recipe, Recipe)
    return METHODS[name].make(recipe, whole("random_state", random_state))


GROUP = "motor_classifiers.methods"
"""Group of entry points for methods of installed packages."""

_OF_FILE = ".py:"
_SECONDS = 30.0  # for progress bars: nobody knows


def find_method(name: str) -> Method:
    """Find a method by name, entry point, or `FILE.py:NAME`, whose file is run.

    Raises:
        InputError: no such method, or its file cannot be run.
    """
    if name in METHODS:
        return METHODS[name]
    if _OF_FILE in name:
        make = _from_file(name)
    else:
        offered = {point.name: point for point in entry_points(group=GROUP)}
        if name not in offered:
            known = ", ".join([*METHODS, *offered])
            raise InputError(f"method must be FILE.py:NAME or one of {known}, got {name!r}")
        make = offered[name].load()
    about = (make.__doc__ or "A method of one's own").strip().splitlines()[0]
    return Method(name, "own", about, make, _SECONDS)


def _from_file(name: str) -> Make:
    file, _, function = name.rpartition(":")
    path = Path(file)
    read_file(path, LARGEST_NOTE_BYTES, "no such file; a method of your own is FILE.py:NAME")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None  # noqa: S101  # the name ends in .py
    assert spec.loader is not None  # noqa: S101  # the same
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's own file raises is the user's to read
        raise InputError(f"{file}: cannot be run ({type(error).__name__}: {error})") from error
    make: Make | None = getattr(module, function, None)
    if not callable(make):
        raise InputError(
            f"{file}: has no function {function!r} of a recipe and a seed that returns an estimator"
        )
    return make


def source_of(name: str) -> str:
    """Return the source text of a method `FILE.py:NAME`; empty for others."""
    return Path(name.rpartition(":")[0]).read_text(encoding="utf-8") if _OF_FILE in name else ""


def model_input(model: BaseEstimator, X: Any) -> Any:
    """Return transients in the shape for a model.

    Flat, (n_cases, n_channels * n_timepoints), unless the tag `input_tags.three_d_array` of the model or a pipeline's
    first step asks for channels.
    """
    first = model
    while isinstance(first, Pipeline):
        first = first.steps[0][1]
    tags = get_tags(first).input_tags if hasattr(first, "__sklearn_tags__") else None
    return X if tags is not None and tags.three_d_array else X.reshape(len(X), -1)


def model_probabilities(model: BaseEstimator, X: Any) -> FloatArray:
    """Return the probability of each of the model's classes, shape (n_cases, n_classes); 0 or 1 for pure decisions."""
    cases = model_input(model, X)
    if hasattr(model, "predict_proba"):
        probabilities: FloatArray = np.asarray(model.predict_proba(cases), dtype=np.float64)
        return probabilities
    return np.asarray(model.predict(cases)[:, None] == model.classes_, dtype=np.float64)
