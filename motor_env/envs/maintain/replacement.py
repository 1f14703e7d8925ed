"""Policies for the maintenance task, and the plan that is best for its belief."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from motor_env.common.arrays import instance, real
from motor_env.envs.maintain.kernel import FEATURES, INSPECT, REPLACE, RUN
from motor_env.envs.maintain.options import LEVELS, MaintainOptions, Tables, make_tables
from motor_env.envs.policies.rule_policies import Actions, Observations, Policy
from motor_env.motor.parameters import FloatArray

_STDS = np.array(
    [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0]
)  # of the plan's grid, in levels


def _feature(observations: Observations, name: str) -> FloatArray:
    return observations[:, FEATURES.index(name)].astype(np.float64)


@dataclass
class ThresholdReplacement(Policy):
    """Replaces the bearing once a feature reaches a threshold.

    Attributes:
        feature: `age`, `mean` (of the severity), or `risk` (of failure today).
        threshold: infinity never replaces.
    """

    feature: str
    threshold: float

    def __post_init__(self) -> None:
        instance("feature", self.feature, str)
        if np.isnan(real("threshold", self.threshold, ())):
            raise ValueError("threshold must be a number or infinity, got nan")

    def act(self, observations: Observations) -> Actions:
        """Replace, or run."""
        return np.where(_feature(observations, self.feature) >= self.threshold, REPLACE, RUN)


class PlannedUpkeep(Policy):
    """The best plan by dynamic programming over the posterior's mean and standard deviation (Bellman 1957).

    A bearing's rate of wear counts as known while it runs; values are interpolated between the rates of the task.
    """

    def __init__(self, options: MaintainOptions) -> None:
        instance("options", options, MaintainOptions)
        self.options = options
        tables = make_tables(options)
        self._pace = tables.rates / options.drift_per_day
        self._values = _plan(options, tables)

    def act(self, observations: Observations) -> Actions:
        """The action of highest value; ties go to running."""
        left = np.round(_feature(observations, "days_left") * self.options.days).astype(int)
        pace = _feature(observations, "rate")
        above = np.clip(np.searchsorted(self._pace, pace), min(1, len(self._pace) - 1), len(self._pace) - 1)
        below = np.maximum(above - 1, 0)
        gap = np.where(above > below, self._pace[above] - self._pace[below], 1.0)
        share = np.clip((pace - self._pace[below]) / gap, 0.0, 1.0)
        place = _places(_feature(observations, "mean") * LEVELS, _feature(observations, "std") * LEVELS)
        worth = [
            (1.0 - share) * _between(self._values[left, action, below], place)
            + share * _between(self._values[left, action, above], place)
            for action in (RUN, INSPECT, REPLACE)
        ]
        best: Actions = np.argmax(worth, axis=0)
        return best


def _places(
    mean: FloatArray, std: FloatArray
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int64], FloatArray]:
    """Cell and weights of mean and standard deviation in the plan's grid."""
    row = np.clip(mean, 0.0, LEVELS - 1.001).astype(int)
    column = np.clip(np.searchsorted(_STDS, std, side="right") - 1, 0, len(_STDS) - 2)
    share = (std - _STDS[column]) / np.diff(_STDS)[column]
    return row, np.clip(mean - row, 0.0, 1.0), column, np.clip(share, 0.0, 1.0)


def _between(
    values: FloatArray, place: tuple[NDArray[np.int64], FloatArray, NDArray[np.int64], FloatArray]
) -> FloatArray:
    """Bilinear interpolation in grids of shape (..., LEVELS, n_stds), one for each place or one for all."""
    row, down, column, across = place
    flat = values.reshape(-1, LEVELS, len(_STDS))
    which = np.arange(len(row)) if len(flat) > 1 else 0
    upper = (1.0 - across) * flat[which, row, column] + across * flat[which, row, column + 1]
    lower = (1.0 - across) * flat[which, row + 1, column] + across * flat[which, row + 1, column + 1]
    answer: FloatArray = (1.0 - down) * upper + down * lower
    return answer


def _gaussians() -> FloatArray:
    """Beliefs over the levels with (nearly) the means and standard deviations of the grid, (n_points, LEVELS)."""
    level, beliefs = np.arange(LEVELS), []
    for mean in range(LEVELS):
        for std in np.maximum(_STDS, 1e-3):
            centre = float(mean)
            for _ in range(20):  # truncation moves the mean: aim beside it
                deviation = (level - centre) / max(std, 0.3 * (std >= 0.3) + 1e-3)
                belief = np.exp(-0.5 * (np.square(deviation) - np.square(deviation).min()))
                belief /= belief.sum()
                centre = float(np.clip(centre + mean - belief @ level, -30.0, LEVELS + 30.0))
            beliefs.append(belief)
    return np.array(beliefs)


def transitions(tables: Tables) -> FloatArray:
    """Probability of each level after a day without failure, given level and rate, (n_rates, LEVELS, LEVELS)."""
    chain = np.zeros((len(tables.rates), LEVELS, LEVELS))
    for level in range(LEVELS):
        for growth, probability in enumerate(tables.wear.T, level + tables.lowest):
            if growth < LEVELS:
                chain[:, level, max(growth, 0)] += probability
    return chain


def _plan(options: MaintainOptions, tables: Tables) -> FloatArray:
    """Value of each action by days left, (days + 1, 3, n_rates, LEVELS * n_stds)."""
    level, beliefs = np.arange(LEVELS), _gaussians()
    chances, places = [], []
    for chain in transitions(tables):
        joint = (beliefs @ chain)[
            :, None, :
        ] * tables.estimate  # of estimate and level, (n_points, n_estimates, LEVELS)
        chance = joint.sum(axis=2)
        posterior = joint / np.maximum(chance, 1e-300)[:, :, None]
        mean = posterior @ level
        std = np.sqrt(np.maximum(posterior @ np.square(level) - mean * mean, 0.0))
        chances.append(chance)
        places.append(_places(mean.ravel(), std.ravel()))
    exact = _places(level.astype(float), np.zeros(LEVELS))
    worth = np.zeros((options.days + 1, 3, len(tables.rates), len(beliefs)))
    for left in range(1, options.days + 1):
        value = worth[left - 1].max(axis=0)
        new = float(tables.weights @ value[:, 0])
        for rate, (chance, place) in enumerate(zip(chances, places, strict=True)):
            going_on = (chance * _between(value[rate], place).reshape(chance.shape)).sum(axis=1)
            failing = beliefs @ tables.failing[rate]
            worth[left, RUN, rate] = going_on + failing * (new - options.failure_cost)
            worth[left, INSPECT, rate] = beliefs @ _between(value[rate], exact) - options.inspection_cost
        worth[left, REPLACE] = tables.weights @ worth[left, RUN, :, 0] - options.replacement_cost
    return worth
