"""The Bayes-optimal posterior over the classes of a recipe: what no classifier can beat on average.

For each class the nuisance factors are integrated out by Laplace's method (Laplace 1774; MacKay 2003, ch. 27): a fit
of the factors under their Gaussian prior, and the volume of the peak from its curvature. Only the recipe, the measured
samples and the nominal voltage enter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from motor_env.common.arrays import instance, numbers, wholes
from motor_env.inference.fit import Prior, fit
from motor_env.inference.parametrisation import Coordinates
from motor_env.inference.sensitivities import Observed, fitted_residuals
from motor_env.motor.faults import NoiseSource, apply_faults, noise_variance_factor
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe


def class_coordinates(recipe: Recipe, fault_class: FaultClass) -> Coordinates:
    """Standard normal coordinates of the motors of a class: each factor is 1 + sd z; those without spread are fixed."""
    free = tuple((name, float(sd)) for name, sd in zip(FACTORS, recipe.spread.std, strict=True) if sd > 0.0)
    return Coordinates(
        nominal=apply_faults(recipe.motor, fault_class.faults),
        names=tuple(name for name, _ in free),
        scales=tuple(sd for _, sd in free),
        logarithmic=False,
    )


def variance_factor(fault_class: FaultClass) -> float:
    """Factor of a class on the variance of the measurement noise."""
    return float(noise_variance_factor(fault_class.faults, NoiseSource.MEASUREMENT, np.zeros(1))[0, 0])


def recipe_observed(recipe: Recipe, measurements: ArrayLike) -> Observed:
    """The measured transients as the recipe sees them; the first part of a transient is taken for a shorter one.

    Args:
        recipe: what the cases were drawn from.
        measurements: shape (n_cases, n_channels, n_samples), n_samples at most the recipe's.
    """
    instance("recipe", recipe, Recipe)
    measured = numbers("measurements", measurements, ("...", len(recipe.sensor.channels), "n_samples"))
    most = recipe.timing.n_samples
    require(
        measured.shape[-1] <= most, f"measurements must have at most {most} samples, got {measured.shape[-1]}"
    )
    voltage = recipe.nominal_voltage_v[: measured.shape[-1]]
    return Observed.from_measurements(measured, voltage, recipe.sensor, recipe.timing.dt_s)


def class_log_evidence(recipe: Recipe, measurements: ArrayLike, prior: Prior | None = None) -> FloatArray:
    """Log probability density of each transient under each class (Laplace 1774), shape (n_cases, n_classes).

    Exact for a recipe without spread: then it is the plain likelihood. A process noise fault leaves no trace here.

    Args:
        recipe: what the cases were drawn from.
        measurements: shape (n_cases, n_channels, n_samples); fewer samples than the recipe's are its first ones.
        prior: of the nuisances, in the coordinates of `class_coordinates`, such as `prior_from_starts` gives; standard
            normal by default.

    Raises:
        ValueError: shapes do not fit, a value is not finite, the recipe's sensor has no noise, or one of its sensors
            fails.
    """
    instance("recipe", recipe, Recipe)
    recipe.require_motor_faults()
    observed = recipe_observed(recipe, measurements)
    if prior is not None:
        instance("prior", prior, Prior)
        prior.require_shape(observed.n_cases, class_coordinates(recipe, FaultClass()).size)
    return np.column_stack([class_evidence(recipe, observed, each, prior) for each in recipe.classes])


def class_evidence(
    recipe: Recipe, observed: Observed, fault_class: FaultClass, prior: Prior | None = None
) -> FloatArray:
    """Log probability density of each transient under one class of the recipe's motors (Laplace 1774), shape (n,)."""
    noisy = observed.with_variance(variance_factor(fault_class))
    coordinates = class_coordinates(recipe, fault_class)
    if coordinates.size == 0:
        exact = np.zeros((noisy.n_cases, 0))
        chi2 = np.square(fitted_residuals(noisy, coordinates, exact)).sum(axis=(-2, -1))
        likelihood: FloatArray = noisy.log_normaliser - 0.5 * chi2
        return likelihood
    belief = Prior.from_std(np.ones(coordinates.size)) if prior is None else prior
    fitted = fit(noisy, coordinates, belief)
    # The peak's volume over the prior's.
    _, log_determinant = np.linalg.slogdet(fitted.information)
    _, log_precision = np.linalg.slogdet(belief.precision)
    evidence: FloatArray = noisy.log_normaliser - 0.5 * (fitted.objective + log_determinant - log_precision)
    return evidence


def class_probabilities(recipe: Recipe, measurements: ArrayLike, prior: Prior | None = None) -> FloatArray:
    """Posterior of each class (Bayes 1763), shape (n_cases, n_classes), rows summing to 1; as `class_log_evidence`."""
    instance("recipe", recipe, Recipe)
    with np.errstate(divide="ignore"):  # a class that is never drawn
        log_prior = np.log(recipe.class_probabilities)
    joint = class_log_evidence(recipe, measurements, prior) + log_prior
    posterior: FloatArray = np.exp(joint - logsumexp(joint, axis=1, keepdims=True))
    return posterior


def prior_from_starts(recipe: Recipe, starts: ArrayLike) -> Prior:
    """What healthy starts of the same motor tell of its next one: the prior of its nuisances then.

    Start by start the posterior of the motor's own factors becomes their next prior; the supply is another one in each
    start, and forgotten. Each posterior is taken for Gaussian, as in Laplace's method (MacKay 2003, ch. 27).

    Args:
        recipe: what the motors are drawn from.
        starts: healthy starts of each motor, shape (n_motors, n_starts, n_channels, n_samples); n_starts may be 0.

    Returns:
        A prior of each motor's own, in the coordinates of `class_coordinates`.
    """
    instance("recipe", recipe, Recipe)
    measured = numbers("starts", starts)
    require(measured.ndim == 4, f"starts must have 4 axes, got shape {measured.shape}")
    coordinates = class_coordinates(recipe, FaultClass())
    n_motors, size = len(measured), coordinates.size
    prior = Prior(np.zeros((n_motors, size)), np.tile(np.eye(size), (n_motors, 1, 1)))
    for start in np.moveaxis(measured, 1, 0) if size else ():
        fitted = fit(recipe_observed(recipe, start), coordinates, prior)
        mean, covariance = fitted.values, fitted.covariance
        if "supply" in coordinates.names:
            supply = coordinates.names.index("supply")
            mean[:, supply] = 0.0
            covariance[:, supply, :] = covariance[:, :, supply] = 0.0
            covariance[:, supply, supply] = 1.0
        prior = Prior(mean, np.asarray(np.linalg.inv(covariance), dtype=np.float64))
    return prior


class Excess(NamedTuple):
    """How far a classifier's accuracy lies above the Bayes-optimal one on the same cases.

    Attributes:
        excess: accuracy minus that of the most probable class; at most 0 on average for every honest classifier.
        standard_error: of the excess, from the cases on which the two are not both right or both wrong.
    """

    excess: float
    standard_error: float


def excess_over_limit(probabilities: FloatArray, class_index: ArrayLike, predicted: ArrayLike) -> Excess:
    """Compare a classifier with the limit, case by case (McNemar 1947).

    Args:
        probabilities: posterior probabilities of the cases, shape (n_cases, n_classes).
        class_index: true classes, shape (n_cases,).
        predicted: the classifier's, shape (n_cases,); -1 for none.

    Raises:
        ValueError: shapes do not fit, fewer than 2 cases, or a number that is no class.
    """
    likely = numbers("probabilities", probabilities, ("n_cases", "n_classes"), least=0.0)
    require(
        len(likely) > 1,
        f"probabilities must be of 2 cases or more, got {likely.shape}",
    )
    truth = wholes("class_index", class_index, 0, likely.shape[1] - 1)
    chosen = wholes("predicted", predicted, -1)
    for name, found in (("class_index", truth), ("predicted", chosen)):
        require(
            found.shape == likely.shape[:1], f"{name} must have shape ({len(likely)},), got {found.shape}"
        )
    best = likely.argmax(axis=1) == truth
    difference = (chosen == truth).astype(np.float64) - best
    return Excess(float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference))))
