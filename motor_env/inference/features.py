"""Features for classifiers that have a meaning: fitted parameters of a transient and what the fit leaves over."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from motor_env.inference.fit import Prior, fit
from motor_env.inference.parametrisation import Coordinates
from motor_env.inference.posterior import recipe_observed
from motor_env.inference.sensitivities import fitted_residuals
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

FEATURE_FREE = ("resistance", "friction", "supply", "constants", "inertia")
"""What the features' fit frees: the faults' quantities first, then the nuisances."""

FEATURE_NAMES = (
    *(f"log_{name}" for name in FEATURE_FREE),
    *(f"log_std_{name}" for name in FEATURE_FREE[:2]),
    "reduced_chi2",
    "residual_mean",
    "residual_late_mean",
    "residual_lag1",
    "residual_largest",
)
"""Names of the columns of `physical_features`."""
_FAULT_STD = 0.3  # of the prior on log R and log B


def physical_features(recipe: Recipe, measurements: ArrayLike) -> FloatArray:
    """Most probable factors, their errors, and statistics of the residual of each transient (Isermann 1984).

    R and B have a prior of 30 %; the supply, K and J have their tolerances as prior; L is nominal.

    Args:
        recipe: nominal motor and supply, tolerances, sensor and timing.
        measurements: shape (n_cases, n_channels, n_samples).

    Returns:
        Shape (n_cases, len(FEATURE_NAMES)), columns as named there. Residuals are in units of the noise.
    """
    observed = recipe_observed(recipe, measurements)
    tolerances = [max(getattr(recipe.spread, name), 1e-6) for name in FEATURE_FREE[2:]]
    coordinates = Coordinates.from_names(recipe.motor, FEATURE_FREE)
    fitted = fit(observed, coordinates, Prior.from_std([_FAULT_STD, _FAULT_STD, *tolerances]))
    residual = fitted_residuals(observed, coordinates, fitted.values).reshape(observed.n_cases, -1)
    late = residual[:, -max(1, residual.shape[1] // 5) :]
    lag1 = (residual[:, 1:] * residual[:, :-1]).mean(axis=1)
    return np.column_stack(
        [
            fitted.values,
            np.log(fitted.std[:, :2]),
            fitted.chi2 / observed.n_values,
            residual.mean(axis=1),
            late.mean(axis=1),
            lag1,
            np.abs(residual).max(axis=1),
        ]
    )
