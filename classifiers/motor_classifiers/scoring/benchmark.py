"""The benchmark: every method trained and judged on the same motors, beside the Bayes-optimal posterior."""

from __future__ import annotations

from collections.abc import Callable

from motor_classifiers.scoring.judging import LIMIT, Answer, judge_apart, posterior
from motor_classifiers.scoring.peers import read_peers
from motor_classifiers.scoring.plan import AnswerStore, Plan, Unit, limit_of, unit_of, units
from motor_classifiers.scoring.score import Results, score_classes
from motor_classifiers.scoring.task import ClassTask
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
        InputError: the peers' answers are to no starts of the plan; or some answer could not be had: all others were
            tried, and stand in the store.
    """
    kept = AnswerStore() if store is None else store
    peers, todo, failures = _peers(plan), units(plan), []
    for unit in todo:
        known = kept.find(unit) is not None
        on_unit(unit, known)
        if not known:
            try:
                kept.put(unit, _answer(unit))
            except InputError as error:
                failures.append(str(error))
    if failures:
        raise InputError(f"{len(failures)} of {len(todo)} answers failed, the first: {failures[0]}")
    return tuple(_scored(plan, task, kept, beside) for task, beside in zip(plan.tasks, peers, strict=True))


def _peers(plan: Plan) -> list[dict[str, Answer]]:
    """Kept answers of peers to the starts of each setting."""
    if plan.peers is None:
        return [{} for _ in plan.tasks]
    found = [read_peers(plan.peers, task) for task in plan.tasks]
    if not any(found):
        raise InputError(
            f"{plan.peers}: holds answers to other starts than those of this benchmark; leave --peers out"
        )
    return found


def _answer(unit: Unit) -> Answer:
    return posterior(unit.task) if unit.name == LIMIT else judge_apart(unit.name, unit.task)


def _scored(plan: Plan, task: ClassTask, store: AnswerStore, peers: dict[str, Answer]) -> Results:
    answers = {name: store.answer(unit_of(task, name)) for name in plan.methods}
    limit = store.answer(unit_of(task, limit_of(task)))
    return score_classes(task, answers | peers, limit, plan.n_comparisons)
