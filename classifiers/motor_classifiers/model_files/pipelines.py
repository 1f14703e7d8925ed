"""Pipelines of scikit-learn as skops archives: only types trusted by name, and trees and vectors that are consistent.

Compiled code follows a tree's children and counts support vectors without looking: a poisoned one would read beside the
arrays. So each step of a pipeline is of a type that is checked here, or that computes with NumPy alone.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import MinMaxScaler, RobustScaler, StandardScaler
from sklearn.svm import SVC
from sklearn.tree import DecisionTreeClassifier

from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection, RuleStatistics
from motor_classifiers.estimators.reference_starts import RecentredStarts
from motor_env.errors import InputError
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Recipe

_WITH_RECIPE = (PhysicalFeatures, ResidualProjection, RecentredStarts, RuleStatistics)
_STEPS = {
    *_WITH_RECIPE, CalibratedClassifierCV, FeatureUnion, GaussianNB, HistGradientBoostingClassifier,
    LinearDiscriminantAnalysis, LogisticRegression, MinMaxScaler, PCA, Pipeline, QuadraticDiscriminantAnalysis,
    RandomForestClassifier, RobustScaler, StandardScaler, SVC,
}  # fmt: skip
_OLD_MODULES = {
    "PhysicalFeatures": "motor_classifiers.features",
    "ResidualProjection": "motor_classifiers.features",
    "RecentredStarts": "motor_classifiers.reference",
    "RuleStatistics": "motor_classifiers.rule_statistics",
}
"""Where these classes were when older files were written."""

_OWN = {made.__name__: made.__module__ for made in _WITH_RECIPE}
TRUSTED = [
    *(f"{module}.{name}" for name, module in _OWN.items()),
    "sklearn.calibration._CalibratedClassifier",
    "sklearn.calibration._SigmoidCalibration",
    "sklearn.calibration._TemperatureScaling",
    "sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor",
    "sklearn.tree._tree.Tree",
]
"""Types beyond those that skops trusts by itself."""


def pipeline_bytes(model: Pipeline) -> bytes:
    """A fitted pipeline without its recipe.

    Raises:
        TypeError: a step is of a type that could not be loaded again.
    """
    import skops.io

    foreign = sorted({type(step).__name__ for step in _steps(model)} - {step.__name__ for step in _STEPS})
    if foreign:
        raise TypeError(f"a pipeline with a {foreign[0]} cannot be saved")
    content: bytes = skops.io.dumps(with_recipe(model, None))
    return content


def load_pipeline(content: bytes, recipe: Recipe) -> Pipeline:
    """The fitted pipeline of an archive; its content is no longer a stranger's afterwards.

    Raises:
        InputError: it would load a type that no model of ours needs.
        ValueError: a tree or a support vector machine whose parts do not fit.
    """
    import skops.io

    content = _with_new_names(content)
    foreign = sorted(set(skops.io.get_untrusted_types(data=content)) - set(TRUSTED))
    if foreign:
        raise InputError(f"is refused: it would load {', '.join(foreign)}, which no model of ours needs")
    model = skops.io.loads(content, trusted=TRUSTED)
    if type(model) is not Pipeline:
        raise InputError(f"holds a {type(model).__name__}, not a pipeline")
    for step in _steps(model):
        if type(step) not in _STEPS:
            raise InputError(f"is refused: it has a {type(step).__name__}, which no model of ours needs")
        _check_step(step)
    return with_recipe(model, recipe)


def with_recipe(model: BaseEstimator, recipe: Recipe | None) -> BaseEstimator:
    """The same fitted model whose physical steps hold another recipe; the given one stays as it is."""
    changed = copy(model)
    if isinstance(model, Pipeline):
        changed.steps = [(name, with_recipe(step, recipe)) for name, step in model.steps]
    elif isinstance(model, FeatureUnion):
        changed.transformer_list = [(n, with_recipe(step, recipe)) for n, step in model.transformer_list]
    elif isinstance(model, _WITH_RECIPE):
        changed.recipe = recipe
    return changed


def _with_new_names(content: bytes) -> bytes:
    """The archive with our classes named by the modules in which they are now; all else stays."""

    def renamed(node: dict[str, Any]) -> dict[str, Any]:
        name = node.get("__class__")
        if isinstance(name, str) and name in _OLD_MODULES and node.get("__module__") == _OLD_MODULES[name]:
            node["__module__"] = _OWN[name]
        return node

    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(buffer, "w") as target:
        for member in source.infolist():
            text = source.read(member)
            if member.filename == "schema.json":
                text = json.dumps(json.loads(text, object_hook=renamed)).encode()
            target.writestr(member, text)
    return buffer.getvalue()


def _steps(model: BaseEstimator) -> Iterator[BaseEstimator]:
    """The model and all that it is made of, except the trees of a forest."""
    yield model
    parts: list[BaseEstimator] = []
    if isinstance(model, Pipeline):
        parts = [step for _, step in model.steps]
    elif isinstance(model, FeatureUnion):
        parts = [step for _, step in model.transformer_list]
    elif isinstance(model, CalibratedClassifierCV):
        parts = [calibrated.estimator for calibrated in model.calibrated_classifiers_]
    for part in parts:
        yield from _steps(part)


def _check_step(step: BaseEstimator) -> None:
    """Check what compiled code will believe.

    Raises:
        ValueError: a tree or a support vector machine whose parts do not fit.
    """
    if isinstance(step, RandomForestClassifier):
        for grown in step.estimators_:
            require(type(grown) is DecisionTreeClassifier, "a forest holds something else than trees")
            tree = grown.tree_
            inner = tree.children_left != -1
            children = (tree.children_left[inner], tree.children_right[inner])
            _check_tree(inner, children, tree.feature[inner], tree.n_features)
    elif isinstance(step, HistGradientBoostingClassifier):
        require(step._preprocessor is None, "a tree asks for a category")  # noqa: SLF001  # no public way
        for predictor in (tree for round_ in step._predictors for tree in round_):  # noqa: SLF001  # no public way
            nodes = predictor.nodes
            inner = nodes["is_leaf"] == 0
            children = (nodes["left"][inner], nodes["right"][inner])
            _check_tree(inner, children, nodes["feature_idx"][inner], step.n_features_in_)
            require(not nodes["is_categorical"].any(), "a tree asks for a category")
    elif isinstance(step, SVC):
        _check_vectors(step)


def _check_tree(
    inner: NDArray[np.bool_], children: tuple[NDArray[Any], ...], asked: NDArray[Any], n_features: int
) -> None:
    """Check a tree: which nodes have children, both children of these, the feature each asks for."""
    require(len(inner) > 0, "a tree has no node")
    for child in children:
        later = (child.astype(np.int64) > np.flatnonzero(inner)) & (child < len(inner))
        require(bool(later.all()), "a tree has a child that does not exist")
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
