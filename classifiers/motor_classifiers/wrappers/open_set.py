"""A classifier that abstains: the verdict `outside what I know`, and faults that are larger than any it was trained on.

A classifier divides the probability among its classes, whatever it sees: a foreign motor far beyond a boundary gets a
probability near 1, so confidence says nothing about it. What tells is the distance from the recipe's own starts
(`outside`). Of those far away, some are of a known kind of fault, only larger (`fault_family`).
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import fitting_recipe, flat_cases, labelled_cases, measured_cases
from motor_classifiers.estimators.state import State
from motor_classifiers.wrappers.fault_family import QUANTITIES, BoolArray, family_fit
from motor_classifiers.wrappers.fitted import ClassifierWrapper, check_share, unfitted
from motor_classifiers.wrappers.outside import OutsideDetector
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

OUTSIDE = "outside what I know"
"""The verdict on a start that is not of the recipe's world."""

_SAME_FAMILY = float(
    chi2.ppf(0.99, len(QUANTITIES))
)  # largest distance of a motor with a fault of a known kind


class Verdicts(NamedTuple):
    """What an open-set classifier says.

    Attributes:
        label: class name; the kind alone where the severity is out of range; `OUTSIDE` for a foreign start, shape (n,).
        is_outside: shape (n,).
        out_of_range: whether a known kind of fault is larger than any of the classes, shape (n,); told for recipes
            without a field.
        severity: most probable one of a fault out of range, nan for all others, shape (n,).
        off: what is off in a foreign start, a key of `outside.ADVICE`; empty for all others, shape (n,).
    """

    label: NDArray[Any]
    is_outside: BoolArray
    out_of_range: BoolArray
    severity: FloatArray
    off: NDArray[Any]


@dataclass(eq=False, repr=False)
class OpenSetClassifier(ClassifierWrapper):
    """Any classifier, and beside its decisions the verdicts `outside what I know` and out of range.

    Args:
        estimator: the classifier; a logistic regression by default.
        recipe: the motors and faults that are known; without one, the paper's motor at 10 kHz.
        false_alarm_rate: share of motors of the known classes that may be refused.
        noise_range: smallest and largest factor on the recipe's noise, for a classifier that reads its level off.

    Attributes:
        classes_: labels of the classifier; `outside what I know` is none of them.
        estimator_: the fitted classifier.
        detector_: the fitted `OutsideDetector`.
        n_features_in_: n_channels * n_timepoints.
    """

    estimator: Any = None
    recipe: Recipe | None = None
    _: KW_ONLY
    false_alarm_rate: float = 0.01
    noise_range: tuple[float, float] | None = None

    def fit(self, X: Any, y: Any) -> Self:
        """Train the classifier; the detector's threshold comes from other starts of the recipe."""
        flat, labels = labelled_cases(self, X, y)
        self.estimator_ = unfitted(self.estimator).fit(flat, self.classes_[labels])
        self.classes_ = np.asarray(self.estimator_.classes_)
        own = fitting_recipe(self.recipe, flat.shape[1])
        self.detector_ = _fitted_detector(own, self.false_alarm_rate, self.noise_range)
        return self

    @classmethod
    def around(
        cls, fitted: BaseEstimator, recipe: Recipe, noise_range: tuple[float, float] | None = None
    ) -> Self:
        """The wrapper around a model that was fitted before, its threshold from starts of the recipe."""
        model = cls(fitted, recipe, noise_range=noise_range)
        model._take_over(fitted)
        model.detector_ = _fitted_detector(recipe, model.false_alarm_rate, noise_range)
        return model

    def verdicts(self, X: Any) -> Verdicts:
        """The classifier's decision where a class explains the case; else what is wrong with that."""
        flat = flat_cases(self, X, reset=False)
        label = self.predict(flat).astype(object)
        off = self.detector_.what_is_off(flat)
        beyond, severity = np.zeros(len(flat), dtype=np.bool_), np.full(len(flat), np.nan)
        recipe, cases = measured_cases(self, flat)
        if recipe.field is None and recipe.duty is None:
            family = family_fit(recipe, cases)
            beyond = family.out_of_range & (family.distance < _SAME_FAMILY)
            label[beyond], severity[beyond] = family.kind[beyond], family.severity[beyond]
        is_outside = (off != "") & ~beyond
        label[is_outside] = OUTSIDE
        return Verdicts(label, is_outside, beyond, severity, np.where(is_outside, off, ""))

    def predict(self, X: Any) -> NDArray[Any]:
        """The classifier's decision, shape (n_cases,)."""
        check_is_fitted(self)
        decided: NDArray[Any] = self.estimator_.predict(flat_cases(self, X, reset=False))
        return decided

    def to_state(self) -> State:
        """What it adds to the model inside."""
        detector = self.detector_
        return State(
            {},
            {
                "false_alarm_rate": float(self.false_alarm_rate),
                "noise_range": None if self.noise_range is None else list(self.noise_range),
                "levels": detector.levels_.tolist(),
                "offsets": detector.offset_.tolist(),
            },
        )

    @classmethod
    def from_state(cls, state: State, inner: BaseEstimator, recipe: Recipe) -> Self:
        """The fitted wrapper around a fitted model.

        Raises:
            ValueError, KeyError, TypeError: values of another type or range than they must have.
        """
        rate, noise = state.values["false_alarm_rate"], state.values["noise_range"]
        check_share("false_alarm_rate", rate)
        noise_range = None if noise is None else (float(noise[0]), float(noise[1]))
        if noise_range is not None:
            low, high = noise_range
            require(0.0 < low < high < np.inf, f"noise_range must be 0 < low < high, got {low:g} to {high:g}")
        levels, offsets = (np.array(state.values[name], dtype=np.float64) for name in ("levels", "offsets"))
        fits = levels.ndim == 1 and len(levels) > 0 and levels.shape == offsets.shape
        finite = fits and bool(np.isfinite([levels, offsets]).all()) and bool((np.diff(levels) > 0.0).all())
        require(finite, "levels and offsets must be as many numbers each, the levels rising")
        model = cls(inner, recipe, false_alarm_rate=rate, noise_range=noise_range)
        model._take_over(inner)
        model.detector_ = OutsideDetector(recipe, rate, noise_range)
        model.detector_.levels_, model.detector_.offset_ = levels, offsets
        model.detector_.n_features_in_ = inner.n_features_in_
        return model


@lru_cache(maxsize=4)
def _fitted_detector(
    recipe: Recipe, false_alarm_rate: float, noise_range: tuple[float, float] | None
) -> OutsideDetector:
    return OutsideDetector(recipe, false_alarm_rate, noise_range).fit()
