"""Answers to a task as files, and their score: a TOML card and a Parquet table. Nothing in them is ever run."""

from __future__ import annotations

import base64
import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike

from motor_classifiers.contest.tasks import load_task
from motor_classifiers.scoring.metrics import resampling_weights
from motor_classifiers.scoring.score import score
from motor_classifiers.scoring.task import VERSION, DrawnTask
from motor_env.errors import InputError
from motor_env.files import LARGEST_TABLE_BYTES, read_file, replacing, write_text
from motor_env.motor.parameters import FloatArray
from motor_env.motor.toml_files import from_dict, read_toml, toml_text

CARD, ANSWERS = "card.toml", "answers.parquet"
_LONGEST = 200  # characters of a text on the card


@dataclass(frozen=True, slots=True)
class Card:
    """What a submission says of itself.

    Attributes:
        task: name of the task.
        version: of motor-bench.
        draw: name of the split that is answered (`DrawnTask.draw_id`).
        method: name in the table.
        authors: who made the method.
        about: what it is.
        learned_from: what it has seen: "2,000 starts", say.
        link: where its code is.
    """

    task: str
    version: str
    draw: str
    method: str
    authors: str
    about: str = ""
    learned_from: str = ""
    link: str = ""

    __pydantic_config__: ClassVar = {"extra": "forbid"}


def write_submission(folder: Path | str, task: DrawnTask, answers: ArrayLike, card: dict[str, str]) -> None:
    """Write the answers to a task and their card; both are checked as for scoring.

    Args:
        folder: of the two files.
        task: that is answered.
        answers: shape (n_test, n_columns) in the order of `task.columns`, of the test cases in their order.
        card: `method` and `authors`, perhaps `about`, `learned_from` and `link`.

    Raises:
        InputError: answers that would be refused.
    """
    values = np.asarray(answers, dtype=np.float64).reshape(len(np.asarray(answers)), -1)
    columns = {"case": np.arange(len(values))} | dict(zip(task.columns, values.T, strict=True))
    full = from_dict(Card, card | {"task": task.name, "version": VERSION, "draw": task.draw_id}, "card")
    _check_card(full, task)
    _checked(task, pa.table(columns))
    with replacing(Path(folder) / ANSWERS) as temporary:
        pq.write_table(pa.table(columns), temporary, compression="zstd")
    write_text(Path(folder) / CARD, toml_text(asdict(full), {}))


def read_submission(folder: Path | str, *, sealed: int | None = None) -> tuple[Card, DrawnTask, FloatArray]:
    """Card, task and checked answers, shape (n_test, n_columns).

    Raises:
        InputError: a file is missing, too large or damaged, for another task, version or split, or has a row too few,
            twice, or with a value that cannot be one.
    """
    path = Path(folder) / CARD
    content = read_toml(path, "a submission needs a card")
    try:
        card = from_dict(Card, content, "card")
        task = replace(load_task(card.task), sealed=sealed)
        _check_card(card, task)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    path = Path(folder) / ANSWERS
    answers = read_file(path, LARGEST_TABLE_BYTES, "a submission needs a table of answers")
    try:
        return card, task, _checked(task, _table(task, answers))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _check_card(card: Card, task: DrawnTask) -> None:
    if card.version != VERSION:
        raise InputError(
            f"the submission is for motor-bench {card.version!r:.60}, this is motor-bench {VERSION}"
        )
    if card.draw != task.draw_id:
        raise InputError(
            f"the submission answers split {card.draw!r:.60} of task {task.name}, this split is {task.draw_id}"
        )
    for name, text in asdict(card).items():
        if len(text) > _LONGEST or not text.isprintable():
            raise InputError(f"{name} of the card must be one line of at most {_LONGEST} characters")
    if not card.method or not card.authors:
        raise InputError("the card must name method and authors")


def _table(task: DrawnTask, content: bytes) -> pa.Table:
    """The table of a file. What it says of itself is checked first: a run of equal numbers takes no room in a file."""
    try:
        with pq.ParquetFile(pa.BufferReader(content)) as file:
            _check_columns(task, file.schema_arrow)
            _check_rows(task, file.metadata.num_rows)
            groups = [file.metadata.row_group(n) for n in range(file.metadata.num_row_groups)]
            if sum(group.total_byte_size for group in groups) > LARGEST_TABLE_BYTES:
                raise InputError(f"unpacks to more than {LARGEST_TABLE_BYTES / 1e6:g} MB")
            return file.read()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise InputError(f"is no Parquet file, or damaged ({' '.join(str(error).split())[:100]})") from None


def _check_columns(task: DrawnTask, schema: pa.Schema) -> None:
    wanted = ["case", *task.columns]
    if sorted(schema.names) != sorted(wanted):
        raise InputError(f"must have the columns {', '.join(wanted)}, got {', '.join(schema.names)[:200]}")
    for name in wanted:
        kind = schema.field(name).type
        if not (pa.types.is_integer(kind) if name == "case" else pa.types.is_floating(kind)):
            raise InputError(f"column {name} must hold {'whole ' * (name == 'case')}numbers, got {kind}")


def _check_rows(task: DrawnTask, count: int) -> None:
    if count > task.n_test:
        raise InputError(f"must have the cases 0 to {task.n_test - 1} and no others, got {count} rows")


def _checked(task: DrawnTask, table: pa.Table) -> FloatArray:
    _check_rows(task, table.num_rows)
    case = table["case"].to_numpy()
    seen, count = np.unique(case[np.isfinite(case)].astype(np.int64), return_counts=True)
    if (count > 1).any():
        raise InputError(f"case {seen[count > 1][0]} stands in it twice")
    missing = np.setdiff1d(np.arange(task.n_test), seen)
    if len(missing):
        raise InputError(
            f"{len(missing)} of the {task.n_test} cases are missing, the first is case {missing[0]}"
        )
    answers = np.column_stack([table[name].to_numpy().astype(np.float64) for name in task.columns])
    answers = answers[np.argsort(case)]
    task.check(answers)
    return answers


def score_submission(folder: Path | str, *, sealed: int | None = None) -> dict[str, Any]:
    """Score a submission beside the limit on the same cases.

    Args:
        folder: of card and answers.
        sealed: secret seed of the split that it answers; None for the public one.

    Returns:
        For JSON: the card's fields, `metric`, its `value` with `low` and `high` (95 %), and `costs`, what the cases
        cost (`unpacked_costs`). Where the best possible is known case by case, `limit` and `above_limit` (the paired
        difference) with its `above_limit_low` and `above_limit_high`; where it is on average, `bracket`.

    Raises:
        InputError: the submission is refused.
    """
    card, task, answers = read_submission(folder, sealed=sealed)
    cases = task.test()
    best = task.limit(cases.X)
    every = {"mine": answers} | ({} if best is None else {"limit": best})
    weights = resampling_weights(task.n_test, 0, groups=cases.motor)
    results = score(task, cases.truth, every, weights, None if best is None else "limit")
    own = results["mine"]
    row = {**asdict(card), "metric": task.metric, "n_test": task.n_test, **own.value._asdict()}
    if task.bracket is not None:
        row["bracket"] = task.bracket
    if own.against_limit is not None:
        row["limit"] = results["limit"].value.value
        names = ("above_limit", "above_limit_low", "above_limit_high")
        row |= dict(zip(names, own.against_limit.difference, strict=True))
    packed = zlib.compress(own.costs.astype(np.float32).tobytes(), 9)
    return row | {"costs": base64.b64encode(packed).decode()}


def unpacked_costs(scored: dict[str, Any]) -> FloatArray:
    """Cost of each case of a scored submission."""
    content = zlib.decompress(base64.b64decode(scored["costs"]))
    return np.frombuffer(content, dtype=np.float32).astype(np.float64)
