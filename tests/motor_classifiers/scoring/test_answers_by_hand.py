"""Answers to the frozen tasks: their costs, files and scores, on a handful of cases by hand."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hostile import odd_places, refused
from output_schema import follows

from motor_classifiers import load_task, score_answers
from motor_classifiers.cli.main import main
from motor_classifiers.scoring import frozen_tasks
from motor_classifiers.scoring.frozen_tasks import TASKS, read_answers, task_facts

# Reaches in: the intervals by hand need the very weights that cases are drawn again with.
from motor_classifiers.scoring.metrics import resampling_weights
from motor_env import InputError
from motor_env.common.files import LARGEST_TABLE_BYTES


def test_costs_of_the_linearised_area_by_hand() -> None:
    """Two known cases, and one and two of the unknown kinds; ties count half (DeLong et al. 1988)."""
    task = load_task("unknown")
    truth = np.array([0, 0, 1, 2, 3, 3])
    score = np.array([1.0, 3.0, 3.0, 4.0, 0.0, 2.0])
    # Kind 1: above 1, equal to 3: loses 1/4. Kind 2: above both. Kind 3: below both, and above one: loses 1 and 1/2.
    lost, lost_known = [[0.25], [0.0], [1.0, 0.5]], [[0.0, 0.5], [0.0, 0.0], [0.5, 1.0]]
    missing = np.mean([np.mean(one) for one in lost])
    known = [missing + 4 * (np.mean([row[n] for row in lost_known]) - missing) for n in range(2)]
    foreign = [missing + 4 * (value - np.mean(one)) / 3 for one in lost for value in one]
    costs = task.costs(truth, score[:, None])
    np.testing.assert_allclose(costs, [*known, *foreign])
    assert costs.mean() == pytest.approx(missing)


def test_costs_and_figures_of_the_other_tasks() -> None:
    severity = load_task("severity")
    costs = severity.costs(np.array([0.10, 0.20]), np.array([[0.13], [0.16]]))
    np.testing.assert_allclose(costs, [9.0, 16.0])  # points squared
    np.testing.assert_allclose(
        severity.figures(costs, np.array([[1.0, 1.0], [2.0, 0.0]])), [np.sqrt(12.5), 3.0]
    )
    bench = load_task("bench")
    answers = np.array([[0.3, 0.4, 0.1, 0.1, 0.1], [0.2, 0.2, 0.2, 0.2, 0.2]])
    assert bench.costs(np.array([1, 1]), answers).tolist() == [0.0, 1.0]
    assert bench.figures(np.array([0.0, 1.0]), np.array([[1.0, 1.0], [3.0, 1.0]])).tolist() == [50.0, 25.0]
    stream = load_task("stream")
    truth = np.array([0.2, 0.2, 0.2, np.nan, 0.2, np.nan, 0.2, 0.2])
    alarm = np.array([0.2, 0.3, 0.4, np.nan, 0.19, 0.0, 0.6, np.nan])
    np.testing.assert_allclose(stream.costs(truth, alarm[:, None]), [0.0, 0.5, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    stream.check(np.array([[0.0], [np.nan]]))
    with pytest.raises(InputError, match=r"case 1: alarm_s must be >= 0 or nan, got -0\.1"):
        stream.check(np.array([[0.0], [-0.1]]))


def test_probabilities_at_their_bounds() -> None:
    bench = load_task("bench")
    bench.check(np.array([[1.0, 0.0, 0.0, 0.0, 0.0]]))
    for off, fits in ((0.995e-3, True), (1.005e-3, False), (-0.995e-3, True), (-1.005e-3, False)):
        answers = np.array([[0.2] * 5, [0.2 + off, 0.2, 0.2, 0.2, 0.2]])
        if fits:
            bench.check(answers)
        else:
            with pytest.raises(InputError, match="case 1: its probabilities must sum to 1"):
                bench.check(answers)
    with pytest.raises(InputError, match=r"case 0: healthy must be a probability from 0 to 1, got 1\.0005"):
        bench.check(np.array([[1.0005, 0.0, 0.0, 0.0, 0.0]]))
    with pytest.raises(InputError, match=r"case 0: bearing_10 must be a probability from 0 to 1, got 1\.5"):
        bench.check(np.array([[-0.5, 1.5, 0.0, 0.0, 0.0]])[:, [1, 1, 2, 3, 4]] * [0, 1, 1, 1, 1])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks of few cases: the counts are checked by the digests."""
    few = {name: replace(task, n_train=60, n_test=120) for name, task in TASKS.items()}
    monkeypatch.setattr(frozen_tasks, "TASKS", few)


@pytest.mark.usefixtures("small")
def test_a_score_is_the_mean_cost_with_its_paired_interval() -> None:
    task = load_task("bench")
    cases = task.test()
    best = task.limit(cases.X)
    assert best is not None
    wrong = np.arange(120) < 30
    scored = score_answers(task, np.eye(5)[np.where(wrong, (cases.truth + 1) % 5, cases.truth)])
    assert scored["value"] == pytest.approx(25.0)
    weights = resampling_weights(120, 0)
    figures = 100.0 * weights @ wrong / 120
    assert (scored["low"], scored["high"]) == pytest.approx(tuple(np.quantile(figures[1:], [0.025, 0.975])))
    right = best.argmax(axis=1) == cases.truth
    assert scored["limit"] == pytest.approx(100.0 * (1.0 - right.mean()))
    differences = 100.0 * weights @ (wrong.astype(float) - ~right) / 120
    assert scored["above_limit"] == pytest.approx(differences[0])
    ends = np.quantile(differences[1:], [0.025, 0.975])
    assert (scored["above_limit_low"], scored["above_limit_high"]) == pytest.approx(tuple(ends))


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("name", TASKS)
def test_every_task_is_answered_from_its_files(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As somebody does who works in another language: arrays in, a table of numbers out."""
    task = load_task(name)
    assert main(["task", name, "--out", str(tmp_path)]) == 0
    told = json.loads((tmp_path / "task.json").read_text())
    with np.load(tmp_path / "test.npz") as arrays:
        assert list(arrays) == ["X"]  # no truth
        X = arrays["X"]
    np.testing.assert_array_equal(X, task.test().X)
    assert (told["n_test"], told["columns"]) == (len(X), ["case", *task.columns])
    count = len(task.columns)
    rng = np.random.default_rng(1)
    answers = rng.dirichlet(np.ones(count), len(X)) if count > 1 else rng.random((len(X), 1))
    path = written(tmp_path, name, answers)
    capsys.readouterr()
    assert main(["score", name, str(path), "--json"]) == 0
    scored = follows("motor-classifiers score", capsys.readouterr().out)
    assert scored == json.loads(json.dumps(score_answers(task, answers)))
    assert scored["low"] < scored["value"] < scored["high"]
    best = task.limit(X)
    assert ("limit" in scored) == (best is not None)
    if best is not None:
        assert scored["above_limit"] == pytest.approx(scored["value"] - scored["limit"])
        assert scored["above_limit_low"] > 0.0  # guesses are not by chance as good
        assert score_answers(task, best)["above_limit"] == pytest.approx(0.0, abs=1e-6)


def test_what_is_told_of_a_task() -> None:
    told = task_facts(load_task("stream"))
    assert told["columns"] == ["case", "alarm_s"]
    assert (told["task"], told["n_train"], told["n_test"], told["version"]) == ("stream", 2000, 2000, "2.0")


def written(folder: Path, name: str, answers: np.ndarray) -> Path:
    """A file of answers to a task."""
    table = pd.DataFrame(answers, columns=list(load_task(name).columns))
    table.insert(0, "case", np.arange(len(table)))
    path = folder / "answers.csv"
    table.to_csv(path, index=False)
    return path


@pytest.mark.usefixtures("small")
def test_rows_and_columns_may_come_in_any_order(tmp_path: Path) -> None:
    task, answers = load_task("bench"), np.random.default_rng(0).dirichlet(np.ones(5), 120)
    path = written(tmp_path, "bench", answers)
    table = pd.read_csv(path)
    table.sample(frac=1.0, random_state=0)[list(table)[::-1]].to_csv(path, index=False)
    np.testing.assert_allclose(read_answers(path, task), answers, rtol=1e-12)


@pytest.mark.usefixtures("small")
def test_a_stream_without_an_alarm_is_an_empty_field(tmp_path: Path) -> None:
    for content in (["0.25"] + [""] * 119, [""] * 120):
        path = tmp_path / "answers.csv"
        rows = [f"{n},{text}" for n, text in enumerate(content)]
        path.write_text("\n".join(["case,alarm_s", *rows]) + "\n")
        answers = read_answers(path, load_task("stream"))[:, 0]
        assert int(np.isnan(answers).sum()) == content.count("")


Table = pd.DataFrame
# What is done to a table of good answers to task bench, or to its file, by the sentence that is said of it.
BAD_TABLES: dict[str, Callable[[Table], Table]] = {
    "must have the cases 0 to 119 and no others: 1 are missing, the first is 119": lambda table: table[:119],
    "case 6 stands in it twice": lambda table: table.assign(case=table["case"].replace(7, 6)),
    "and no others: 1 too many, the first is 120": lambda table: pd.concat(
        [table, table[:1].assign(case=120)]
    ),
    "case 3: healthy must be a number, got nan": lambda table: _with(table, np.nan),
    "case 3: healthy must be a number, got inf": lambda table: _with(table, np.inf),
    "case 3: healthy must be a probability from 0 to 1, got -0.5": lambda table: _with(table, -0.5),
    "case 3: its probabilities must sum to 1, got 0.9": lambda table: _with(table, 0.1),
    "column healthy must hold numbers": lambda table: table.assign(healthy="sure"),
    "column case must hold whole numbers": lambda table: table.assign(case=table["case"] + 0.5),
    "must have the columns case, healthy,": lambda table: table.drop(columns="healthy"),
}
BAD_FILES: dict[str, Callable[[Path], object]] = {
    "no such file": lambda path: path.unlink(),
    "is larger than 20 MB": lambda path: path.write_bytes(b"x" * (LARGEST_TABLE_BYTES + 1)),
    "is no table of CSV": lambda path: path.write_bytes(b""),
    "is no table of CSV (": lambda path: path.write_bytes(b"\xff\xfe\x00,\x00"),
    "must have the columns case, healthy": lambda path: path.write_bytes(b"case,case,case\n1,2,3\n"),
}


def _with(table: Table, value: float) -> Table:
    """Another probability of being healthy in case 3."""
    return table.assign(healthy=table["healthy"].where(table["case"] != 3, value))


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("sentence", [*BAD_TABLES, *BAD_FILES])
def test_bad_answers_are_one_sentence(sentence: str, tmp_path: Path) -> None:
    path = written(tmp_path, "bench", np.full((120, 5), 0.2))
    if sentence in BAD_TABLES:
        BAD_TABLES[sentence](pd.read_csv(path)).to_csv(path, index=False)
    else:
        BAD_FILES[sentence](path)
    assert sentence in refused(lambda: main(["score", "bench", str(path)]), path)


@pytest.mark.usefixtures("small")
@pytest.mark.timeout(30)
def test_only_regular_files_of_answers_are_read(tmp_path: Path) -> None:
    for odd in odd_places(tmp_path / "answers.csv"):
        assert "is no regular file" in refused(partial(read_answers, odd, load_task("bench")), odd)


def test_another_task_is_one_sentence() -> None:
    with pytest.raises(InputError, match="task must be one of bench, bench-full"):
        load_task("wrench")
