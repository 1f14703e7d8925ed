"""Severities of a model beside those of the exact posterior, on the same cases, which neither was trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_datasets.generate import generate_arrays
from motor_env.inference.severity import SeverityPrior, severity_posterior
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe

_FIRST_CASE = 1_000_000_000
_SMALLEST = 1e-6  # a class with a fault needs a severity; this one is healthy to rounding


class SeverityScore(NamedTuple):
    """Errors of estimated severities, and how often their 90 % intervals hold the truth.

    Attributes:
        rmse: root mean square error, 0.01 for a point.
        coverage: share of the intervals that hold the severity.
    """

    rmse: float
    coverage: float


@dataclass(frozen=True, slots=True)
class SeverityCell:
    """Severities of one kind: a model's and the limit's on the same cases."""

    prior: SeverityPrior
    n_cases: int
    model: SeverityScore
    limit: SeverityScore


def severity_cell(
    model: PosteriorNetwork, recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int
) -> SeverityCell:
    """Judge severities, drawn uniformly over the range, of motors that have this kind of fault."""
    own = replace(recipe, classes=(FaultClass(prior.kind, 0.0, severity_to=prior.largest),))
    test = generate_arrays(own, seed, np.arange(n_cases) + _FIRST_CASE)
    estimated = model.predict_severity(test.X, str(prior.kind))
    exact = severity_posterior(recipe, prior, test.X)
    return SeverityCell(
        prior,
        n_cases,
        _severity_score(estimated.mean, np.column_stack([estimated.low, estimated.high]), test.severity),
        _severity_score(exact.mean, exact.interval(0.90), test.severity),
    )


def _severity_score(mean: FloatArray, interval: FloatArray, truth: FloatArray) -> SeverityScore:
    inside = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    return SeverityScore(float(np.sqrt(np.square(mean - truth).mean())), float(inside.mean()))
