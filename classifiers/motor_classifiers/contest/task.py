"""What a task of motor-bench is: what is learned from, what is judged, and what a wrong answer costs.

A task never changes: another recipe, seed or count is another version. Every score is a mean of costs of cases, so any
two submissions are compared in pairs. Test cases are numbered from 0; their numbers tell nothing of the truth.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_classifiers.scoring.judging import TRAIN_FIRST_CASE, judged_starts
from motor_datasets.arrays import Dataset
from motor_env.errors import InputError
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipe_files import recipe_to_dict
from motor_env.simulation.recipes import Recipe

VERSION = "1.0"
SEED = 20_261
"""Of the public splits; a sealed split has a secret one."""


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
        bracket: between which the best possible lies on average, where it is not known case by case (docs/limits.md).
    """

    name: str
    title: str
    recipe: Recipe = field(repr=False)
    n_train: int = 2000
    n_test: int = 5000
    metric: str = "error rate, %"
    bracket: tuple[float, float] | None = None

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
