"""A benchmark's results from made answers, for the tests of scores, tables and pages: nothing is trained."""

from typing import Any

import numpy as np

# Reaches in: results are made up as the benchmark keeps them: to run it takes minutes.
from motor_classifiers.scoring.benchmark import AnswerStore, Plan, run_plan, units
from motor_classifiers.scoring.judging import LIMIT, Answer, Cost
from motor_classifiers.scoring.metrics import IntArray
from motor_classifiers.scoring.score import Results
from motor_classifiers.scoring.task import class_task
from motor_env import Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))
TASK = class_task(RECIPE, 100, 60)


def answer(decided: IntArray, sure: float = 0.75) -> Answer:
    """Decisions with one probability for all, the rest shared by the other classes."""
    probabilities = np.full((len(decided), 5), (1.0 - sure) / 4.0)
    probabilities[np.arange(len(decided)), decided] = sure
    costs = Cost(1.5, 20.0), Cost(0.003, None)
    return Answer(probabilities, *costs)


def decisions(wrong: slice) -> IntArray:
    """The true classes, but the next class in some rows."""
    decided = TASK.starts().class_index.copy()
    decided[wrong] = (decided[wrong] + 1) % 5
    return decided


def made_results(limit: Answer, **methods: Answer) -> tuple[Plan, Results]:
    """Results of the one setting, as if a run had had these answers; `residual_qda` is residual-qda."""
    by_name: dict[str, Any] = {name.replace("_", "-"): one for name, one in methods.items()}
    plan, store = Plan((TASK,), tuple(by_name)), AnswerStore()
    for unit in units(plan):
        store.put(unit, (by_name | {LIMIT: limit})[unit.name])
    (result,) = run_plan(plan, store)
    return plan, result
