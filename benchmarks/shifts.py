"""A model under other conditions than it was trained on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.neural_network import MLPClassifier

from motor_classifiers.scoring.metrics import calibration_scores
from motor_classifiers.wrappers.conformal import ConformalSets
from motor_classifiers.wrappers.outlier_detector import (
    Coordinates,
    OutsideDetector,
    StartDensity,
    class_mixture,
    single_starts,
)
from motor_datasets.generate import generate_arrays
from motor_env.inference.posterior import class_probabilities
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe, Spread

COVERAGE = 0.90
"""Wanted of the conformal sets."""


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
        limit: the same accuracy of who knows the conditions: the exact posterior, or an estimate for a field.
        refused: share of cases that the detector refuses.
        answered_accuracy: accuracy in the other cases; nan where there is none.
        answered_ece: expected calibration error in them.
    """

    name: str
    accuracy: float
    ece: float
    coverage: float
    set_size: float
    limit: float
    refused: float
    answered_accuracy: float
    answered_ece: float


def shift_scores(
    model: Any,
    trained: Recipe,
    conditions: Mapping[str, Recipe],
    *,
    sets: ConformalSets,
    detector: OutsideDetector,
    reference: Callable[[Recipe], Any],
    seed: int,
    cases: NDArray[np.int64],
) -> tuple[ShiftScore, ...]:
    """Judge a model under conditions that it was not trained for.

    Args:
        model: fitted classifier of the classes of `trained`.
        trained: what it was trained for.
        conditions: recipes by name, with the time axis and channels of `trained`.
        sets: calibrated on cases of `trained` with the model's probabilities, its columns in the order of `classes_`.
        detector: fitted, which refuses cases.
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
        held = sets.sets(probabilities, COVERAGE)
        true = kinds == drawn.kind[:, None]
        kind_accuracy, ece = _kind_scores(probabilities, kinds, drawn.kind)
        left = detector.predict(drawn.X) > 0
        after = _kind_scores(probabilities[left], kinds, drawn.kind[left]) if left.any() else (np.nan, np.nan)
        scores.append(
            ShiftScore(
                name,
                kind_accuracy,
                ece,
                float((held & true).any(axis=1).mean()),
                float(held.sum(axis=1).mean()),
                _limit(recipe, drawn.X, drawn.kind, reference),
                1.0 - float(left.mean()),
                *after,
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
    reference: Callable[[Recipe], Any],
) -> float:
    kind_of = {c.name: c.label_kind for c in recipe.classes}
    if len(set(kind_of.values())) < 2:
        return 1.0
    if recipe.field is None:
        names, probabilities = recipe.class_names, class_probabilities(recipe, X)
    else:
        model = reference(recipe)
        names, probabilities = tuple(map(str, model.classes_)), np.asarray(model.predict_proba(X))
    return _kind_scores(probabilities, np.array([kind_of[name] for name in names]), truth)[0]


def trained_power(recipe: Recipe, changed: Recipe, seed: int, cases: NDArray[np.int64]) -> float:
    """Power of a test for this very change at 1 % of false alarms: of two trained for it, the better one.

    One is the likelihood ratio of the Gaussian mixtures of both recipes, the other a perceptron; both see the
    directions of the detector and the level of the noise.
    """
    density = StartDensity.from_recipe(recipe)
    at = [
        [_located(density, one, seed, cases + first) for first in (0, 1_000_000)] for one in (recipe, changed)
    ]
    other = single_starts(changed)
    silent, class_index = density.noiseless(other, 0, len(cases))
    theirs, free = class_mixture(other, silent.along, class_index), (1.0, 1.0)

    def ratio(where: Coordinates) -> FloatArray:
        mine, own = (mixture.log_density(where, density.freedom, free) for mixture in (theirs, density.own))
        difference: FloatArray = mine - own
        return difference

    centre, scale = at[0][0].along.mean(axis=0), at[0][0].along.std(axis=0)

    def seen(where: Coordinates) -> FloatArray:
        level = (where.energy / density.freedom - 1.0) * np.sqrt(0.5 * density.freedom)
        columns: FloatArray = np.column_stack([(where.along - centre) / scale, level])
        return np.clip(columns, -30.0, 30.0)

    learned = MLPClassifier((48, 48), early_stopping=True, random_state=0, max_iter=40, batch_size=512)
    learned.fit(np.concatenate([seen(at[0][0]), seen(at[1][0])]), np.repeat([0, 1], [len(cases), len(cases)]))
    powers = []
    for test in (ratio, lambda where: learned.predict_proba(seen(where))[:, 1]):
        threshold = np.quantile(test(at[0][1]), 0.99)
        powers.append(float((test(at[1][1]) > threshold).mean()))
    return max(powers)


def _located(density: StartDensity, recipe: Recipe, seed: int, cases: NDArray[np.int64]) -> Coordinates:
    X = generate_arrays(recipe, seed, cases).X
    return density.coordinates(X.reshape(len(X), -1).astype(np.float64))
