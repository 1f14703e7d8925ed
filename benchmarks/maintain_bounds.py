"""What no policy of the maintenance task can exceed, and what the truth would be worth there."""

from __future__ import annotations

import numpy as np

from motor_env.envs import MaintainOptions
from motor_env.envs.maintain.options import LEVELS, make_tables
from motor_env.envs.maintain.replacement import transitions
from motor_env.motor.parameters import FloatArray


def maintenance_bound(options: MaintainOptions) -> float:
    """A return that no policy exceeds in the mean: the fast informed bound (Hauskrecht 2000).

    It is the return of an agent that is told yesterday's level and the rate, but not what today brought.
    """
    tables = make_tables(options)
    chain, weights = transitions(tables), tables.weights
    worth = np.zeros((3, len(weights), LEVELS))

    def told(rate: int) -> FloatArray:
        """For each level before: of each estimate and next action the expected worth, (LEVELS, n_estimates, 3)."""
        after = tables.estimate[:, :, None] * worth[:, rate].T  # (n_estimates, LEVELS, 3)
        expected: FloatArray = np.einsum("xz,eza->xea", chain[rate], after, optimize=True)
        return expected

    for _ in range(options.days):
        new = float((weights @ worth[:, :, 0].T).max())
        ahead = np.array([told(rate) for rate in range(len(weights))])
        fails = tables.failing * (new - options.failure_cost)
        run = ahead.max(axis=3).sum(axis=2) + fails
        replaced = np.tensordot(weights, ahead[:, 0], axes=1).max(axis=1).sum() + float(weights @ fails[:, 0])
        inspect = worth.max(axis=0) - options.inspection_cost
        worth = np.stack([run, inspect, np.full_like(run, replaced - options.replacement_cost)])
    return float((weights @ worth[:, :, 0].T).max())


def clairvoyant_value(options: MaintainOptions) -> float:
    """Mean return of whoever sees level and rate every morning: dynamic programming without a belief."""
    tables = make_tables(options)
    chain, weights = transitions(tables), tables.weights
    value = np.zeros((len(weights), LEVELS))
    for _ in range(options.days):
        new = float(weights @ value[:, 0])
        run = np.einsum("rxz,rz->rx", chain, value) + tables.failing * (new - options.failure_cost)
        value = np.maximum(run, float(weights @ run[:, 0]) - options.replacement_cost)
    return float(weights @ value[:, 0])
