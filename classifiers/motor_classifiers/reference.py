"""Starts of a motor when it was healthy, beside the start that is judged: its own tolerances, seen once, are known.

A judged start with k reference starts is one case with (1 + k) times the channels: first those of the judged start,
then those of each reference. Any method for several channels takes it as it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.cases import flat_cases
from motor_classifiers.features import ResidualProjection
from motor_datasets.generate import generate_arrays
from motor_env.parameters import FloatArray
from motor_env.posterior import class_probabilities, prior_from_starts
from motor_env.recipes import Recipe


class ReferencedStarts(NamedTuple):
    """Judged starts, each with reference starts of the same motor.

    Attributes:
        X: shape (n_motors, (1 + n_references) * n_channels, n_samples), float32.
        class_name: label of the judged start, shape (n_motors,).
        class_index: the same as an index into the recipe's classes.
    """

    X: NDArray[np.float32]
    class_name: NDArray[np.str_]
    class_index: NDArray[np.int64]


def referenced_starts(recipe: Recipe, seed: int, motors: ArrayLike, n_references: int) -> ReferencedStarts:
    """Draw motors, and of each so many healthy starts before the one that is judged.

    Args:
        recipe: what motors are drawn from; how many starts it says a motor has does not matter.
        seed: the random seed.
        motors: motor numbers, shape (n_motors,).
        n_references: healthy starts of each motor, k.
    """
    if n_references < 0:
        raise ValueError(f"n_references must be >= 0, got {n_references}")
    starts = n_references + 1
    several = replace(recipe, starts_per_motor=starts, healthy_starts=n_references)
    numbers = np.atleast_1d(np.asarray(motors, dtype=np.int64))
    cases = numbers[:, None] * starts + np.roll(
        np.arange(starts), 1
    )  # the last one is judged, and comes first
    drawn = generate_arrays(several, seed, cases.ravel())
    judged = slice(None, None, starts)
    X = drawn.X.reshape(len(numbers), starts * drawn.X.shape[1], -1)
    return ReferencedStarts(X, drawn.class_name[judged], drawn.class_index[judged])


def split_starts(X: Any, recipe: Recipe) -> FloatArray:
    """Cases as starts, shape (n_cases, 1 + n_references, n_channels, n_samples); flattened cases, too.

    Raises:
        ValueError: a case is no whole number of the recipe's starts.
    """
    n_channels, n_samples = len(recipe.sensor.channels), recipe.timing.n_samples
    cases = np.asarray(X)
    flat = cases.reshape(len(cases), -1)
    if flat.shape[1] % (n_channels * n_samples):
        raise ValueError(
            f"a case must be starts of {n_channels} x {n_samples} values each, got {flat.shape[1]} values"
        )
    return flat.reshape(len(flat), -1, n_channels, n_samples)


def referenced_probabilities(recipe: Recipe, X: Any) -> FloatArray:
    """The Bayes-optimal posterior of each class, given the reference starts: the limit for k references.

    Args:
        recipe: what motors are drawn from.
        X: as `ReferencedStarts.X`.

    Returns:
        Shape (n_cases, n_classes).
    """
    starts = split_starts(X, recipe)
    return class_probabilities(recipe, starts[:, 0], prior=prior_from_starts(recipe, starts[:, 1:]))


class ReferencedProjection(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):
    """The residual's components (`ResidualProjection`) of the judged start, and their mean over its references.

    What the two have in common is the motor's own tolerances; how much of the mean to take off, the classifier learns.
    Without a reference the components of the start stand alone.

    Args:
        recipe: the motor, its nuisances and faults, and how long one start is. Without one, a case is one start.
        n_components: directions of each.

    Attributes:
        projection_: the fitted `ResidualProjection` of one start.
        n_features_in_: values of a case.
    """

    def __init__(self, recipe: Recipe | None = None, n_components: int = 6) -> None:
        self.recipe = recipe
        self.n_components = n_components

    def fit(self, X: Any, y: Any = None) -> Self:
        """Find the directions; the labels are not looked at."""
        flat = flat_cases(self, X, reset=True)
        self.projection_ = ResidualProjection(self.recipe, self.n_components).fit(self._starts(flat)[:, 0])
        self._n_features_out = self.transform(flat[:1]).shape[1]
        return self

    def transform(self, X: Any) -> FloatArray:
        """Components, shape (n_cases, n_components), or twice as many with references."""
        check_is_fitted(self, "projection_")
        starts = self._starts(flat_cases(self, X, reset=False))
        components: FloatArray = self.projection_.transform(starts.reshape(-1, starts.shape[-1]))
        components = components.reshape(len(starts), starts.shape[1], -1)
        if starts.shape[1] == 1:
            return components[:, 0]
        return np.concatenate([components[:, 0], components[:, 1:].mean(axis=1)], axis=1)

    def _starts(self, flat: FloatArray) -> FloatArray:
        """Shape (n_cases, 1 + n_references, values of a start)."""
        if self.recipe is None:
            return flat[:, None]
        starts = split_starts(flat, self.recipe)
        return starts.reshape(*starts.shape[:2], -1)
