"""How large a fault is: the posterior of a continuous severity, the nuisances integrated out.

The severity of a kind is uniform between two bounds beforehand. At a few severities the evidence of the samples comes
from Laplace's method, as for the classes; its logarithm is smooth in the severity, so a polynomial through those
nodes (Chebyshev: Trefethen 2013, ch. 4) gives it everywhere. No posterior mean has a smaller mean squared error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from motor_env.common.arrays import instance, number
from motor_env.inference.posterior import class_evidence, recipe_observed
from motor_env.motor.faults import SENSOR_KINDS, FaultKind
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import LARGEST_SEVERITY, FaultClass, Recipe

_NODES = 12
_GRID = 201
_ZOOMS = 4
_NEGLIGIBLE = 30.0  # a log density this far below the largest adds nothing


@dataclass(frozen=True, slots=True)
class SeverityPrior:
    """A kind of fault whose severity is uniform between two bounds.

    Raises:
        ValueError: bounds out of order, negative, or not below 1 where something is lost; the kind is that of a sensor.
    """

    kind: FaultKind
    smallest: float = 0.0
    largest: float = 0.30

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", FaultKind(self.kind))
        require(self.kind not in SENSOR_KINDS, f"kind must be a fault of the motor or noise, got {self.kind}")
        for name in ("smallest", "largest"):
            number(name, getattr(self, name))
        require(
            0.0 <= self.smallest < self.largest <= LARGEST_SEVERITY,
            f"severity of {self.kind} must range from >= 0 to more, got {self.smallest:g} to {self.largest:g}",
        )
        self.kind.require_severity(self.largest)

    def at(self, position: FloatArray) -> FloatArray:
        """Severities at positions from -1 (smallest) to 1 (largest)."""
        return self.smallest + 0.5 * (position + 1.0) * (self.largest - self.smallest)


class SeverityPosterior(NamedTuple):
    """Posterior of the severity of each case.

    Attributes:
        severity: grid of each case, over all that has weight, shape (n_cases, n_grid).
        weights: probability of each grid point, rows summing to 1, shape (n_cases, n_grid).
        log_evidence: log probability density of each transient under this kind, the severity integrated out too,
            shape (n_cases,).
    """

    severity: FloatArray
    weights: FloatArray
    log_evidence: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Posterior mean, shape (n_cases,): the estimate with the smallest mean squared error."""
        mean: FloatArray = (self.weights * self.severity).sum(axis=1)
        return mean

    @property
    def std(self) -> FloatArray:
        """Posterior standard deviation, shape (n_cases,)."""
        off = np.square(self.severity - self.mean[:, None])
        deviation: FloatArray = np.sqrt((self.weights * off).sum(axis=1))
        return deviation

    def quantile(self, probability: float) -> FloatArray:
        """Severity below which the posterior holds the probability, shape (n_cases,)."""
        probability = number("probability", probability, above=0.0, below=1.0)
        # Half of a point's weight lies on either side of it.
        cumulated = np.cumsum(self.weights, axis=1) - 0.5 * self.weights
        rows = zip(cumulated, self.severity, strict=True)
        return np.array([np.interp(probability, row, severity) for row, severity in rows])

    def interval(self, coverage: float = 0.90) -> FloatArray:
        """Bounds between equal tails, shape (n_cases, 2)."""
        tail = 0.5 * (1.0 - number("coverage", coverage, above=0.0, below=1.0))
        return np.column_stack([self.quantile(tail), self.quantile(1.0 - tail)])


def severity_posterior(recipe: Recipe, prior: SeverityPrior, measurements: ArrayLike) -> SeverityPosterior:
    """Posterior of the severity of one kind of fault, given that the motor has this kind (or, from 0, none).

    Laplace's method at Chebyshev nodes (Laplace 1774; Trefethen 2013, ch. 4).

    Args:
        recipe: nominal motor, tolerances, sensor, timing; its classes are not looked at.
        prior: kind and range of the severity.
        measurements: shape (n_cases, n_channels, n_samples); fewer samples than the recipe's are its first ones.
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
    """Grids of positions that hold all the mass of each case, however little room it takes, and the log density there.

    Args:
        coefficients: Chebyshev series of the log density, shape (n_nodes, n_cases).
    """
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
