"""The frozen tasks of motor-bench: cases, costs, digests, and scores of answer files.

Each task has its own seed, and its test cases are of distinct motors.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from motor_classifiers.estimators.reference_starts import referenced_probabilities, referenced_starts
from motor_classifiers.scoring.metrics import resampling_weights
from motor_classifiers.scoring.score import score
from motor_classifiers.scoring.task import (
    TEST_FIRST_CASE,
    TRAIN_FIRST_CASE,
    Cases,
    ClassTask,
    DrawnTask,
    judged_starts,
    mean_figures,
)
from motor_datasets.arrays import Dataset
from motor_env.common.arrays import instance, is_one_of, real, shown
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_TABLE_BYTES, read_file
from motor_env.inference.posterior import SeverityPrior, severity_posterior
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray, SupplyParameters
from motor_env.simulation.named_recipes import named_recipe, recipe_to_dict
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.recipes import FACTORS, FaultClass, Recipe
from motor_env.simulation.sampling import apply_factors, draw
from motor_env.simulation.simulate import Timing, simulate


@dataclass(frozen=True, slots=True)
class ForeignFault:
    """Departure that no fault kind explains: factors on quantities of the healthy motor.

    Attributes:
        name: for tables.
        supply: on the supply's voltage.
        resistance: on the resistance.
        constants: on both motor constants.
        inertia: on the inertia.
        friction: on the viscous friction.
    """

    name: str
    supply: float = 1.0
    resistance: float = 1.0
    constants: float = 1.0
    inertia: float = 1.0
    friction: float = 1.0


UNKNOWN_FAULTS = (
    ForeignFault("inertia +25 %", inertia=1.25),
    ForeignFault("motor constants -10 %", constants=0.9),
    ForeignFault("supply -10 %", supply=0.9),
)
"""Faults without training cases: a heavier rotor, weaker magnets, a weak supply."""


def foreign_starts(
    recipe: Recipe, fault: ForeignFault, seed: int, cases: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Simulate starts with a foreign fault, shape (n_cases, n_channels, n_samples).

    Args:
        recipe: tolerances, supply, sensor and timing.
        fault: the departure.
        seed: the random seed.
        cases: case numbers, shape (n_cases,).

    Raises:
        ValueError: the recipe departs from the textbook motor.
    """
    if recipe.field is not None:
        raise ValueError(f"foreign faults are those of textbook motors, recipe {recipe.name} has a field")
    scenario = draw(replace(recipe, classes=(FaultClass(),), healthy_starts=0), seed, cases).scenario
    changed = replace(
        scenario,
        parameters=apply_factors(scenario.parameters, np.array([getattr(fault, name) for name in FACTORS])),
        supply=SupplyParameters(scenario.supply.voltage_v * fault.supply),
    )
    return simulate(changed, seed, cases).measurements.astype(np.float32)


VERSION = "2.0"
"""Version of the frozen tasks; another recipe, seed or count needs another version."""

SEED = 20_261
"""Base of every task's seed, a digest of this number, its name and the version."""

SMALL = 24
"""Cases of the small counts for quick checks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceTask(ClassTask):
    """Task: name the class, given healthy starts of the same motor as further channels."""

    n_references: int = 1

    def train(self) -> Dataset:
        """Return starts with their references."""
        return referenced_starts(self.recipe, self.seed, np.arange(self.n_train), self.n_references)

    def starts(self) -> Dataset:
        """Return starts of other motors, with their references."""
        motors = np.arange(self.n_test) + TEST_FIRST_CASE // 10
        return referenced_starts(self.recipe, self.seed, motors, self.n_references)

    def best(self, X: NDArray[np.float32]) -> FloatArray:
        """Return the exact posterior given the references."""
        return referenced_probabilities(self.recipe, X)


@dataclass(frozen=True, slots=True, kw_only=True)
class SeverityTask(DrawnTask):
    """Task: estimate the severity of a fault of known kind; the answer is a number, 0.01 for a point."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Return one estimate."""
        return ("severity",)

    def test(self) -> Cases:
        """Return starts of other motors, with uniform severities."""
        starts = judged_starts(self.recipe, self.seed, TEST_FIRST_CASE, self.n_test)
        return Cases(starts.X, starts.severity)

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Return squared errors in points."""
        squares: FloatArray = np.square(100.0 * (answers[:, 0] - truth))
        return squares

    def figures(self, costs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the root mean squared error, in points."""
        roots: FloatArray = np.sqrt(0.01 * mean_figures(costs, weights))
        return roots

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """Return the posterior mean."""
        (fault,) = self.recipe.classes
        assert fault.kind is not None  # noqa: S101  # a task of one kind
        prior = SeverityPrior(fault.kind, fault.severity, fault.largest_severity)
        return severity_posterior(self.recipe, prior, X).mean[:, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class NoveltyTask(DrawnTask):
    """Task: score the novelty of a start, with known classes against unknown faults.

    The metric is 1 minus the area under the ROC curve, averaged over the unknown faults. The cost of a case is its
    part of that area's linearisation (DeLong et al. 1988).
    """

    @property
    def columns(self) -> tuple[str, ...]:
        """Return one novelty score, larger for novel starts."""
        return ("strangeness",)

    def test(self) -> Cases:
        """Return equally many starts of the known classes and of each unknown fault, shuffled."""
        per_kind = self.n_test // (1 + len(UNKNOWN_FAULTS))
        numbers = np.arange((1 + len(UNKNOWN_FAULTS)) * per_kind).reshape(-1, per_kind) + TEST_FIRST_CASE
        known = judged_starts(self.recipe, self.seed, TEST_FIRST_CASE, per_kind).X
        foreign = [
            foreign_starts(self.recipe, fault, self.seed, own)
            for fault, own in zip(UNKNOWN_FAULTS, numbers[1:], strict=True)
        ]
        order = np.random.default_rng(self.seed).permutation(per_kind * (1 + len(foreign)))
        kinds = np.repeat(np.arange(1 + len(foreign)), per_kind)
        return Cases(np.concatenate([known, *foreign])[order], kinds[order])

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Return each case's part of 1 minus the area."""
        score, n_faults = answers[:, 0], len(UNKNOWN_FAULTS)
        is_known = truth == 0
        known = score[is_known]
        lost_known, deviation, missing = np.zeros(len(known)), np.zeros(len(truth)), 0.0
        for fault in range(1, n_faults + 1):
            foreign = score[truth == fault]
            lost = 1.0 - _share_below(np.sort(known), foreign)
            missing += float(lost.mean()) / n_faults
            lost_known += _share_below(np.sort(foreign), known) / n_faults
            deviation[truth == fault] = (lost - lost.mean()) / n_faults
        deviation[is_known] = lost_known - missing
        return missing + (1 + n_faults) * deviation


def _share_below(others: FloatArray, score: FloatArray) -> FloatArray:
    """Return the share of sorted others below each score, ties half."""
    below = np.searchsorted(others, score, "left") + np.searchsorted(others, score, "right")
    share: FloatArray = below / (2.0 * len(others))
    return share


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamTask(DrawnTask):
    """Task: sound an alarm soon after a fault's onset; the answer is a time, nan for none.

    Half of the motors stay healthy. A false alarm or a miss costs 1, a delay its share of `longest_delay_s`.
    """

    longest_delay_s: float = 0.2
    onsets_s: tuple[float, float, int] = (0.15, 0.45, 31)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the time of the alarm after the step of the supply."""
        return ("alarm_s",)

    def test(self) -> Cases:
        """Return long starts; a fault has one of the onsets."""
        return self._drawn(self.seed, TEST_FIRST_CASE, self.n_test)

    def train_streams(self) -> Cases:
        """Return long starts of other motors, to choose thresholds."""
        return self._drawn(self.seed, TRAIN_FIRST_CASE, self.n_train)

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the training streams, and their faults' onsets."""
        X, onset_s = self.train_streams()
        return {"X": X, "onset_s": onset_s}

    def _drawn(self, seed: int, first: int, count: int) -> Cases:
        numbers = np.arange(count) + first
        grid = np.linspace(*self.onsets_s)
        chosen = (uniforms(seed, Stream.ONSET, numbers, 1)[:, 0] * len(grid)).astype(np.int64)
        X = np.zeros((count, len(self.recipe.sensor.channels), self.recipe.timing.n_samples), np.float32)
        healthy = np.zeros(count, dtype=bool)
        for n, onset in enumerate(grid):
            rows = np.flatnonzero(chosen == n)
            if len(rows):
                drawn = draw(self.recipe, seed, numbers[rows])
                late = tuple(replace(fault, onset_s=float(onset)) for fault in drawn.scenario.faults)
                X[rows] = simulate(replace(drawn.scenario, faults=late), seed, numbers[rows]).measurements
                healthy[rows] = drawn.class_index == 0
        return Cases(X, np.where(healthy, np.nan, grid[chosen]))

    def check(self, answers: FloatArray) -> None:
        """Check that a time is nan or not negative."""
        wrong = np.flatnonzero(answers[:, 0] < 0.0)
        if len(wrong):
            raise InputError(f"case {wrong[0]}: alarm_s must be >= 0 or nan, got {answers[wrong[0], 0]:g}")

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Return 1 for a false alarm or a miss, else the delay."""
        alarm = np.where(np.isnan(answers[:, 0]), np.inf, answers[:, 0])
        onset = np.where(np.isnan(truth), np.inf, truth)
        late = np.where(np.isfinite(alarm) & np.isfinite(onset), alarm, 0.0) - np.where(
            np.isfinite(onset), onset, 0.0
        )
        delay = np.clip(late / self.longest_delay_s, 0.0, 1.0)
        wrong = (alarm < onset) | (np.isinf(alarm) & np.isfinite(onset))
        return np.where(wrong, 1.0, np.where(np.isinf(onset), 0.0, delay))


def task_seed(name: str) -> int:
    """Return the seed of a task: 64 bits of a digest of `SEED`, name and version."""
    return int.from_bytes(hashlib.sha256(f"motor-bench {VERSION} {name} {SEED}".encode()).digest()[:8])


def _tasks() -> dict[str, DrawnTask]:
    bench = named_recipe("bench")
    severities = replace(bench, classes=(FaultClass(FaultKind.BEARING, 0.0, severity_to=0.30),))
    # A winding that ages under a motor without load hardly changes its current: bearings alone.
    bearings = [FaultClass(FaultKind.BEARING, severity) for severity in (0.25, 0.5, 1.0)]
    half = (FaultClass(weight=float(len(bearings))), *bearings)
    stream = replace(bench, classes=half, timing=Timing(1_000.0, 0.7))
    slow = replace(bench, timing=Timing(1_000.0, 0.1))
    full, field, operation = map(named_recipe, ("bench-full", "field", "operation"))
    friction = "Which class in the field: friction, ramps, sensor errors"
    at_work = "Which class at work: another voltage, which is a channel, and load in each case"
    late = "When did a bearing fault set in: delay against false alarms"
    area = "100 (1 - area under the ROC curve)"
    every: tuple[DrawnTask, ...] = (
        ClassTask("bench", "Which of five classes: tolerances, current alone, 10 kHz", recipe=bench),
        ClassTask("bench-full", "Which of nine classes: all kinds of faults", recipe=full),
        ClassTask("field", friction, bracket=(16.29, 16.97), recipe=field, judged_per_motor=1),
        ClassTask("operation", at_work, bracket=(18.68, 20.16), recipe=operation),
        ReferenceTask(
            "reference", "Which class, with one healthy start of the same motor", 2000, recipe=bench
        ),
        SeverityTask(
            "severity", "How large a bearing fault, 0 to 30 %", 2000, "RMSE, points", recipe=severities
        ),
        NoveltyTask("unknown", "How strange: faults never trained on, 1 kHz", 4000, area, recipe=slow),
        StreamTask("stream", late, 2000, "100 x mean cost", recipe=stream),
    )
    return {task.name: replace(task, seed=task_seed(task.name)) for task in every}


TASKS = _tasks()
"""Every task by name."""


def load_task(name: str) -> DrawnTask:
    """Return a frozen task of motor-bench: recipe, training starts, test cases.

    Raises:
        InputError: no such task.
    """
    if not is_one_of(name, TASKS):
        raise InputError(f"task must be one of {', '.join(TASKS)}, got {shown(name)}")
    return TASKS[name]


def task_facts(task: DrawnTask) -> dict[str, Any]:
    """Describe a task for JSON."""
    return {
        "task": task.name,
        "version": VERSION,
        "title": task.title,
        "metric": task.metric,
        "columns": ["case", *task.columns],
        "n_train": task.n_train,
        "n_test": task.n_test,
        "recipe": recipe_to_dict(task.recipe),
    }


def task_digests(task: DrawnTask) -> dict[str, str]:
    """Return the SHA-256 of the measurements and the truth of both splits."""
    numbers, test = (
        [values for values in task.training_arrays().values() if values.dtype.kind != "U"],
        task.test(),
    )
    return {"train": _digest(numbers), "test": _digest((test.X, test.truth))}


def _digest(arrays: Iterable[NDArray[Any]]) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(values).tobytes() for values in arrays)).hexdigest()


def current_digests(*, whole: bool) -> dict[str, dict[str, str]]:
    """Return digests of all tasks as drawn now, whole or of `SMALL` cases."""
    tasks = TASKS if whole else {n: replace(t, n_train=SMALL, n_test=SMALL) for n, t in TASKS.items()}
    return {name: task_digests(task) for name, task in tasks.items()}


def frozen_digests() -> dict[str, Any]:
    """Read the required digests, written by `python benchmarks/leaderboard.py freeze`."""
    text = (files("motor_classifiers.scoring") / "motor_bench.json").read_text(encoding="utf-8")
    digests: dict[str, Any] = json.loads(text)
    return digests


def read_answers(path: Path, task: DrawnTask) -> FloatArray:
    """Read answers from a CSV file, shape (n_test, n_columns), in the order of the cases.

    Args:
        path: file with the column `case` and those of the task; an empty field is nan.
        task: the task.

    Raises:
        InputError: a missing file, one above 20 MB, no such table, missing or repeated rows, or a bad value.
    """
    content = read_file(path, LARGEST_TABLE_BYTES)
    try:
        return _checked(_table(content, ["case", *task.columns]), task)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _table(content: bytes, wanted: list[str]) -> pd.DataFrame:
    try:
        table = pd.read_csv(io.BytesIO(content), skipinitialspace=True)
    except (ValueError, OverflowError) as error:  # pandas' own errors, and text that is no UTF-8
        raise InputError(f"is no table of CSV ({' '.join(str(error).split())[:100]})") from None
    names = [str(name) for name in table.columns]
    if sorted(names) != sorted(wanted):
        raise InputError(f"must have the columns {', '.join(wanted)}, got {', '.join(names)[:200]!r}")
    for name in wanted:
        kind = table[name].dtype.kind
        empty = bool(table[name].isna().all())
        if kind not in ("iu" if name == "case" else "iuf") and not (empty and name != "case"):
            raise InputError(f"column {name} must hold {'whole ' * (name == 'case')}numbers")
    return table


def _checked(table: pd.DataFrame, task: DrawnTask) -> FloatArray:
    case: NDArray[np.int64] = table["case"].to_numpy()
    known, count = np.unique(case, return_counts=True)
    if (count > 1).any():
        raise InputError(f"case {known[count > 1][0]} stands in it twice")
    wanted = np.arange(task.n_test)
    for words, cases in (
        ("are missing", np.setdiff1d(wanted, known)),
        ("too many", np.setdiff1d(known, wanted)),
    ):
        if len(cases):
            counted = f"{len(cases)} {words}, the first is {cases[0]}"
            raise InputError(f"must have the cases 0 to {task.n_test - 1} and no others: {counted}")
    answers = table[list(task.columns)].to_numpy(dtype=np.float64)[np.argsort(case)]
    task.check(answers)
    return answers


def score_answers(task: DrawnTask, answers: FloatArray) -> dict[str, Any]:
    """Score answers to a task's test cases.

    Args:
        task: the task.
        answers: shape (n_test, n_columns), ordered as `task.columns`.

    Returns:
        For JSON: `task`, `version`, `metric`, `n_test`, the metric's `value` with `low` and `high` (95 %). If the best
        possible is known by case, `limit` and `above_limit` (the paired difference) with `above_limit_low` and
        `above_limit_high`; if on average, `bracket`.

    Raises:
        InputError: a bad answer.
    """
    instance("task", task, DrawnTask)
    answers = real("answers", answers, (task.n_test, len(task.columns)))
    task.check(answers)
    cases = task.test()
    best = task.limit(cases.X)
    every = {"mine": answers} | ({} if best is None else {"limit": best})
    weights = resampling_weights(task.n_test, 0)
    results = score(task, cases.truth, every, weights, None if best is None else "limit")
    own = results["mine"]
    facts = {"task": task.name, "version": VERSION, "metric": task.metric, "n_test": task.n_test}
    row: dict[str, Any] = {**facts, **own.value._asdict()}
    if task.bracket is not None:
        row["bracket"] = list(task.bracket)
    if own.against_limit is not None:
        row["limit"] = results["limit"].value.value
        names = ("above_limit", "above_limit_low", "above_limit_high")
        row |= dict(zip(names, own.against_limit.difference, strict=True))
    return row
