"""Whether a start is of the world that a recipe knows, and if not, what is off.

Along the few directions in which starts can differ, the recipe's own starts are one normal cloud a class (plus the
noise), and outside these directions they are noise alone. The distance is the log likelihood ratio of any motor, in any
surroundings and of any noise above the known one, to the recipe (Neyman & Pearson 1933). Its threshold is the quantile
of fresh starts of the recipe. What is off is the one departure that, added to the recipe, explains the start best.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, OutlierMixin

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, measured_cases, values_of_start
from motor_classifiers.wrappers.world import Levels, World
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

OUTSIDE = "outside what I know"
"""The verdict on a start that is not of the recipe's world."""

ADVICE = {
    "noise": "the sensor is noisier than in training: train for its noise",
    "offset": "the sensor's offset is off: measure it before the start and take it off",
    "gain": "the sensor's gain is off: calibrate it",
    "ramp": "the supply rises more slowly than in training: put `ramp_s` into the recipe",
    "warmth": "winding and magnets are warmer or colder than in training: measure the temperature, or wait",
    "load": "the motor drives a load: uncouple it, or put `load_ratio` into the recipe",
    "severity": "a fault of another size than in training: train with `severity_to`, or ask `motor-env diagnose`",
    "another motor": "it is another motor, or has a fault never trained on: use a model of its own, or "
    "`motor-env diagnose`",
}
"""What can be off, and what to do."""


_QUIETEST = 1e-6
_LEVELS = 8  # of a noise that is not known


@dataclass(eq=False, repr=False)
class OutsideDetector(OutlierMixin, BaseEstimator):
    """Finds starts that a recipe does not explain, by scikit-learn's interface for outliers.

    Args:
        recipe: motors, faults, surroundings and sensor that are known; without one, the paper's motor at 10 kHz.
        false_alarm_rate: share of the recipe's own starts that may be called foreign.
        noise_range: smallest and largest factor on the recipe's noise, where its level is not known beforehand.

    Attributes:
        levels_: logarithms of levels of the noise's variance, shape (n_levels,).
        offset_: `score_samples` below it is foreign, for each of these levels; in between along straight lines.
        n_features_in_: n_channels * n_timepoints.
    """

    recipe: Recipe | None = None
    false_alarm_rate: float = 0.01
    noise_range: tuple[float, float] | None = None

    def fit(self, X: Any = None, y: Any = None) -> Self:
        """Set the threshold on the given starts of the known classes, or on fresh ones of the recipe.

        Raises:
            ValueError: a rate outside (0, 1), or starts of another length.
        """
        rate = self.false_alarm_rate
        require(0.0 < rate < 1.0, f"false_alarm_rate must lie between 0 and 1, got {rate:g}")
        given = None if X is None else flat_cases(self, X, reset=True, min_features=2)
        if given is None:
            require(self.recipe is not None, "fit needs starts or a recipe, got neither")
            self.n_features_in_ = values_of_start(self.recipe)  # type: ignore[arg-type]  # there is one
        low, high = self._variances
        levels = np.geomspace(low, high, 1 if low == high else _LEVELS)
        self.levels_ = np.log(levels)
        world = self._world
        starts: list[Any] = [world.fresh(level) if given is None else self._at(given) for level in levels]
        distances = [world.distance(own, (low, high)) for own in starts]
        self.offset_ = np.array([np.quantile(-distance, rate) for distance in distances])
        return self

    def score_samples(self, X: Any) -> FloatArray:
        """The distance, negative: the lower, the more foreign, shape (n_cases,)."""
        return -self._world.distance(self._at(X), self._variances)

    def decision_function(self, X: Any) -> FloatArray:
        """Score over the threshold: below 0 for foreign starts, shape (n_cases,)."""
        return self._over(self._at(X))

    def predict(self, X: Any) -> NDArray[np.int64]:
        """-1 for foreign starts, else 1, shape (n_cases,)."""
        return np.where(self.decision_function(X) < 0.0, -1, 1)

    def what_is_off(self, X: Any) -> NDArray[Any]:
        """For foreign starts what explains them best, a key of `ADVICE`; empty for the others, shape (n_cases,)."""
        at = self._at(X)
        foreign = self._over(at) < 0.0
        names = np.full(len(foreign), "", dtype=object)
        if foreign.any():
            names[foreign] = self._world.off(type(at)(*(part[foreign] for part in at)), self._variances)
        return names

    def _over(self, at: Any) -> FloatArray:
        level = np.maximum(at.energy / self._world.freedom, _QUIETEST)
        threshold = np.interp(np.log(level), self.levels_, self.offset_)
        over: FloatArray = -self._world.distance(at, self._variances) - threshold
        return over

    @property
    def _variances(self) -> Levels:
        low, high = (1.0, 1.0) if self.noise_range is None else self.noise_range
        return low**2, high**2

    @property
    def _world(self) -> World:
        return _world(fitting_recipe(self.recipe, self.n_features_in_))

    def _at(self, X: Any) -> Any:
        _, cases = measured_cases(self, X)
        return self._world.coordinates(cases.reshape(len(cases), -1))


@lru_cache(maxsize=4)
def _world(recipe: Recipe) -> World:
    return World.from_recipe(recipe)
