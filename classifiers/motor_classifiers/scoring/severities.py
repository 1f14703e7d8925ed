"""Severities of a model beside those of the exact posterior, on the same cases, which neither was trained on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_datasets.generate import generate_arrays
from motor_env.inference.severity import SeverityPrior, severity_posterior
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe

_FIRST_CASE = 1_000_000_000


Scored = dict[str, float]


def severity_figures(
    model: PosteriorNetwork, recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int
) -> dict[str, Scored]:
    """Judge severities, drawn uniformly over the range, of motors that have this kind of fault.

    Returns:
        Of the `network` and of the `limit`, on the same cases: `rmse`, the root mean square error, 0.01 for a point,
        and `coverage`, the share of the 90 % intervals that hold the severity.
    """
    own = replace(recipe, classes=(FaultClass(prior.kind, 0.0, severity_to=prior.largest),))
    test = generate_arrays(own, seed, np.arange(n_cases) + _FIRST_CASE)
    estimated = model.predict_severity(test.X, str(prior.kind))
    exact = severity_posterior(recipe, prior, test.X)
    intervals = np.column_stack([estimated.low, estimated.high]), exact.interval(0.90)
    return {
        "network": _scored(estimated.mean, intervals[0], test.severity),
        "limit": _scored(exact.mean, intervals[1], test.severity),
    }


def _scored(mean: FloatArray, interval: FloatArray, truth: FloatArray) -> Scored:
    inside = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    return {"rmse": float(np.sqrt(np.square(mean - truth).mean())), "coverage": float(inside.mean())}
