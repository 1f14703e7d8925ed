"""Confirmation by thresholds (paper, Figure 1) as an estimator."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import check_is_fitted

from motor_classifiers.estimators import cases
from motor_classifiers.estimators.cases import State
from motor_classifiers.estimators.threshold_rule import ConfirmationResult, ThresholdRule
from motor_env.filters.batch import run_filter
from motor_env.filters.kalman import KalmanFilter
from motor_env.inference.posterior import variance_factor
from motor_env.motor.faults import HEALTHY, apply_faults
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import FaultClass, Recipe

_RULE_ARRAYS = (
    "windows", "bank_windows", "healthy_center", "healthy_scale", "lower", "upper", "own_scale", "prior",
)  # fmt: skip


@dataclass(eq=False, repr=False)
class ThresholdConfirmationClassifier(cases.ProbabilityClassifier):
    """The paper's confirmation by thresholds as a scikit-learn classifier.

    Args:
        recipe: source of the filters. Without one, the mean training case of each class replaces its filter's
            prediction, and `healthy` or else the first class is the healthy one.
        false_alarm_rate: share of healthy cases with an alarm (`ThresholdRule.tune`); by default the most correct
            decisions on the training cases.

    Attributes:
        rule_: the tuned `ThresholdRule`.
        filters_: a filter for each class of the recipe; none without a recipe.
        templates_: mean training cases, shape (n_classes, n_features_in_); None with a recipe.
    """

    recipe: Recipe | None = None
    false_alarm_rate: float | None = None

    def fit(self, X: Any, y: Any) -> Self:
        """Tune windows, thresholds, M, N and weights.

        Raises:
            ValueError: labels unknown to the recipe, no healthy case, or shapes that do not fit.
        """
        flat, labels = cases.labelled_cases(self, X, y)
        self.templates_: FloatArray | None = None
        self.filters_: tuple[KalmanFilter, ...] = ()
        with_spread = False
        if self.recipe is None:
            healthy = self.classes_.tolist().index(HEALTHY) if HEALTHY in self.classes_ else 0
            self.templates_ = np.stack([flat[labels == n].mean(axis=0) for n in range(len(self.classes_))])
        else:
            recipe = cases.fitting_recipe(self.recipe, flat.shape[1])
            cases.check_classes(recipe, self.classes_)
            kinds = [c.kind for c in recipe.classes]
            require(
                kinds.count(None) == 1,
                f"recipe {recipe.name} must have one healthy class, got {kinds.count(None)}",
            )
            healthy, labels = kinds.index(None), self._columns()[labels]
            with_spread = any(kind.changes_noise for kind in recipe.kinds)
            self.filters_ = tuple(class_filter(recipe, c) for c in recipe.classes)
        self.rule_ = ThresholdRule.tune(
            self._residuals(flat),
            labels,
            healthy,
            with_spread=with_spread,
            false_alarm_rate=self.false_alarm_rate,
        )
        return self

    def decide(self, X: Any) -> ConfirmationResult:
        """Decide by the rule; classes are the recipe's, else `classes_`."""
        check_is_fitted(self)
        return self.rule_.decide(self._residuals(cases.flat_cases(self, X, reset=False)))

    def predict_proba(self, X: Any) -> FloatArray:
        """Return the probability of each class, shape (n_cases, n_classes).

        If the rule decides against the most probable class, their probabilities are exchanged.
        """
        result = self.decide(X)
        graded = result.probabilities.copy()
        rows = np.arange(len(graded))
        largest = graded.argmax(axis=1)
        top = graded[rows, largest].copy()
        graded[rows, largest] = graded[rows, result.class_index]
        graded[rows, result.class_index] = top
        chosen = graded[:, self._columns()]
        probabilities: FloatArray = chosen / chosen.sum(axis=1, keepdims=True)
        return probabilities

    def to_state(self) -> State:
        """Return the tuned rule as arrays and values.

        Raises:
            ValueError: tuned without a recipe.
        """
        require(self.recipe is not None, "a confirmation without a recipe cannot be saved")
        rule = {field.name: getattr(self.rule_, field.name) for field in fields(self.rule_)}
        arrays = {name: rule.pop(name) for name in _RULE_ARRAYS}
        return State(arrays, {"rule": rule, "false_alarm_rate": self.false_alarm_rate})

    @classmethod
    def from_state(cls, state: State, recipe: Recipe) -> Self:
        """Restore the fitted estimator.

        Raises:
            ValueError, KeyError, TypeError: values of another type or range.
        """
        values = state.values
        rule: dict[str, Any] = {**values["rule"], **{name: state.arrays[name] for name in _RULE_ARRAYS}}
        _check_rule(rule, recipe)
        rate = values["false_alarm_rate"]
        require(rate is None or isinstance(rate, float), f"false_alarm_rate must be a number, got {rate!r}")
        model = cls(recipe, rate)
        model.rule_ = ThresholdRule(**rule)
        model.filters_ = tuple(class_filter(recipe, c) for c in recipe.classes)
        model.templates_ = None
        model.classes_ = np.array(values["classes"])
        model.n_features_in_ = cases.values_of_start(recipe)
        return model

    def _residuals(self, flat: FloatArray) -> FloatArray:
        """Return the residual of each case under each class, shape (n_classes, n_cases, n_samples, n_channels)."""
        if self.recipe is None:
            residual: FloatArray = (flat - np.asarray(self.templates_)[:, None])[..., None]
            return residual
        measured = cases.with_channels(flat, cases.fitting_recipe(self.recipe, flat.shape[1]))
        voltage = self.recipe.nominal_voltage_v
        return np.stack([run_filter(belief, measured, voltage).whitened for belief in self.filters_])

    def _columns(self) -> NDArray[np.int64]:
        if self.recipe is None:
            return np.arange(len(self.classes_))
        return np.array([self.recipe.class_names.index(str(name)) for name in self.classes_])


def _check_rule(rule: dict[str, Any], recipe: Recipe) -> None:
    for name in ("windows", "bank_windows"):
        windows = rule[name]
        require(
            windows.ndim == 2
            and windows.shape[1:] == (2,)
            and windows.dtype == np.int64
            and windows.size > 0,
            f"{name} must be pairs of integers, got shape {windows.shape}",
        )
        least = 1 + bool(rule["with_spread"])
        require(
            bool((windows >= 0).all() and (np.diff(windows) >= least).all())
            and windows.max() <= recipe.timing.n_samples,
            f"{name} must lie on its recipe's time axis",
        )
    n_windows = len(rule["windows"])
    require(bool((np.diff(rule["windows"][:, 1]) >= 0).all()), "windows must be in the order of their ends")
    counts = (rule["needed"], rule["among"], rule["healthy_index"])
    require(all(type(count) is int for count in counts), f"M, N and class must be integers, got {counts!r}")
    require(
        1 <= counts[0] <= counts[1] <= n_windows, f"M of N must fit {n_windows} windows, got {counts[:2]}"
    )
    require(0 <= counts[2] < len(recipe.classes), f"healthy_index must be a class, got {counts[2]}")
    spread = rule["with_spread"]
    require(type(spread) is bool, f"with_spread must be true or false, got {spread!r}")
    n_features = len(recipe.sensor.channels) * (1 + spread)
    shapes: dict[str, tuple[int, ...]] = {
        "prior": (len(recipe.classes),),
        "own_scale": (len(rule["bank_windows"]), n_features),
    }
    for name in ("healthy_center", "healthy_scale", "lower", "upper"):
        shapes[name] = (n_windows, n_features)
    for name, shape in shapes.items():
        require(rule[name].shape == shape, f"{name} must be of shape {shape}, got {rule[name].shape}")
    tiny = np.finfo(np.float64).tiny
    for name in ("healthy_scale", "upper", "own_scale"):
        require(bool((rule[name] >= tiny).all()), f"{name} must be > 0")
    require(bool((rule["lower"] <= -tiny).all()), "lower must be < 0")
    # A share may be 0; a scale may not.
    require(bool((rule["prior"] >= 0.0).all()), "prior must be >= 0")
    for name in ("temperature", "slope", "intercept"):
        require(
            isinstance(rule[name], float) and np.isfinite(rule[name]),
            f"{name} must be a number, got {rule[name]!r}",
        )


def class_filter(recipe: Recipe, fault_class: FaultClass) -> KalmanFilter:
    """Return the filter that assumes one class of the recipe at its nominal parameters (Magill 1965)."""
    sensor = recipe.sensor.with_noise(float(np.sqrt(variance_factor(fault_class))))
    return KalmanFilter.from_parameters(
        apply_faults(recipe.motor, fault_class.faults), sensor, recipe.timing.dt_s
    )
