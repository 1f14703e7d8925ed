"""How far a start is from all the motors that a recipe's classes allow, at any severity.

In the space of the logarithms of the parameters each kind of fault is a ray from the healthy motor along which
its severity grows, without end, and the tolerances are a Gaussian cloud around it. The distance is the likelihood
ratio of the nearest of these motors against any motor at all (Wilks 1938).
"""

from __future__ import annotations

from collections.abc import Iterator
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

    Raises:
        ValueError: one of the recipe's sensors fails: that is no fault of a motor.
    """
    recipe.require_motor_faults()
    observed = recipe_observed(recipe, measurements)
    parts = [
        _fit_part(recipe, observed.rows(slice(begin, begin + _AT_ONCE)))
        for begin in range(0, observed.n_cases, _AT_ONCE)
    ]
    return FamilyFit(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _fit_part(recipe: Recipe, observed: Observed) -> FamilyFit:
    coordinates = Coordinates.from_names(recipe.motor, QUANTITIES)
    prior = Prior.from_std(np.full(len(QUANTITIES), _ANY_MOTOR))
    loose = fit(observed, coordinates, prior, max_iterations=_MOST_STEPS)
    # Any motor, and noise of any variance above the believed one: n log f + chi2 / f is least at f = chi2 / n.
    n_values = observed.n_values
    noise = np.maximum(loose.chi2 / n_values, 1.0)
    anything = loose.objective - loose.chi2 + loose.chi2 / noise + n_values * np.log(noise)
    candidates = [_fit_kinds(recipe, observed, noise, *hypothesis) for hypothesis in _hypotheses(recipe)]
    objectives = np.nan_to_num([c.distance for c in candidates], nan=np.inf, posinf=np.inf)
    nearest = objectives.argmin(axis=0), np.arange(observed.n_cases)
    fitted = FamilyFit(*(np.array(column)[nearest] for column in zip(*candidates, strict=True)))
    return fitted._replace(distance=objectives[nearest] - anything)


def _fit_kinds(
    recipe: Recipe, observed: Observed, noise: FloatArray, label: str, present: frozenset[FaultKind]
) -> FamilyFit:
    """Objective (in the place of the distance; infinite outside the rays) and severity of motors with these faults.

    Args:
        recipe: as of `family_fit`.
        observed: the transients.
        noise: factor on the noise's variance of each case where the fault is one of noise, shape (n,).
        label: label kind.
        present: kinds of faults, of any severity.
    """
    largest: dict[FaultKind | None, float] = {}
    for part in (part for fault_class in recipe.classes for part in fault_class.parts):
        largest[part.kind] = max(part.largest_severity, largest.get(part.kind, 0.0))
    moving = [kind for kind in recipe.kinds if kind in present and kind.motor_powers]
    noisy = [kind for kind in recipe.kinds if kind in present and not kind.motor_powers]
    rays = np.array([kind.direction(QUANTITIES) for kind in moving]).reshape(-1, len(QUANTITIES))
    tolerances = np.square(np.maximum([*recipe.spread.std, 0.0], _LEAST_TOLERANCE))
    precision = np.linalg.inv(np.diag(tolerances) + _ANY_SEVERITY**2 * rays.T @ rays)
    prior = Prior(np.zeros(len(QUANTITIES)), precision)
    coordinates = Coordinates.from_names(recipe.motor, QUANTITIES)
    fitted = fit(observed, coordinates, prior, max_iterations=_MOST_STEPS)
    objective = fitted.objective
    if noisy:
        objective = objective - fitted.chi2 + fitted.chi2 / noise + observed.n_values * np.log(noise)
    t, std = _along(rays, precision, fitted)
    objective = np.where((t > 0.0).all(axis=1), objective, np.inf)
    severity, beyond = np.zeros(len(t)), np.zeros(len(t), dtype=np.bool_)
    for column, kind in enumerate(moving):
        severity += kind.severity(t[:, column])
        beyond |= t[:, column] - _SURE * std[:, column] > kind.log_size(largest[kind])
    if noisy:
        severity = severity + noise - 1.0
        least = noise * (1.0 - _SURE * np.sqrt(2.0 / observed.n_values))
        beyond |= least > 1.0 + max(largest[kind] for kind in noisy)
    return FamilyFit(objective, np.full(len(t), label), severity, beyond)


def _along(rays: FloatArray, precision: FloatArray, fitted: Fit) -> tuple[FloatArray, FloatArray]:
    """Most probable t along each ray and its standard deviation, each (n, n_rays), given fitted logarithms.

    The logarithms are tolerances plus t rays: given them, t is normal, by the usual regression.
    """
    weights = _ANY_SEVERITY**2 * rays @ precision
    rest = _ANY_SEVERITY**2 * (1.0 - np.einsum("ri,ri->r", weights, rays))
    variance = np.einsum("ri,nij,rj->nr", weights, fitted.covariance, weights) + rest
    return fitted.values @ weights.T, np.sqrt(np.maximum(variance, 0.0))


def _hypotheses(recipe: Recipe) -> Iterator[tuple[str, frozenset[FaultKind]]]:
    """Label kinds, and the kinds or combinations of kinds that they stand for; healthy first."""
    labels: dict[str, frozenset[FaultKind]] = {HEALTHY: frozenset()}
    for fault_class in recipe.classes:
        kinds = frozenset(part.kind for part in fault_class.parts if part.kind is not None)
        labels.setdefault(fault_class.label_kind, kinds)
    seen = set(labels.values())
    for label, kinds in labels.items():
        yield label, kinds
        # Tolerances can hide a small one of joint faults: then those that are left stand for all.
        for count in range(len(kinds) - 1, 0, -1):
            for left in map(frozenset, combinations(sorted(kinds), count)):
                if left not in seen:
                    yield label, left
