"""Times of verdicts: moments, the alarm by hand, and the order of the rules that theory gives."""

import numpy as np
from trust_figures import FIXED_TIME, STATED_ERRORS, STOPPING_RULE, race, stopping_rows

# Reaches in: the rows are the scores of the rule that stops, on probabilities that no classifier gave.
from motor_classifiers.wrappers.early import stop_when_sure, stopping_score
from motor_env import FaultKind, Timing, load_recipe
from motor_env.simulation.recipes import FaultClass


def test_rows_are_the_scores_of_the_stopping_rule() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(3, size=50)
    told = rng.dirichlet(np.ones(3), size=(4, 50))
    time_s = np.array([0.001, 0.002, 0.003, 0.004])
    rows = stopping_rows({"one": told, "two": told[:, ::-1]}, truth, time_s)
    assert [(row["stated"], row["probabilities_of"]) for row in rows[:2]] == [(0.1, "one"), (0.1, "two")]
    assert len(rows) == 2 * len(STATED_ERRORS)
    score = stopping_score(stop_when_sure(told, 0.05), truth, time_s)._asdict()
    assert {name: rows[2][name] for name in score} == score


def test_stopping_when_sure_is_sooner_than_a_fixed_time_and_than_the_rules() -> None:
    recipe = load_recipe("bench", timing=Timing(2_000.0, 0.1))
    fault = FaultClass(FaultKind.BEARING, 0.4)
    curves = race(recipe, fault, seed=1, first_case=0, n_cases=400, n_healthy=800)

    def time_for(name: str, wrong: float) -> float:
        """Of the soonest setting with no more wrong verdicts."""
        return min(point.time_s for point in curves[name] if point.wrong <= wrong)

    best = time_for(STOPPING_RULE, 0.05)
    assert best < time_for(FIXED_TIME, 0.05)
    assert best < time_for("CUSUM", 0.05) + 0.002
    assert best < time_for("GLR", 0.05) + 0.002
    fixed = [point.wrong for point in curves[FIXED_TIME]]
    assert fixed[0] > 0.3
    assert fixed[-1] < 0.05
    for name in ("SPRT", "CUSUM", "GLR"):
        times = [point.time_s for point in curves[name]]
        assert times == sorted(times)  # fewer false alarms, later verdicts
