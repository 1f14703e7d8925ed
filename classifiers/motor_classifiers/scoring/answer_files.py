"""Answers to a frozen task as a CSV file, and their score beside the best possible answers to the same cases."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from motor_classifiers.scoring.frozen_tasks import VERSION
from motor_classifiers.scoring.metrics import resampling_weights
from motor_classifiers.scoring.score import score
from motor_classifiers.scoring.task import DrawnTask
from motor_env.common.errors import InputError
from motor_env.common.files import LARGEST_TABLE_BYTES, read_file
from motor_env.motor.parameters import FloatArray


def read_answers(path: Path, task: DrawnTask) -> FloatArray:
    """Checked answers of a CSV file, shape (n_test, n_columns), in the order of the cases.

    Args:
        path: of a file with the column `case` and those of the task, in any order; an empty field is nan.
        task: that is answered.

    Raises:
        InputError: a file that is missing, larger than 20 MB or no such table, or that has a row too few, one twice,
            or a value that cannot be one.
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
        task: that is answered.
        answers: shape (n_test, n_columns), the columns in the order of `task.columns`.

    Returns:
        For JSON: `task`, `version`, `metric`, `n_test`, the metric's `value` with `low` and `high` (95 %). Where the
        best possible is known case by case, `limit` and `above_limit` (the paired difference) with `above_limit_low`
        and `above_limit_high`; where it is on average, `bracket`.

    Raises:
        InputError: a value that cannot be an answer.
    """
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
