"""Reference starts: healthy starts of the same motor, beside the judged start.

A judged start with k references is one case with (1 + k) times the channels, its own first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import flat_cases
from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.inference import posterior
from motor_env.inference.sensitivities import fitted_residuals
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe

_AT_ONCE = 1024


def referenced_starts(recipe: Recipe, seed: int, motors: ArrayLike, n_references: int) -> Dataset:
    """Draw motors, each with healthy starts before the judged one.

    Labels are the judged start's; X has shape (n_motors, (1 + n_references) * n_channels, n_samples).

    Args:
        recipe: distribution of the motors; its number of starts a motor is ignored.
        seed: the random seed.
        motors: motor numbers, shape (n_motors,).
        n_references: healthy starts of each motor, k.
    """
    starts = n_references + 1
    several = replace(recipe, starts_per_motor=starts, healthy_starts=n_references)
    numbers = np.atleast_1d(np.asarray(motors, dtype=np.int64))
    order = np.roll(np.arange(starts), 1)  # the last one is judged, and comes first
    cases = numbers[:, None] * starts + order
    drawn = generate_arrays(several, seed, cases.ravel())
    X = drawn.X.reshape(len(numbers), starts * drawn.X.shape[1], -1)
    return replace(drawn.select(np.arange(0, len(cases.ravel()), starts)), X=X)


def split_starts(X: Any, recipe: Recipe) -> FloatArray:
    """Split cases, also flat ones, into starts, (n_cases, 1 + n_references, n_channels, n_samples).

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
    """Compute the Bayes-optimal posterior with references, shape (n_cases, n_classes); X as `referenced_starts`."""
    starts = split_starts(X, recipe)
    return posterior.class_probabilities(
        recipe, starts[:, 0], prior=posterior.prior_from_starts(recipe, starts[:, 1:])
    )


@dataclass(eq=False, repr=False)
class RecentredStarts(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):
    """Recentre the judged start as if its motor were the nominal one.

    The references give the motor's most probable parameters (`prior_from_starts`); the deviation of its healthy
    response from nominal is subtracted.

    Args:
        recipe: motor, nuisances, faults and length of a start. Without one, a case is one start.

    Attributes:
        n_features_in_: values of a case.
    """

    recipe: Recipe | None = None

    def fit(self, X: Any, y: Any = None) -> Self:
        """Check the cases' shape."""
        self._starts(flat_cases(self, X, reset=True))
        return self

    def transform(self, X: Any) -> FloatArray:
        """Return recentred starts, flat, shape (n_cases, n_channels * n_samples); without references unchanged."""
        check_is_fitted(self, "n_features_in_")
        starts = self._starts(flat_cases(self, X, reset=False))
        parts = [
            _recentred(self.recipe, starts[begin : begin + _AT_ONCE])
            for begin in range(0, len(starts), _AT_ONCE)
        ]
        return np.concatenate(parts).reshape(len(starts), -1)

    def _starts(self, flat: FloatArray) -> FloatArray:
        return flat[:, None, None] if self.recipe is None else split_starts(flat, self.recipe)

    @property
    def _n_features_out(self) -> int:
        if self.recipe is None:
            return int(self.n_features_in_)
        return len(self.recipe.sensor.channels) * self.recipe.timing.n_samples


def _recentred(recipe: Recipe | None, starts: FloatArray) -> FloatArray:
    """Return the judged ones of starts (n_cases, 1 + n_references, n_channels, n_samples), recentred."""
    judged: FloatArray = starts[:, 0]
    if recipe is None or starts.shape[1] == 1:
        return judged
    own = posterior.prior_from_starts(recipe, starts[:, 1:]).mean
    observed, coordinates = (
        posterior.recipe_observed(recipe, judged),
        posterior.class_coordinates(recipe, FaultClass()),
    )
    nominal = fitted_residuals(observed, coordinates, np.zeros_like(own))
    moved = nominal - fitted_residuals(observed, coordinates, own)
    recentred: FloatArray = judged - moved * recipe.sensor.noise_std[:, None]
    return recentred
