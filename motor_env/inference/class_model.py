"""A class of a recipe as a function of its nuisances, and the residuals of its best fit as features."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from motor_env.inference.fit import Prior, fit
from motor_env.inference.posterior import recipe_observed, variance_factor
from motor_env.inference.sensitivities import Coordinates, fitted_residuals
from motor_env.motor.faults import Fault
from motor_env.motor.parameters import Channel, FloatArray, SupplyParameters
from motor_env.simulation.fast_path import measure
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe
from motor_env.simulation.sampling import apply_factors, driven, surroundings
from motor_env.simulation.simulate import Scenario

FEATURE_FREE = ("resistance", "friction", "supply", "constants", "inertia")
"""Quantities that the features' fit frees: those of faults first, then the nuisances."""

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
    """Compute most probable factors, their errors, and residual statistics of each transient (Isermann 1984).

    R and B have a prior of 30 %, the supply, K and J their tolerances; L is nominal.

    Args:
        recipe: nominal motor and supply, tolerances, sensor and timing.
        measurements: shape (n_cases, n_channels, n_samples).

    Returns:
        Shape (n_cases, len(FEATURE_NAMES)). Residuals are in units of the noise.
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


_LARGEST_NORMAL = 6.77  # of the streams of random numbers


@dataclass(frozen=True, slots=True)
class ClassModel:
    """One class of a recipe: the readings as a function of its nuisances.

    Coordinates: `FACTORS`, standard normal; then priors and severities that have a range, uniform in 0 .. 1.

    Attributes:
        recipe: distribution of the motors.
        fault_class: the class.
        voltage_v: of a motor at work, shape (n_samples,) or (n, n_samples); None for starts.
    """

    recipe: Recipe
    fault_class: FaultClass
    voltage_v: FloatArray | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coordinate; severities by their kind."""
        uncertain = [name for name, (low, high) in self.recipe.priors.items() if low < high]
        ranged = [str(part.kind) for part in self.fault_class.parts if part.severity_to is not None]
        return (*FACTORS, *uncertain, *ranged[::-1])

    @property
    def n_uniform(self) -> int:
        """Number of uniform coordinates."""
        return len(self.names) - len(FACTORS)

    @property
    def box(self) -> FloatArray:
        """Lower and upper bounds of the coordinates, shape (2, size)."""
        normal, uniform = np.full(len(FACTORS), _LARGEST_NORMAL), np.ones(self.n_uniform)
        return np.array([[*-normal, *(0.0 * uniform)], [*normal, *uniform]])

    @property
    def prior(self) -> FloatArray:
        """Means and precisions of the normal prior that approximates the uniform one in the linear motor, (2, size)."""
        return np.concatenate(
            [np.tile([[0.0], [1.0]], len(FACTORS)), np.tile([[0.5], [1.0]], self.n_uniform)], axis=1
        )

    @property
    def steps(self) -> FloatArray:
        """Converter step of each value, 0 without one, shape (n_channels * n_samples,)."""
        channels, field = self.recipe.sensor.channels, self.recipe.field
        step = (
            2.0 * field.sensor_range_a / 2.0**field.adc_bits if field is not None and field.adc_bits else 0.0
        )
        each = [step * (channel is Channel.CURRENT) for channel in channels]
        return np.repeat(each, self.recipe.timing.n_samples)

    @property
    def noise(self) -> FloatArray:
        """Standard deviation of the noise of each value, without the converter's."""
        std = np.sqrt(variance_factor(self.fault_class)) * self.recipe.sensor.noise_std
        return np.repeat(std, self.recipe.timing.n_samples)

    @property
    def whole_noise(self) -> FloatArray:
        """Standard deviation of the noise of each value, with the converter's as if normal."""
        whole: FloatArray = np.hypot(self.noise, self.steps / np.sqrt(12.0))
        return whole

    def readings(self, values: FloatArray) -> FloatArray:
        """Compute readings without noise and converter, shape (n, n_channels * n_samples), at coordinates (n, size)."""
        recipe, n = self.recipe, len(values)
        factors = 1.0 + recipe.spread.std * values[:, : len(FACTORS)]
        severities, column = {}, values.shape[1]
        for part in self.fault_class.parts:
            if part.kind is not None:
                severities[part.kind] = np.full(n, part.severity)
                if part.severity_to is not None:
                    column -= 1
                    severities[part.kind] += (part.severity_to - part.severity) * values[:, column]
        scenario = Scenario(
            parameters=apply_factors(recipe.motor, factors),
            faults=tuple(Fault(kind, severity) for kind, severity in severities.items()),
            supply=SupplyParameters(recipe.supply.voltage_v * factors[:, FACTORS.index("supply")]),
            sensor=recipe.sensor.with_noise(0.0),
            timing=recipe.timing,
        )
        effects = chain = driving = None
        if recipe.field is not None:
            low, high = np.array(list(recipe.priors.values())).T
            drawn, free = np.tile(low, (n, 1)), low < high
            drawn[:, free] += (high - low)[free] * values[:, len(FACTORS) : len(FACTORS) + free.sum()]
            effects, chain = surroundings(recipe, drawn, severities)
            chain = replace(chain, adc_bits=0, range_a=0.0, missing_fraction=0.0)
            if self.voltage_v is not None:
                driving = driven(recipe, drawn, np.atleast_2d(self.voltage_v))
        exact = measure(
            scenario, 0, np.arange(n), effects=effects, chain=chain, nominal=recipe.motor, driving=driving
        )
        return exact[:, : len(recipe.sensor.channels)].reshape(n, -1).astype(np.float64)
