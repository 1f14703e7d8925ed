"""Pipelines of scikit-learn as skops archives: only types trusted by name, and trees and vectors that are consistent.

Compiled code follows a tree's children and counts support vectors without looking: a poisoned one would read beside the
arrays. So each step of a pipeline is of a type that is checked here, or that computes with NumPy alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.calibration import CalibratedClassifierCV
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier, HistGradientBoostingClassifier, RandomForestClassifier
from sklearn.ensemble._hist_gradient_boosting.predictor import TreePredictor
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import MinMaxScaler, RobustScaler, StandardScaler
from sklearn.svm import SVC
from sklearn.tree import DecisionTreeClassifier, ExtraTreeClassifier
from sklearn.tree._tree import Tree

from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection, RuleStatistics
from motor_classifiers.estimators.reference_starts import RecentredStarts
from motor_classifiers.model_files.containers import packed, parsed, unpacked
from motor_env.errors import InputError
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Recipe

_WITH_RECIPE = (PhysicalFeatures, ResidualProjection, RecentredStarts, RuleStatistics)
_STEPS = {
    *_WITH_RECIPE, CalibratedClassifierCV, ExtraTreesClassifier, FeatureUnion, GaussianNB,
    HistGradientBoostingClassifier, LinearDiscriminantAnalysis, LogisticRegression, MinMaxScaler, MLPClassifier, PCA,
    Pipeline, QuadraticDiscriminantAnalysis, RandomForestClassifier, RobustScaler, StandardScaler, SVC,
}  # fmt: skip
_TREES = (DecisionTreeClassifier, ExtraTreeClassifier)
_FORESTS = (RandomForestClassifier, ExtraTreesClassifier)
_SCHEMA = "schema.json"
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

_ALLOWED = {
    *TRUSTED,
    *(f"{step.__module__}.{step.__name__}" for step in (*_STEPS, *_TREES)),
    *(f"builtins.{name}" for name in ("dict", "list", "str", "tuple")),
    *(
        f"numpy.{name}"
        for name in ("bool", "float32", "float64", "int32", "int64", "ndarray", "uint64", "uint8")
    ),
    "numpy.random._generator.Generator",
    "sklearn._loss._loss.CyHalfBinomialLoss",
    "sklearn._loss._loss.CyHalfMultinomialLoss",
    "sklearn._loss.link.Interval",
    "sklearn._loss.link.LogitLink",
    "sklearn._loss.link.MultinomialLogit",
    "sklearn._loss.loss.HalfBinomialLoss",
    "sklearn._loss.loss.HalfMultinomialLoss",
    "sklearn.ensemble._hist_gradient_boosting.binning._BinMapper",
    "sklearn.preprocessing._label.LabelBinarizer",
    "sklearn.preprocessing._label.LabelEncoder",
}
"""All types that a saved pipeline is made of; skops itself would take any of scikit-learn, NumPy and SciPy."""

_LOADERS = {
    f"{name}Node"
    for name in (
        "Dict", "Json", "List", "Loss", "NdArray", "Object", "RandomGenerator", "Tree", "Tuple", "Type",
    )
}  # fmt: skip
"""Ways of skops to make an object; among the others are methods, operators and functions."""


def check_pipeline(model: BaseEstimator) -> None:
    """Check that an estimator or a pipeline, fitted or not, is made of steps that could be loaded again.

    Raises:
        InputError: it is not; the sentence says what would be.
    """
    steps = [model, *(part for part in model.get_params().values() if isinstance(part, BaseEstimator))]
    foreign = sorted({type(step).__name__ for step in steps if type(step) not in _STEPS})
    if foreign:
        raise InputError(
            f"a model with a {foreign[0]} cannot be saved: a file may hold {_names(_STEPS)} alone, because nothing else"
            " is safe to load; use one of these, or score it unsaved by motor-classifiers benchmark --with"
        )
    require(
        all(getattr(step, "n_jobs", None) is None for step in steps), "a saved model must have n_jobs=None"
    )


def _names(types: Iterable[type]) -> str:
    return ", ".join(sorted(step.__name__ for step in types))


def pipeline_members(model: BaseEstimator) -> dict[str, bytes]:
    """A fitted pipeline, or an estimator as one, without its recipe, as the members of an archive.

    Raises:
        InputError: a step is of a type that could not be loaded again.
    """
    import skops.io

    check_pipeline(model)
    model = model if isinstance(model, Pipeline) else Pipeline([("classify", model)])
    members = unpacked(skops.io.dumps(with_recipe(model, None)))
    unsafe = _foreign_types(parsed(members[_SCHEMA]))
    require(
        not unsafe, f"a model that holds {min(unsafe, default='')} cannot be saved: it is not safe to load"
    )
    return members


def load_pipeline(members: dict[str, bytes], recipe: Recipe) -> Pipeline:
    """The fitted pipeline of an archive; its content is no longer a stranger's afterwards.

    Raises:
        InputError: it would load a type that no model of ours needs.
        ValueError: a tree or a support vector machine whose parts do not fit.
    """
    import skops.io

    schema = parsed(members[_SCHEMA])
    foreign = _foreign_types(schema)
    if foreign:
        raise InputError(
            f"is refused: it would load {', '.join(sorted(foreign))[:200]}, which no model of ours needs"
        )
    content = packed(members | {_SCHEMA: json.dumps(schema).encode()})
    model = skops.io.loads(content, trusted=TRUSTED)
    if type(model) is not Pipeline:
        raise InputError(f"holds a {type(model).__name__}, not a pipeline")
    for step in _steps(model):
        if type(step) not in _STEPS:
            raise InputError(f"is refused: it has a {type(step).__name__}, which no model of ours needs")
        _check_step(step)
    return with_recipe(model, recipe)


def _foreign_types(node: Any) -> set[str]:
    """Names of types, and of skops's ways to make them, that are in a schema and must not be."""
    if isinstance(node, list):
        return set().union(*map(_foreign_types, node))
    if not isinstance(node, dict):
        return set()
    foreign = set().union(*map(_foreign_types, node.values()))
    if "__loader__" in node:
        name = f"{node['__module__']}.{node['__class__']}"
        foreign |= set() if name in _ALLOWED else {name}
        foreign |= set() if node["__loader__"] in _LOADERS else {str(node["__loader__"])}
    return foreign


def with_recipe(model: BaseEstimator, recipe: Recipe | None) -> BaseEstimator:
    """The same fitted model whose physical steps hold another recipe; the given one stays as it is."""
    changed = copy(model)
    if isinstance(model, Pipeline):
        changed.steps = [(name, with_recipe(step, recipe)) for name, step in model.steps]
    elif isinstance(model, FeatureUnion):
        changed.transformer_list = [(n, with_recipe(step, recipe)) for n, step in model.transformer_list]
    elif isinstance(model, _WITH_RECIPE):
        changed.recipe = recipe
    elif isinstance(model, MLPClassifier):
        for name in ("_random_state", "_optimizer"):  # of the training alone, and not safe to load
            vars(changed).pop(name, None)
    return changed


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
    """Check what compiled code, or a pool of workers, will believe.

    Raises:
        ValueError: a tree or a support vector machine whose parts do not fit, or workers asked for.
    """
    require(getattr(step, "n_jobs", None) is None, "it asks for workers")
    if isinstance(step, _FORESTS):
        for grown in step.estimators_:
            require(type(grown) in _TREES, "a forest holds something else than trees")
            _check_grown(grown, step)
    elif isinstance(step, HistGradientBoostingClassifier):
        _check_boosting(step)
    elif isinstance(step, SVC):
        _check_vectors(step)


def _check_grown(grown: DecisionTreeClassifier, forest: BaseEstimator) -> None:
    tree = grown.tree_
    # Before anything else: the arrays of a tree are views of as many nodes as it says.
    require(type(tree) is Tree and tree.node_count == tree.capacity, "a tree has not the nodes that it says")
    sizes = (tree.n_features, tree.n_outputs, tree.max_n_classes)
    require(
        sizes == (forest.n_features_in_, 1, len(forest.classes_)) and grown.n_features_in_ == tree.n_features,
        f"a tree is for {sizes[0]} features and {sizes[2]} classes, and its forest is not",
    )
    inner = tree.children_left != -1
    children = (tree.children_left[inner], tree.children_right[inner])
    _check_tree(inner, children, tree.feature[inner], tree.n_features)


def _check_boosting(boosting: HistGradientBoostingClassifier) -> None:
    mapper, n_classes = boosting._bin_mapper, len(boosting.classes_)  # noqa: SLF001  # no public way
    require(
        boosting._preprocessor is None and not np.any(mapper.is_categorical_),  # noqa: SLF001  # no public way
        "a tree asks for a category",
    )
    require(not getattr(boosting, "_in_fit", False), "its boosting is not fitted")
    n_trees = 1 if n_classes == 2 else n_classes
    require(boosting.n_trees_per_iteration_ == n_trees, f"its boosting must have {n_trees} trees a round")
    for trees in boosting._predictors:  # noqa: SLF001  # no public way
        require(len(trees) == n_trees, f"its boosting must have {n_trees} trees a round")
        for predictor in trees:
            nodes = predictor.nodes
            require(type(predictor) is TreePredictor and nodes.ndim == 1, "a tree has no list of nodes")
            inner = nodes["is_leaf"] == 0
            children = (nodes["left"][inner], nodes["right"][inner])
            _check_tree(inner, children, nodes["feature_idx"][inner], boosting.n_features_in_)
            require(not nodes["is_categorical"].any(), "a tree asks for a category")


def _check_tree(
    inner: NDArray[np.bool_], children: tuple[NDArray[Any], ...], asked: NDArray[Any], n_features: int
) -> None:
    """Check a tree: which nodes have children, both children of these, the feature each asks for."""
    require(len(inner) > 0, "a tree has no node")
    for child in children:
        # Children lie behind their parents: so no walk is endless.
        later = (child.astype(np.int64) > np.flatnonzero(inner)) & (child < len(inner))
        require(bool(later.all()), "a tree has a child that does not exist")
    require(bool(((asked >= 0) & (asked < n_features)).all()), "a tree asks for no feature")


def _check_vectors(machine: SVC) -> None:
    n_classes, n_vectors = len(machine.classes_), len(machine.support_vectors_)
    n_pairs = n_classes * (n_classes - 1) // 2
    counts = machine._n_support  # noqa: SLF001  # what libsvm is given
    scales = {machine._probA.shape, machine._probB.shape}  # noqa: SLF001  # the same
    require(
        n_classes >= 2
        and machine.support_vectors_.shape == (n_vectors, machine.n_features_in_)
        and counts.shape == (n_classes,)
        and bool((counts >= 0).all())
        and int(counts.sum()) == n_vectors == len(machine.support_)
        and machine._dual_coef_.shape == (n_classes - 1, n_vectors)
        and machine._intercept_.shape == (n_pairs,)
        and scales in ({(0,)}, {(n_pairs,)}),
        "the parts of its support vector machine do not fit each other",
    )
    kind = (machine._impl, machine._sparse)  # noqa: SLF001  # the same
    require(
        kind == ("c_svc", False) and machine.kernel in ("linear", "poly", "rbf", "sigmoid"),
        "its support vector machine is of an unknown kind",
    )
