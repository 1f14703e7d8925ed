"""Features of a transient: what the filter leaves over, and the motor's parameters. Levels are kept, always.

Both transformers take (n_cases, n_channels, n_timepoints) or flattened cases, and work in scikit-learn's Pipeline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, with_channels
from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import KalmanFilter
from motor_env.inference.features import FEATURE_NAMES, physical_features
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.drawing import draw
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.simulate import simulate

_FAMILY_SEED = 0xFA317  # of the noise-free signal family; no data set is drawn with it
_AT_ONCE = 512


def whitened_residual(recipe: Recipe, measurements: FloatArray) -> FloatArray:
    """Residual of the filter that believes in the recipe's nominal motor, white where it is right.

    Args:
        recipe: nominal motor, supply, sensor and timing.
        measurements: shape (n_cases, n_channels, n_samples).

    Returns:
        Shape (n_cases, n_samples * n_channels).
    """
    belief = KalmanFilter.from_parameters(recipe.motor, recipe.sensor, recipe.timing.dt_s)
    whitened = run_filter(belief, measurements, recipe.nominal_voltage_v).whitened
    return whitened.reshape(len(measurements), -1)


def signal_family(recipe: Recipe, n_draws: int) -> FloatArray:
    """Residuals of noise-free starts drawn from the recipe, shape (n_draws, n_samples * n_channels)."""
    drawn = draw(recipe, _FAMILY_SEED, np.arange(n_draws)).scenario
    silent = replace(drawn, sensor=drawn.sensor.with_noise(0.0))
    clean = simulate(silent, _FAMILY_SEED, np.arange(n_draws)).measurements
    return whitened_residual(recipe, clean)


def residual_map(recipe: Recipe, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights and offset such that measurements @ weights.T + offset is the residual along the directions.

    The filter's gains do not depend on the data, so its residual is an affine map of the measurements: one product
    with a small matrix does the work of the filter and of the projection.

    Args:
        recipe: whose filter.
        directions: shape (n_components, n_samples * n_channels).

    Returns:
        Weights (n_components, n_channels * n_samples) and offset (n_components,).
    """
    return affine_map(recipe, lambda measured: whitened_residual(recipe, measured) @ directions.T)


def affine_map(recipe: Recipe, numbers: Callable[[FloatArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Weights and offset such that flattened measurements @ weights.T + offset are some numbers affine in them.

    Args:
        recipe: whose channels and time axis.
        numbers: from measurements (n_cases, n_channels, n_samples) to (n_cases, n_numbers).

    Returns:
        Weights (n_numbers, n_channels * n_samples) and offset (n_numbers,).
    """
    n_channels, n_samples = len(recipe.sensor.channels), recipe.timing.n_samples
    size = n_channels * n_samples
    offset = numbers(np.zeros((1, n_channels, n_samples)))[0]
    weights = np.empty((len(offset), size))
    for begin in range(0, size, _AT_ONCE):
        columns = np.arange(begin, min(begin + _AT_ONCE, size))
        units = np.zeros((len(columns), size))
        units[np.arange(len(columns)), columns] = 1.0
        weights[:, columns] = (numbers(units.reshape(-1, n_channels, n_samples)) - offset).T
    return weights, offset


class ResidualProjection(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):
    """The filter's residual along the leading singular vectors of the model's own signal family.

    A transient in white noise enters its likelihood only through the directions in which the model's signals can
    differ; a handful of them carry everything (docs/classifiers.md). The directions come from noise-free draws
    of the recipe, not from training cases, and are fixed by the recipe.

    Args:
        recipe: the motor, its nuisances and faults. Without one, directions come from the training cases.
        n_components: how many directions.
        n_draws: noise-free starts that span the family.

    Attributes:
        weights_: shape (n_components, n_features_in_).
        offset_: shape (n_components,); components are X @ weights_.T + offset_, in units of the noise.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(self, recipe: Recipe | None = None, n_components: int = 10, *, n_draws: int = 1000) -> None:
        self.recipe = recipe
        self.n_components = n_components
        self.n_draws = n_draws

    def fit(self, X: Any, y: Any = None) -> Self:
        """Find the directions; the labels are not looked at."""
        flat = flat_cases(self, X, reset=True)
        if self.recipe is None:
            mean = flat.mean(axis=0)
            self.weights_ = np.linalg.svd(flat - mean, full_matrices=False)[2][: self.n_components]
            self.offset_ = -self.weights_ @ mean
        else:
            recipe = fitting_recipe(self.recipe, flat.shape[1])
            family = signal_family(recipe, self.n_draws)
            directions = np.linalg.svd(family, full_matrices=False)[2][: self.n_components]
            self.weights_, self.offset_ = residual_map(recipe, directions)
        return self

    def transform(self, X: Any) -> FloatArray:
        """Components of each case, shape (n_cases, n_components)."""
        check_is_fitted(self)
        components: FloatArray = flat_cases(self, X, reset=False) @ self.weights_.T + self.offset_
        return components

    @property
    def _n_features_out(self) -> int:
        return len(self.weights_)


class PhysicalFeatures(TransformerMixin, BaseEstimator):
    """Most probable parameters of each transient, their errors, and what the fit leaves over.

    The columns are named in `motor_env.inference.features.FEATURE_NAMES`.

    Args:
        recipe: nominal motor, tolerances, supply, sensor and timing; without one, the paper's motor at 10 kHz.

    Attributes:
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(self, recipe: Recipe | None = None) -> None:
        self.recipe = recipe

    def fit(self, X: Any, y: Any = None) -> Self:
        """Check the cases' shape; there is nothing to learn."""
        flat = flat_cases(self, X, reset=True, min_features=2)
        fitting_recipe(self.recipe, flat.shape[1])
        return self

    def transform(self, X: Any) -> FloatArray:
        """Features of each case, shape (n_cases, n_features)."""
        check_is_fitted(self, "n_features_in_")
        flat = flat_cases(self, X, reset=False)
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        return physical_features(recipe, with_channels(flat, recipe))

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Names of the columns."""
        check_is_fitted(self, "n_features_in_")
        return np.array(FEATURE_NAMES, dtype=object)
