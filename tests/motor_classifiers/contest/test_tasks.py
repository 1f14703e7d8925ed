"""The frozen tasks: they stay what they are, answers to them are checked and scored, and ranks know ties."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import odd_places, refused
from output_schema import follows

from motor_classifiers import load_task, score_submission, write_submission
from motor_classifiers.cli.main import main
from motor_classifiers.contest import submissions, tasks
from motor_classifiers.contest.submissions import ANSWERS, CARD, unpacked_costs
from motor_classifiers.contest.tasks import TASKS, current_digests, frozen_digests

# Reaches in: a comparison of two answers by hand needs the weights that cases are drawn again with.
from motor_classifiers.scoring.task import DrawnTask
from motor_env.files import LARGEST_TABLE_BYTES

WHO = {"method": "mine", "authors": "A Stranger"}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Tasks of few cases: the counts are checked by the digests."""
    if "whole" not in request.node.name:
        few = {name: replace(task, n_train=120, n_test=80) for name, task in TASKS.items()}
        monkeypatch.setattr(tasks, "TASKS", few)
        monkeypatch.setattr("motor_classifiers.contest.leaderboard.TASKS", few)


def good_answers(task: DrawnTask) -> Any:
    best = task.limit(task.test().X)
    assert best is not None
    return best


def test_small_counts_of_every_task_are_frozen_whole() -> None:
    assert current_digests(whole=False) == frozen_digests()["small"]
    assert {name: (task.n_train, task.n_test) for name, task in TASKS.items()} == {
        "bench": (2000, 5000), "bench-full": (2000, 5000), "field": (2000, 5000), "operation": (2000, 5000),
        "reference": (2000, 2000), "severity": (2000, 2000), "unknown": (2000, 4000), "stream": (2000, 2000),
    }  # fmt: skip


@pytest.mark.long
@pytest.mark.timeout(300)
def test_whole_tasks_are_frozen() -> None:
    assert current_digests(whole=True) == frozen_digests()["whole"]


@pytest.mark.parametrize("name", TASKS)
def test_a_submission_is_scored_beside_the_best_possible(name: str, tmp_path: Path) -> None:
    task = load_task(name)
    cases = task.test()
    rng = np.random.default_rng(1)
    best = task.limit(cases.X)
    count = len(task.columns)
    answers = rng.dirichlet(np.ones(count), task.n_test) if count > 1 else rng.random((task.n_test, 1))
    write_submission(tmp_path, task, answers, WHO)
    scored = json.loads(json.dumps(score_submission(tmp_path)))
    assert scored["low"] < scored["value"] < scored["high"]
    np.testing.assert_allclose(unpacked_costs(scored), task.costs(cases.truth, answers), rtol=1e-6)
    if best is None:
        assert "limit" not in scored
    else:
        assert scored["above_limit"] == pytest.approx(scored["value"] - scored["limit"])
        assert scored["above_limit_low"] > 0.0  # guesses are not by chance as good
        write_submission(tmp_path, task, best, WHO)
        assert score_submission(tmp_path)["above_limit"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("name", TASKS)
def test_a_sealed_split_is_other_cases_and_what_is_learned_from_stays(name: str) -> None:
    """A secret seed that drew the starts to learn from would be told by them."""
    public = load_task(name)
    sealed = replace(public, sealed=2**50)
    learned = public.learned()
    for part, values in sealed.learned().items():
        np.testing.assert_array_equal(values, learned[part])
    known = {case.tobytes() for X in (learned["X"], public.test().X) for case in X}
    assert len(known) == 200
    assert known.isdisjoint(case.tobytes() for case in sealed.test().X)


def _with(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, pa.array(values))


def _with_case(table: pa.Table, value: float) -> pa.Table:
    """Another probability of being healthy in case 3."""
    return _with(table, "healthy", np.where(np.arange(80) == 3, value, np.array(table["healthy"])))


# What is done to the table of a good submission to task bench, or to its folder, by the sentence that is said of it.
BAD_TABLES: dict[str, Callable[[pa.Table], pa.Table]] = {
    "1 of the 80 cases are missing, the first is case 79": lambda table: table.slice(0, 79),
    "case 6 stands in it twice": lambda table: _with(
        table, "case", np.where(np.arange(80) == 7, 6, np.arange(80))
    ),
    "must have the cases 0 to 79 and no others, got 81 rows": lambda table: pa.concat_tables(
        [table, _with(table.slice(0, 1), "case", [80])]
    ),
    "case 3: healthy must be a number, got nan": lambda table: _with_case(table, np.nan),
    "case 3: healthy must be a probability from 0 to 1, got -0.5": lambda table: _with_case(table, -0.5),
    "column healthy must hold numbers, got string": lambda table: _with(
        table, "healthy", [str(value) for value in table["healthy"]]
    ),
    "must have the columns case, healthy,": lambda table: table.drop_columns(["healthy"]),
}
BAD_FILES: dict[str, Callable[[Path], object]] = {
    "is no Parquet file, or damaged": lambda folder: (folder / ANSWERS).write_bytes(b"PAR1 nothing"),
    "a submission needs a table of answers": lambda folder: (folder / ANSWERS).unlink(),
    "is larger than 20 MB": lambda folder: (folder / ANSWERS).write_bytes(b"x" * (LARGEST_TABLE_BYTES + 1)),
    "the submission is for motor-bench '0.9', this is motor-bench 1.0": lambda folder: _edit_card(
        folder, '"1.0"', '"0.9"'
    ),
    "answers split '0000000000000000' of task bench": lambda folder: _edit_card(
        folder, load_task("bench").draw_id, "0" * 16
    ),
    "answers split 'a\\nb' of task bench": lambda folder: _edit_card(
        folder, load_task("bench").draw_id, "a\\nb"
    ),
    "task must be one of bench,": lambda folder: _edit_card(folder, '"bench"', '"wrench"'),
    "unknown key 'run' in card": lambda folder: _edit_card(folder, "about =", "run = 1\nabout ="),
}


def _edit_card(folder: Path, old: str, new: str) -> None:
    (folder / CARD).write_text((folder / CARD).read_text().replace(old, new))


@pytest.mark.parametrize("sentence", [*BAD_TABLES, *BAD_FILES])
def test_a_bad_submission_is_one_sentence(sentence: str, tmp_path: Path) -> None:
    task = load_task("bench")
    write_submission(tmp_path, task, good_answers(task), WHO)
    path = tmp_path / ANSWERS
    if sentence in BAD_TABLES:
        pq.write_table(BAD_TABLES[sentence](pq.read_table(path)), path)
    else:
        BAD_FILES[sentence](tmp_path)
    assert sentence in refused(lambda: main(["score", str(tmp_path)]), path, named=str(tmp_path))


def test_rows_are_counted_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of one number take no room in a file, and its own statement of their size may be wrong."""
    task = load_task("severity")
    write_submission(tmp_path, task, good_answers(task), WHO)
    runs = pa.table({"case": np.zeros(1_000_000, dtype=np.int64), "severity": np.zeros(1_000_000)})
    pq.write_table(runs, tmp_path / ANSWERS, compression="zstd")
    asked = partial(score_submission, tmp_path)
    monkeypatch.setattr(pq.ParquetFile, "read", None)
    assert "the cases 0 to 79 and no others, got 1000000 rows" in refused(asked, tmp_path / ANSWERS)
    lists = pa.table({"case": np.arange(80), "severity": pa.array([[0.1]] * 80)})
    pq.write_table(lists, tmp_path / ANSWERS)
    assert "column severity must hold numbers, got list<" in refused(asked, tmp_path / ANSWERS)


def test_a_table_that_unpacks_to_too_much_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = load_task("bench")
    write_submission(tmp_path, task, good_answers(task), WHO)
    zeros = pa.table({"case": np.arange(80), **dict.fromkeys(task.columns, np.zeros(80))})
    pq.write_table(
        zeros,
        tmp_path / ANSWERS,
        compression="zstd",
        use_dictionary=False,
        write_statistics=False,
        store_schema=False,
    )
    largest = (tmp_path / ANSWERS).stat().st_size
    monkeypatch.setattr(submissions, "LARGEST_TABLE_BYTES", largest)
    monkeypatch.setattr(pq.ParquetFile, "read", None)
    assert "unpacks to more than" in refused(partial(score_submission, tmp_path), tmp_path / ANSWERS)


@pytest.mark.timeout(30)
def test_only_regular_files_of_a_submission_are_read(tmp_path: Path) -> None:
    task = load_task("severity")
    write_submission(tmp_path, task, good_answers(task), WHO)
    for name in (ANSWERS, CARD):
        path = tmp_path / name
        content = path.read_bytes()
        for odd in odd_places(path):
            if odd == path:
                assert "is no regular file" in refused(partial(score_submission, tmp_path), path)
        path.write_bytes(content)
    for odd in odd_places(tmp_path / "seed"):
        asked = ["score", str(tmp_path), "--sealed", str(odd)]
        assert "is no regular file" in refused(partial(main, asked), odd)


def test_a_submission_is_checked_before_it_is_written(tmp_path: Path) -> None:
    task = load_task("bench")
    good, path = good_answers(task), tmp_path / ANSWERS
    for answers, who, words in (
        (0.1 * good, WHO, "sum to 1"),
        (good, {"method": "", "authors": ""}, "must name method and authors"),
    ):
        assert words in refused(partial(write_submission, tmp_path, task, answers, who), path, named=False)
    assert list(tmp_path.iterdir()) == []


def test_commands_make_answer_and_score_a_sealed_split(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seed, sealed = tmp_path / "seed", load_task("bench")
    seed.write_text("18446744073709551615\n")
    options = ["--sealed", str(seed)]
    assert main(["task", "bench", "--out", str(tmp_path / "task"), *options]) == 0
    with np.load(tmp_path / "task" / "test.npz") as arrays:
        assert list(arrays) == ["X"]  # no truth
        assert not np.array_equal(arrays["X"], sealed.test().X)
    told = json.loads((tmp_path / "task" / "task.json").read_text())
    assert "18446744073709551615" not in json.dumps(told)
    assert told["draw"] != sealed.draw_id
    mine, kept = tmp_path / "mine", tmp_path / "kept"
    command = ["submit", "bench", "--method", "residual-qda", "--authors", "me", "--out", str(mine)]
    assert main([*command, *options]) == 0
    assert main(["score", str(mine)]) == 2  # it answers another split
    capsys.readouterr()
    assert main(["score", str(mine), *options, "--keep", str(kept)]) == 0
    assert "the best possible on the same cases" in capsys.readouterr().out
    scored = json.loads((kept / "bench" / "residual-qda.json").read_text())
    assert scored["value"] < 40.0
    assert scored["learned_from"] == f"{sealed.n_train:,} starts"
    assert main(["score", str(mine), *options, "--json"]) == 0
    printed = capsys.readouterr().out
    follows("motor-classifiers score", printed)
    assert json.loads(printed) == scored
    assert "costs" not in scored  # a cost of each case would tell its truth
    for value in scored.values():
        assert isinstance(value, str | int | float), value
        assert not isinstance(value, str) or len(value) <= 200, value
