"""Answers, figures and scores that were kept: only regular files of a stated size are read, and what fits."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import archive_of, odd_places, refused, zip_bombs

# Reaches in: one set-up for all that reads what was kept.
from motor_classifiers.estimators.methods import find_method
from motor_classifiers.model_files import containers
from motor_classifiers.model_files.containers import read_arrays
from motor_classifiers.scoring.judging import load_answer
from motor_classifiers.scoring.task import class_task
from motor_env import load_recipe

TASK = class_task(load_recipe("bench"), 50, 50)


@pytest.mark.timeout(20)
def test_only_regular_files_are_read(tmp_path: Path) -> None:
    for path in odd_places(tmp_path / "a.npz"):
        assert load_answer(path, TASK) is None
        assert "is no regular file" in refused(partial(read_arrays, path), path)
    for path in odd_places(tmp_path / "own.py"):
        if path.suffix == ".py":
            assert "is no regular file" in refused(partial(find_method, f"{path}:make"), path)


def test_an_archive_that_unpacks_to_too_much_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(containers, "LARGEST_DATA_BYTES", 100_000)
    path = tmp_path / "a.npz"
    for _, bomb in zip_bombs({}, 100_001):
        path.write_bytes(bomb)
        refused(partial(read_arrays, path), path)
    path.write_bytes(archive_of({"a.npy": archive_of({})}))
    assert "is no NumPy archive" in refused(partial(read_arrays, path), path)


@pytest.mark.parametrize(
    "changed", [{"costs": np.float64(1.0)}, {"probabilities": np.zeros((4, 5))}, {"more": np.zeros(1)}]
)
def test_an_answer_of_another_shape_is_had_again(changed: dict[str, Any], tmp_path: Path) -> None:
    whole: dict[str, Any] = {"probabilities": np.full((50, 5), 0.2), "costs": np.ones(4)}
    np.savez(tmp_path / "a.npz", allow_pickle=False, **whole)
    assert load_answer(tmp_path / "a.npz", TASK) is not None
    np.savez(tmp_path / "a.npz", allow_pickle=False, **whole | changed)
    assert load_answer(tmp_path / "a.npz", TASK) is None
