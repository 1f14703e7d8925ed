"""A classifier beside the limit in one setting of rate and noise: accuracy in pairs, probabilities, severities.

Both see the same cases, which are drawn anew from the recipe and were in nobody's training.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from motor_classifiers.estimators.networks.posterior_network import PosteriorNetwork
from motor_classifiers.scoring.calibration import CalibrationScores, calibration_scores
from motor_classifiers.scoring.judging import in_recipe_order
from motor_datasets.generate import generate_arrays
from motor_env.inference.posterior import Excess, class_probabilities, excess_over_limit
from motor_env.inference.severity import SeverityPrior, severity_posterior
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe

RATES_HZ = (10_000.0, 1_000.0)
NOISES_A = (0.005, 0.02, 0.1)

_FIRST_CASE = 1_000_000_000


def six_cells(recipe: Recipe) -> Iterator[Recipe]:
    """The recipe at each rate and noise."""
    for rate_hz in RATES_HZ:
        for noise_a in NOISES_A:
            timing = replace(recipe.timing, sampling_rate_hz=rate_hz)
            yield replace(recipe, timing=timing, sensor=replace(recipe.sensor, current_noise_a=noise_a))


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


@dataclass(frozen=True, slots=True)
class LimitCell:
    """One setting.

    Attributes:
        recipe: with its rate and noise.
        n_cases: test cases.
        model: of the classifier's probabilities.
        limit: of the exact posterior's on the same cases.
        excess: accuracy above the limit, compared in pairs.
        severities: by kind.
    """

    recipe: Recipe
    n_cases: int
    model: CalibrationScores
    limit: CalibrationScores
    excess: Excess
    severities: tuple[SeverityCell, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """One row, for a table or a file."""
        return {
            "recipe": self.recipe.name,
            "sampling_rate_hz": self.recipe.timing.sampling_rate_hz,
            "noise_a": self.recipe.sensor.current_noise_a,
            "n_cases": self.n_cases,
            **_scores("", self.model),
            **_scores("limit_", self.limit),
            "excess": self.excess.excess,
            "excess_standard_error": self.excess.standard_error,
            "severities": {
                str(cell.prior.kind): {
                    "n_cases": cell.n_cases,
                    **cell.model._asdict(),
                    **{f"limit_{name}": value for name, value in cell.limit._asdict().items()},
                }
                for cell in self.severities
            },
        }


def _scores(prefix: str, scored: CalibrationScores) -> dict[str, float]:
    return {f"{prefix}{name}": getattr(scored, name) for name in ("accuracy", "log_loss", "ece", "brier")}


def limit_cell(
    model: PosteriorNetwork, recipe: Recipe, seed: int, n_cases: int, n_severities: int = 0
) -> LimitCell:
    """Judge a model on fresh cases of a recipe.

    Args:
        model: fitted; it may have been trained for another noise than the recipe's.
        recipe: what the cases are drawn from; its likelihood must be known (no `field`).
        seed: the random seed.
        n_cases: test cases for the classes.
        n_severities: test cases for the severities of each kind.
    """
    test = generate_arrays(recipe, seed, np.arange(n_cases) + _FIRST_CASE)
    limit = class_probabilities(recipe, test.X)
    own = in_recipe_order(model, model.predict_proba(test.X), recipe)
    return LimitCell(
        recipe,
        n_cases,
        calibration_scores(own, test.class_index),
        calibration_scores(limit, test.class_index),
        excess_over_limit(limit, test.class_index, own.argmax(axis=1)),
        tuple(
            severity_cell(model, recipe, prior, seed, n_severities)
            for prior in model.severity_priors_
            if n_severities > 0
        ),
    )


def severity_cell(
    model: PosteriorNetwork, recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int
) -> SeverityCell:
    """Judge severities, drawn uniformly over the range, of motors that have this kind of fault."""
    own = replace(recipe, classes=(FaultClass(prior.kind, 0.0, severity_to=prior.largest),))
    test = generate_arrays(own, seed, np.arange(n_cases) + _FIRST_CASE)
    told = model.predict_severity(test.X, str(prior.kind))
    exact = severity_posterior(recipe, prior, test.X)
    return SeverityCell(
        prior,
        n_cases,
        _severity_score(told.mean, np.column_stack([told.low, told.high]), test.severity),
        _severity_score(exact.mean, exact.interval(0.90), test.severity),
    )


def _severity_score(mean: FloatArray, interval: FloatArray, truth: FloatArray) -> SeverityScore:
    held = (interval[:, 0] <= truth) & (truth <= interval[:, 1])
    return SeverityScore(float(np.sqrt(np.square(mean - truth).mean())), float(held.mean()))
