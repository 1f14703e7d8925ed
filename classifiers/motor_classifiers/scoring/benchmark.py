"""The benchmark: its plan, stored answers of methods and peers, and the run."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_classifiers.estimators.methods import ESTIMATE, METHODS, find_method
from motor_classifiers.model_files.containers import read_arrays
from motor_classifiers.scoring.judging import (
    LIMIT,
    Answer,
    Cost,
    answer_key,
    judge_in_subprocess,
    load_answer,
    posterior,
    save_answer,
)
from motor_classifiers.scoring.score import Results, score_classes
from motor_classifiers.scoring.task import ClassTask, class_task
from motor_datasets.arrays import Dataset
from motor_env.common.errors import InputError
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.named_recipes import changed_recipe
from motor_env.simulation.recipes import Recipe

PEERS = {
    "quant": "QUANT of aeon: quantiles of intervals, extra trees (Dempster et al. 2024)",
    "minirocket": "MiniRocket of aeon: shares of positive convolutions, ridge (Dempster et al. 2021)",
    "multirocket-hydra": "MultiRocket-Hydra of aeon: convolutions, ridge (Dempster et al. 2023)",
}
"""Peers by name, with what they are."""

_SAME_MEAN_A = 1e-6  # between machines the last bits of a simulated start may differ, and no more


def _means(X: NDArray[np.float32]) -> NDArray[np.float32]:
    means: NDArray[np.float32] = X.mean(axis=(1, 2), dtype=np.float64).astype(np.float32)
    return means


def identity(train: Dataset, test: Dataset) -> dict[str, NDArray[Any]]:
    """Return a fingerprint of test starts: level and class of each."""
    return {
        "train_mean": _means(train.X),
        "train_class_index": train.class_index.astype(np.int8),
        "test_mean": _means(test.X),
        "test_class_index": test.class_index.astype(np.int8),
    }


def read_peers(path: Path, task: ClassTask) -> dict[str, Answer]:
    """Return peers' answers to the starts of a setting, by name; none for other starts.

    Slow peers may have judged only the first starts.

    Raises:
        InputError: no such file, or not of benchmarks/aeon_peers.py.
    """
    arrays = read_arrays(path)
    try:
        facts = json.loads(str(arrays["facts"]))
        if not _same_starts(arrays, task):
            return {}
        origin = f"{facts['date']}, {facts['machine']}, aeon {facts['aeon']}, {facts['command']}"
        return {
            name: _peer_answer(arrays[name].astype(np.float64), measured, task)._replace(origin=origin)
            for name, measured in facts["methods"].items()
            if len(arrays[name]) >= task.n_test
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: holds no answers of peers ({' '.join(str(error).split())[:100]})"
        ) from None


def _same_starts(arrays: dict[str, NDArray[Any]], task: ClassTask) -> bool:
    """Whether a file's answers are for this setting; it may hold more test starts."""
    if len(arrays["test_mean"]) < task.n_test or len(arrays["train_mean"]) != task.n_train:
        return False
    ours = identity(task.train(), task.starts())
    return all(
        np.allclose(arrays[name][: len(values)], values, rtol=0.0, atol=_SAME_MEAN_A)
        for name, values in ours.items()
    )


def _peer_answer(probabilities: FloatArray, measured: dict[str, Any], task: ClassTask) -> Answer:
    if probabilities.ndim != 2 or probabilities.shape[1] != len(task.recipe.classes):
        raise ValueError(f"probabilities of shape {probabilities.shape}")
    shown = probabilities[: task.n_test]
    shown = shown / shown.sum(axis=1, keepdims=True)
    seconds = 1e-6 * float(measured["microseconds_per_transient"]) * len(shown)
    return Answer(
        shown,
        Cost(float(measured["train_s"]), measured["train_memory_mb"]),
        Cost(seconds, measured["inference_memory_mb"]),
    )


REFERENCE: dict[str, Any] = {
    "recipe": "bench",
    "sampling_rate_hz": 10_000.0,
    "noise_a": 0.02,
    "n_train": 2000,
}
"""Setting that the page shows in full."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Plan of a benchmark: each method on each task.

    Attributes:
        tasks: one a setting.
        methods: names for `find_method`.
        peers: file with answers of peers to the starts of a setting.
    """

    tasks: tuple[ClassTask, ...]
    methods: tuple[str, ...] = tuple(METHODS)
    peers: Path | None = None

    def __post_init__(self) -> None:
        for name in self.methods:
            find_method(name)
        require(len(set(self.methods)) == len(self.methods), "methods must differ")

    @property
    def n_comparisons(self) -> int:
        """Comparisons with the limit."""
        return len(self.tasks) * len(self.methods)

    @property
    def reference(self) -> int:
        """Index of the setting nearest to `REFERENCE`."""
        settings = [task.setting() for task in self.tasks]
        return int(
            np.argmax([sum(setting[name] == REFERENCE[name] for name in REFERENCE) for setting in settings])
        )


def make_tasks(
    recipes: Sequence[Recipe],
    *,
    rates_hz: Sequence[float],
    noises_a: Sequence[float],
    train_sizes: Sequence[int],
    n_test: int,
    seed: int,
) -> tuple[ClassTask, ...]:
    """Make the tasks of a sweep: recipes by rates by noises, and training sizes at the usual noise.

    Args:
        recipes: distributions of motors.
        rates_hz: of each recipe; its own if empty.
        noises_a: of each recipe; its own if empty.
        train_sizes: the first is for the sweep over rates and noises.
        n_test: test starts.
        seed: of everything.
    """
    tasks: dict[ClassTask, None] = {}
    for recipe in recipes:
        rates = rates_hz or (recipe.timing.sampling_rate_hz,)
        noises = noises_a or (recipe.sensor.current_noise_a,)
        usual = REFERENCE["noise_a"] if REFERENCE["noise_a"] in noises else noises[0]
        for rate, noise, n_train in product(rates, noises, train_sizes):
            if n_train == train_sizes[0] or noise == usual:
                own = changed_recipe(recipe, sampling_rate_hz=rate, current_noise_a=noise)
                tasks[class_task(own, n_train, n_test, seed)] = None
    return tuple(tasks)


class Unit(NamedTuple):
    """Unit of work: the answer of a method in a setting.

    Attributes:
        task: setting.
        name: method, or `LIMIT`.
        key: of its answer.
        seconds: expected.
    """

    task: ClassTask
    name: str
    key: str
    seconds: float


def units(plan: Plan) -> tuple[Unit, ...]:
    """List the answers that a plan needs, each once, as the limit does not depend on training starts."""
    needed: dict[str, Unit] = {}
    for task in plan.tasks:
        for name in (limit_of(task), *plan.methods):
            unit = unit_of(task, name)
            needed.setdefault(unit.key, unit)
    return tuple(needed.values())


def limit_of(task: ClassTask) -> str:
    """Return the limit of a setting: the exact posterior, an estimate at work, or the method that estimates it."""
    return LIMIT if task.recipe.field is None or task.recipe.duty is not None else ESTIMATE


def unit_of(task: ClassTask, name: str) -> Unit:
    """Return the unit of a method, or of the limit, in a setting."""
    return Unit(task, name, answer_key(name, task), _expected_seconds(name, task))


def _expected_seconds(name: str, task: ClassTask) -> float:
    samples = task.recipe.timing.n_samples / 1000.0
    if name == LIMIT:
        return 0.5 + 1e-3 * task.n_test * samples * len(task.recipe.classes) / 5.0
    method = find_method(name)
    if method.from_stream and task.recipe.field is not None:
        return 20.0 * method.seconds  # whatever the rate: the motor's equations take small steps
    size = 0.5 if method.from_stream else 0.5 * (task.n_train + task.n_test) / 2000.0
    return 1.0 + method.seconds * size * (0.2 + 0.8 * samples)


class AnswerStore:
    """Answers by key: in memory, and in a folder for later runs.

    Args:
        folder: of the files; None for none.
        fresh: whether to overwrite earlier files instead of reading them.
    """

    def __init__(self, folder: Path | None = None, *, fresh: bool = False) -> None:
        self._folder = folder
        self._fresh = fresh
        self._answers: dict[str, Answer | None] = {}

    def find(self, unit: Unit) -> Answer | None:
        """Return the answer; None without one."""
        if unit.key not in self._answers and self._folder is not None and not self._fresh:
            self._answers[unit.key] = load_answer(self._folder / f"{unit.key}.npz", unit.task)
        return self._answers.get(unit.key)

    def answer(self, unit: Unit) -> Answer:
        """Return the answer.

        Raises:
            KeyError: no such answer.
        """
        answer = self.find(unit)
        if answer is None:
            raise KeyError(unit.key)
        return answer

    def put(self, unit: Unit, answer: Answer) -> None:
        """Keep an answer."""
        self._answers[unit.key] = answer
        if self._folder is not None:
            save_answer(answer, self._folder / f"{unit.key}.npz")


def run_plan(
    plan: Plan,
    store: AnswerStore | None = None,
    on_unit: Callable[[Unit, bool], object] = lambda unit, known: None,
) -> tuple[Results, ...]:
    """Compute all answers, then score them task by task.

    Args:
        plan: what to run.
        store: of answers; in memory by default.
        on_unit: called before each unit, with whether its answer exists.

    Raises:
        InputError: the peers' answers are for other starts; or some answer failed, after all others are in the store.
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
    if plan.peers is None:
        return [{} for _ in plan.tasks]
    answers = [read_peers(plan.peers, task) for task in plan.tasks]
    if not any(answers):
        raise InputError(
            f"{plan.peers}: holds answers to other starts than those of this benchmark; leave --peers out"
        )
    return answers


def _answer(unit: Unit) -> Answer:
    return posterior(unit.task) if unit.name == LIMIT else judge_in_subprocess(unit.name, unit.task)


def _scored(plan: Plan, task: ClassTask, store: AnswerStore, peers: dict[str, Answer]) -> Results:
    answers = {name: store.answer(unit_of(task, name)) for name in plan.methods}
    limit = store.answer(unit_of(task, limit_of(task)))
    return score_classes(task, answers | peers, limit, plan.n_comparisons)
