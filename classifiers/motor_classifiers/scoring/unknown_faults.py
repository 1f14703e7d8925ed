"""Faults that no model of ours is trained on: their starts, and how well distance and confidence tell them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score, roc_curve

from motor_classifiers.scoring.task import judged_cases
from motor_classifiers.wrappers.fault_family import family_fit
from motor_datasets.generate import generate_arrays
from motor_env.motor.parameters import FloatArray, SupplyParameters
from motor_env.simulation.drawing import apply_factors, draw
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe
from motor_env.simulation.simulate import simulate

Confidence = Callable[[NDArray[np.float32]], FloatArray]
"""Probabilities of transients: shape (n_cases, n_channels, n_samples) to (n_cases, n_classes)."""

DISTANCE = "distance"
"""What faults are told by beside the classifiers' confidence: the distance from the recipe's family (`family_fit`)."""

_FALSE_ALARMS = 0.01

FALSE_ALARM_RATES: FloatArray = np.linspace(0.0, 1.0, 101)
"""Where curves are drawn."""


@dataclass(frozen=True, slots=True)
class ForeignFault:
    """A departure from the healthy motor that no fault kind explains: factors on its quantities.

    Attributes:
        name: for tables.
        supply: factor on the supply's voltage.
        resistance: factor on the resistance.
        constants: common factor on both motor constants.
        inertia: factor on the inertia.
        friction: factor on the viscous friction.
    """

    name: str
    supply: float = 1.0
    resistance: float = 1.0
    constants: float = 1.0
    inertia: float = 1.0
    friction: float = 1.0


UNKNOWN_FAULTS = (
    ForeignFault("inertia +25 %", inertia=1.25),
    ForeignFault("motor constants -10 %", constants=0.9),
    ForeignFault("supply -10 %", supply=0.9),
)
"""Faults on which no model of ours is trained: a heavier rotor, magnets that lost strength, a weak supply."""


def foreign_starts(
    recipe: Recipe, fault: ForeignFault, seed: int, cases: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Starts of otherwise healthy motors of a recipe with a foreign fault, shape (n_cases, n_channels, n_samples).

    Args:
        recipe: tolerances, supply, sensor and timing.
        fault: what is wrong with them.
        seed: the random seed.
        cases: case numbers, shape (n_cases,).

    Raises:
        ValueError: the recipe departs from the textbook motor.
    """
    if recipe.field is not None:
        raise ValueError(f"foreign faults are those of textbook motors, recipe {recipe.name} has a field")
    scenario = draw(replace(recipe, classes=(FaultClass(),), healthy_starts=0), seed, cases).scenario
    changed = replace(
        scenario,
        parameters=apply_factors(scenario.parameters, np.array([getattr(fault, name) for name in FACTORS])),
        supply=SupplyParameters(scenario.supply.voltage_v * fault.supply),
    )
    return simulate(changed, seed, cases).measurements.astype(np.float32)


def foreign_scores(
    recipe: Recipe,
    confidences: Mapping[str, Confidence],
    *,
    seed: int,
    first_case: int,
    n_threshold: int,
    n_known: int,
    n_foreign: int,
) -> dict[str, Any]:
    """Measure how well distance, and the confidence of classifiers, tell `UNKNOWN_FAULTS`.

    The threshold of the distance, for 1 % of false alarms, is set on other motors than it is tried on.

    Args:
        recipe: the known classes.
        confidences: classifiers by name; the smaller their largest probability, the more foreign a start.
        seed: the random seed.
        first_case: of the starts of known classes; the foreign ones are motors of the same numbers.
        n_threshold: starts of known classes that set the threshold.
        n_known: starts of known classes that are judged.
        n_foreign: starts of each foreign fault.

    Returns:
        For JSON: `false_alarms`, the share of motors of the known classes that are called `other`, and `faults`: of
        each its name `fault`, the area under the ROC curve `auroc` and the share found at each of `FALSE_ALARM_RATES`
        `roc`, both by `DISTANCE` and by each classifier's confidence, and the share `called_other`.
    """
    known_cases = judged_cases(recipe, first_case, n_known + n_threshold)
    known = generate_arrays(recipe, seed, known_cases[:n_known]).X
    of_threshold = family_fit(recipe, generate_arrays(recipe, seed, known_cases[n_known:]).X).distance
    threshold = float(np.quantile(of_threshold, 1.0 - _FALSE_ALARMS))

    def scores_of(X: NDArray[np.float32]) -> dict[str, FloatArray]:
        sure = {name: classify(X).max(axis=1) for name, classify in confidences.items()}
        return {DISTANCE: -family_fit(recipe, X).distance, **sure}

    of_known = scores_of(known)
    scored = []
    for fault in UNKNOWN_FAULTS:
        of_foreign = scores_of(foreign_starts(recipe, fault, seed, known_cases[:n_foreign]))
        areas, curves = {}, {}
        for name, low in of_foreign.items():
            truth = np.repeat([0, 1], [n_known, n_foreign])
            strange = -np.concatenate([of_known[name], low])
            areas[name] = float(roc_auc_score(truth, strange))
            false, right, _ = roc_curve(truth, strange)
            curves[name] = np.round(np.interp(FALSE_ALARM_RATES, false, right), 4).tolist()
        called_other = float((of_foreign[DISTANCE] < -threshold).mean())
        scored.append({"fault": fault.name, "auroc": areas, "called_other": called_other, "roc": curves})
    return {"false_alarms": float((of_known[DISTANCE] < -threshold).mean()), "faults": scored}
