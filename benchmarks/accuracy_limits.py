"""What can be known at best from the starts of a recipe: measured on drawn cases, none of which a rule has seen.

Each figure is an average over the recipe's own cases of what the exact posterior expects: no rule does better on
average. The truth is drawn here, and only scored; what decides gets the recipe, the samples and the nominal voltage.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.inference.fit import Prior, inverse_information
from motor_env.inference.posterior import SeverityPrior, class_probabilities, severity_posterior
from motor_env.inference.sensitivities import Coordinates, jacobian
from motor_env.motor.faults import Fault
from motor_env.motor.parameters import FloatArray, MotorParameters, SensorParameters, require
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.sampling import draw
from motor_env.simulation.simulate import Timing, simulate

_CHUNK = 2000


def cramer_rao_bound(
    motor: MotorParameters,
    sensor: SensorParameters,
    timing: Timing,
    free: tuple[str, ...] = ("resistance", "friction"),
    prior_std: ArrayLike = np.inf,
) -> FloatArray:
    """Smallest covariance of unbiased estimates of relative values from a start at 12 V (Rao 1945; Cramer 1946).

    Args:
        motor: the motor.
        sensor: what is read.
        timing: time axis.
        free: quantities that are not known, of `QUANTITIES`; all others are.
        prior_std: relative standard deviation known beforehand of each, infinite for none; with one it is the Bayesian
            bound of van Trees (1968), linearised at the motor.

    Returns:
        Shape (n_free, n_free): sqrt of its diagonal is 0.01 for 1 %.

    Raises:
        ValueError: the samples leave a direction open.
    """
    _, slopes = jacobian(Coordinates.from_names(motor, free), timing.step(12.0), sensor, timing.dt_s)
    white = (slopes / sensor.noise_std[:, None, None]).reshape(-1, len(free))
    precision = Prior.from_std(np.broadcast_to(prior_std, len(free))).precision
    return inverse_information(white.T @ white + precision, free)


class Limit(NamedTuple):
    """The Bayes-optimal accuracy on given cases.

    Attributes:
        expected_accuracy: mean of the largest probabilities.
        standard_error: its standard error.
    """

    expected_accuracy: float
    standard_error: float


def bayes_limit(probabilities: FloatArray) -> Limit:
    """Best accuracy that any rule can have (Chow 1957), from posterior probabilities of drawn cases.

    The mean of the largest probability has half the standard error of counting hits, and needs no labels.

    Args:
        probabilities: shape (n_cases, n_classes), at least two cases.
    """
    largest = probabilities.max(axis=1)
    return Limit(float(largest.mean()), float(largest.std(ddof=1) / np.sqrt(len(largest))))


class SeverityLimit(NamedTuple):
    """The smallest error of a severity, for severities drawn uniformly from a range.

    Attributes:
        expected_rmse: root mean posterior variance.
        rmse: of the posterior mean on the drawn cases.
        coverage: share of the 90 % intervals that hold the severity.
    """

    expected_rmse: float
    rmse: float
    coverage: float


def chunks(n_cases: int) -> Iterator[np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """Case numbers, as many at once as memory holds."""
    require(n_cases >= 2, f"n_cases must be >= 2, got {n_cases}")
    for begin in range(0, n_cases, _CHUNK):
        yield np.arange(begin, min(begin + _CHUNK, n_cases))


def class_limits(
    recipe: Recipe, seed: int, n_cases: int, samples_seen: Sequence[int] | None = None
) -> list[tuple[Limit, float]]:
    """Bayes-optimal accuracy from the first samples, and the share that the most probable class names rightly.

    Args:
        recipe: what the cases are drawn from.
        seed: the random seed.
        n_cases: cases 0 .. n_cases - 1 of that seed.
        samples_seen: numbers of samples, each giving one limit; all samples by default.
    """
    seen = samples_seen or [recipe.timing.n_samples]
    probabilities: list[list[FloatArray]] = [[] for _ in seen]
    labels = []
    for cases in chunks(n_cases):
        drawn = draw(recipe, seed, cases)
        measured = simulate(drawn.scenario, seed, cases).measurements
        labels.append(drawn.class_index)
        for column, count in zip(probabilities, seen, strict=True):
            column.append(class_probabilities(recipe, measured[..., :count]))
    truth = np.concatenate(labels)
    posteriors = [np.concatenate(column) for column in probabilities]
    return [(bayes_limit(each), float((each.argmax(axis=1) == truth).mean())) for each in posteriors]


def severity_limit(recipe: Recipe, prior: SeverityPrior, seed: int, n_cases: int) -> SeverityLimit:
    """Smallest error of the severity of one kind of fault.

    Args:
        recipe: nominal motor, tolerances, sensor and timing; its classes are not looked at.
        prior: kind and range.
        seed: the random seed.
        n_cases: cases 0 .. n_cases - 1 of that seed.
    """
    sound = replace(recipe, classes=(FaultClass(),))
    errors, variances, covered = [], [], []
    for cases in chunks(n_cases):
        severity = prior.at(2.0 * uniforms(seed, Stream.ONSET, cases, 1)[:, 0] - 1.0)
        scenario = replace(draw(sound, seed, cases).scenario, faults=(Fault(prior.kind, severity),))
        posterior = severity_posterior(recipe, prior, simulate(scenario, seed, cases).measurements)
        low, high = posterior.interval(0.90).T
        errors.append(posterior.mean - severity)
        variances.append(np.square(posterior.std))
        covered.append((low <= severity) & (severity <= high))
    return SeverityLimit(
        expected_rmse=float(np.sqrt(np.concatenate(variances).mean())),
        rmse=float(np.sqrt(np.square(np.concatenate(errors)).mean())),
        coverage=float(np.concatenate(covered).mean()),
    )
