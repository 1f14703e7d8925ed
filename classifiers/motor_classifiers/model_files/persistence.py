"""Models on disk without pickle: one file a model, which tells its recipe.

A scikit-learn pipeline is a skops archive with our own `motor.json` beside its schema. The confirmation and the
networks are safetensors with the same JSON in the header. A classifier around one of these (open-set, conformal) is an
archive of its own values as JSON and the file of the model inside. A file that holds anything else is refused.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from copy import copy
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors, save as save_tensors
from sklearn.base import BaseEstimator
from sklearn.pipeline import FeatureUnion, Pipeline

from motor_classifiers.estimators.confirmation import ConfirmationClassifier
from motor_classifiers.estimators.features import PhysicalFeatures, ResidualProjection
from motor_classifiers.estimators.perceptron import NetworkClassifier, perceptron
from motor_classifiers.estimators.posterior_network import PosteriorNetwork
from motor_classifiers.estimators.reference_starts import RecentredStarts
from motor_classifiers.estimators.residual_network import ResidualNetworkClassifier, residual_network
from motor_classifiers.estimators.rule_statistics import RuleStatistics
from motor_classifiers.model_files.posterior_file import (
    load_posterior,
    plain_parameters,
    posterior_arrays,
    posterior_values,
)
from motor_classifiers.model_files.skops_checks import TRUSTED, check_pipeline
from motor_classifiers.model_files.wrapper_file import Wrapper, load_wrapper, wrapped_model, wrapper_values
from motor_classifiers.wrappers.conformal import ConformalClassifier
from motor_classifiers.wrappers.open_set import OpenSetClassifier
from motor_env.detection.confirmation import ThresholdConfirmation, class_filter
from motor_env.errors import InputError
from motor_env.files import replacing
from motor_env.motor.parameters import require
from motor_env.simulation.recipe_files import recipe_from_dict, recipe_to_dict
from motor_env.simulation.recipes import Recipe

FORMAT = "motor-classifiers"
VERSION = 1
PRETRAINED = Path(__file__).parent / "pretrained" / "paper-motor.safetensors"
"""The network for the paper's motor that comes with the package (pretrained/README.md)."""
LARGEST_FILE_BYTES = 200_000_000
MOST_FEATURES = 10_000_000
"""Values of a case: a recipe that asks for more comes from a damaged file, not from a motor."""
_MEMBER = "motor.json"
_WRAPPER, _INNER = "wrapper.json", "model"
_MOST_WRAPPERS = 2
_RULE_ARRAYS = ("healthy_scale", "own_scale", "prior")


def save_model(model: BaseEstimator, recipe: Recipe, method: str, path: Path) -> None:
    """Write a fitted model; the file appears whole or not at all.

    Raises:
        TypeError: a model of another kind than those of `methods`, and no wrapper around one.
        InputError: the file cannot be written.
    """
    content = _content(model, recipe, method)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _content(model: BaseEstimator, recipe: Recipe, method: str) -> bytes:
    if isinstance(model, OpenSetClassifier | ConformalClassifier):
        return _wrapper_bytes(model, recipe, method)
    head: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "method": method,
        "recipe": recipe_to_dict(recipe),
        "classes": [str(name) for name in model.classes_],
    }
    if isinstance(model, Pipeline):
        return _pipeline_bytes(model, head)
    if isinstance(model, ConfirmationClassifier):
        return _confirmation_bytes(model, head)
    if isinstance(model, NetworkClassifier):
        return _network_bytes(model, head)
    if isinstance(model, PosteriorNetwork):
        return _tensor_bytes(posterior_arrays(model), head | posterior_values(model))
    if isinstance(model, ResidualNetworkClassifier):
        return _residual_bytes(model, head)
    raise TypeError(f"model must be a pipeline, a confirmation or a network, got {type(model).__name__}")


def load_model(path: Path) -> tuple[BaseEstimator, Recipe, str]:
    """Read a model, the recipe it was trained for, and its method's name.

    Raises:
        InputError: no such file, not one of ours, damaged, or with content that is not allowed.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise InputError(
                f"{path}: is larger than {LARGEST_FILE_BYTES // 1_000_000} MB, not a model of ours"
            )
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({(error.strerror or str(error)).lower()})") from None
    try:
        model, recipe, method = _load_content(content, _MOST_WRAPPERS)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (
        ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError,
        ImportError, zipfile.BadZipFile, zlib.error, SafetensorError, ArithmeticError, MemoryError, EOFError,
    ) as error:  # fmt: skip
        reason = " ".join(str(error).split())[:150]
        raise InputError(f"{path}: is no model of motor-classifiers, or damaged ({reason})") from None
    return model, recipe, method


def _load_content(content: bytes, most_wrappers: int) -> tuple[BaseEstimator, Recipe, str]:
    if zipfile.is_zipfile(io.BytesIO(content)):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(member.file_size for member in archive.infolist()) > 4 * LARGEST_FILE_BYTES:
                raise InputError("unpacks to more than a model of ours needs")
            is_wrapper = _WRAPPER in archive.namelist()
        loaded = _load_wrapper(content, most_wrappers) if is_wrapper else _load_pipeline(content)
    else:
        loaded = _load_tensors(content)
    _try_out(*loaded[:2])
    return loaded


def _wrapper_bytes(model: Wrapper, recipe: Recipe, method: str) -> bytes:
    head = {"format": FORMAT, "version": VERSION} | wrapper_values(model, recipe)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(_WRAPPER, json.dumps(head))
        archive.writestr(_INNER, _content(wrapped_model(model), recipe, method))
    return buffer.getvalue()


def _load_wrapper(content: bytes, most_wrappers: int) -> tuple[BaseEstimator, Recipe, str]:
    require(most_wrappers > 0, "too many classifiers are nested in it")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        head, inner = json.loads(archive.read(_WRAPPER)), archive.read(_INNER)
    _check_format(head)
    model, recipe, method = _load_content(inner, most_wrappers - 1)
    return load_wrapper(head, model, recipe), recipe, method


def _try_out(model: BaseEstimator, recipe: Recipe) -> None:
    """Judge one quiet case: a file whose parts do not fit each other fails here, and not in the user's hands.

    Raises:
        ValueError: classes or probabilities are not what the recipe needs.
    """
    starts, rest = divmod(model.n_features_in_, _n_features(recipe))
    with_references = isinstance(_first(model), PosteriorNetwork | RecentredStarts)
    require(
        rest == 0 and (starts == 1 or (starts > 1 and with_references)),
        f"its cases of {model.n_features_in_} values are no starts of its recipe",
    )
    require(model.n_features_in_ <= MOST_FEATURES, f"a case has more than {MOST_FEATURES} values")
    probabilities = model.predict_proba(np.zeros((1, model.n_features_in_)))
    require(probabilities.shape == (1, len(model.classes_)), "it gives no probability for each class")
    require(bool(np.isfinite(probabilities).all()), "its probabilities are not finite")
    foreign = {str(name) for name in model.classes_} - set(recipe.class_names)
    require(not foreign, f"its recipe does not know the class {min(foreign, default='')!r}")


def _first(model: BaseEstimator) -> BaseEstimator:
    """What sees the transients: inside a wrapper, the first step of a pipeline."""
    if isinstance(model, OpenSetClassifier | ConformalClassifier):
        return _first(wrapped_model(model))
    return _first(model.steps[0][1]) if isinstance(model, Pipeline) else model


def _check_format(head: dict[str, Any]) -> None:
    if head["format"] != FORMAT or head["version"] != VERSION:
        raise InputError(
            f"is of format {head['format']!r} version {head['version']!r}, not {FORMAT} {VERSION}"
        )


def _checked_head(text: str) -> tuple[dict[str, Any], Recipe]:
    head = json.loads(text)
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
    require(_n_features(recipe) <= MOST_FEATURES, f"a case has more than {MOST_FEATURES} values")
    return head, recipe


def _with_recipe(model: BaseEstimator, recipe: Recipe | None) -> BaseEstimator:
    """The same fitted model whose physical steps hold another recipe; the given one stays as it is."""
    if isinstance(model, Pipeline):
        changed = copy(model)
        changed.steps = [(name, _with_recipe(step, recipe)) for name, step in model.steps]
        return changed
    if isinstance(model, FeatureUnion):
        changed = copy(model)
        changed.transformer_list = [(n, _with_recipe(step, recipe)) for n, step in model.transformer_list]
        return changed
    if isinstance(model, PhysicalFeatures | ResidualProjection | RecentredStarts | RuleStatistics):
        changed = copy(model)
        changed.recipe = recipe
        return changed
    return model


def _pipeline_bytes(model: Pipeline, head: dict[str, Any]) -> bytes:
    import skops.io

    buffer = io.BytesIO(skops.io.dumps(_with_recipe(model, None)))
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(_MEMBER, json.dumps(head))
    return buffer.getvalue()


def _load_pipeline(content: bytes) -> tuple[BaseEstimator, Recipe, str]:
    import skops.io

    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if _MEMBER not in archive.namelist():
            raise InputError("is no model of motor-classifiers")
        head, recipe = _checked_head(archive.read(_MEMBER).decode())
    foreign = sorted(set(skops.io.get_untrusted_types(data=content)) - set(TRUSTED))
    if foreign:
        raise InputError(f"is refused: it would load {', '.join(foreign)}, which no model of ours needs")
    model = skops.io.loads(content, trusted=list(TRUSTED))
    if not isinstance(model, Pipeline):
        raise InputError(f"holds a {type(model).__name__}, not a pipeline")
    check_pipeline(model)
    return _with_recipe(model, recipe), recipe, str(head["method"])


def _tensor_bytes(tensors: dict[str, Any], head: dict[str, Any]) -> bytes:
    arrays = {name: np.ascontiguousarray(values) for name, values in tensors.items()}
    return save_tensors(arrays, metadata={FORMAT: json.dumps(head)})


def _confirmation_bytes(model: ConfirmationClassifier, head: dict[str, Any]) -> bytes:
    rule = model.rule_
    plain = {f.name: getattr(rule, f.name) for f in fields(rule) if f.name not in ("filters", *_RULE_ARRAYS)}
    head |= {"kind": "confirmation", "rule": plain, "false_alarm_rate": model.false_alarm_rate}
    return _tensor_bytes({name: getattr(rule, name) for name in _RULE_ARRAYS}, head)


def _network_bytes(model: NetworkClassifier, head: dict[str, Any]) -> bytes:
    head |= {"kind": "network", "parameters": plain_parameters(model)}
    tensors = {f"network.{name}": values.numpy() for name, values in model.network_.state_dict().items()}
    tensors |= {"weights": model.projection_.weights_, "offset": model.projection_.offset_}
    tensors |= {"center": model.center_, "scale": model.scale_}
    return _tensor_bytes(tensors, head)


def _residual_bytes(model: ResidualNetworkClassifier, head: dict[str, Any]) -> bytes:
    head |= {"kind": "residual-network", "parameters": plain_parameters(model)}
    tensors = {f"network.{name}": values.numpy() for name, values in model.network_.state_dict().items()}
    return _tensor_bytes(tensors | {"center": model.center_, "scale": model.scale_}, head)


def _load_tensors(content: bytes) -> tuple[BaseEstimator, Recipe, str]:
    tensors = load_tensors(content)
    length = int.from_bytes(content[:8], "little")
    metadata = json.loads(content[8 : 8 + length])["__metadata__"]
    head, recipe = _checked_head(metadata[FORMAT])
    load = {
        "confirmation": _load_confirmation,
        "network": _load_network,
        "posterior-network": load_posterior,
        "residual-network": _load_residual,
    }[head["kind"]]
    return load(head, tensors, recipe), recipe, str(head["method"])


def _n_features(recipe: Recipe) -> int:
    return len(recipe.sensor.channels) * recipe.timing.n_samples


def _load_confirmation(head: dict[str, Any], tensors: dict[str, Any], recipe: Recipe) -> BaseEstimator:
    model = ConfirmationClassifier(recipe, head["false_alarm_rate"])
    rule = {**head["rule"], "edges": tuple(int(edge) for edge in head["rule"]["edges"])}
    edges, n_classes = np.array(rule["edges"]), len(recipe.classes)
    require(
        edges[0] == 0 and bool((np.diff(edges) > 0).all()) and edges[-1] == recipe.timing.n_samples,
        "its windows do not fill its recipe's time axis",
    )
    counts = (rule["needed"], rule["among"], rule["healthy_index"])
    require(all(type(count) is int for count in counts), f"M, N and class must be integers, got {counts!r}")
    require(
        1 <= counts[0] <= counts[1] < len(edges),
        f"M of N must fit {len(edges) - 1} windows, got {counts[:2]}",
    )
    require(0 <= counts[2] < n_classes, f"healthy_index must be a class, got {counts[2]}")
    require(
        type(rule["with_spread"]) is bool, f"with_spread must be true or false, got {rule['with_spread']!r}"
    )
    for name in ("threshold", "temperature", "slope", "intercept"):
        require(isinstance(rule[name], float), f"{name} must be a number, got {rule[name]!r}")
    rate = head["false_alarm_rate"]
    require(rate is None or isinstance(rate, float), f"false_alarm_rate must be a number, got {rate!r}")
    arrays = {name: tensors[name] for name in _RULE_ARRAYS}
    filters = tuple(class_filter(recipe, c) for c in recipe.classes)
    model.rule_ = ThresholdConfirmation(filters=filters, **rule, **arrays)
    model.templates_ = None
    model.classes_ = np.array(head["classes"])
    model.n_features_in_ = _n_features(recipe)
    return model


def _load_network(head: dict[str, Any], tensors: dict[str, Any], recipe: Recipe) -> BaseEstimator:
    import torch

    model = NetworkClassifier(recipe, **head["parameters"])
    model.classes_ = np.array(head["classes"])
    model.n_features_in_ = _n_features(recipe)
    projection = ResidualProjection(recipe, model.n_components)
    projection.weights_, projection.offset_ = tensors["weights"], tensors["offset"]
    projection.n_features_in_ = model.n_features_in_
    if projection.weights_.shape != (len(projection.offset_), model.n_features_in_):
        raise ValueError(f"weights of shape {projection.weights_.shape} do not fit its recipe")
    model.projection_ = projection
    model.center_, model.scale_ = tensors["center"], tensors["scale"]
    # The sizes are believed only once the file holds as much: memory for a false one would be taken before a look.
    n_layers, n_hidden = model.n_layers, model.n_hidden
    weights = sum(name.startswith("network.") and name.endswith(".weight") for name in tensors)
    require(
        type(n_layers) is int and n_layers >= 0 and weights == n_layers + 1,
        f"n_layers is {n_layers!r}, the file holds {weights} matrices",
    )
    first = tensors["network.0.weight"].shape
    require(
        type(n_hidden) is int and first[0] == (n_hidden if n_layers else len(model.classes_)),
        f"n_hidden is {n_hidden!r}, the first matrix has shape {first}",
    )
    network = perceptron(len(projection.offset_), model.n_hidden, model.n_layers, len(model.classes_))
    state = {
        name.removeprefix("network."): torch.from_numpy(values)
        for name, values in tensors.items()
        if name.startswith("network.")
    }
    network.load_state_dict(state)
    model.network_ = network.eval()
    return model


def _load_residual(head: dict[str, Any], tensors: dict[str, Any], recipe: Recipe) -> BaseEstimator:
    import torch

    model = ResidualNetworkClassifier(recipe, **head["parameters"])
    model.classes_ = np.array(head["classes"])
    model.n_features_in_ = _n_features(recipe)
    model.center_, model.scale_ = tensors["center"], tensors["scale"]
    for name in ("center", "scale"):
        require(tensors[name].shape == (model.n_features_in_,), f"{name} does not fit its recipe")
    require(bool((model.scale_ > 0.0).all()), "scale must be > 0")
    state = {
        name.removeprefix("network."): torch.from_numpy(values)
        for name, values in tensors.items()
        if name.startswith("network.")
    }
    # The sizes are believed only once the file holds as much: memory for a false one would be taken before a look.
    sizes = (model.width, model.stem, model.kernel)
    require(all(type(size) is int and size >= 1 for size in sizes), f"sizes must be integers, got {sizes!r}")
    stem, inner = state["0.0.weight"].shape, state["2.second.0.weight"].shape
    require(
        stem == (model.width, len(recipe.sensor.channels), 2 * model.stem + 1) and inner[2] == model.kernel,
        f"width, stem and kernel are {sizes}, the file holds convolutions of shape {tuple(stem)}, {tuple(inner)}",
    )
    network = residual_network(stem[1], len(model.classes_), *sizes).double()
    network.load_state_dict(state)
    model.network_ = network.eval()
    return model
