"""Tasks for methods: cases, the cost of an answer, the metric, and the best possible answers.

Every metric comes from costs of cases, for paired comparisons.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from motor_datasets.arrays import Dataset
from motor_datasets.generate import generate_arrays
from motor_env.common.errors import InputError
from motor_env.inference.posterior import class_probabilities
from motor_env.inference.work_features import work_probabilities
from motor_env.motor.parameters import FloatArray, require
from motor_env.simulation.recipes import Recipe

TRAIN_FIRST_CASE = 0
TEST_FIRST_CASE = 1_000_000_000
"""First case number of test motors, so that they differ from training motors."""

_TOLERANCE = 1e-3  # of a sum of probabilities


class Cases(NamedTuple):
    """Cases of a split.

    Attributes:
        X: measurements, float32, shape (n_cases, n_channels, n_samples).
        truth: class index, severity, unknown fault (0: none) or onset in seconds (nan: no fault), shape (n_cases,).
    """

    X: NDArray[np.float32]
    truth: NDArray[Any]


@dataclass(frozen=True, slots=True)
class DrawnTask(ABC):
    """A task whose cases a recipe draws.

    Attributes:
        title: the question.
        metric: name of the mean cost; smaller is better.
        bracket: bounds of the best possible mean cost, if unknown by case.
        recipe: distribution of motors.
        n_train: training starts, of other motors than the test.
    """

    name: str
    title: str
    n_test: int = 5000
    metric: str = "error rate, %"
    bracket: tuple[float, float] | None = None
    _: KW_ONLY
    recipe: Recipe = field(repr=False)
    n_train: int = 2000
    seed: int = 0

    @property
    @abstractmethod
    def columns(self) -> tuple[str, ...]:
        """Names of an answer's numbers for each case."""

    @abstractmethod
    def test(self) -> Cases:
        """Return the test cases with their truth."""

    @abstractmethod
    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Return the cost of each case, shape (n_test,), for answers of shape (n_test, n_columns)."""

    def figures(self, costs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the metric for each row of weights, shape (n_rows,), from costs of shape (n_test,)."""
        return mean_figures(costs, weights)

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """Return answers of the exact posterior, shape (n_test, n_columns); None if unknown."""
        return None

    def check(self, answers: FloatArray) -> None:
        """Check answers beyond their shape.

        Raises:
            InputError: a bad value, with case and column.
        """
        wrong = np.argwhere(~np.isfinite(answers))
        if len(wrong):
            case, column = wrong[0]
            raise InputError(
                f"case {case}: {self.columns[column]} must be a number, got {answers[case, column]}"
            )

    def train(self) -> Dataset:
        """Return labelled training starts."""
        return judged_starts(self.recipe, self.seed, TRAIN_FIRST_CASE, self.n_train)

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the training cases as arrays, by name."""
        train = self.train()
        return {name: getattr(train, name) for name in ("X", "severity", "class_index", "class_name")}


def mean_figures(costs: FloatArray, weights: FloatArray) -> FloatArray:
    """Return mean costs in per cent for each row of weights, shape (n_rows,), from costs of shape (n_cases,)."""
    means: FloatArray = 100.0 * (weights @ costs) / weights.sum(axis=1)
    return means


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassTask(DrawnTask):
    """Task: name the class; the answer is a probability of each, the decision the largest.

    Attributes:
        judged_per_motor: judged starts of each motor; None for all but the commissioning starts.
    """

    judged_per_motor: int | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Return one column a class."""
        return self.recipe.class_names

    def starts(self) -> Dataset:
        """Return the test starts with all labels, of other motors than the training."""
        cases = judged_cases(self.recipe, TEST_FIRST_CASE, self.n_test, self.judged_per_motor)
        return generate_arrays(self.recipe, self.seed, cases)

    def test(self) -> Cases:
        """Return the test starts with their class index."""
        starts = self.starts()
        return Cases(starts.X, starts.class_index)

    def costs(self, truth: NDArray[Any], answers: FloatArray) -> FloatArray:
        """Return 1 for a wrong decision."""
        wrong: FloatArray = (answers.argmax(axis=1) != truth).astype(np.float64)
        return wrong

    def best(self, X: NDArray[np.float32]) -> FloatArray:
        """Return Bayes-optimal probabilities; without a closed form, those of the motor without its field.

        For motors at work the motor is linear around its fit.
        """
        if self.recipe.duty is None:
            return class_probabilities(self.recipe, X)
        return work_probabilities(self.recipe, X.astype(np.float64))

    def limit(self, X: NDArray[np.float32]) -> FloatArray | None:
        """Return the exact posterior where the likelihood has a closed form."""
        return None if self.recipe.field is not None else self.best(X)

    def check(self, answers: FloatArray) -> None:
        """Check that probabilities lie in 0 .. 1 and sum to 1 within a thousandth."""
        DrawnTask.check(self, answers)
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

    def setting(self) -> dict[str, Any]:
        """Return the recipe's setting and the counts as fields of a row."""
        timing, sensor = self.recipe.timing, self.recipe.sensor
        return {
            "recipe": self.recipe.name,
            "sampling_rate_hz": timing.sampling_rate_hz,
            "duration_s": timing.duration_s,
            "noise_a": sensor.current_noise_a,
            "channels": [str(channel) for channel in sensor.channels],
            "n_train": self.n_train,
            "n_test": self.n_test,
            "seed": self.seed,
        }


def class_task(recipe: Recipe, n_train: int = 2000, n_test: int = 2000, seed: int = 0) -> ClassTask:
    """Return the task to name the classes of a recipe.

    Raises:
        ValueError: fewer than 50 starts.
    """
    for name, count in (("n_train", n_train), ("n_test", n_test)):
        require(count >= 50, f"{name} must be >= 50, got {count}")
    rate, noise = recipe.timing.sampling_rate_hz, recipe.sensor.current_noise_a
    title = f"{recipe.name}, {rate / 1e3:g} kHz, {1e3 * noise:g} mA, {n_train} training starts"
    return ClassTask(name=recipe.name, title=title, recipe=recipe, n_train=n_train, n_test=n_test, seed=seed)


@dataclass(frozen=True, slots=True, kw_only=True)
class GivenTask(ClassTask):
    """Task: name the class of given cases, a split of a data set.

    Attributes:
        given: the cases with their labels.
    """

    given: Dataset = field(repr=False, compare=False)

    def starts(self) -> Dataset:
        """Return the given cases."""
        return self.given


def judged_cases(recipe: Recipe, first: int, count: int, per_motor: int | None = None) -> NDArray[np.int64]:
    """Return numbers of cases without commissioning starts.

    Args:
        recipe: for the starts of a motor.
        first: least number.
        count: of cases.
        per_motor: cases of each motor; all by default.
    """
    starts, healthy = recipe.starts_per_motor, recipe.healthy_starts
    if healthy == starts:
        raise InputError(f"all starts of recipe {recipe.name} are healthy ones: nothing to classify")
    judged = np.arange(healthy, starts)[:per_motor]
    motors = np.arange(-(-count // len(judged)))[:, None] + -(-first // starts)
    return (motors * starts + judged).ravel()[:count]


def judged_starts(recipe: Recipe, seed: int, first: int, count: int) -> Dataset:
    """Return the starts with these numbers (`judged_cases`)."""
    return generate_arrays(recipe, seed, judged_cases(recipe, first, count))
