"""The Bayes-optimal posterior over the classes of a recipe, and over a severity.

Laplace's method integrates out the nuisance factors (Laplace 1774; MacKay 2003, ch. 27): a fit under their Gaussian
prior, and the peak's volume from its curvature.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from motor_env.common.arrays import instance, number, numbers, real, wholes
from motor_env.inference.fit import Prior, fit
from motor_env.inference.sensitivities import Coordinates, Observed, fitted_residuals
from motor_env.motor.faults import SENSOR_KINDS, FaultKind, NoiseSource, apply_faults, noise_variance_factor
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import FACTORS, LARGEST_SEVERITY, FaultClass, Recipe


def class_coordinates(recipe: Recipe, fault_class: FaultClass) -> Coordinates:
    """Return standard normal coordinates of a class's motors: each factor with a spread is 1 + sd z."""
    free = tuple((name, float(sd)) for name, sd in zip(FACTORS, recipe.spread.std, strict=True) if sd > 0.0)
    return Coordinates(
        nominal=apply_faults(recipe.motor, fault_class.faults),
        names=tuple(name for name, _ in free),
        scales=tuple(sd for _, sd in free),
        logarithmic=False,
    )


def variance_factor(fault_class: FaultClass) -> float:
    """Return a class's factor on the variance of the measurement noise."""
    return float(noise_variance_factor(fault_class.faults, NoiseSource.MEASUREMENT, np.zeros(1))[0, 0])


def recipe_observed(recipe: Recipe, measurements: ArrayLike) -> Observed:
    """Whiten measured transients by a recipe's sensor; fewer samples are the first part of a transient.

    `measurements` has shape (n_cases, n_channels, n_samples), n_samples at most the recipe's.
    """
    instance("recipe", recipe, Recipe)
    measured = real("measurements", measurements, ("...", len(recipe.sensor.channels), "n_samples"))
    most = recipe.timing.n_samples
    require(
        measured.shape[-1] <= most, f"measurements must have at most {most} samples, got {measured.shape[-1]}"
    )
    voltage = recipe.nominal_voltage_v[: measured.shape[-1]]
    return Observed.from_measurements(measured, voltage, recipe.sensor, recipe.timing.dt_s)


def class_log_evidence(recipe: Recipe, measurements: ArrayLike, prior: Prior | None = None) -> FloatArray:
    """Compute the log density of each transient under each class, shape (n_cases, n_classes).

    Exact for a recipe without spread. A process noise fault has no effect here.

    Args:
        recipe: distribution of the cases.
        measurements: shape (n_cases, n_channels, n_samples), n_samples at most the recipe's.
        prior: of the nuisances in `class_coordinates`, as from `prior_from_starts`; standard normal by default.

    Raises:
        ValueError: shapes do not fit, a value is not finite, a sensor has no noise, or a class is a sensor fault.
    """
    observed = recipe_observed(recipe, measurements)
    recipe.require_motor_faults()
    if prior is not None:
        instance("prior", prior, Prior)
        prior.require_shape(observed.n_cases, class_coordinates(recipe, FaultClass()).size)
    return np.column_stack([class_evidence(recipe, observed, each, prior) for each in recipe.classes])


def class_evidence(
    recipe: Recipe, observed: Observed, fault_class: FaultClass, prior: Prior | None = None
) -> FloatArray:
    """Compute the log density of each transient under one class of the recipe, shape (n,)."""
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
    """Compute the posterior of each class, shape (n_cases, n_classes); arguments as `class_log_evidence`."""
    evidence = class_log_evidence(recipe, measurements, prior)
    with np.errstate(divide="ignore"):  # a class that is never drawn
        joint = evidence + np.log(recipe.class_probabilities)
    posterior: FloatArray = np.exp(joint - logsumexp(joint, axis=1, keepdims=True))
    return posterior


def prior_from_starts(recipe: Recipe, starts: ArrayLike) -> Prior:
    """Return the prior of a motor's nuisances after healthy starts of the same motor.

    The posterior of the motor's factors, as a Gaussian, is the next start's prior; the supply differs in each start.

    Args:
        recipe: distribution of the motors.
        starts: healthy starts of each motor, shape (n_motors, n_starts, n_channels, n_samples); n_starts may be 0.

    Returns:
        A prior for each motor, in `class_coordinates`.
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
    """A classifier's accuracy above the Bayes-optimal one on the same cases.

    Attributes:
        excess: accuracy minus that of the most probable class; at most 0 on average.
        standard_error: of the excess.
    """

    excess: float
    standard_error: float


def excess_over_limit(probabilities: FloatArray, class_index: ArrayLike, predicted: ArrayLike) -> Excess:
    """Compare a classifier with the Bayes-optimal one, case by case (McNemar 1947).

    `probabilities` are the posterior, shape (n_cases, n_classes); classes have shape (n_cases,), -1 for none.

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


_NODES = 12
_GRID = 201
_ZOOMS = 4
_NEGLIGIBLE = 30.0  # a log density this far below the largest adds nothing


@dataclass(frozen=True, slots=True)
class SeverityPrior:
    """A kind of fault whose severity is uniform between two bounds.

    Raises:
        ValueError: bounds out of order, negative, or not below 1 for a loss; a sensor fault.
    """

    kind: FaultKind
    smallest: float = 0.0
    largest: float = 0.30

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", FaultKind(self.kind))
        require(self.kind not in SENSOR_KINDS, f"kind must be a fault of the motor or noise, got {self.kind}")
        for name in ("smallest", "largest"):
            object.__setattr__(self, name, number(name, getattr(self, name)))
        require(
            0.0 <= self.smallest < self.largest <= LARGEST_SEVERITY,
            f"severity of {self.kind} must range from >= 0 to more, got {self.smallest:g} to {self.largest:g}",
        )
        self.kind.require_severity(self.largest)

    def at(self, position: FloatArray) -> FloatArray:
        """Return severities at positions from -1 (smallest) to 1 (largest)."""
        return self.smallest + 0.5 * (position + 1.0) * (self.largest - self.smallest)


class SeverityPosterior(NamedTuple):
    """Posterior of the severity of each case.

    Attributes:
        severity: grid of each case, shape (n_cases, n_grid).
        weights: probability of each grid point, rows summing to 1, shape (n_cases, n_grid).
        log_evidence: log density of each transient under this kind, shape (n_cases,).
    """

    severity: FloatArray
    weights: FloatArray
    log_evidence: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Return the posterior mean, shape (n_cases,)."""
        mean: FloatArray = (self.weights * self.severity).sum(axis=1)
        return mean

    @property
    def std(self) -> FloatArray:
        """Return the posterior standard deviation, shape (n_cases,)."""
        off = np.square(self.severity - self.mean[:, None])
        deviation: FloatArray = np.sqrt((self.weights * off).sum(axis=1))
        return deviation

    def quantile(self, probability: float) -> FloatArray:
        """Return the quantile of a probability, shape (n_cases,)."""
        probability = number("probability", probability, above=0.0, below=1.0)
        # Half of a point's weight lies on either side of it.
        cumulated = np.cumsum(self.weights, axis=1) - 0.5 * self.weights
        rows = zip(cumulated, self.severity, strict=True)
        return np.array([np.interp(probability, row, severity) for row, severity in rows])

    def interval(self, coverage: float = 0.90) -> FloatArray:
        """Return bounds between equal tails, shape (n_cases, 2)."""
        tail = 0.5 * (1.0 - number("coverage", coverage, above=0.0, below=1.0))
        return np.column_stack([self.quantile(tail), self.quantile(1.0 - tail)])


def severity_posterior(recipe: Recipe, prior: SeverityPrior, measurements: ArrayLike) -> SeverityPosterior:
    """Compute the posterior of the severity of one kind of fault, assuming its presence.

    Laplace's method at Chebyshev nodes (Laplace 1774; Trefethen 2013, ch. 4).

    Args:
        recipe: nominal motor, tolerances, sensor, timing.
        prior: kind and range of the severity.
        measurements: shape (n_cases, n_channels, n_samples), n_samples at most the recipe's.
    """
    instance("prior", prior, SeverityPrior)
    observed = recipe_observed(recipe, measurements)
    # Chebyshev's points of the second kind: they hold the ends.
    nodes = np.cos(np.pi * np.arange(_NODES) / (_NODES - 1))[::-1]
    at_nodes = [
        class_evidence(
            recipe, observed, FaultClass(prior.kind, float(severity)) if severity else FaultClass()
        )
        for severity in prior.at(nodes)
    ]
    fitted = np.polynomial.chebyshev.chebfit(nodes, np.stack(at_nodes), deg=_NODES - 1)
    position, log_density = _zoomed(np.asarray(fitted, dtype=np.float64))
    # Trapezoid's rule; the prior's density over positions from -1 to 1 is 1/2.
    ends = np.where(np.arange(_GRID) % (_GRID - 1) == 0, 0.5, 1.0)
    mass = 0.5 * (position[:, 1:2] - position[:, :1]) * ends
    largest = log_density.max(axis=1, keepdims=True)
    density = np.exp(log_density - largest) * mass
    total = density.sum(axis=1, keepdims=True)
    return SeverityPosterior(prior.at(position), density / total, (largest + np.log(total))[:, 0])


def _zoomed(coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return grids of positions with all the mass of each case, and the log density there."""
    n_cases = coefficients.shape[1]
    low, high = np.full((n_cases, 1), -1.0), np.full((n_cases, 1), 1.0)
    share = np.linspace(0.0, 1.0, _GRID)
    for _ in range(_ZOOMS):
        position = low + (high - low) * share
        log_density = np.polynomial.chebyshev.chebval(position, coefficients[..., None], tensor=False)
        has_mass = log_density > log_density.max(axis=1, keepdims=True) - _NEGLIGIBLE
        # A neighbour on either side, since the peak may lie between two points.
        first = np.maximum(has_mass.argmax(axis=1) - 1, 0)
        last = np.minimum(_GRID - has_mass[:, ::-1].argmax(axis=1), _GRID - 1)
        low = np.take_along_axis(position, first[:, None], axis=1)
        high = np.take_along_axis(position, last[:, None], axis=1)
    return position, log_density
