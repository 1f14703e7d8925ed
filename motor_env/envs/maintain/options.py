"""Options of the maintenance task, and the tables of probabilities that follow from them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from motor_env.envs.options import settle_numbers
from motor_env.motor.parameters import FloatArray, require

LEVELS = 50
"""Levels of wear up to the limit."""
N_ESTIMATES = 2 * LEVELS + 1
"""Estimates in levels, from minus half the limit to one and a half times the limit."""
LOWEST_ESTIMATE = -LEVELS // 2
NOTHING = N_ESTIMATES + LEVELS
"""Observations of a day are numbered: estimates, levels that an inspection finds, nothing."""
_RATES = 5
_REACH = 6.0  # standard deviations of a day's wear that are followed


@dataclass(frozen=True, slots=True, kw_only=True)
class MaintainOptions:
    """Everything about the task that can be chosen. Costs are in units of a planned replacement.

    Attributes:
        days: length of an episode. The motor starts once a day.
        limit: severity of the bearing fault at which the bearing fails: 0.5 is 50 % more friction.
        drift_per_day: mean growth of the severity in a day.
        diffusion: standard deviation of a day's growth about its mean.
        rate_spread: standard deviation of the logarithm of the drift from bearing to bearing. 0: the rate is known.
        estimate_std: standard deviation of a start's estimate of the severity; 0.031 is the Cramer-Rao bound of the
            recipe `bench`.
        failure_cost: of a bearing that fails in service, with the new one.
        replacement_cost: of a planned replacement, with the downtime.
        inspection_cost: of a day on which the motor stands still and its bearing is measured.

    Raises:
        ValueError: a value is out of its range; the sentence says which and what would be right.
    """

    days: int = 120
    limit: float = 0.5
    drift_per_day: float = 0.01
    diffusion: float = 0.02
    rate_spread: float = 0.0
    estimate_std: float = 0.031
    failure_cost: float = 5.0
    replacement_cost: float = 1.0
    inspection_cost: float = 0.1

    def __post_init__(self) -> None:
        settle_numbers(self)
        for field in fields(self):
            value = getattr(self, field.name)
            require(bool(0.0 <= value < 1e6), f"{field.name} must be in 0 .. 1e6, got {value:g}")
        require(
            self.days == int(self.days) and self.days >= 1,
            f"days must be a whole number >= 1, got {self.days:g}",
        )
        for name in ("limit", "drift_per_day", "estimate_std", "replacement_cost"):
            require(getattr(self, name) > 0.0, f"{name} must be > 0, got {getattr(self, name):g}")
        require(
            self.failure_cost > self.replacement_cost,
            f"failure_cost must be above replacement_cost ({self.replacement_cost:g}), else nobody would replace, "
            f"got {self.failure_cost:g}",
        )
        step = self.limit / LEVELS
        require(
            self.diffusion >= 0.5 * step,
            f"diffusion must be at least a hundredth of the limit ({0.5 * step:g}), got {self.diffusion:g}",
        )
        fastest = self.drift_per_day * float(np.exp(3.0 * self.rate_spread)) + self.diffusion
        require(
            fastest < self.limit,
            f"drift_per_day must leave a bearing more than a day: a fast one wears {fastest:g} of {self.limit:g} a day",
        )


class Tables(NamedTuple):
    """Probabilities of a day, for each rate of wear."""

    rates: FloatArray  # mean growth a day, shape (n_rates,)
    weights: FloatArray  # how often a bearing has each rate, shape (n_rates,)
    wear: FloatArray  # of each growth in a day, in levels from `lowest` on, shape (n_rates, n_growths)
    lowest: int  # smallest growth in levels
    failing: FloatArray  # that the bearing fails on a day that begins at a level, shape (n_rates, LEVELS)
    estimate: FloatArray  # of each estimate, given the level, shape (N_ESTIMATES, LEVELS)


def make_tables(options: MaintainOptions) -> Tables:
    """Tables of a task.

    Wear is a Wiener process with drift (Whitmore 1995) on a lattice, so its belief is exact. The rates are the nodes of
    Gauss-Hermite's rule for a lognormal distribution.
    """
    step = options.limit / LEVELS
    nodes, weights = np.polynomial.hermite_e.hermegauss(_RATES if options.rate_spread > 0.0 else 1)
    rates = options.drift_per_day * np.exp(options.rate_spread * nodes - 0.5 * options.rate_spread**2)
    spread = options.diffusion / step
    lowest = -int(np.ceil(_REACH * spread))
    growth = np.arange(lowest, int(np.ceil(rates.max() / step + _REACH * spread)) + 1)
    wear = np.diff(ndtr((np.append(growth, growth[-1] + 1) - 0.5 - rates[:, None] / step) / spread))
    wear /= wear.sum(axis=1, keepdims=True)
    level = np.arange(LEVELS)
    failing = wear @ (growth[:, None] + level >= LEVELS)
    edges = np.arange(LOWEST_ESTIMATE, LOWEST_ESTIMATE + N_ESTIMATES + 1) - 0.5
    edges[0], edges[-1] = -np.inf, np.inf
    estimate = np.diff(ndtr((edges[:, None] - level) * step / options.estimate_std), axis=0)
    return Tables(rates, weights / weights.sum(), wear, lowest, failing, np.ascontiguousarray(estimate))
