"""Detect starts that a recipe does not explain, and name the likely shift.

Along the few directions in which starts differ, the classes form a Gaussian mixture; outside there is only noise. The
distance is the log likelihood ratio of any motor, in any surroundings and of any larger noise, to the recipe (Neyman &
Pearson 1933). Its threshold is the quantile of fresh starts of the recipe. The likely shift is the one departure that
explains the start best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from sklearn.base import BaseEstimator, OutlierMixin

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, measured_cases, values_of_start
from motor_classifiers.estimators.networks.signal_space import SignalSpace
from motor_datasets.generate import generate_arrays
from motor_env.common.arrays import number, numbers
from motor_env.inference.class_model import ClassModel
from motor_env.inference.posterior import variance_factor
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.disturbances import PRIORS, Field
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe, Spread
from motor_env.simulation.sampling import apply_factors

SEED = 0xFA318  # of mixture and threshold; no data set is drawn with it
N_FITTED = 6_000  # starts that the mixture is fitted to
_CALIBRATION = 10_000
ANYWHERE = 0.1  # variance of any surroundings, relative to that of the departures that are named
WIDER = 4.0  # variance of any motor, relative to that of all the recipe's starts
SIZES = {"offset": 0.005, "gain": 0.02, "warmth": 20.0, "load": 0.5, "severity": 0.10, "another motor": 0.10}
_RAMP = 5.0  # electrical time constants
_HEALTHY = FaultClass()


Levels = tuple[float, float]
"""Smallest and largest factor on the variance of the noise."""


class Coordinates(NamedTuple):
    """Starts in units of the noise.

    Attributes:
        along: coefficients along the directions, shape (n, n_directions).
        energy: squares outside them, shape (n,).
    """

    along: FloatArray
    energy: FloatArray


class GaussianMixture(NamedTuple):
    """Density of starts along the directions, one normal distribution a class, in units of the noise.

    Attributes:
        log_weight: shape (n_components,).
        mean: shape (n_components, n_directions).
        covariance: without the noise, shape (n_components, n_directions, n_directions).
        noise: variance of the noise, relative to the recipe's, shape (n_components,).
    """

    log_weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    noise: FloatArray

    def log_density(self, at: Coordinates, freedom: int, levels: Levels) -> FloatArray:
        """Return the log density up to a constant, shape (n,), with the noise estimated within the levels."""
        logs = []
        for weight, mean, covariance, noise in zip(*self, strict=True):
            level = noise * np.clip(at.energy / (freedom * noise), *levels)
            values, axes = np.linalg.eigh(covariance)
            variance = np.maximum(values, 0.0) + level[:, None]
            squares = np.square((at.along - mean) @ axes) / variance
            outside = at.energy / level + freedom * np.log(level)
            logs.append(weight - 0.5 * ((squares + np.log(variance)).sum(axis=1) + outside))
        density: FloatArray = logsumexp(logs, axis=0)
        return density


_NO_MIXTURE = GaussianMixture(*(np.zeros(0),) * 4)


@dataclass(frozen=True, slots=True)
class StartDensity:
    """Densities of a recipe's starts, with and without one departure.

    Attributes:
        recipe: distribution of motors, one start each.
        nominal: start of the nominal motor, shape (n_values,).
        noise: standard deviation of each value's noise, shape (n_values,).
        directions: orthonormal in units of the noise, shape (n_directions, n_values).
        own: the recipe's starts.
        alternative: any motor in any surroundings.
        departures: the recipe's starts with one departure, by its name.
    """

    recipe: Recipe
    nominal: FloatArray
    noise: FloatArray
    directions: FloatArray
    own: GaussianMixture
    alternative: GaussianMixture
    departures: Mapping[str, GaussianMixture]

    @classmethod
    def from_recipe(cls, recipe: Recipe) -> StartDensity:
        """Fit the mixtures to `N_FITTED` simulated starts.

        Raises:
            ValueError: a recipe of motors at work, or of failed sensors.
        """
        recipe.require_motor_faults()
        recipe.require_step()
        single = single_starts(recipe)
        space = SignalSpace.from_recipe(single, None, sees_noise=True)
        nominal, noise, directions = (
            np.asarray(part) for part in (space.nominal, space.noise, space.directions)
        )
        signatures = {name: rows / noise for name, rows in _signatures(single).items()}
        for row in np.concatenate([*signatures.values()]):
            left = row - directions.T @ (directions @ row)
            if len(directions) < len(noise) - 1 and np.linalg.norm(left) > 1e-6 * np.linalg.norm(row):
                directions = np.vstack([directions, left / np.linalg.norm(left)])
        first = cls(single, nominal, noise, directions, *(_NO_MIXTURE,) * 2, {})
        (at, _), family = first.noiseless(single, 0, N_FITTED)
        own = class_mixture(single, at, family)
        spread = {name: (rows @ directions.T).T @ (rows @ directions.T) for name, rows in signatures.items()}
        wide = WIDER * np.atleast_2d(np.cov(at.T)) + ANYWHERE * sum(spread.values())
        weight = np.zeros(1)
        alternative = GaussianMixture(weight, at.mean(axis=0)[None], wide[None], own.noise.min() + weight)
        departures = {name: own._replace(covariance=own.covariance + extra) for name, extra in spread.items()}
        return replace(first, own=own, alternative=alternative, departures=departures)

    def noiseless(self, recipe: Recipe, begin: int, count: int) -> tuple[Coordinates, NDArray[np.int64]]:
        """Return starts of the recipe without noise, and their classes."""
        family = generate_arrays(_silent(recipe), SEED, np.arange(begin, begin + count))
        return self.coordinates(family.X.reshape(count, -1).astype(np.float64)), family.class_index

    def coordinates(self, flat: FloatArray) -> Coordinates:
        """Return coordinates of cases, `flat` of shape (n, n_values)."""
        deviation = (flat - self.nominal) / self.noise
        along = deviation @ self.directions.T
        return Coordinates(along, np.square(deviation - along @ self.directions).sum(axis=1))

    @property
    def freedom(self) -> int:
        """Degrees of freedom outside the directions."""
        return len(self.noise) - len(self.directions)

    def distance(self, at: Coordinates, levels: Levels) -> FloatArray:
        """Return the log likelihood ratio of any start to the recipe's, shape (n,); `levels`: allowed noise."""
        alternative = self.alternative.log_density(at, self.freedom, (levels[0], np.inf))
        return alternative - self.own.log_density(at, self.freedom, levels)

    def likely_departure(self, at: Coordinates, levels: Levels) -> NDArray[Any]:
        """Return the departure that explains each start best, a key of `ADVICE`, shape (n,)."""
        logs = [self.own.log_density(at, self.freedom, (levels[0], np.inf))]
        logs += [mixture.log_density(at, self.freedom, levels) for mixture in self.departures.values()]
        names = np.array(["noise", *self.departures], dtype=object)
        likeliest: NDArray[Any] = names[np.argmax(logs, axis=0)]
        return likeliest

    def calibration_starts(self, level: float) -> Coordinates:
        """Return starts outside the fitted ones, at `level` times the noise variance."""
        silent, class_index = self.noiseless(self.recipe, N_FITTED, _CALIBRATION)
        noise = level * noise_variances(self.recipe)[class_index]
        generator = np.random.default_rng(SEED)
        std = np.sqrt(noise)
        along = silent.along + std[:, None] * generator.standard_normal(silent.along.shape)
        first = np.sqrt(silent.energy) + std * generator.standard_normal(len(std))
        rest = noise * generator.chisquare(self.freedom - 1, len(std)) if self.freedom > 1 else 0.0
        return Coordinates(along, np.square(first) + rest)


def single_starts(recipe: Recipe) -> Recipe:
    """Return the recipe with one start of each motor."""
    return replace(recipe, starts_per_motor=1, healthy_starts=0, shifts=())


def _silent(recipe: Recipe) -> Recipe:
    field = None if recipe.field is None else replace(recipe.field, adc_bits=0)
    return replace(recipe, sensor=recipe.sensor.with_noise(0.0), field=field)


def noise_variances(recipe: Recipe) -> FloatArray:
    """Return each class's noise variance (converter included) over the recipe's, shape (n_classes,)."""
    steps = ClassModel(recipe, recipe.classes[0]).steps
    converter = np.square(steps).mean() / 12.0 / np.square(recipe.sensor.noise_std).mean()
    variances: FloatArray = np.array([variance_factor(each) for each in recipe.classes]) + converter
    return variances


def class_mixture(recipe: Recipe, at: FloatArray, class_index: NDArray[np.int64]) -> GaussianMixture:
    """Fit one normal distribution to each drawn class."""
    drawn = [n for n in range(len(recipe.classes)) if (class_index == n).sum() > 1]
    groups = [at[class_index == n] for n in drawn]
    return GaussianMixture(
        np.log([len(each) / len(at) for each in groups]),
        np.array([each.mean(axis=0) for each in groups]),
        np.array([np.atleast_2d(np.cov(each.T)) for each in groups]),
        noise_variances(recipe)[drawn],
    )


def _signatures(recipe: Recipe) -> dict[str, FloatArray]:
    field = Field() if recipe.field is None else recipe.field
    middle = {name: 0.5 * sum(getattr(field, name)) for name in PRIORS}
    calm = replace(field, adc_bits=0, sensor_range_a=0.0, missing_fraction=0.0)
    volts = np.asarray(recipe.supply.voltage_v)

    def start(factors: FloatArray | float = 1.0, fault: FaultClass = _HEALTHY, **more: float) -> FloatArray:
        factors = np.broadcast_to(factors, len(FACTORS))
        values = {name: (value + more.get(name, 0.0),) * 2 for name, value in middle.items()}
        other = replace(
            _silent(recipe),
            motor=apply_factors(recipe.motor, factors),
            supply=replace(recipe.supply, voltage_v=float(volts * factors[FACTORS.index("supply")])),
            spread=Spread(),
            classes=(fault,),
            field=replace(calm, **values),  # type: ignore[arg-type]  # names of ranges
        )
        return generate_arrays(other, SEED, 1).X.reshape(1, -1).astype(np.float64)

    usual = start()
    faults = [FaultClass(kind, SIZES["severity"]) for kind in recipe.kinds if kind.motor_powers]
    signatures = {
        "offset": start(sensor_offset_a=SIZES["offset"] * float(np.abs(usual).max())),
        "gain": start(sensor_gain=SIZES["gain"]),
        "ramp": start(ramp_s=_RAMP * float(recipe.motor.inductance_h / recipe.motor.resistance_ohm)),
        "warmth": start(temperature_rise_k=SIZES["warmth"]),
        "load": start(load_ratio=SIZES["load"]),
        "severity": np.concatenate([usual, *(start(fault=fault) for fault in faults)])[1:],
        "another motor": np.concatenate(
            [start(1.0 + SIZES["another motor"] * row) for row in np.eye(len(FACTORS))]
        ),
    }
    return {name: rows - usual for name, rows in signatures.items()}


OUTSIDE = "outside what I know"
"""Verdict on a start that the recipe does not explain."""

ADVICE = {
    "noise": "the sensor is noisier than in training: train for its noise",
    "offset": "the sensor's offset differs: measure it before the start and subtract it",
    "gain": "the sensor's gain differs: calibrate it",
    "ramp": "the supply rises more slowly than in training: put `ramp_s` into the recipe",
    "warmth": "winding and magnets are warmer or colder than in training: measure the temperature, or wait",
    "load": "the motor drives a load: uncouple it, or put `load_ratio` into the recipe",
    "severity": "a fault of another size than in training: train with `severity_to`, or ask `motor-env diagnose`",
    "another motor": "it is another motor, or has a fault never trained on: use a model of its own, or "
    "`motor-env diagnose`",
}
"""Each departure, with advice."""


_QUIETEST = 1e-6
_LEVELS = 8  # of a noise that is not known


@dataclass(eq=False, repr=False)
class OutsideDetector(OutlierMixin, BaseEstimator):
    """Scikit-learn detector of starts that a recipe does not explain.

    Args:
        recipe: known motors, faults, surroundings and sensor; by default the paper's motor at 10 kHz.
        false_alarm_rate: share of the recipe's own starts called foreign.
        noise_range: bounds of the factor on the recipe's noise, if unknown.

    Attributes:
        levels_: log levels of the noise variance, shape (n_levels,).
        offset_: threshold on `score_samples` at these levels, linear in between.
    """

    recipe: Recipe | None = None
    false_alarm_rate: float = 0.01
    noise_range: tuple[float, float] | None = None

    def fit(self, X: Any = None, y: Any = None) -> Self:
        """Set the threshold on given starts of the known classes, or on fresh ones of the recipe.

        Raises:
            ValueError: a rate outside (0, 1), or starts of another length.
        """
        rate = number("false_alarm_rate", self.false_alarm_rate, above=0.0, below=1.0)
        given = None if X is None else flat_cases(self, X, reset=True, min_features=2)
        if given is None:
            require(self.recipe is not None, "fit needs starts or a recipe, got neither")
            self.n_features_in_ = values_of_start(self.recipe)  # type: ignore[arg-type]  # there is one
        low, high = self._variances
        levels = np.geomspace(low, high, 1 if low == high else _LEVELS)
        self.levels_ = np.log(levels)
        density = self._start_density
        starts: list[Any] = [
            density.calibration_starts(level) if given is None else self._at(given) for level in levels
        ]
        distances = [density.distance(group, (low, high)) for group in starts]
        self.offset_ = np.array([np.quantile(-distance, rate) for distance in distances])
        return self

    def score_samples(self, X: Any) -> FloatArray:
        """Return the negative distance from the recipe's starts, shape (n_cases,)."""
        return -self._start_density.distance(self._at(X), self._variances)

    def decision_function(self, X: Any) -> FloatArray:
        """Return the score over the threshold, below 0 for foreign starts, shape (n_cases,)."""
        return self._over(self._at(X))

    def predict(self, X: Any) -> NDArray[np.int64]:
        """Return -1 for foreign starts, else 1, shape (n_cases,)."""
        return np.where(self.decision_function(X) < 0.0, -1, 1)

    def likely_shift(self, X: Any) -> NDArray[Any]:
        """Return the best explanation of foreign starts, a key of `ADVICE`; empty for others, shape (n_cases,)."""
        at = self._at(X)
        foreign = self._over(at) < 0.0
        names = np.full(len(foreign), "", dtype=object)
        if foreign.any():
            names[foreign] = self._start_density.likely_departure(
                type(at)(*(part[foreign] for part in at)), self._variances
            )
        return names

    def _over(self, at: Any) -> FloatArray:
        level = np.maximum(at.energy / self._start_density.freedom, _QUIETEST)
        threshold = np.interp(np.log(level), self.levels_, self.offset_)
        over: FloatArray = -self._start_density.distance(at, self._variances) - threshold
        return over

    @property
    def _variances(self) -> Levels:
        if self.noise_range is None:
            return 1.0, 1.0
        low, high = numbers("noise_range", self.noise_range, (2,)).tolist()
        require(0.0 < low <= high, f"noise_range must be 0 < low <= high, got {low:g} to {high:g}")
        return low**2, high**2

    @property
    def _start_density(self) -> StartDensity:
        return _start_density(fitting_recipe(self.recipe, self.n_features_in_))

    def _at(self, X: Any) -> Any:
        _, cases = measured_cases(self, X)
        return self._start_density.coordinates(cases.reshape(len(cases), -1))


@lru_cache(maxsize=4)
def _start_density(recipe: Recipe) -> StartDensity:
    return StartDensity.from_recipe(recipe)
