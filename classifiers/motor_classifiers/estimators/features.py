"""Features of a transient: the filter's residual, the motor's parameters, the decision rules' statistics.

The transformers take (n_cases, n_channels, n_timepoints) or flattened cases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, measured_cases
from motor_env.common.arrays import whole
from motor_env.detection.rules import Cusum, Rule, nis_rule
from motor_env.detection.rules.tolerant import TolerantFilter
from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import KalmanFilter
from motor_env.inference.class_model import FEATURE_NAMES, physical_features
from motor_env.inference.whitening import MatchedTest
from motor_env.inference.work_features import work_feature_names, work_features
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe
from motor_env.simulation.sampling import draw
from motor_env.simulation.simulate import simulate

_FAMILY_SEED = 0xFA317  # of the noise-free signal family; no data set is drawn with it
_AT_ONCE = 512  # cases filtered at a time
# Of the CUSUMs, in standard deviations of the noise: between a bearing of 10 % and of 25 % at 20 mA.
_SHIFT = 0.2
_RULES: dict[str, Rule] = {"nis": nis_rule(), "cusum": Cusum(_SHIFT, two_sided=True)}


def whitened_residual(recipe: Recipe, measurements: FloatArray) -> FloatArray:
    """Compute the whitened residual of a filter for the nominal motor.

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
    """Return residuals of noise-free starts drawn from the recipe, shape (n_draws, n_samples * n_channels)."""
    drawn = draw(recipe, _FAMILY_SEED, np.arange(n_draws)).scenario
    silent = replace(drawn, sensor=drawn.sensor.with_noise(0.0))
    clean = simulate(silent, _FAMILY_SEED, np.arange(n_draws)).measurements
    return whitened_residual(recipe, clean)


def affine_map(recipe: Recipe, numbers: Callable[[FloatArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return weights and offset of numbers affine in the measurements: flat @ weights.T + offset.

    Args:
        recipe: for channels and time axis.
        numbers: maps measurements (n_cases, n_channels, n_samples) to (n_cases, n_numbers).

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


@dataclass(eq=False, repr=False)
class ResidualProjection(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):
    """The filter's residual along the leading singular vectors of the model's own signal family.

    The likelihood depends on a transient only through the few directions in which the model's signals differ.

    Args:
        recipe: motor, nuisances and faults. Without one, directions come from the training cases.
        n_components: number of directions.
        n_draws: noise-free starts that span the family.

    Attributes:
        weights_: shape (n_components, n_features_in_).
        offset_: shape (n_components,); components are X @ weights_.T + offset_, in units of the noise.
    """

    recipe: Recipe | None = None
    n_components: int = 10
    _: KW_ONLY
    n_draws: int = 1000

    def fit(self, X: Any, y: Any = None) -> Self:
        """Find the directions, without the labels."""
        whole("n_components", self.n_components, 1)
        whole("n_draws", self.n_draws, 1)
        flat = flat_cases(self, X, reset=True)
        if self.recipe is None:
            mean = flat.mean(axis=0)
            self.weights_ = np.linalg.svd(flat - mean, full_matrices=False)[2][: self.n_components]
            self.offset_ = -self.weights_ @ mean
        else:
            recipe = fitting_recipe(self.recipe, flat.shape[1])
            family = signal_family(recipe, self.n_draws)
            directions = np.linalg.svd(family, full_matrices=False)[2][: self.n_components]
            # The filter's gains do not depend on the data, so its residual is affine in the measurements: one product
            # with a small matrix does the work of the filter and of the projection.
            self.weights_, self.offset_ = affine_map(
                recipe, lambda measured: whitened_residual(recipe, measured) @ directions.T
            )
        return self

    def restore(self, weights: FloatArray, offset: FloatArray) -> int:
        """Take the directions of a file; return their number.

        Raises:
            ValueError: shapes that do not fit.
        """
        shape = weights.shape
        require(
            weights.ndim == 2 and offset.shape == shape[:1], f"weights of shape {shape} do not fit the offset"
        )
        self.weights_, self.offset_, self.n_features_in_ = weights, offset, shape[1]
        return len(offset)

    def transform(self, X: Any) -> FloatArray:
        """Return components of each case, shape (n_cases, n_components)."""
        check_is_fitted(self)
        components: FloatArray = flat_cases(self, X, reset=False) @ self.weights_.T + self.offset_
        return components

    @property
    def _n_features_out(self) -> int:
        return len(self.weights_)


@dataclass(eq=False, repr=False)
class PhysicalFeatures(TransformerMixin, BaseEstimator):
    """Most probable parameters of each transient, their errors, and residual statistics.

    Columns: `motor_env.inference.class_model.FEATURE_NAMES`, or `work_feature_names` for motors at work.

    Args:
        recipe: nominal motor, tolerances, supply, sensor and timing; without one, the paper's motor at 10 kHz.
    """

    recipe: Recipe | None = None

    def fit(self, X: Any, y: Any = None) -> Self:
        """Check the cases' shape."""
        flat = flat_cases(self, X, reset=True, min_features=2)
        fitting_recipe(self.recipe, flat.shape[1])
        return self

    def transform(self, X: Any) -> FloatArray:
        """Return features of each case, shape (n_cases, n_features)."""
        recipe, measured = measured_cases(self, X)
        return physical_features(recipe, measured) if recipe.duty is None else work_features(recipe, measured)

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Return the names of the columns."""
        check_is_fitted(self, "n_features_in_")
        if self.recipe is None or self.recipe.duty is None:
            return np.array(FEATURE_NAMES, dtype=object)
        return np.array(work_feature_names(self.recipe), dtype=object)


@dataclass(eq=False, repr=False)
class RuleStatistics(TransformerMixin, BaseEstimator):
    """Statistics of the decision rules over a transient, and a matched test for each fault of the recipe.

    The largest NIS, the largest CUSUM, and the mean NIS, each as log(1 + x), of the residual whitened for the recipe's
    tolerances. A linear classifier on the matched tests is a bank of filters to first order.

    Args:
        recipe: nominal motor, tolerances, faults, sensor and timing; without one, the paper's motor at 10 kHz.

    Attributes:
        weights_: of the matched tests, affine in the measurements, shape (n_tests, n_features_in_).
        offset_: shape (n_tests,).
        feature_names_: of the columns.
    """

    recipe: Recipe | None = None

    def fit(self, X: Any, y: Any = None) -> Self:
        """Prepare the tests from the recipe."""
        flat = flat_cases(self, X, reset=True, min_features=2)
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        single = [
            c for c in recipe.classes if len(c.faults) == 1 and c.kind is not None and c.kind.motor_powers
        ]
        tests = [MatchedTest.from_recipe(recipe, c.faults[0]) for c in single]
        self.weights_, self.offset_ = affine_map(
            recipe,
            lambda measured: np.array([t.statistic(measured) for t in tests]).reshape(-1, len(measured)).T,
        )
        self.feature_names_ = [*_RULES, "mean_nis", *(f"matched_{c.name}" for c in single)]
        return self

    def transform(self, X: Any) -> FloatArray:
        """Return statistics of each case, shape (n_cases, n_statistics)."""
        recipe, measured = measured_cases(self, X)
        begins = range(0, len(measured), _AT_ONCE)
        levels = np.concatenate([_levels(recipe, measured[begin : begin + _AT_ONCE]) for begin in begins])
        return np.column_stack([levels, measured.reshape(len(measured), -1) @ self.weights_.T + self.offset_])

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Return the names of the columns."""
        check_is_fitted(self)
        return np.array(self.feature_names_, dtype=object)


def _levels(recipe: Recipe, measured: FloatArray) -> FloatArray:
    white = _filter(recipe).white(measured)
    largest = [rule.statistic(white).max(axis=-1) for rule in _RULES.values()]
    levels: FloatArray = np.log1p([*largest, np.square(white).mean(axis=(1, 2))]).T
    return levels


@lru_cache(maxsize=4)
def _filter(recipe: Recipe) -> TolerantFilter:
    """Return filter and whitening of the recipe."""
    return TolerantFilter.from_recipe(recipe)
