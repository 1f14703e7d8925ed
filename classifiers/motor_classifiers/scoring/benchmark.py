"""The benchmark: every method trained and judged on the same motors, beside the Bayes-optimal posterior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from motor_classifiers.scoring.judging import LIMIT, Answer, judge_apart, posterior
from motor_classifiers.scoring.peers import read_peers
from motor_classifiers.scoring.plan import AnswerStore, Plan, Unit, limit_of, trust_unit, unit_of, units
from motor_classifiers.scoring.score import Results, score_classes
from motor_classifiers.scoring.task import ClassTask
from motor_classifiers.scoring.trust import TRUST, Figures, set_figures, trust_figures
from motor_env.errors import InputError


def run_plan(
    plan: Plan,
    store: AnswerStore | None = None,
    on_unit: Callable[[Unit, bool], object] = lambda unit, known: None,
) -> tuple[Results, ...]:
    """Have all answers, then score them task by task.

    Args:
        plan: what to run.
        store: where answers are kept and looked up; in memory by default.
        on_unit: called before each unit, with whether its answer is already there.

    Raises:
        InputError: some answer could not be had; all others were tried, and stand in the store.
    """
    kept = AnswerStore() if store is None else store
    todo, failures = units(plan), []
    for unit in todo:
        known = kept.find(unit) is not None
        on_unit(unit, known)
        if not known:
            try:
                kept.put(unit, _answer(plan, unit))
            except InputError as error:
                failures.append(str(error))
    if failures:
        raise InputError(f"{len(failures)} of {len(todo)} answers failed, the first: {failures[0]}")
    results = [_scored(plan, task, kept) for task in plan.tasks]
    reference = results[plan.reference]
    figures = {"sets": _sets(reference), **kept.find(trust_unit(plan))}
    results[plan.reference] = replace(reference, trust=figures)
    return tuple(results)


def _answer(plan: Plan, unit: Unit) -> Answer | Figures:
    if unit.name == TRUST:
        return trust_figures(unit.task, with_network=plan.with_network)
    return posterior(unit.task) if unit.name == LIMIT else judge_apart(unit.name, unit.task)


def _sets(result: Results) -> Figures:
    """Conformal sets of the limit and of every method that grades, from the answers that are there."""
    graded = [result.limit, *(method for method in result.ranked() if method.calibration is not None)]
    return set_figures({one.name: one.answer.probabilities for one in graded}, result.task.starts())


def _scored(plan: Plan, task: ClassTask, store: AnswerStore) -> Results:
    answers: dict[str, Answer] = {name: store.find(unit_of(task, name)) for name in plan.methods}
    peers = {} if plan.peers is None else read_peers(plan.peers, task)
    limit: Answer = store.find(unit_of(task, limit_of(task)))
    return score_classes(task, answers | peers, limit, plan.n_comparisons)
