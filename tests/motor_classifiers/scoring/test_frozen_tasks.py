"""The frozen tasks stay what they are, and the test cases of all of them together give nothing away."""

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest
from numpy.typing import NDArray

from motor_classifiers.scoring.frozen_tasks import TASKS, current_digests, frozen_digests
from motor_classifiers.scoring.task import ClassTask
from motor_env.motor.parameters import FloatArray

Rows = NDArray[np.float32]
N_TEST = 160


def late_noise(rows: Rows, n_samples: int) -> FloatArray:
    """Second differences of the late ones of the first samples, as unit vectors, shape (n_rows, n)."""
    differences = np.diff(rows[:, n_samples // 2 : n_samples].astype(np.float64), 2, axis=1)
    scale = 3.0 * np.median(np.abs(differences), axis=1, keepdims=True)
    differences = np.clip(differences, -scale, scale)  # steps of a drive are none of the noise
    unit: FloatArray = differences / np.linalg.norm(differences, axis=1, keepdims=True)
    return unit


def largest_likeness(first: Rows, second: Rows) -> float:
    """Largest correlation between the noise of a row and that of another one."""
    n_samples = min(first.shape[1], second.shape[1])
    likeness = late_noise(first, n_samples) @ late_noise(second, n_samples).T
    if first is second:
        np.fill_diagonal(likeness, 0.0)
    return float(np.abs(likeness).max())


def currents() -> dict[str, Rows]:
    """Recorded currents of the first test cases of each task, one row a start, shape (n_rows, n_samples)."""
    few = {name: replace(task, n_test=N_TEST).test().X for name, task in TASKS.items()}
    few["operation"] = few["operation"][:, :1]  # the other channel is the voltage
    return {name: X.reshape(-1, X.shape[-1]) for name, X in few.items()}


def test_no_pair_of_test_rows_shares_its_noise() -> None:
    rows = currents()
    for (first, one), (second, other) in combinations_with_replacement(rows.items(), 2):
        assert largest_likeness(one, other) < 0.9, (first, second)


def test_shared_noise_would_stand_out() -> None:
    """One seed for two tasks, and one number for two cases: what the other test looks for."""
    rows = currents()
    task = replace(TASKS["bench-full"], seed=TASKS["bench"].seed, n_test=N_TEST)
    again = task.test().X[:, 0]
    assert largest_likeness(rows["bench"], again) > 0.99
    twice = np.concatenate([rows["unknown"], rows["unknown"][:1] + np.float32(0.1)])
    assert largest_likeness(twice, twice) > 0.99


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if isinstance(task, ClassTask)])
def test_test_rows_are_of_distinct_motors(name: str) -> None:
    task = replace(TASKS[name], n_test=N_TEST)
    assert isinstance(task, ClassTask)
    starts = task.starts()
    assert len(np.unique(starts.motor_id)) == N_TEST
    learned = task.train()
    assert not set(starts.motor_id.tolist()) & set(learned.motor_id.tolist())


def test_seeds_of_tasks_differ() -> None:
    assert len({task.seed for task in TASKS.values()}) == len(TASKS)


def test_small_counts_of_every_task_are_frozen() -> None:
    assert current_digests(whole=False) == frozen_digests()["small"]
    assert {name: (task.n_train, task.n_test) for name, task in TASKS.items()} == {
        "bench": (2000, 5000), "bench-full": (2000, 5000), "field": (2000, 5000), "operation": (2000, 5000),
        "reference": (2000, 2000), "severity": (2000, 2000), "unknown": (2000, 4000), "stream": (2000, 2000),
    }  # fmt: skip


@pytest.mark.long
@pytest.mark.timeout(300)
def test_whole_tasks_are_frozen() -> None:
    assert current_digests(whole=True) == frozen_digests()["whole"]
