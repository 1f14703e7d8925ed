"""The verdict `other`: faults that no class of the recipe knows, and known ones that are larger than any it holds.

A classifier divides the probability among its classes, whatever it sees: a foreign motor far beyond a boundary gets a
probability near 1, so confidence says nothing about it. What tells is the distance from all the motors that the classes
allow (`fault_family`).
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, OutlierMixin
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators.cases import flat_cases, labelled_cases, measured_cases
from motor_classifiers.estimators.state import State
from motor_classifiers.wrappers.fault_family import BoolArray, FamilyFit, family_fit
from motor_classifiers.wrappers.fitted import ClassifierWrapper, check_share, unfitted
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

OTHER = "other"
"""The verdict on a motor that no class explains."""


@dataclass(eq=False, repr=False)
class FaultFamilyDetector(OutlierMixin, BaseEstimator):
    """Tells motors that no class of the recipe explains, by scikit-learn's interface for outliers.

    Args:
        recipe: the motors and faults that are known; without one, the paper's motor at 10 kHz.
        false_alarm_rate: share of the training cases, motors of the known classes, that may be called foreign.

    Attributes:
        offset_: `score_samples` below it is foreign.
        n_features_in_: n_channels * n_timepoints.
    """

    recipe: Recipe | None = None
    false_alarm_rate: float = 0.01

    def fit(self, X: Any, y: Any = None) -> Self:
        """Set the threshold on cases of the known classes; the labels are not looked at."""
        rate = self.false_alarm_rate
        require(0.0 < rate < 1.0, f"false_alarm_rate must lie between 0 and 1, got {rate:g}")
        flat = flat_cases(self, X, reset=True, min_features=2)
        distance = self.family(flat).distance
        self.offset_ = float(np.quantile(-distance, rate))
        return self

    def family(self, X: Any) -> FamilyFit:
        """Distance, nearest kind, its severity and whether that is out of range, of each case."""
        return family_fit(*measured_cases(self, X))

    def score_samples(self, X: Any) -> FloatArray:
        """The distance, negative: the lower, the more foreign, shape (n_cases,)."""
        return -self.family(X).distance

    def decision_function(self, X: Any) -> FloatArray:
        """Score over the threshold: below 0 for foreign motors, shape (n_cases,)."""
        return self.score_samples(X) - self.offset_

    def predict(self, X: Any) -> NDArray[np.int64]:
        """-1 for foreign motors, else 1, shape (n_cases,)."""
        return np.where(self.decision_function(X) < 0.0, -1, 1)


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


@dataclass(eq=False, repr=False)
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

    estimator: Any = None
    recipe: Recipe | None = None
    _: KW_ONLY
    false_alarm_rate: float = 0.01

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
