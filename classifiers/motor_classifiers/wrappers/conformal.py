"""Split conformal prediction: sets of classes with a known coverage (Vovk, Gammerman & Shafer 2005).

It holds for cases with the distribution of the calibration cases, which must not be training cases.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from itertools import cycle
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator
from sklearn.utils import check_random_state

from motor_classifiers.estimators.cases import State, labelled_cases
from motor_classifiers.wrappers.fitted import ClassifierWrapper, check_share, unfitted
from motor_env.common.arrays import instance, number, numbers, wholes
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ConformalSets:
    """Conformal p-values and sets of classes from probabilities.

    The nonconformity of a class is the probability of all others, which gives the smallest sets (Sadinle, Lei &
    Wasserman 2019).

    Attributes:
        nonconformity: of the calibration cases, rising: one array for each class (label-conditional), or one for all.
    """

    nonconformity: tuple[FloatArray, ...]

    def __post_init__(self) -> None:
        instance("nonconformity", self.nonconformity, tuple)
        require(len(self.nonconformity) > 0, "nonconformity must have one array or more, got none")
        checked = tuple(numbers("nonconformity", scores, ("n_cases",)) for scores in self.nonconformity)
        rises = all((np.diff(scores) >= 0.0).all() for scores in checked)
        require(rises, "nonconformity must rise in each array")
        object.__setattr__(self, "nonconformity", checked)

    @classmethod
    def calibrate(
        cls, probabilities: FloatArray, truth: ArrayLike, *, label_conditional: bool = False
    ) -> ConformalSets:
        """Calibrate on cases outside the training.

        Args:
            probabilities: shape (n_cases, n_classes).
            truth: true class of each case as a column of `probabilities`, shape (n_cases,).
            label_conditional: whether the coverage holds in each class.

        Raises:
            ValueError: shapes that do not fit, or, label-conditional, a class without a case.
        """
        probabilities, labels = _probabilities(probabilities), wholes("truth", truth)
        require(
            probabilities.ndim == 2 and labels.shape == (len(probabilities),) and len(labels) > 0,
            f"probabilities (n_cases, n_classes) and truth (n_cases,) must fit, "
            f"got {np.shape(probabilities)} and {labels.shape}",
        )
        wholes("truth", labels, most=probabilities.shape[1] - 1)
        own = _nonconformity(probabilities)[np.arange(len(labels)), labels]
        if not label_conditional:
            return cls((np.sort(own),))
        n_classes = probabilities.shape[1]
        missing = sorted(set(range(n_classes)) - set(labels.tolist()))
        require(not missing, f"each class needs calibration cases, class {missing[:1]} has none")
        return cls(tuple(np.sort(own[labels == n]) for n in range(n_classes)))

    def p_values(self, probabilities: FloatArray) -> FloatArray:
        """Return the conformal p-value of each class, shape (n_cases, n_classes).

        That of the true class is at most alpha in a share alpha of the cases.
        """
        probabilities = _probabilities(probabilities)
        n_arrays, n_classes = len(self.nonconformity), probabilities.shape[1]
        require(
            n_arrays in (1, n_classes),
            f"probabilities must be of {n_arrays} classes as at the calibration, got {n_classes}",
        )
        # One array stands for all classes.
        pairs = zip(_nonconformity(probabilities).T, cycle(self.nonconformity), strict=False)
        shares = [
            (len(known) - np.searchsorted(known, own) + 1.0) / (len(known) + 1.0) for own, known in pairs
        ]
        return np.stack(shares, axis=1)

    def sets(self, probabilities: FloatArray, coverage: float = 0.90) -> BoolArray:
        """Return membership of each case's set, shape (n_cases, n_classes); a set may be empty.

        Args:
            probabilities: shape (n_cases, n_classes).
            coverage: share of sets with the true class.
        """
        number("coverage", coverage, above=0.0, below=1.0)
        return self.p_values(probabilities) > 1.0 - coverage


def _probabilities(given: ArrayLike) -> FloatArray:
    return numbers("probabilities", given, ("n_cases", "n_classes"), least=0.0)


def _nonconformity(probabilities: FloatArray) -> FloatArray:
    # Not 1 - p, which rounds to 0 for many a clear case: among equals no set could be cut to size.
    columns = range(probabilities.shape[1])
    return np.stack([np.delete(probabilities, column, axis=1).sum(axis=1) for column in columns], axis=1)


class Coverage(NamedTuple):
    """Coverage and size of prediction sets on test cases.

    Attributes:
        overall: share of sets with the true class.
        by_class: the same for each class, nan without cases, shape (n_classes,).
        mean_size: mean number of classes in a set.
        empty: share of empty sets.
    """

    overall: float
    by_class: FloatArray
    mean_size: float
    empty: float


def measured_coverage(sets: BoolArray, truth: ArrayLike) -> Coverage:
    """Measure coverage and sizes of sets, shape (n_cases, n_classes), for the true classes, shape (n_cases,)."""
    labels = np.asarray(truth)
    covered = sets[np.arange(len(labels)), labels]
    size = sets.sum(axis=1)
    by_class = [covered[labels == n].mean() if (labels == n).any() else np.nan for n in range(sets.shape[1])]
    return Coverage(float(covered.mean()), np.array(by_class), float(size.mean()), float((size == 0).mean()))


@dataclass(eq=False, repr=False)
class ConformalClassifier(ClassifierWrapper):
    """Classifier with sets of classes of a known coverage beside its decisions.

    Args:
        estimator: any classifier with probabilities; a logistic regression by default. A `FrozenEstimator` is not
            trained, and `fit` calibrates on all cases.
        coverage: share of sets with the true class.
        label_conditional: whether the coverage holds in each class.
        calibration_share: share of the cases for calibration.
        random_state: of their choice.

    Attributes:
        estimator_: the fitted classifier.
        sets_: the calibrated `ConformalSets`.
    """

    estimator: Any = None
    coverage: float = 0.90
    _: KW_ONLY
    label_conditional: bool = True
    calibration_share: float = 0.3
    random_state: int | np.random.RandomState | None = None

    def fit(self, X: Any, y: Any) -> Self:
        """Train on one part of the cases and calibrate on the other.

        If both parts have transients of the same motors, the coverage is too optimistic: freeze an estimator trained
        on other motors instead.
        """
        number("coverage", self.coverage, above=0.0, below=1.0)
        number("calibration_share", self.calibration_share, above=0.0, below=1.0)
        flat, labels = labelled_cases(self, X, y)
        names = self.classes_[labels]
        if isinstance(self.estimator, FrozenEstimator):
            self.estimator_, held_out = self.estimator, np.arange(len(flat))
        else:
            rng = check_random_state(self.random_state)
            by_class = (np.flatnonzero(labels == n) for n in range(len(self.classes_)))
            held_out = np.concatenate([_share(rows, self.calibration_share, rng) for rows in by_class])
            training = np.setdiff1d(np.arange(len(flat)), held_out)
            self.estimator_ = unfitted(self.estimator).fit(flat[training], names[training])
        self.classes_ = np.asarray(self.estimator_.classes_)
        unknown = sorted(set(names.tolist()) - set(self.classes_.tolist()))
        if unknown:
            raise ValueError(f"the estimator does not know the class {unknown[0]!r}")
        columns = np.searchsorted(self.classes_, names[held_out])
        probabilities = self.estimator_.predict_proba(flat[held_out])
        self.sets_ = ConformalSets.calibrate(probabilities, columns, label_conditional=self.label_conditional)
        return self

    def predict_set(self, X: Any) -> BoolArray:
        """Return membership of each of `classes_` in each case's set, shape (n_cases, n_classes)."""
        sets: BoolArray = self.sets_.sets(self.predict_proba(X), self.coverage)
        return sets

    def to_state(self) -> State:
        """Return the state of the wrapper, without the model inside."""
        strangeness = [scores.tolist() for scores in self.sets_.nonconformity]
        return State({}, {"coverage": float(self.coverage), "strangeness": strangeness})

    @classmethod
    def from_state(cls, state: State, inner: BaseEstimator, recipe: Recipe) -> Self:
        """Restore the fitted wrapper around a fitted model.

        Raises:
            ValueError, KeyError, TypeError: values of another type or range.
        """
        coverage, strangeness = state.values["coverage"], state.values["strangeness"]
        check_share("coverage", coverage)
        require(
            isinstance(strangeness, list) and len(strangeness) in (1, len(inner.classes_)),
            "strangeness must be one list, or one for each class",
        )
        scores = tuple(np.array(part, dtype=np.float64) for part in strangeness)
        for part in scores:
            require(
                part.ndim == 1
                and len(part) > 0
                and bool(np.isfinite(part).all() and (np.diff(part) >= 0.0).all()),
                "strangeness must be finite numbers that rise",
            )
        model = cls(FrozenEstimator(inner), coverage, label_conditional=len(scores) > 1)
        model._take_over(model.estimator)
        model.sets_ = ConformalSets(scores)
        return model


def _share(rows: NDArray[np.int64], share: float, rng: np.random.RandomState) -> NDArray[np.int64]:
    """Draw a share of the rows, at least one, and not all of two or more."""
    count = min(max(1, round(share * len(rows))), max(1, len(rows) - 1))
    chosen: NDArray[np.int64] = rng.permutation(rows)[:count]
    return chosen
