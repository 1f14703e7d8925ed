"""One class of a recipe as a function: what is read of a motor at given nuisances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from motor_env.inference.posterior import variance_factor
from motor_env.motor.faults import Fault
from motor_env.motor.parameters import Channel, FloatArray, SupplyParameters
from motor_env.simulation.drawing import apply_factors, driven, surroundings
from motor_env.simulation.fast_path import measure
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe
from motor_env.simulation.simulate import Scenario

_LARGEST_NORMAL = 6.77  # of the streams of random numbers


@dataclass(frozen=True, slots=True)
class ClassModel:
    """One class of a recipe: what is read, as a function of its nuisances.

    The coordinates are the standard normal ones of `FACTORS`; then, uniform in 0 .. 1, the recipe's priors that have a
    range, and the severities that have one.

    Attributes:
        recipe: what motors are drawn from.
        fault_class: the class.
        voltage_v: what was applied to a motor at work, shape (n_samples,), or (n, n_samples) for as many coordinates;
            None for starts.
    """

    recipe: Recipe
    fault_class: FaultClass
    voltage_v: FloatArray | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """What each coordinate is, severities by their kind."""
        uncertain = [name for name, (low, high) in self.recipe.priors.items() if low < high]
        ranged = [str(part.kind) for part in self.fault_class.parts if part.severity_to is not None]
        return (*FACTORS, *uncertain, *ranged[::-1])

    @property
    def n_uniform(self) -> int:
        """Number of uniform coordinates."""
        return len(self.names) - len(FACTORS)

    @property
    def box(self) -> FloatArray:
        """Lower and upper ends of the coordinates, shape (2, size)."""
        normal, uniform = np.full(len(FACTORS), _LARGEST_NORMAL), np.ones(self.n_uniform)
        return np.array([[*-normal, *(0.0 * uniform)], [*normal, *uniform]])

    @property
    def prior(self) -> FloatArray:
        """Means and precisions of the normal prior that stands for the uniform one in the linear motor, (2, size)."""
        return np.concatenate(
            [np.tile([[0.0], [1.0]], len(FACTORS)), np.tile([[0.5], [1.0]], self.n_uniform)], axis=1
        )

    @property
    def steps(self) -> FloatArray:
        """Step of the converter for each value, 0 where there is none, shape (n_channels * n_samples,)."""
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
        """Standard deviation of the noise of each value, the converter's with it, were that normal."""
        whole: FloatArray = np.hypot(self.noise, self.steps / np.sqrt(12.0))
        return whole

    def readings(self, values: FloatArray) -> FloatArray:
        """Readings without noise and converter, shape (n, n_channels * n_samples), at coordinates (n, size)."""
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
