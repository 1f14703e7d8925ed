"""Pipelines of scikit-learn as skops archives: only types that are listed here, all of which compute with NumPy alone.

Compiled code follows a tree's children and counts support vectors without looking: a poisoned one would read beside the
arrays. So trees and support vector machines are neither saved nor loaded.
"""

from __future__ import annotations

import json
from copy import copy
from typing import Any

from sklearn.base import BaseEstimator
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import MinMaxScaler, RobustScaler, StandardScaler

from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection, RuleStatistics
from motor_classifiers.estimators.reference_starts import RecentredStarts
from motor_classifiers.model_files.containers import packed, parsed, unpacked
from motor_env.common.errors import InputError
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Recipe

_WITH_RECIPE = (PhysicalFeatures, ResidualProjection, RecentredStarts, RuleStatistics)
_STEPS = {
    *_WITH_RECIPE, FeatureUnion, GaussianNB, LinearDiscriminantAnalysis, LogisticRegression, MinMaxScaler,
    MLPClassifier, PCA, Pipeline, QuadraticDiscriminantAnalysis, RobustScaler, StandardScaler,
}  # fmt: skip
_SCHEMA = "schema.json"
TRUSTED = [f"{made.__module__}.{made.__name__}" for made in _WITH_RECIPE]
"""Types beyond those that skops trusts by itself."""

_ALLOWED = {
    *(f"{step.__module__}.{step.__name__}" for step in _STEPS),
    *(f"builtins.{name}" for name in ("dict", "list", "str", "tuple")),
    *(f"numpy.{name}" for name in ("bool", "float32", "float64", "int32", "int64", "ndarray")),
    "sklearn.preprocessing._label.LabelBinarizer",
}
"""All types that a saved pipeline is made of; skops itself would take any of scikit-learn, NumPy and SciPy."""

_LOADERS = {f"{name}Node" for name in ("Dict", "Json", "List", "NdArray", "Object", "Tuple", "Type")}
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
            f"a model with a {foreign[0]} cannot be saved: a file may hold"
            f" {', '.join(sorted(step.__name__ for step in _STEPS))} alone, because nothing else is safe to load;"
            " use one of these, or score it unsaved by motor-classifiers benchmark --with"
        )
    require(
        all(getattr(step, "n_jobs", None) is None for step in steps), "a saved model must have n_jobs=None"
    )


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
        InputError: it would load a type or a step that no model of ours needs.
        ValueError: a step asks for workers.
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
    check_pipeline(model)
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
    """A copy of a fitted model whose physical steps hold another recipe; the given one stays as it is."""
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
