"""The verdict `other`: faults that no class of the recipe knows, and known ones that are larger than any it holds.

A classifier divides the probability among its classes, whatever it sees: a foreign motor far beyond a boundary gets a
probability near 1, so confidence says nothing about it. What tells is the distance from all the motors that the classes
allow. In the space of the logarithms of the parameters each kind of fault is a ray from the healthy motor along which
its severity grows, without end, and the tolerances are a Gaussian cloud around it. The distance is the likelihood
ratio of the nearest of these motors against any motor at all (Wilks 1938).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri
from sklearn.base import BaseEstimator, OutlierMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, labelled_cases, with_channels
from motor_classifiers.estimators.state import State
from motor_classifiers.wrappers.fitted import ClassifierWrapper, check_share, unfitted
from motor_env.inference.fit import Fit, Prior, fit
from motor_env.inference.parametrisation import Coordinates
from motor_env.inference.posterior import recipe_observed
from motor_env.inference.sensitivities import Observed
from motor_env.motor.faults import HEALTHY, FaultKind
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import FACTORS, Recipe

BoolArray = NDArray[np.bool_]

OTHER = "other"
"""The verdict on a motor that no class explains."""

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


class FaultFamilyDetector(OutlierMixin, BaseEstimator):
    """Tells motors that no class of the recipe explains, by scikit-learn's interface for outliers.

    Args:
        recipe: the motors and faults that are known; without one, the paper's motor at 10 kHz.
        false_alarm_rate: share of the training cases, motors of the known classes, that may be called foreign.

    Attributes:
        offset_: `score_samples` below it is foreign.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(self, recipe: Recipe | None = None, false_alarm_rate: float = 0.01) -> None:
        self.recipe = recipe
        self.false_alarm_rate = false_alarm_rate

    def fit(self, X: Any, y: Any = None) -> Self:
        """Set the threshold on cases of the known classes; the labels are not looked at."""
        rate = self.false_alarm_rate
        require(0.0 < rate < 1.0, f"false_alarm_rate must lie between 0 and 1, got {rate:g}")
        flat = flat_cases(self, X, reset=True, min_features=2)
        distance = self._family(flat).distance
        self.offset_ = float(np.quantile(-distance, rate))
        return self

    def family(self, X: Any) -> FamilyFit:
        """Distance, nearest kind, its severity and whether that is out of range, of each case."""
        check_is_fitted(self)
        return self._family(flat_cases(self, X, reset=False))

    def score_samples(self, X: Any) -> FloatArray:
        """The distance, negative: the lower, the more foreign, shape (n_cases,)."""
        return -self.family(X).distance

    def decision_function(self, X: Any) -> FloatArray:
        """Score over the threshold: below 0 for foreign motors, shape (n_cases,)."""
        return self.score_samples(X) - self.offset_

    def predict(self, X: Any) -> NDArray[np.int64]:
        """-1 for foreign motors, else 1, shape (n_cases,)."""
        return np.where(self.decision_function(X) < 0.0, -1, 1)

    def _family(self, flat: FloatArray) -> FamilyFit:
        recipe = fitting_recipe(self.recipe, flat.shape[1])
        return family_fit(recipe, with_channels(flat, recipe))


class Verdicts(NamedTuple):
    """What an open-set classifier says.

    Attributes:
        label: class name; the kind alone where the severity is out of range; `other` for a foreign motor, shape (n,).
        is_other: shape (n,).
        out_of_range: whether a known kind of fault is larger than any of the classes, shape (n,).
        severity: most probable severity of the nearest kind, nan for a foreign motor, shape (n,).
    """

    label: NDArray[Any]
    is_other: BoolArray
    out_of_range: BoolArray
    severity: FloatArray


class OpenSetClassifier(ClassifierWrapper):
    """Any classifier, and beside its decisions the verdicts `other` and out of range.

    Args:
        estimator: the classifier; a logistic regression by default.
        recipe: the motors and faults that are known; without one, the paper's motor at 10 kHz.
        false_alarm_rate: share of motors of the known classes that may be called `other`.

    Attributes:
        classes_: labels of the classifier; `other` is none of them.
        estimator_: the fitted classifier.
        detector_: the fitted `FaultFamilyDetector`.
        n_features_in_: n_channels * n_timepoints.
    """

    def __init__(
        self, estimator: Any = None, recipe: Recipe | None = None, *, false_alarm_rate: float = 0.01
    ) -> None:
        self.estimator = estimator
        self.recipe = recipe
        self.false_alarm_rate = false_alarm_rate

    def fit(self, X: Any, y: Any) -> Self:
        """Train the classifier, and set the detector's threshold on the same cases."""
        flat, labels = labelled_cases(self, X, y)
        self.estimator_ = unfitted(self.estimator).fit(flat, self.classes_[labels])
        self.classes_ = np.asarray(self.estimator_.classes_)
        self.detector_ = FaultFamilyDetector(self.recipe, self.false_alarm_rate).fit(flat)
        return self

    def verdicts(self, X: Any) -> Verdicts:
        """The classifier's decision where a class explains the case; else what is wrong with that."""
        flat = flat_cases(self, X, reset=False)
        label = self.predict(flat).astype(object)
        family = self.detector_.family(flat)
        is_other = -family.distance < self.detector_.offset_
        beyond = family.out_of_range & ~is_other
        label[beyond] = family.kind[beyond]
        label[is_other] = OTHER
        return Verdicts(label, is_other, beyond, np.where(is_other, np.nan, family.severity))

    def predict(self, X: Any) -> NDArray[Any]:
        """The classifier's decision, shape (n_cases,)."""
        check_is_fitted(self)
        decided: NDArray[Any] = self.estimator_.predict(flat_cases(self, X, reset=False))
        return decided

    def to_state(self) -> State:
        """What it adds to the model inside."""
        offset = self.detector_.offset_
        return State({}, {"false_alarm_rate": float(self.false_alarm_rate), "offset": offset})

    @classmethod
    def from_state(cls, state: State, inner: BaseEstimator, recipe: Recipe) -> Self:
        """The fitted wrapper around a fitted model.

        Raises:
            ValueError, KeyError, TypeError: values of another type or range than they must have.
        """
        rate, offset = state.values["false_alarm_rate"], state.values["offset"]
        check_share("false_alarm_rate", rate)
        require(isinstance(offset, float) and np.isfinite(offset), f"offset must be a number, got {offset!r}")
        model = cls(inner, recipe, false_alarm_rate=rate)
        model._take_over(inner)
        model.detector_ = FaultFamilyDetector(recipe, rate)
        model.detector_.offset_, model.detector_.n_features_in_ = offset, inner.n_features_in_
        return model
