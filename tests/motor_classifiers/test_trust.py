"""Models under other conditions than in training: what the table says of models whose answers are known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from motor_classifiers.conformal import ConformalSets
from motor_classifiers.foreign import UNKNOWN_FAULTS, ForeignFault, foreign_starts
from motor_classifiers.novelty import FaultFamilyDetector
from motor_classifiers.shifts import shift_scores, textbook_shifts
from motor_datasets.generate import generate_arrays
from motor_env.posterior import class_probabilities
from motor_env.recipes import FaultClass, Recipe, Spread, named_recipe
from motor_env.simulation import Timing

BENCH = named_recipe("bench", timing=Timing(1_000.0, 0.1))


class Posterior:
    """The exact posterior as a fitted classifier."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.classes_ = np.array(recipe.class_names)

    def predict_proba(self, X: Any) -> Any:
        return class_probabilities(self.recipe, X)


def calibrated(model: Posterior) -> ConformalSets:
    known = generate_arrays(BENCH, 2, np.arange(800) + 5_000)
    return ConformalSets.calibrate(model.predict_proba(known.X), known.class_index)


def test_the_posterior_keeps_its_word_and_loses_it_under_shifts() -> None:
    model = Posterior(BENCH)
    detector = FaultFamilyDetector(BENCH).fit(generate_arrays(BENCH, 2, 500).X)
    conditions = {"same": BENCH, **textbook_shifts(BENCH)}
    got = shift_scores(
        model, BENCH, conditions, sets=calibrated(model), detector=detector, seed=3, cases=np.arange(300)
    )
    by_name = {score.name: score for score in got}
    same = by_name["same"]
    assert same.accuracy == same.limit
    assert same.ece < 0.06
    # A set may hold another level of the true kind, so kinds are covered more often than classes.
    assert same.coverage > 0.86
    assert same.other < 0.05
    short = by_name["shorted turns, 10 %"]
    assert (short.accuracy, short.limit, short.coverage) == (0.0, 1.0, 0.0)
    assert short.other > 0.9
    hotter = by_name["20 K hotter"]
    assert hotter.accuracy < hotter.limit - 0.02
    assert hotter.ece > same.ece + 0.05
    assert by_name["sensor twice as noisy"].ece > same.ece
    assert by_name["severities between the levels"].accuracy > 0.5


def test_a_field_needs_a_reference() -> None:
    model = Posterior(BENCH)
    still = replace(
        named_recipe("field").shifted("hotter"), motor=BENCH.motor, timing=BENCH.timing,
        starts_per_motor=1, healthy_starts=0,
    )  # fmt: skip
    sets = calibrated(model)
    cases = np.arange(60)
    alone, estimated = (
        shift_scores(model, BENCH, {"hotter": still}, sets=sets, reference=reference, seed=3, cases=cases)[0]
        for reference in (None, lambda recipe: model)
    )
    assert np.isnan(alone.limit)
    assert np.isnan(alone.other)
    assert estimated.limit == estimated.accuracy
    with pytest.raises(ValueError, match="has a field"):
        foreign_starts(still, UNKNOWN_FAULTS[0], 0, np.arange(2))


def test_foreign_starts_are_the_healthy_motors_with_the_change() -> None:
    certain = replace(BENCH, spread=Spread(), classes=(FaultClass(),))
    none = ForeignFault("none")
    starts = foreign_starts(certain, none, 4, np.arange(5))
    np.testing.assert_allclose(starts, generate_arrays(certain, 4, 5).X, atol=1e-6)
    weak = ForeignFault("supply -50 %", supply=0.5)
    silent = replace(certain, sensor=replace(certain.sensor, current_noise_a=1e-9))
    half, full = (foreign_starts(silent, fault, 4, np.arange(1)) for fault in (weak, none))
    np.testing.assert_allclose(half, 0.5 * full, atol=1e-6)
