"""The frozen tasks of motor-bench: what is learned from, what is judged, and what a wrong answer costs.

A task never changes: another recipe, seed or count is another version. Every score is a mean of costs of cases, so any
two submissions are compared in pairs. Test cases are numbered from 0; their numbers tell nothing of the truth.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_classifiers.estimators.reference_starts import referenced_probabilities, referenced_starts
from motor_classifiers.scoring.judging import TEST_FIRST_CASE, TRAIN_FIRST_CASE, judged_starts
from motor_classifiers.scoring.unknown_faults import UNKNOWN_FAULTS, foreign_starts
from motor_datasets.arrays import Dataset
from motor_env.errors import InputError
from motor_env.inference.posterior import class_probabilities
from motor_env.inference.severity import SeverityPrior, severity_posterior
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.drawing import draw
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.random_streams import Stream, uniforms
from motor_env.simulation.recipe_files import recipe_to_dict
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.simulate import Timing, simulate

VERSION = "1.0"
SEED = 20_261
"""Of the public splits; a sealed split has a secret one."""

_TOLERANCE = 1e-3  # of a sum of probabilities


class Cases(NamedTuple):
    """Cases of a split.

    Attributes:
        X: measurements, float32, shape (n_cases, n_channels, n_samples).
        truth: what the task's costs compare answers with, shape (n_cases,): class index, severity, unknown fault
            (0: none) or time of the onset in seconds (nan: no fault).
        motor: of each case, shape (n_cases,), where several are of one motor: intervals then draw motors.
    """

    X: NDArray[np.float32]
    truth: NDArray[Any]
    motor: NDArray[np.int64] | None = None


@dataclass(frozen=True, slots=True)
class Task(ABC):
    """One task.

    Attributes:
        name: on the command line.
        title: what is asked, for a person.
        recipe: what motors are drawn from.
        n_train: starts to learn from.
        n_test: cases to be judged, of other motors.
        metric: what the mean cost is called; smaller is better.
    """

    name: str
    title: str
    recipe: Recipe
    n_train: int = 2000
    n_test: int = 5000
    metric: str = "error rate, %"

    @property
    @abstractmethod
    def columns(self) -> tuple[str, ...]:
        """Columns of a submission beside `case`."""

    @abstractmethod
    def test(self, seed: int = SEED) -> Cases:
        """What is judged, with the truth."""

    @abstractmethod
    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Cost of each case, shape (n_test,), for answers of shape (n_test, n_columns)."""

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """Answers of the exact posterior, shape (n_test, n_columns); None where the best possible is not known."""
        return None

    def check(self, answers: FloatArray) -> None:
        """Check answers beyond their shape.

        Raises:
            InputError: a value that cannot be one; the sentence names case and column.
        """
        wrong = np.argwhere(~np.isfinite(answers))
        if len(wrong):
            case, column = wrong[0]
            raise InputError(
                f"case {case}: {self.columns[column]} must be a number, got {answers[case, column]}"
            )

    def train(self) -> Dataset:
        """Labelled starts to learn from; no motor of theirs is judged."""
        return judged_starts(self.recipe, SEED, TRAIN_FIRST_CASE, self.n_train)

    def figures(self, costs: FloatArray, weights: FloatArray) -> FloatArray:
        """The metric, once for each row of weights, shape (n_rows,), from costs of shape (n_test,)."""
        means: FloatArray = 100.0 * (weights @ costs) / weights.sum(axis=1)
        return means

    def learned(self) -> dict[str, NDArray[Any]]:
        """What a stranger learns from, as arrays."""
        train = self.train()
        return {name: getattr(train, name) for name in ("X", "severity", "class_index", "class_name")}

    def draw_id(self, seed: int = SEED) -> str:
        """Name of a split: a digest of task, version and seed, from which the seed cannot be told."""
        return hashlib.sha256(f"motor-bench {VERSION} {self.name} {seed}".encode()).hexdigest()[:16]

    def digests(self) -> dict[str, str]:
        """SHA-256 of the measurements and the truth of both public splits."""
        numbers = [values for values in self.learned().values() if values.dtype.kind != "U"]
        return {"train": _digest(numbers), "test": _digest(self.test()[:2])}

    def as_json(self, seed: int = SEED) -> dict[str, Any]:
        """What a stranger needs to know of it."""
        return {
            "task": self.name,
            "version": VERSION,
            "draw": self.draw_id(seed),
            "title": self.title,
            "metric": self.metric,
            "columns": ["case", *self.columns],
            "n_train": self.n_train,
            "n_test": self.n_test,
            "recipe": recipe_to_dict(self.recipe),
        }


def _digest(arrays: Iterable[NDArray[Any]]) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(values).tobytes() for values in arrays)).hexdigest()


@dataclass(frozen=True, slots=True)
class ClassTask(Task):
    """Name the class; the answer is a probability of each, the decision the largest."""

    @property
    def columns(self) -> tuple[str, ...]:
        """One column a class."""
        return self.recipe.class_names

    def test(self, seed: int = SEED) -> Cases:
        """Starts of other motors than those of the training."""
        starts = judged_starts(self.recipe, seed, TEST_FIRST_CASE, self.n_test)
        return Cases(starts.X, starts.class_index, starts.motor_id)

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """1 for a wrong decision."""
        wrong: FloatArray = (answers.argmax(axis=1) != truth).astype(np.float64)
        return wrong

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """The exact posterior where the likelihood has a closed form."""
        return None if self.recipe.field is not None else class_probabilities(self.recipe, X)

    def check(self, answers: FloatArray) -> None:
        """Probabilities lie in 0 .. 1 and sum to 1 within a thousandth."""
        Task.check(self, answers)
        outside = np.argwhere((answers < 0.0) | (answers > 1.0))
        if len(outside):
            case, column = outside[0]
            value = answers[case, column]
            raise InputError(
                f"case {case}: {self.columns[column]} must be a probability from 0 to 1, got {value:g}"
            )
        total = answers.sum(axis=1)
        wrong = np.flatnonzero(np.abs(total - 1.0) > _TOLERANCE)
        if len(wrong):
            raise InputError(f"case {wrong[0]}: its probabilities must sum to 1, got {total[wrong[0]]:g}")


@dataclass(frozen=True, slots=True)
class ReferenceTask(ClassTask):
    """The same with healthy starts of the same motor as further channels."""

    n_references: int = 1

    def train(self) -> Dataset:
        """Starts with their references."""
        return referenced_starts(self.recipe, SEED, np.arange(self.n_train), self.n_references)

    def test(self, seed: int = SEED) -> Cases:
        """Starts of other motors, with their references."""
        motors = np.arange(self.n_test) + TEST_FIRST_CASE // 10
        starts = referenced_starts(self.recipe, seed, motors, self.n_references)
        return Cases(starts.X, starts.class_index)

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """The exact posterior given the references."""
        return referenced_probabilities(self.recipe, X)


@dataclass(frozen=True, slots=True)
class SeverityTask(Task):
    """Tell the severity of a fault whose kind is known; the answer is a number, 0.01 for a point."""

    @property
    def columns(self) -> tuple[str, ...]:
        """One estimate."""
        return ("severity",)

    def test(self, seed: int = SEED) -> Cases:
        """Starts of other motors, severities uniform."""
        starts = judged_starts(self.recipe, seed, TEST_FIRST_CASE, self.n_test)
        return Cases(starts.X, starts.severity)

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Squared error in points."""
        squares: FloatArray = np.square(100.0 * (answers[:, 0] - truth))
        return squares

    def figures(self, costs: FloatArray, weights: FloatArray) -> FloatArray:
        """Root of the mean squared error, in points."""
        roots: FloatArray = np.sqrt(0.01 * Task.figures(self, costs, weights))
        return roots

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """The posterior mean."""
        (fault,) = self.recipe.classes
        assert fault.kind is not None  # noqa: S101  # a task of one kind
        prior = SeverityPrior(fault.kind, fault.severity, fault.largest_severity)
        return severity_posterior(self.recipe, prior, X).mean[:, None]


@dataclass(frozen=True, slots=True)
class StrangerTask(Task):
    """Say how strange a start is: motors of the known classes against faults that nobody was trained on.

    The metric is 1 minus the area under the ROC curve, averaged over the unknown faults. The cost of a case is its part
    of that area's linearisation (DeLong et al. 1988): the mean is the metric, and the scatter that of the area.
    """

    @property
    def columns(self) -> tuple[str, ...]:
        """One score, the larger the stranger."""
        return ("strangeness",)

    def test(self, seed: int = SEED) -> Cases:
        """As many starts of the known classes as of each unknown fault, in an order of the seed's own."""
        per_kind = self.n_test // (1 + len(UNKNOWN_FAULTS))
        numbers = np.arange(per_kind) + TEST_FIRST_CASE
        known = judged_starts(self.recipe, seed, TEST_FIRST_CASE, per_kind).X
        foreign = [foreign_starts(self.recipe, fault, seed, numbers) for fault in UNKNOWN_FAULTS]
        order = np.random.default_rng(seed).permutation(per_kind * (1 + len(foreign)))
        kinds = np.repeat(np.arange(1 + len(foreign)), per_kind)
        return Cases(np.concatenate([known, *foreign])[order], kinds[order])

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Each case's part of 1 minus the area."""
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
    """Share of sorted others below each score, ties half."""
    below = np.searchsorted(others, score, "left") + np.searchsorted(others, score, "right")
    share: FloatArray = below / (2.0 * len(others))
    return share


@dataclass(frozen=True, slots=True)
class StreamTask(Task):
    """Sound an alarm soon after a fault sets in: half of the motors stay healthy; the answer is a time, nan for none.

    A false alarm costs 1, a miss costs 1, and a delay its share of `longest_delay_s`.
    """

    longest_delay_s: float = 0.2
    onsets_s: tuple[float, float, int] = (0.15, 0.45, 31)

    @property
    def columns(self) -> tuple[str, ...]:
        """Time of the alarm after the step of the supply."""
        return ("alarm_s",)

    def test(self, seed: int = SEED) -> Cases:
        """Starts that go on; where the class is a fault, it sets in at one of the onsets."""
        return self._drawn(seed, TEST_FIRST_CASE, self.n_test)

    def train_streams(self) -> Cases:
        """The same of other motors, to choose thresholds on."""
        return self._drawn(SEED, TRAIN_FIRST_CASE, self.n_train)

    def learned(self) -> dict[str, NDArray[Any]]:
        """Streams, and when their faults set in."""
        X, onset_s, _ = self.train_streams()
        return {"X": X, "onset_s": onset_s}

    def _drawn(self, seed: int, first: int, count: int) -> Cases:
        numbers = np.arange(count) + first
        grid = np.linspace(*self.onsets_s)
        chosen = (uniforms(seed, Stream.ONSET, numbers, 1)[:, 0] * len(grid)).astype(np.int64)
        X = np.zeros((count, len(self.recipe.sensor.channels), self.recipe.timing.n_samples), np.float32)
        healthy = np.zeros(count, dtype=bool)
        for n, onset in enumerate(grid):
            mine = np.flatnonzero(chosen == n)
            if len(mine):
                drawn = draw(self.recipe, seed, numbers[mine])
                late = tuple(replace(fault, onset_s=float(onset)) for fault in drawn.scenario.faults)
                X[mine] = simulate(replace(drawn.scenario, faults=late), seed, numbers[mine]).measurements
                healthy[mine] = drawn.class_index == 0
        return Cases(X, np.where(healthy, np.nan, grid[chosen]))

    def check(self, answers: FloatArray) -> None:
        """A time is nan or not negative."""
        wrong = np.flatnonzero(answers[:, 0] < 0.0)
        if len(wrong):
            raise InputError(f"case {wrong[0]}: alarm_s must be >= 0 or nan, got {answers[wrong[0], 0]:g}")

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """1 for a false alarm or a miss, else the delay."""
        alarm = np.where(np.isnan(answers[:, 0]), np.inf, answers[:, 0])
        onset = np.where(np.isnan(truth), np.inf, truth)
        late = np.where(np.isfinite(alarm) & np.isfinite(onset), alarm, 0.0) - np.where(
            np.isfinite(onset), onset, 0.0
        )
        delay = np.clip(late / self.longest_delay_s, 0.0, 1.0)
        wrong = (alarm < onset) | (np.isinf(alarm) & np.isfinite(onset))
        return np.where(wrong, 1.0, np.where(np.isinf(onset), 0.0, delay))


def _tasks() -> dict[str, Task]:
    bench = named_recipe("bench")
    severities = replace(bench, classes=(FaultClass(FaultKind.BEARING, 0.0, severity_to=0.30),))
    # A winding that ages under a motor without load hardly changes its current: bearings alone.
    bearings = [FaultClass(FaultKind.BEARING, severity) for severity in (0.25, 0.5, 1.0)]
    half = (FaultClass(weight=float(len(bearings))), *bearings)
    stream = replace(bench, classes=half, timing=Timing(1_000.0, 0.7))
    slow = replace(bench, timing=Timing(1_000.0, 0.1))
    every = (
        ClassTask("bench", "Which of five classes: tolerances, current alone, 10 kHz", bench),
        ClassTask("bench-full", "Which of nine classes: all kinds of faults", named_recipe("bench-full")),
        ClassTask("field", "Which class in the field: friction, ramps, sensor errors", named_recipe("field")),
        ReferenceTask(
            "reference", "Which class, with one healthy start of the same motor", bench, n_test=2000
        ),
        SeverityTask(
            "severity", "How large a bearing fault, 0 to 30 %", severities, n_test=2000, metric="RMSE, points"
        ),
        StrangerTask(
            "unknown",
            "How strange: faults never trained on, 1 kHz",
            slow,
            n_test=4000,
            metric="100 (1 - area under the ROC curve)",
        ),
        StreamTask(
            "stream",
            "When did a bearing fault set in: delay against false alarms",
            stream,
            n_test=2000,
            metric="100 x mean cost",
        ),
    )
    return {task.name: task for task in every}


TASKS = _tasks()
"""Every task by name."""


def load_task(name: str) -> Task:
    """A task of motor-bench.

    Raises:
        InputError: there is none of this name.
    """
    if name not in TASKS:
        raise InputError(f"task must be one of {', '.join(TASKS)}, got {name!r}")
    return TASKS[name]


SMALL = 24
"""Cases of the small counts that are checked quickly."""


def current_digests(*, whole: bool) -> dict[str, dict[str, str]]:
    """Digests of all tasks as this code draws them, of so many cases as they have, or of `SMALL`."""
    tasks = TASKS if whole else {n: replace(t, n_train=SMALL, n_test=SMALL) for n, t in TASKS.items()}
    return {name: task.digests() for name, task in tasks.items()}


def frozen_digests() -> dict[str, Any]:
    """What they must be: of `small` counts and `whole`, written by `python benchmarks/leaderboard.py freeze`."""
    text = (files("motor_classifiers.contest") / "motor_bench.json").read_text(encoding="utf-8")
    digests: dict[str, Any] = json.loads(text)
    return digests
