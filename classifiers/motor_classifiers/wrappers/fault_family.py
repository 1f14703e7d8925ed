"""How far a start is from all the motors that a recipe's classes allow, at any severity.

In the space of the logarithms of the parameters each kind of fault is a ray from the healthy motor along which
its severity grows, without end, and the tolerances are a Gaussian cloud around it. The distance is the likelihood
ratio of the nearest of these motors against any motor at all (Wilks 1938).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from motor_env.inference.fit import Fit, Prior, fit
from motor_env.inference.parametrisation import Coordinates
from motor_env.inference.posterior import recipe_observed
from motor_env.inference.sensitivities import Observed
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FACTORS, Recipe

BoolArray = NDArray[np.bool_]

QUANTITIES = (*FACTORS, "inductance")

_ANY_MOTOR = 0.3  # standard deviation of the logarithms of any motor's parameters around the nominal ones
_ANY_SEVERITY = 1.0  # of t: 0.7 sd for a fault that doubles its parameter
_LEAST_TOLERANCE = 1e-4  # where the recipe has none: below what a start can tell
_SURE = float(ndtri(0.99))  # a severity is out of range when it is so with this probability
_AT_ONCE = 512
_MOST_STEPS = 12  # of a fit: a motor needs five or so, what is none need not be fitted well


class FamilyFit(NamedTuple):
    """Each transient and the nearest of the motors that the recipe's classes allow.

    Attributes:
        distance: twice the logarithm of the likelihood ratio of any motor against the nearest one allowed, shape (n,).
        kind: its label kind: healthy, bearing, ...; joint faults with a plus between, shape (n,).
        severity: its most probable severity (of joint faults the sum), shape (n,).
        out_of_range: whether the severity is larger than any that the recipe has for this kind, by more than tolerances
            and noise explain in 99 % of the cases.
    """

    distance: FloatArray
    kind: NDArray[np.str_]
    severity: FloatArray
    out_of_range: BoolArray


def family_fit(recipe: Recipe, measurements: ArrayLike) -> FamilyFit:
    """Fit the nearest motor allowed by the recipe's classes, each with a severity from 0 on, and any motor.

    Args:
        recipe: nominal motor, tolerances, classes, supply, sensor and timing.
        measurements: shape (n_cases, n_channels, n_samples).
    """
    observed = recipe_observed(recipe, measurements)
    parts = [
        _fit_part(recipe, observed.rows(slice(begin, begin + _AT_ONCE)))
        for begin in range(0, observed.n_cases, _AT_ONCE)
    ]
    return FamilyFit(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _fit_part(recipe: Recipe, observed: Observed) -> FamilyFit:
    coordinates = Coordinates.from_names(recipe.motor, QUANTITIES)
    loose = fit(
        observed,
        coordinates,
        Prior.from_std(np.full(len(QUANTITIES), _ANY_MOTOR)),
        max_iterations=_MOST_STEPS,
    )
    # Any motor, and noise of any variance above the believed one: n log f + chi2 / f is least at f = chi2 / n.
    n_values = observed.n_values
    noise = np.maximum(loose.chi2 / n_values, 1.0)
    anything = loose.objective - loose.chi2 + loose.chi2 / noise + n_values * np.log(noise)
    best = FamilyFit(
        np.full(observed.n_cases, np.inf),
        np.full(observed.n_cases, HEALTHY, dtype="<U60"),
        np.zeros(observed.n_cases),
        np.zeros(observed.n_cases, dtype=np.bool_),
    )
    for hypothesis in _hypotheses(recipe):
        candidate = hypothesis.against(observed, coordinates, noise)
        nearer = candidate.distance - anything < best.distance
        for kept, new in zip(best, (candidate.distance - anything, *candidate[1:]), strict=True):
            kept[nearer] = np.asarray(new)[nearer]
    return best


def tolerance_covariance(recipe: Recipe) -> FloatArray:
    """Covariance of the logarithms of `QUANTITIES` over healthy motors and starts of a recipe."""
    std = [*recipe.spread.std, 0.0]
    return np.diag(np.square(np.maximum(std, _LEAST_TOLERANCE)))


@dataclass(frozen=True, slots=True)
class _Hypothesis:
    """Motors with these kinds of faults, of any severity.

    Attributes:
        label: label kind.
        kinds: those that change the motor.
        noisy: those that change the noise's variance alone.
        largest: largest severity of each of `kinds`, and of the noise where there is such a fault.
        tolerances: covariance of the logarithms without a fault.
    """

    label: str
    kinds: tuple[FaultKind, ...]
    noisy: tuple[FaultKind, ...]
    largest: dict[FaultKind, float]
    tolerances: FloatArray

    def against(self, observed: Observed, coordinates: Coordinates, noise: FloatArray) -> FamilyFit:
        """Objective (in the place of the distance; infinite outside the rays) and severity of each case.

        Args:
            observed: the transients.
            coordinates: logarithms of `QUANTITIES`.
            noise: factor on the noise's variance of each case where the fault is one of noise, shape (n,).
        """
        rays = np.array([kind.direction(QUANTITIES) for kind in self.kinds]).reshape(-1, len(QUANTITIES))
        covariance = self.tolerances + _ANY_SEVERITY**2 * rays.T @ rays
        precision = np.linalg.inv(covariance)
        fitted = fit(
            observed, coordinates, Prior(np.zeros(len(QUANTITIES)), precision), max_iterations=_MOST_STEPS
        )
        objective = fitted.objective
        if self.noisy:
            objective = objective - fitted.chi2 + fitted.chi2 / noise + observed.n_values * np.log(noise)
        t, std = _along(rays, precision, fitted)
        objective = np.where((t > 0.0).all(axis=1), objective, np.inf)
        severity, beyond = np.zeros(len(t)), np.zeros(len(t), dtype=np.bool_)
        for column, kind in enumerate(self.kinds):
            severity += kind.severity(t[:, column])
            beyond |= t[:, column] - _SURE * std[:, column] > kind.log_size(self.largest[kind])
        if self.noisy:
            severity = severity + noise - 1.0
            least = noise * (1.0 - _SURE * np.sqrt(2.0 / observed.n_values))
            beyond |= least > 1.0 + max(self.largest[kind] for kind in self.noisy)
        return FamilyFit(objective, np.full(len(t), self.label), severity, beyond)


def _along(rays: FloatArray, precision: FloatArray, fitted: Fit) -> tuple[FloatArray, FloatArray]:
    """Most probable t along each ray and its standard deviation, each (n, n_rays), given fitted logarithms.

    The logarithms are tolerances plus t rays: given them, t is normal, by the usual regression.
    """
    weights = _ANY_SEVERITY**2 * rays @ precision
    rest = _ANY_SEVERITY**2 * (1.0 - np.einsum("ri,ri->r", weights, rays))
    variance = np.einsum("ri,nij,rj->nr", weights, fitted.covariance, weights) + rest
    return fitted.values @ weights.T, np.sqrt(np.maximum(variance, 0.0))


def _hypotheses(recipe: Recipe) -> Iterator[_Hypothesis]:
    """The kinds, and combinations of kinds, of a recipe's classes; healthy first."""
    largest: dict[FaultKind, float] = {}
    labels: dict[str, frozenset[FaultKind]] = {HEALTHY: frozenset()}
    for fault_class in recipe.classes:
        parts: list[FaultKind] = []
        for part in fault_class.parts:
            if part.kind is not None:
                largest[part.kind] = max(part.largest_severity, largest.get(part.kind, 0.0))
                parts.append(part.kind)
        labels.setdefault(fault_class.label_kind, frozenset(parts))
    tolerances = tolerance_covariance(recipe)
    seen = set(labels.values())
    for label, kinds in labels.items():
        # Tolerances can hide a small one of joint faults: then those that are left stand for all.
        for present in _subsets(kinds):
            if present == kinds or present not in seen:
                moving = tuple(kind for kind in recipe.kinds if kind in present and kind.motor_powers)
                noisy = tuple(kind for kind in recipe.kinds if kind in present and not kind.motor_powers)
                yield _Hypothesis(label, moving, noisy, largest, tolerances)


def _subsets(kinds: frozenset[FaultKind]) -> Iterator[frozenset[FaultKind]]:
    """All of the kinds first, then fewer; at least one, where there is one."""
    for count in range(len(kinds), 0 if kinds else -1, -1):
        for chosen in combinations(sorted(kinds), count):
            yield frozenset(chosen)
