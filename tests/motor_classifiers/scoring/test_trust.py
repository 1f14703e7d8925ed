"""How far models can be trusted: under other conditions, on foreign faults, on halves; what the figures say."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shifts import shift_scores, textbook_shifts

from motor_classifiers import ConformalSets, OutsideDetector
from motor_classifiers.scoring import trust as trust_module
from motor_classifiers.scoring.task import class_task
from motor_classifiers.scoring.trust import (
    SECTIONS,
    Counts,
    halves_coverage,
    load_figures,
    save_figures,
    shipped_network,
    trust_figures,
    trust_key,
)
from motor_classifiers.scoring.unknown_faults import (
    DISTANCE,
    UNKNOWN_FAULTS,
    foreign_starts,
)
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


FEW = Counts(threshold=100, known=60, foreign=20, severity=40, early=60, healthy=60, steps=5)


def test_figures_are_json_and_survive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust_module, "COUNTS", FEW)
    cell = class_task(BENCH, 200, 100)
    told = trust_figures(cell, with_network=False)
    assert told["severity"].keys() == {"reason"}
    assert len(told["unknown"]["settings"]) == 1
    assert set(told["unknown"]["settings"][0]["faults"][0]["auroc"]) == {DISTANCE, "limit"}
    assert all(0.0 <= share <= 1.0 for shares in told["early"]["accuracy"].values() for share in shares)
    assert [row["stated"] for row in told["early"]["stopping"][::2]] == [0.10, 0.05, 0.02, 0.01]
    path = tmp_path / "figures.json"
    save_figures(told, path)
    assert load_figures(path) == json.loads(json.dumps(told))
    assert load_figures(path) == json.loads(json.dumps(trust_figures(cell, with_network=False)))
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"[]", b"{}", b""):
        path.write_bytes(damaged)
        assert load_figures(path) is None
    assert load_figures(tmp_path / "none.json") is None


def test_the_shipped_network_is_taken_where_the_recipe_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust_module, "COUNTS", FEW)
    recipe = load_recipe("bench")
    assert shipped_network(recipe) is not None
    assert shipped_network(BENCH) is None
    told = trust_module._severity(class_task(recipe), shipped_network(recipe))
    assert told["network_is_shipped"]
    by_kind = {row["kind"]: row for row in told["kinds"]}
    assert set(by_kind) == {"bearing", "winding_contact", "winding_short"}
    for row in by_kind.values():
        assert row["network"]["rmse"] == pytest.approx(row["limit"]["rmse"], rel=0.15)


def test_what_a_setting_cannot_have_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust_module, "COUNTS", FEW)
    told = trust_figures(class_task(load_recipe("field"), 100, 100), with_network=True)
    assert all("no closed form" in told[name]["reason"] for name in SECTIONS)
    no_bearing = replace(BENCH, classes=(BENCH.classes[0], BENCH.classes[3]))
    assert "bearing" in trust_module._race(class_task(no_bearing))["reason"]


def test_the_key_holds_all_that_the_figures_depend_on(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = (
        class_task(BENCH, 200),
        class_task(BENCH, 300),
        class_task(BENCH, 200, seed=1),
        class_task(replace(BENCH, name="b"), 200),
    )
    keys = {trust_key(cell, with_network=also) for cell in cells for also in (False, True)}
    assert len(keys) == 2 * len(cells)
    monkeypatch.setattr(trust_module, "COUNTS", FEW)
    assert trust_key(cells[0], with_network=False) not in keys


def test_early_verdicts_are_tried_on_starts_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither those that the method learns from nor those that the benchmark judges."""
    cell, taken = class_task(BENCH, 60, 60), list[set[int]]()

    def noted(recipe: Recipe, seed: int, train: Any, test: Any) -> dict[str, Any]:
        taken.extend(set(starts.case_id.tolist()) for starts in (train, test))
        return {"limit": np.full((13, len(test), 5), 0.2)}

    monkeypatch.setattr(trust_module, "COUNTS", FEW)
    monkeypatch.setattr(trust_module, "probabilities_by_moment", noted)
    trust_module._early(cell)
    learned, tried = taken
    assert (len(learned), len(tried)) == (60, 60)
    assert not tried & (learned | set(cell.starts().case_id.tolist()))
