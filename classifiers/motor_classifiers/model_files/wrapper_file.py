"""Classifiers around another model as plain values, and back: the verdict `other`, and conformal sets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.frozen import FrozenEstimator

from motor_classifiers.wrappers.conformal import ConformalClassifier, ConformalSets
from motor_classifiers.wrappers.open_set import FaultFamilyDetector, OpenSetClassifier
from motor_env.motor.parameters import require
from motor_env.simulation.recipes import Recipe

Wrapper = OpenSetClassifier | ConformalClassifier


def wrapped_model(wrapper: Wrapper) -> BaseEstimator:
    """The fitted model inside."""
    inner = wrapper.estimator_
    return inner.estimator if isinstance(inner, FrozenEstimator) else inner


def wrapper_values(wrapper: Wrapper, recipe: Recipe) -> dict[str, Any]:
    """What describes it beside the model inside.

    Raises:
        ValueError: it tells foreign motors from those of another recipe.
    """
    if isinstance(wrapper, OpenSetClassifier):
        require(wrapper.recipe == recipe, "an open-set classifier must be saved with its own recipe")
        return {
            "kind": "open-set",
            "false_alarm_rate": float(wrapper.false_alarm_rate),
            "offset": wrapper.detector_.offset_,
        }
    return {
        "kind": "conformal",
        "coverage": float(wrapper.coverage),
        "strangeness": [known.tolist() for known in wrapper.sets_.strangeness],
    }


def load_wrapper(head: Mapping[str, Any], inner: BaseEstimator, recipe: Recipe) -> Wrapper:
    """The wrapper of a file around the model that was loaded.

    Raises:
        ValueError, KeyError, TypeError: values of another type or range than they must have.
    """
    return {"open-set": _load_open_set, "conformal": _load_conformal}[head["kind"]](head, inner, recipe)


def _load_open_set(head: Mapping[str, Any], inner: BaseEstimator, recipe: Recipe) -> Wrapper:
    rate, offset = head["false_alarm_rate"], head["offset"]
    _check_share("false_alarm_rate", rate)
    require(isinstance(offset, float) and math.isfinite(offset), f"offset must be a number, got {offset!r}")
    model = OpenSetClassifier(inner, recipe, rate)
    model.estimator_, model.classes_ = inner, inner.classes_
    model.n_features_in_ = inner.n_features_in_
    model.detector_ = FaultFamilyDetector(recipe, rate)
    model.detector_.offset_, model.detector_.n_features_in_ = offset, inner.n_features_in_
    return model


def _load_conformal(head: Mapping[str, Any], inner: BaseEstimator, recipe: Recipe) -> Wrapper:
    coverage, strangeness = head["coverage"], head["strangeness"]
    _check_share("coverage", coverage)
    require(
        isinstance(strangeness, list) and len(strangeness) in (1, len(inner.classes_)),
        "strangeness must be one list, or one for each class",
    )
    known = tuple(np.array(part, dtype=np.float64) for part in strangeness)
    for part in known:
        rises = (
            part.ndim == 1
            and len(part) > 0
            and bool(np.isfinite(part).all() and (np.diff(part) >= 0.0).all())
        )
        require(rises, "strangeness must be finite numbers that rise")
    model = ConformalClassifier(FrozenEstimator(inner), coverage, label_conditional=len(known) > 1)
    model.estimator_, model.classes_ = model.estimator, inner.classes_
    model.n_features_in_ = inner.n_features_in_
    model.sets_ = ConformalSets(known)
    return model


def _check_share(name: str, value: Any) -> None:
    inside = isinstance(value, float) and 0.0 < value < 1.0
    require(inside, f"{name} must lie between 0 and 1, got {value!r}")
