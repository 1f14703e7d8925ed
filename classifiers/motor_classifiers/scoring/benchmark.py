"""The benchmark: every method trained and judged on the same motors, beside the Bayes-optimal posterior."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from motor_classifiers.scoring.calibration import CalibrationScores, calibration_scores
from motor_classifiers.scoring.judging import LIMIT, Answer, Cell, judge_apart, posterior
from motor_classifiers.scoring.metrics import (
    Comparison,
    IntArray,
    Score,
    Scores,
    compare,
    resampling_weights,
    root_mean_square,
    scores,
)
from motor_classifiers.scoring.peers import read_peers
from motor_classifiers.scoring.plan import AnswerStore, Plan, Unit, limit_of, trust_unit, unit_of, units
from motor_classifiers.scoring.trust import TRUST, Figures, set_figures, trust_figures
from motor_datasets.arrays import Dataset
from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

SIGNIFICANCE = 0.01
"""Of the check that no method beats the limit: shared among all comparisons of a run (Bonferroni), one-sided."""


class Judged(NamedTuple):
    """An answer and its scores.

    Attributes:
        answer: what was said of each test start.
        scores: of the decisions, with intervals.
        calibration: of the probabilities; None for a method that only decides.
        severity_rmse: root mean square error of the severity, 0.01 for a point.
    """

    answer: Answer
    scores: Scores
    calibration: CalibrationScores | None
    severity_rmse: Score


class MethodResult(NamedTuple):
    """One method in one setting.

    Attributes:
        name: of `find_method` or `PEERS`.
        judged: answer and scores.
        against_limit: compared in pairs with the limit's decisions.
        above_limit: whether it is significantly better than what is possible: then something leaks.
        origin: where a peer's answers come from; empty for methods that this run judged.
    """

    name: str
    judged: Judged
    against_limit: Comparison
    above_limit: bool
    origin: str = ""


class CellResult(NamedTuple):
    """All of one setting.

    Attributes:
        cell: setting.
        truth: index of the true class of each test start.
        severity: true severity of each.
        limit: the Bayes-optimal posterior, or its estimate.
        limit_is_estimate: whether it is one: where the likelihood has no closed form, nothing better is known.
        methods: in the order asked, then the peers.
        weights: of the bootstrap, shape (1 + n_resamples, n_test).
        trust: figures on trust, in the reference setting alone.
    """

    cell: Cell
    truth: IntArray
    severity: FloatArray
    limit: Judged
    limit_is_estimate: bool
    methods: tuple[MethodResult, ...]
    weights: FloatArray
    trust: Figures | None = None

    @property
    def leaks(self) -> tuple[str, ...]:
        """Names of the methods that are significantly above the limit."""
        return tuple(method.name for method in self.methods if method.above_limit)

    def ranked(self) -> tuple[MethodResult, ...]:
        """Methods, the most accurate first."""
        return tuple(sorted(self.methods, key=lambda method: -method.judged.scores.accuracy.value))

    def difference(self, first: str, second: str) -> Comparison:
        """Two methods compared in pairs."""
        right = {m.name: m.judged.answer.decided == self.truth for m in self.methods}
        return compare(right[first], right[second], self.weights)


def run_plan(
    plan: Plan,
    store: AnswerStore | None = None,
    on_unit: Callable[[Unit, bool], object] = lambda unit, known: None,
) -> tuple[CellResult, ...]:
    """Have all answers, then score them setting by setting.

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
    results = [_score_cell(plan, cell, kept) for cell in plan.cells]
    reference = results[plan.reference]
    figures = {"sets": _sets(reference), **kept.find(trust_unit(plan))}
    results[plan.reference] = reference._replace(trust=figures)
    return tuple(results)


def _answer(plan: Plan, unit: Unit) -> Answer | Figures:
    if unit.name == TRUST:
        return trust_figures(unit.cell, with_network=plan.with_network)
    return posterior(unit.cell) if unit.name == LIMIT else judge_apart(unit.name, unit.cell)


def _sets(result: CellResult) -> Figures:
    """Conformal sets of the limit and of every method that grades, from the answers that are there."""
    graded = {m.name: m.judged for m in result.ranked() if m.judged.calibration is not None}
    probabilities = {name: one.answer.probabilities for name, one in ({LIMIT: result.limit} | graded).items()}
    return set_figures(probabilities, result.cell.test())


def _score_cell(plan: Plan, cell: Cell, store: AnswerStore) -> CellResult:
    test = cell.test()
    weights = resampling_weights(cell.n_test, cell.seed, groups=test.motor_id)
    limit = _judged(cell.recipe, store.find(unit_of(cell, limit_of(cell))), test, weights)
    limit_right = limit.answer.decided == test.class_index
    is_estimate = cell.recipe.field is not None
    answers: dict[str, Answer] = {name: store.find(unit_of(cell, name)) for name in plan.methods}
    peers = None if plan.peers is None else read_peers(plan.peers, cell)
    results = []
    for name, answer in (answers | (peers.answers if peers else {})).items():
        is_ours = peers is None or name not in peers.answers
        comparison = compare(answer.decided == test.class_index, limit_right, weights)
        above = is_ours and not is_estimate and comparison.p_above < SIGNIFICANCE / plan.n_comparisons
        judged = _judged(cell.recipe, answer, test, weights)
        origin = "" if peers is None or is_ours else peers.origin
        results.append(MethodResult(name, judged, comparison, above, origin))
    return CellResult(cell, test.class_index, test.severity, limit, is_estimate, tuple(results), weights)


def _judged(recipe: Recipe, answer: Answer, test: Dataset, weights: FloatArray) -> Judged:
    return Judged(
        answer,
        scores(recipe, test.class_index, answer.decided, weights),
        calibration_scores(answer.probabilities, test.class_index) if answer.is_graded else None,
        root_mean_square(answer.severity - test.severity, weights),
    )
