"""Files of models with their recipe, without pickle.

A scikit-learn pipeline is a skops archive with our `motor.json`. The confirmation and the networks are safetensors
with the same JSON in the header, and a digest of both. A conformal classifier is an archive of its values as JSON and
the file of the model inside.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors, save as save_tensors
from sklearn.base import BaseEstimator
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis, QuadraticDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.naive_bayes import GaussianNB
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.preprocessing import MinMaxScaler, RobustScaler, StandardScaler

from motor_classifiers.estimators.cases import State, values_of_start
from motor_classifiers.estimators.confirmation import ThresholdConfirmationClassifier
from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection, RuleStatistics
from motor_classifiers.estimators.methods import model_probabilities
from motor_classifiers.estimators.networks.epoch_classifier import PerceptronClassifier, ResNetClassifier
from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.reference_starts import RecentredStarts
from motor_classifiers.model_files import containers
from motor_classifiers.model_files.containers import packed, parsed, unpacked
from motor_classifiers.wrappers.conformal import ConformalClassifier
from motor_classifiers.wrappers.fitted import innermost
from motor_env.common.arrays import instance
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_DATA_BYTES, read_file, replacing
from motor_env.motor.parameters import require
from motor_env.simulation.named_recipes import recipe_from_dict, recipe_to_dict
from motor_env.simulation.recipes import Recipe

_WITH_RECIPE = (PhysicalFeatures, ResidualProjection, RecentredStarts, RuleStatistics)
_STEPS = {
    *_WITH_RECIPE, FeatureUnion, GaussianNB, LinearDiscriminantAnalysis, LogisticRegression, MinMaxScaler,
    MLPClassifier, PCA, Pipeline, QuadraticDiscriminantAnalysis, RobustScaler, StandardScaler,
}  # fmt: skip
_SCHEMA = "schema.json"
TRUSTED = [f"{made.__module__}.{made.__name__}" for made in _WITH_RECIPE]
"""Types allowed beside those that skops trusts."""

_ALLOWED = {
    *(f"{step.__module__}.{step.__name__}" for step in _STEPS),
    *(f"builtins.{name}" for name in ("dict", "list", "str", "tuple")),
    *(f"numpy.{name}" for name in ("bool", "float32", "float64", "int32", "int64", "ndarray")),
    "sklearn.preprocessing._label.LabelBinarizer",
}
"""All allowed types in a saved pipeline, fewer than those of skops."""

_LOADERS = {f"{name}Node" for name in ("Dict", "Json", "List", "NdArray", "Object", "Tuple", "Type")}
"""Allowed ways of skops to make an object."""


def check_pipeline(model: BaseEstimator) -> None:
    """Check that an estimator's or pipeline's steps could be loaded again.

    Raises:
        InputError: they could not.
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
    """Pack a fitted pipeline or estimator, without its recipe, as archive members.

    Raises:
        InputError: a step could not be loaded again.
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
    """Load the fitted pipeline of an archive.

    Raises:
        InputError: a type or step that is not allowed.
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
    """Copy a fitted model with another recipe in its physical steps."""
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


FORMAT = "motor-classifiers"
VERSION = 1
PRETRAINED = Path(__file__).parent / "pretrained" / "paper-motor.safetensors"
"""Network for the paper's motor in the package (pretrained/README.md)."""
MOST_FEATURES = 1_000_000
"""Most values of a case; a larger number means a damaged file."""

_KINDS: dict[str, Any] = {
    "confirmation": ThresholdConfirmationClassifier,
    "network": PerceptronClassifier,
    "posterior-network": PosteriorNetwork,
    "residual-network": ResNetClassifier,
}
_WRAPPERS: dict[str, Any] = {"conformal": ConformalClassifier}
_NAMES: dict[type, str] = {made: kind for kind, made in {**_KINDS, **_WRAPPERS}.items()}
_MEMBER = "motor.json"
_WRAPPER, _INNER = "wrapper.json", "model"
_DIGEST = "sha256"
_MOST_WRAPPERS = 2

Loaded = tuple[BaseEstimator, Recipe, str]


def save_model(model: BaseEstimator, recipe: Recipe, method: str, path: Path | str) -> None:
    """Write a fitted model, as a whole file.

    Args:
        model: of `METHODS`, of scikit-learn's steps that are safe to load, or a `ConformalClassifier` around one.
        recipe: of the training.
        method: name of the method.
        path: new file.

    Raises:
        InputError: a model of another kind, or the file cannot be written.
    """
    instance("model", model, BaseEstimator)
    instance("recipe", recipe, Recipe)
    instance("method", method, str)
    instance("path", path, (Path, str))
    content = _content(model, recipe, method)
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(content)


def check_saveable(model: BaseEstimator) -> None:
    """Check before a training that an estimator's file could be loaded again.

    Raises:
        InputError: it could not.
    """
    if type(model) not in _NAMES:
        check_pipeline(model)


def load_model(path: Path | str) -> Loaded:
    """Read a model, its recipe, and its method's name.

    Raises:
        InputError: no such file, another kind, damaged, or content that is not allowed.
    """
    instance("path", path, (Path, str))
    content = read_file(Path(path), LARGEST_DATA_BYTES)
    try:
        return _loaded(content, _MOST_WRAPPERS)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (
        ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError,
        ImportError, zipfile.BadZipFile, zlib.error, SafetensorError, ArithmeticError, MemoryError, EOFError,
    ) as error:  # fmt: skip
        reason = " ".join(str(error).split())[:150]
        raise InputError(f"{path}: is no model of motor-classifiers, or damaged ({reason})") from None


def _content(model: BaseEstimator, recipe: Recipe, method: str) -> bytes:
    head: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    kind = _NAMES.get(type(model))
    if kind in _WRAPPERS:
        head |= {"kind": kind, **model.to_state().values}
        inner = _content(model.wrapped_model, recipe, method)
        return containers.packed({_WRAPPER: json.dumps(head).encode(), _INNER: inner})
    head |= {
        "method": method,
        "recipe": recipe_to_dict(recipe),
        "classes": [str(name) for name in model.classes_],
    }
    if kind is None:
        return containers.packed({**pipeline_members(model), _MEMBER: json.dumps(head).encode()})
    state = model.to_state()
    arrays = {name: np.ascontiguousarray(values) for name, values in state.arrays.items()}
    head |= {"kind": kind, **state.values}
    head[_DIGEST] = containers.digest(json.dumps(head), arrays)
    return save_tensors(
        arrays, metadata={FORMAT: json.dumps(head)}
    )  # one entry: safetensors does not order them


def _loaded(content: bytes, most_wrappers: int) -> Loaded:
    if zipfile.is_zipfile(io.BytesIO(content)):
        members = containers.unpacked(content)
        if _WRAPPER in members:
            loaded = _loaded_wrapper(members, most_wrappers)
        elif _MEMBER in members:
            head = containers.parsed(members.pop(_MEMBER))
            recipe = _checked_recipe(head)
            loaded = load_pipeline(members, recipe), recipe, str(head["method"])
            own = [str(name) for name in loaded[0].classes_]
            require(own == head["classes"], "its classes are not those of its pipeline")
        else:
            raise InputError("is no model of motor-classifiers")
    else:
        length = int.from_bytes(content[:8], "little")
        require(length <= containers.LARGEST_TEXT_BYTES, "its header is too long")
        arrays = load_tensors(content)
        metadata = containers.parsed(content[8 : 8 + length])["__metadata__"]
        head = containers.parsed(metadata[FORMAT])
        own = head.pop(_DIGEST, None)  # files of older versions have none
        require(
            own in (None, containers.digest(json.dumps(head), arrays)), "its content is not what was saved"
        )
        for name, values in arrays.items():
            require(
                values.dtype.kind in "fi" and bool(np.isfinite(values).all()), f"{name[:60]} is not finite"
            )
        recipe = _checked_recipe(head)
        model = _KINDS[head["kind"]].from_state(State(arrays, head), recipe)
        loaded = model, recipe, str(head["method"])
    _try_out(*loaded[:2])
    return loaded


def _loaded_wrapper(members: dict[str, bytes], most_wrappers: int) -> Loaded:
    require(most_wrappers > 0, "too many classifiers are nested in it")
    head = containers.parsed(members[_WRAPPER])
    _check_format(head)
    inner, recipe, method = _loaded(members[_INNER], most_wrappers - 1)
    return _WRAPPERS[head["kind"]].from_state(State({}, head), inner, recipe), recipe, method


def _try_out(model: BaseEstimator, recipe: Recipe) -> None:
    """Judge one quiet case, so that inconsistent files fail here."""
    starts, rest = divmod(model.n_features_in_, values_of_start(recipe))
    first = innermost(model)
    while isinstance(first, Pipeline):
        first = first.steps[0][1]
    with_references = isinstance(first, PosteriorNetwork | RecentredStarts)
    require(
        rest == 0 and (starts == 1 or (starts > 1 and with_references)),
        f"its cases of {model.n_features_in_} values are no starts of its recipe",
    )
    require(model.n_features_in_ <= MOST_FEATURES, f"a case has more than {MOST_FEATURES} values")
    with np.errstate(all="ignore"):
        probabilities = model_probabilities(model, np.zeros((1, model.n_features_in_)))
    require(probabilities.shape == (1, len(model.classes_)), "it gives no probability for each class")
    require(bool(np.isfinite(probabilities).all()), "its probabilities are not finite")


def _check_format(head: dict[str, Any]) -> None:
    if head["format"] != FORMAT or head["version"] != VERSION:
        raise InputError(
            f"is of format {head['format']!r} version {head['version']!r}, not {FORMAT} {VERSION}"
        )


def _checked_recipe(head: dict[str, Any]) -> Recipe:
    """Return the recipe of a head, if method and classes are valid."""
    _check_format(head)
    recipe = recipe_from_dict(head["recipe"])
    classes = head["classes"]
    require(isinstance(head["method"], str), f"method must be text, got {head['method']!r}")
    require(
        isinstance(classes, list) and all(isinstance(name, str) for name in classes),
        f"classes must be a list of names, got {classes!r}",
    )
    unknown = set(classes) - set(recipe.class_names)
    if unknown:
        raise InputError(f"names the class {min(unknown)!r}, which its recipe does not know")
    require(classes == sorted(set(classes)) and len(classes) >= 2, "classes must be two or more, sorted")
    require(values_of_start(recipe) <= MOST_FEATURES, f"a case has more than {MOST_FEATURES} values")
    return recipe
