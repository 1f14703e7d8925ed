"""How far models can be trusted: under other conditions, on foreign faults, on halves; what the figures say."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import trust_figures
from trust_figures import Counts, halves_coverage, shift_scores, shipped_network, textbook_shifts

from motor_classifiers import ConformalSets, OutsideDetector
from motor_classifiers.scoring.frozen_tasks import UNKNOWN_FAULTS, foreign_starts
from motor_classifiers.scoring.task import class_task
from motor_datasets import generate_arrays
from motor_env import Recipe, Timing, class_probabilities, load_recipe

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))


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
    detector = OutsideDetector(BENCH).fit()
    conditions = {"same": BENCH, **textbook_shifts(BENCH)}
    got = shift_scores(
        model, BENCH, conditions, sets=calibrated(model), detector=detector, reference=Posterior, seed=3,
        cases=np.arange(300),
    )  # fmt: skip
    by_name = {score.name: score for score in got}
    same = by_name["same"]
    assert same.accuracy == same.limit
    assert same.ece < 0.06
    # A set may hold another level of the true kind, so kinds are covered more often than classes.
    assert same.coverage > 0.86
    assert same.refused < 0.05
    short = by_name["shorted turns, 10 %"]
    assert (short.accuracy, short.limit, short.coverage) == (0.0, 1.0, 0.0)
    assert short.refused > 0.9
    hotter = by_name["20 K hotter"]
    assert hotter.accuracy < hotter.limit - 0.02
    assert hotter.ece > same.ece + 0.05
    assert hotter.refused > 0.4
    # Fewer wrong answers are given; among those given more are wrong: the faulty ones look strangest when hot.
    assert (1.0 - hotter.refused) * (1.0 - hotter.answered_accuracy) < 0.85 * (1.0 - hotter.accuracy)
    assert by_name["sensor twice as noisy"].ece > same.ece
    assert by_name["severities between the levels"].accuracy > 0.5


def test_a_field_needs_a_reference() -> None:
    model = Posterior(BENCH)
    still = replace(
        load_recipe("field").shifted("hotter"), motor=BENCH.motor, timing=BENCH.timing,
        starts_per_motor=1, healthy_starts=0,
    )  # fmt: skip
    (estimated,) = shift_scores(
        model, BENCH, {"hotter": still}, sets=calibrated(model), detector=OutsideDetector(BENCH).fit(),
        reference=lambda recipe: model, seed=3, cases=np.arange(60),
    )  # fmt: skip
    assert estimated.limit == estimated.accuracy
    with pytest.raises(ValueError, match="has a field"):
        foreign_starts(still, UNKNOWN_FAULTS[0], 0, np.arange(2))


def test_each_half_of_the_motors_calibrates_the_other() -> None:
    rng = np.random.default_rng(1)
    motors = np.repeat(np.arange(300), 2)
    truth = rng.integers(3, size=300)[motors]
    probabilities = rng.dirichlet(np.ones(3), size=600) + 1.5 * np.eye(3)[truth] * rng.random((600, 1))
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    got = halves_coverage(probabilities, truth, motors)
    even = motors % 2 == 0
    held = np.zeros(600, dtype=bool)
    for known in (even, ~even):
        for label in range(3):
            # The rank of split conformal prediction: the ceil(0.9 (n + 1))-th strangest of a class is still in.
            strange = np.sort(1.0 - probabilities[known & (truth == label), label])
            largest = strange[int(np.ceil(0.9 * (len(strange) + 1))) - 1]
            mine = ~known & (truth == label)
            held[mine] = 1.0 - probabilities[mine, label] <= largest + 1e-12
    assert got.overall == pytest.approx(held.mean())
    assert got.by_class == pytest.approx([held[truth == label].mean() for label in range(3)])
    with pytest.raises(ValueError, match="each class needs"):
        halves_coverage(probabilities[:2], truth[:2], motors[[0, 2]])


FEW = Counts(known=60, foreign=20, severity=40, early=60, healthy=60, steps=5)


def test_the_shipped_network_is_taken_where_the_recipe_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust_figures, "COUNTS", FEW)
    recipe = load_recipe("bench")
    assert shipped_network(recipe) is not None
    assert shipped_network(BENCH) is None
    told = trust_figures.severities(class_task(recipe), trust_figures.network_for(recipe, 0))
    assert told["n_cases"] == 40
    by_kind = {row["kind"]: row for row in told["kinds"]}
    assert set(by_kind) == {"bearing", "winding_contact", "winding_short"}
    for row in by_kind.values():
        assert row["network"]["rmse"] == pytest.approx(row["limit"]["rmse"], rel=0.15)


def test_foreign_faults_are_told_by_their_distance() -> None:
    got = trust_figures.foreign_scores(
        BENCH, {"limit": partial(class_probabilities, BENCH)}, seed=0, n_known=200, n_foreign=40
    )
    assert [row["fault"] for row in got["faults"]] == [fault.name for fault in UNKNOWN_FAULTS]
    heavier = got["faults"][0]
    assert heavier["auroc"]["distance"] > 0.99 > 0.7 > heavier["auroc"]["limit"]
    assert heavier["called_other"] > 0.9
    assert heavier["roc"]["distance"][0] <= heavier["roc"]["distance"][-1] == 1.0
    assert len(heavier["roc"]["limit"]) == 101
    assert got["false_alarms"] < 0.05


def test_early_verdicts_are_tried_on_starts_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither those that the method learns from nor those that the benchmark judges."""
    cell, taken = class_task(BENCH, 60, 60), list[set[int]]()

    def noted(recipe: Recipe, seed: int, train: Any, test: Any) -> dict[str, Any]:
        taken.extend(set(starts.case_id.tolist()) for starts in (train, test))
        return {"limit": np.full((13, len(test), 5), 0.2)}

    monkeypatch.setattr(trust_figures, "COUNTS", FEW)
    monkeypatch.setattr(trust_figures, "probabilities_by_moment", noted)
    trust_figures.early_figures(cell)
    learned, tried = taken
    assert (len(learned), len(tried)) == (60, 60)
    assert not tried & (learned | set(cell.starts().case_id.tolist()))
