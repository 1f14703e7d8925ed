"""A model under other conditions than it was trained on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_classifiers.scoring.calibration import calibration_scores
from motor_classifiers.wrappers.conformal import ConformalSets
from motor_classifiers.wrappers.open_set import FaultFamilyDetector
from motor_datasets.generate import generate_arrays
from motor_env.inference.posterior import class_probabilities
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe, Spread


def textbook_shifts(recipe: Recipe) -> dict[str, Recipe]:
    """Other conditions for a recipe of textbook motors; for each the exact posterior is known.

    A recipe with a field has shifts of its own (`Recipe.shifts`).
    """
    louder = replace(recipe.sensor, current_noise_a=2.0 * recipe.sensor.current_noise_a)
    names = ("supply", "resistance", "constants", "inertia", "friction")
    wider = Spread(**{name: 2.0 * getattr(recipe.spread, name) for name in names})
    # Copper gains 0.393 % a kelvin, magnets lose 0.1 %.
    hot = recipe.motor.scaled(
        resistance_ohm=1.0786, back_emf_constant_v_s_per_rad=0.98, torque_constant_n_m_per_a=0.98
    )
    between = (
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.17),
        FaultClass(FaultKind.WINDING_CONTACT, 0.17),
    )
    return {
        "20 K hotter": replace(recipe, motor=hot),
        "sensor twice as noisy": replace(recipe, sensor=louder),
        "tolerances twice as wide": replace(recipe, spread=wider),
        "severities between the levels": replace(recipe, classes=between),
        "shorted turns, 10 %": replace(recipe, classes=(FaultClass(FaultKind.WINDING_SHORT, 0.10),)),
    }


class ShiftScore(NamedTuple):
    """A model under other conditions. Kinds count, not levels: severities may be others than in training.

    Attributes:
        name: of the conditions.
        accuracy: share of cases with the right kind.
        ece: expected calibration error of the kinds' probabilities.
        coverage: share of the conformal sets that hold a class of the true kind.
        set_size: mean number of classes in a set.
        other: share of cases that the detector calls `other`; nan without a detector.
        limit: the same accuracy of who knows the conditions: the exact posterior, or an estimate for a field.
    """

    name: str
    accuracy: float
    ece: float
    coverage: float
    set_size: float
    other: float
    limit: float


def shift_scores(
    model: Any,
    trained: Recipe,
    conditions: Mapping[str, Recipe],
    *,
    sets: ConformalSets,
    coverage: float = 0.90,
    detector: FaultFamilyDetector | None = None,
    reference: Callable[[Recipe], Any] | None = None,
    seed: int,
    cases: NDArray[np.int64],
) -> tuple[ShiftScore, ...]:
    """Judge a model under conditions that it was not trained for.

    Args:
        model: fitted classifier of the classes of `trained`.
        trained: what it was trained for.
        conditions: recipes by name, with the time axis and channels of `trained`.
        sets: calibrated on cases of `trained` with the model's probabilities, its columns in the order of `classes_`.
        coverage: wanted of the sets.
        detector: fitted, for `other`.
        reference: fits a classifier for a recipe with a field, where there is no exact posterior.
        seed: of the cases.
        cases: case numbers, shape (n_cases,).
    """
    scores = []
    kind_of = {c.name: c.label_kind for c in trained.classes}
    kinds = np.array([kind_of[str(name)] for name in model.classes_])
    for name, recipe in conditions.items():
        drawn = generate_arrays(recipe, seed, cases)
        probabilities = np.asarray(model.predict_proba(drawn.X), dtype=np.float64)
        held = sets.sets(probabilities, coverage)
        true = kinds == drawn.kind[:, None]
        kind_accuracy, ece = _kind_scores(probabilities, kinds, drawn.kind)
        scores.append(
            ShiftScore(
                name,
                kind_accuracy,
                ece,
                float((held & true).any(axis=1).mean()),
                float(held.sum(axis=1).mean()),
                float("nan") if detector is None else float((detector.predict(drawn.X) < 0).mean()),
                _limit(recipe, drawn.X, drawn.kind, reference),
            )
        )
    return tuple(scores)


def _kind_scores(
    probabilities: FloatArray, kinds: NDArray[np.str_], truth: NDArray[np.str_]
) -> tuple[float, float]:
    """Accuracy and expected calibration error of the kinds' probabilities; a kind never trained on is never right."""
    names = sorted({*kinds.tolist(), *truth.tolist()})
    of_kind = np.stack([probabilities[:, kinds == name].sum(axis=1) for name in names], axis=1)
    scores = calibration_scores(of_kind, np.searchsorted(names, truth))
    return scores.accuracy, scores.ece


def _limit(
    recipe: Recipe,
    X: NDArray[np.float32],
    truth: NDArray[np.str_],
    reference: Callable[[Recipe], Any] | None,
) -> float:
    kind_of = {c.name: c.label_kind for c in recipe.classes}
    if len(set(kind_of.values())) < 2:
        return 1.0
    if recipe.field is None:
        names, probabilities = recipe.class_names, class_probabilities(recipe, X)
    elif reference is None:
        return float("nan")
    else:
        model = reference(recipe)
        names, probabilities = tuple(map(str, model.classes_)), np.asarray(model.predict_proba(X))
    return _kind_scores(probabilities, np.array([kind_of[name] for name in names]), truth)[0]
