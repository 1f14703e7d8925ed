"""Cases for estimators, (n_cases, n_channels, n_timepoints) or flattened, and a fitted estimator's state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.pipeline import FeatureUnion, Pipeline
from sklearn.utils import validation
from sklearn.utils.multiclass import check_classification_targets
from torch import nn

from motor_env.common.arrays import instance, numbers
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import Timing

Arrays = dict[str, NDArray[Any]]


class State(NamedTuple):
    """State of a fitted estimator.

    Attributes:
        arrays: its numbers.
        values: for JSON; in a file with the list of `classes`.
    """

    arrays: Arrays
    values: dict[str, Any]


def plain_parameters(model: BaseEstimator) -> dict[str, Any]:
    """Return the parameters for JSON: no recipe, and a random state only if it is a number."""
    parameters = {name: value for name, value in model.get_params().items() if name != "recipe"}
    if not isinstance(parameters["random_state"], int):
        parameters["random_state"] = None
    return parameters


def module_arrays(module: nn.Module, part: str) -> Arrays:
    """Return weights and buffers of a torch module, with the part's name as prefix."""
    return {f"{part}.{name}": values.numpy() for name, values in module.state_dict().items()}


def part_of(arrays: Arrays, part: str) -> Arrays:
    """Return the arrays of one part, without its prefix."""
    return {name.removeprefix(f"{part}."): a for name, a in arrays.items() if name.startswith(f"{part}.")}


def loaded_module(module: nn.Module, arrays: Arrays) -> nn.Module:
    """Load weights and buffers in double precision into a torch module on the device `meta`.

    Raises:
        ValueError: other names or shapes than the module's.
    """
    # A file has one value in the place of a number.
    wanted = {name: tuple(values.shape) or (1,) for name, values in module.state_dict().items()}
    shapes = {name: values.shape or (1,) for name, values in arrays.items()}
    require(shapes == wanted, "its arrays do not fit its parameters")
    module.double().to_empty(device="cpu")
    module.load_state_dict({name: torch.from_numpy(a) for name, a in arrays.items()})
    return module.eval()


class ProbabilityClassifier(ClassifierMixin, BaseEstimator, ABC):
    """Classifier that decides for the most probable class."""

    classes_: NDArray[Any]

    @abstractmethod
    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class, shape (n_cases, n_classes)."""

    def predict(self, X: Any) -> NDArray[Any]:
        """Return the most probable class of each case, shape (n_cases,)."""
        most = self.predict_proba(X).argmax(axis=1)
        decided: NDArray[Any] = self.classes_[most]
        return decided


def flat_cases(estimator: BaseEstimator, X: Any, *, reset: bool, min_features: int = 1) -> FloatArray:
    """Check transients and flatten them to (n_cases, n_channels * n_timepoints), float64.

    Args:
        estimator: owner of `n_features_in_`, set in a fit, else compared.
        X: shape (n_cases, n_channels, n_timepoints), or flattened in that order.
        reset: whether this is a fit.
        min_features: least number of values in a case.

    Raises:
        ValueError: no cases, a value that is not finite, or another number of values than in the fit.
    """
    checked: FloatArray = validation.validate_data(
        estimator,
        _flattened(estimator, X, reset=reset),
        reset=reset,
        dtype=np.float64,
        ensure_min_features=min_features,
    )
    return checked


def cases_by_axis(X: Any, recipe: Recipe | None = None) -> FloatArray:
    """Return real finite cases, shape (n_cases, n_channels, n_timepoints), by the recipe's axes.

    Raises:
        ValueError: they are not; k starts a case have k times the channels.
    """
    cases = numbers("X", X, ("n_cases", "n_channels", "n_timepoints"), single=True)
    if recipe is not None:
        instance("recipe", recipe, Recipe)
        channels, samples = len(recipe.channels), recipe.timing.n_samples
        require(
            cases.shape[2] == samples and cases.shape[1] % channels == 0,
            f"X must have {channels} x {samples} values a case as recipe {recipe.name} says, "
            f"got {cases.shape[1]} x {cases.shape[2]}",
        )
    return cases


def _flattened(estimator: Any, X: Any, *, reset: bool) -> Any:
    recipe = _recipe_of(estimator)
    instance("recipe", recipe, (Recipe, type(None)))
    if hasattr(X, "columns") or hasattr(X, "toarray"):
        return X
    is_array = isinstance(X, np.ndarray) and X.dtype.kind not in "mM" and not np.ma.is_masked(X)
    if not is_array:
        X = numbers("X", X)
    seen: tuple[int, ...] | None = None
    if X.ndim > 2:
        X = cases_by_axis(X, recipe)
        seen = X.shape[1:]
        before = None if reset else getattr(estimator, "case_shape_", None)
        require(before in (None, seen), f"X must have {before} values a case as at the fit, got {seen}")
        X = X.reshape(len(X), -1)
    if reset and recipe is None:
        estimator.case_shape_ = seen
    return X


def _recipe_of(estimator: Any) -> Any:
    """Return the recipe of an estimator, or of the one inside it."""
    while estimator is not None and getattr(estimator, "recipe", None) is None:
        if isinstance(estimator, Pipeline):
            estimator = estimator.steps[0][1]
        elif isinstance(estimator, FeatureUnion):
            estimator = estimator.transformer_list[0][1]
        else:
            estimator = getattr(estimator, "estimator", None)
    return None if estimator is None else estimator.recipe


def fitting_recipe(recipe: Recipe | None, n_features: int) -> Recipe:
    """Check the recipe against the length of the cases; default: the paper's motor at its usual rate.

    Raises:
        ValueError: another length than the recipe's.
    """
    if recipe is None:
        bench = named_recipe("bench")
        rate = bench.timing.sampling_rate_hz
        return replace(bench, timing=Timing(rate, n_features / rate))
    require(
        n_features == values_of_start(recipe),
        f"X must have {len(recipe.channels)} x {recipe.timing.n_samples} values a case as recipe "
        f"{recipe.name} says, got {n_features}",
    )
    return recipe


def with_channels(flat: FloatArray, recipe: Recipe) -> FloatArray:
    """Reshape flattened cases to (n_cases, n_channels, n_timepoints)."""
    return flat.reshape(len(flat), len(recipe.channels), -1)


def measured_cases(estimator: Any, X: Any) -> tuple[Recipe, FloatArray]:
    """Return the recipe of a fitted estimator, and checked cases, shape (n_cases, n_channels, n_timepoints)."""
    validation.check_is_fitted(estimator, "n_features_in_")
    flat = flat_cases(estimator, X, reset=False)
    recipe = fitting_recipe(estimator.recipe, flat.shape[1])
    return recipe, with_channels(flat, recipe)


def values_of_start(recipe: Recipe) -> int:
    """Return the values of one start of the recipe: n_channels * n_samples."""
    return len(recipe.channels) * recipe.timing.n_samples


def check_classes(recipe: Recipe, names: NDArray[np.str_]) -> None:
    """Check that each name is a class of the recipe.

    Raises:
        ValueError: one is not.
    """
    unknown = set(names.tolist()) - set(recipe.class_names)
    require(
        not unknown, f"class must be one of {', '.join(recipe.class_names)}, got {min(unknown, default='')!r}"
    )


def labelled_cases(estimator: BaseEstimator, X: Any, y: Any) -> tuple[FloatArray, NDArray[np.int64]]:
    """Check cases and labels of a fit, set `classes_`, and return flat cases and label indices.

    Raises:
        ValueError: fewer than two classes, invalid labels, or shapes that do not fit.
    """
    flat, checked = validation.validate_data(
        estimator, _flattened(estimator, X, reset=True), y, dtype=np.float64
    )
    check_classification_targets(checked)
    estimator.classes_, labels = np.unique(checked, return_inverse=True)
    if len(estimator.classes_) < 2:
        raise ValueError(f"y must hold at least two classes, got 1 class: {estimator.classes_[0]!r}")
    return flat, labels.astype(np.int64)
