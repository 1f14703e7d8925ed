"""The benchmark: every method trained and judged on the same motors, beside the Bayes-optimal posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from motor_classifiers.calibration import CalibrationScores, calibration_scores
from motor_classifiers.judging import (
    LIMIT,
    Answer,
    Cell,
    answer_key,
    judge_apart,
    load_answer,
    posterior,
    save_answer,
)
from motor_classifiers.methods import ESTIMATE, METHODS
from motor_classifiers.metrics import (
    Comparison,
    IntArray,
    Score,
    Scores,
    compare,
    resampling_weights,
    root_mean_square,
    scores,
)
from motor_classifiers.peers import Peers, read_peers
from motor_datasets.arrays import Dataset
from motor_env.parameters import FloatArray, require
from motor_env.recipes import Recipe

SIGNIFICANCE = 0.01
"""Of the check that no method beats the limit: shared among all comparisons of a run (Bonferroni), one-sided."""

REFERENCE = {"recipe": "bench", "sampling_rate_hz": 10_000.0, "current_noise_a": 0.02, "n_train": 2000}
"""The setting that is told in full where there are several."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What is run: each method in each setting.

    Attributes:
        cells: settings.
        methods: names of `METHODS`.
        peers: file with answers of peers; they join where its starts are those of a setting.
    """

    cells: tuple[Cell, ...]
    methods: tuple[str, ...] = tuple(METHODS)
    peers: Path | None = None

    def __post_init__(self) -> None:
        for name in self.methods:
            require(name in METHODS, f"method must be one of {', '.join(METHODS)}, got {name!r}")
        require(len(set(self.methods)) == len(self.methods), "methods must differ")

    @property
    def n_comparisons(self) -> int:
        """Comparisons with the limit."""
        return len(self.cells) * len(self.methods)

    @property
    def reference(self) -> int:
        """Index of the setting that is told in full: the one nearest to `REFERENCE`."""
        likeness = [
            sum(_setting(cell)[name] == value for name, value in REFERENCE.items()) for cell in self.cells
        ]
        return int(np.argmax(likeness))


def _setting(cell: Cell) -> dict[str, Any]:
    recipe = cell.recipe
    return {
        "recipe": recipe.name,
        "sampling_rate_hz": recipe.timing.sampling_rate_hz,
        "current_noise_a": recipe.sensor.current_noise_a,
        "n_train": cell.n_train,
    }


def make_cells(
    recipes: tuple[Recipe, ...],
    rates_hz: tuple[float, ...],
    noises_a: tuple[float, ...],
    train_sizes: tuple[int, ...],
    n_test: int,
    seed: int,
) -> tuple[Cell, ...]:
    """Settings of a sweep: recipes, rates and noises crossed, and training sizes at the usual noise.

    Args:
        recipes: what motors are drawn from.
        rates_hz: of each recipe; its own where empty.
        noises_a: of each recipe; its own where empty.
        train_sizes: the first is that of the sweep over rates and noises.
        n_test: starts to be judged on.
        seed: of everything.
    """
    cells: dict[Cell, None] = {}
    for recipe in recipes:
        rates = rates_hz or (recipe.timing.sampling_rate_hz,)
        noises = noises_a or (recipe.sensor.current_noise_a,)
        usual = REFERENCE["current_noise_a"] if REFERENCE["current_noise_a"] in noises else noises[0]
        for rate, noise, n_train in product(rates, noises, train_sizes):
            if n_train == train_sizes[0] or noise == usual:
                own = replace(
                    recipe,
                    timing=replace(recipe.timing, sampling_rate_hz=rate),
                    sensor=replace(recipe.sensor, current_noise_a=noise),
                )
                cells[Cell(own, n_train, n_test, seed)] = None
    return tuple(cells)


class Unit(NamedTuple):
    """One answer to be had.

    Attributes:
        cell: setting.
        name: method, or `LIMIT`.
        key: of its answer.
        seconds: about how long it takes.
    """

    cell: Cell
    name: str
    key: str
    seconds: float


def units(plan: Plan) -> tuple[Unit, ...]:
    """All answers that a plan needs, each once: the limit does not depend on the training starts."""
    found: dict[str, Unit] = {}
    for cell in plan.cells:
        for name in (_limit_of(cell), *plan.methods):
            unit = _unit(cell, name)
            found.setdefault(unit.key, unit)
    return tuple(found.values())


def _limit_of(cell: Cell) -> str:
    """What stands for the limit: the exact posterior, or the method that estimates it."""
    return LIMIT if cell.recipe.field is None else ESTIMATE


def _unit(cell: Cell, name: str) -> Unit:
    return Unit(cell, name, answer_key(name, cell), _expected_seconds(name, cell))


def _expected_seconds(name: str, cell: Cell) -> float:
    samples = cell.recipe.timing.n_samples / 1000.0
    if name == LIMIT:
        return 0.5 + 1e-3 * cell.n_test * samples * len(cell.recipe.classes) / 5.0
    method = METHODS[name]
    if method.from_stream and cell.recipe.field is not None:
        return 20.0 * method.seconds  # whatever the rate: the motor's equations take small steps
    size = 0.5 if method.from_stream else 0.5 * (cell.n_train + cell.n_test) / 2000.0
    return 1.0 + method.seconds * size * (0.2 + 0.8 * samples)


class AnswerStore:
    """Answers by key: in memory, and, given a folder, as files that a later run finds again.

    Args:
        folder: where files are kept; None for none.
        fresh: whether files of earlier runs are overwritten instead of read.
    """

    def __init__(self, folder: Path | None = None, *, fresh: bool = False) -> None:
        self._folder = folder
        self._fresh = fresh
        self._held: dict[str, Answer] = {}

    def find(self, unit: Unit) -> Answer | None:
        """The answer, or None."""
        if unit.key not in self._held and self._folder is not None and not self._fresh:
            found = load_answer(self._folder / f"{unit.key}.npz", unit.cell)
            if found is not None:
                self._held[unit.key] = found
        return self._held.get(unit.key)

    def get(self, unit: Unit) -> Answer:
        """The answer.

        Raises:
            KeyError: there is none.
        """
        found = self.find(unit)
        if found is None:
            raise KeyError(f"the answer of {unit.name} is missing")
        return found

    def put(self, unit: Unit, answer: Answer) -> None:
        """Keep an answer."""
        self._held[unit.key] = answer
        if self._folder is not None:
            save_answer(answer, self._folder / f"{unit.key}.npz")


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
        name: of `METHODS` or `PEERS`.
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
    """

    cell: Cell
    truth: IntArray
    severity: FloatArray
    limit: Judged
    limit_is_estimate: bool
    methods: tuple[MethodResult, ...]
    weights: FloatArray

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
    """
    kept = AnswerStore() if store is None else store
    for unit in units(plan):
        known = kept.find(unit) is not None
        on_unit(unit, known)
        if not known:
            kept.put(unit, posterior(unit.cell) if unit.name == LIMIT else judge_apart(unit.name, unit.cell))
    return tuple(_score_cell(plan, cell, kept) for cell in plan.cells)


def _score_cell(plan: Plan, cell: Cell, store: AnswerStore) -> CellResult:
    test = cell.test()
    weights = resampling_weights(cell.n_test, cell.seed, groups=test.motor_id)
    best, *found = (store.get(_unit(cell, name)) for name in (_limit_of(cell), *plan.methods))
    answers = dict(zip(plan.methods, found, strict=True))
    limit = _judged(cell.recipe, best, test, weights, graded=True)
    right = best.decided == test.class_index
    is_estimate = cell.recipe.field is not None
    results = []
    for name in plan.methods:
        comparison = compare(answers[name].decided == test.class_index, right, weights)
        above = not is_estimate and comparison.p_above < SIGNIFICANCE / plan.n_comparisons
        judged = _judged(cell.recipe, answers[name], test, weights, graded=True)
        results.append(MethodResult(name, judged, comparison, above))
    peers = None if plan.peers is None else read_peers(plan.peers, cell)
    if peers is not None:
        results += _peer_results(peers, cell.recipe, test, weights, right)
    return CellResult(cell, test.class_index, test.severity, limit, is_estimate, tuple(results), weights)


def _peer_results(
    peers: Peers, recipe: Recipe, test: Dataset, weights: FloatArray, limit_right: Any
) -> Iterator[MethodResult]:
    for name, answer in peers.answers.items():
        comparison = compare(answer.decided == test.class_index, limit_right, weights)
        judged = _judged(recipe, answer, test, weights, graded=name in peers.graded)
        yield MethodResult(name, judged, comparison, False, peers.origin)


def _judged(recipe: Recipe, answer: Answer, test: Dataset, weights: FloatArray, *, graded: bool) -> Judged:
    return Judged(
        answer,
        scores(recipe, test.class_index, answer.decided, weights),
        calibration_scores(answer.probabilities, test.class_index) if graded else None,
        root_mean_square(answer.severity - test.severity, weights),
    )
