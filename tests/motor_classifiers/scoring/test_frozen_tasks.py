"""The frozen tasks stay what they are; answers to them: costs, files and scores."""

import json
import re
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
from motor_classifiers.scoring.frozen_tasks import (
    TASKS,
    UNKNOWN_FAULTS,
    ForeignFault,
    current_digests,
    foreign_starts,
    frozen_digests,
    read_answers,
)

# Reaches in: the intervals need the very weights that cases are drawn again with, and a fault's name tells its factor.
from motor_classifiers.scoring.metrics import resampling_weights
from motor_env import InputError, Timing, load_recipe, simulate_states
from motor_env.common.files import LARGEST_TABLE_BYTES
from motor_env.simulation.recipes import FACTORS, Spread


def test_small_counts_of_every_task_are_frozen() -> None:
    assert current_digests(whole=False) == frozen_digests()["small"]
    assert len({task.seed for task in TASKS.values()}) == len(TASKS)
    assert {name: (task.n_train, task.n_test) for name, task in TASKS.items()} == {
        "bench": (2000, 5000), "bench-full": (2000, 5000), "field": (2000, 5000), "operation": (2000, 5000),
        "reference": (2000, 2000), "severity": (2000, 2000), "unknown": (2000, 4000), "stream": (2000, 2000),
    }  # fmt: skip


@pytest.mark.long
@pytest.mark.timeout(300)
def test_whole_tasks_are_frozen() -> None:
    assert current_digests(whole=True) == frozen_digests()["whole"]


@pytest.mark.parametrize("fault", UNKNOWN_FAULTS, ids=lambda fault: fault.name)
def test_an_unknown_fault_is_applied_to_a_healthy_motor_as_large_as_its_name_says(
    fault: ForeignFault,
) -> None:
    name, change, _ = fault.name.rsplit(" ", 2)
    own = {{"motor constants": "constants"}.get(name, name): 1.0 + float(change) / 100.0}
    factors = {quantity: getattr(fault, quantity) for quantity in FACTORS}
    assert factors == pytest.approx(dict.fromkeys(FACTORS, 1.0) | own)
    bench = load_recipe("bench", timing=Timing(1_000.0, 0.1))
    certain = replace(bench, spread=Spread(), sensor=replace(bench.sensor, current_noise_a=1e-9))
    motor = certain.motor.scaled(
        inertia_kg_m2=fault.inertia, torque_constant_n_m_per_a=fault.constants,
        back_emf_constant_v_s_per_rad=fault.constants,
    )  # fmt: skip
    expected = simulate_states(motor, fault.supply * certain.timing.step(12.0), 1e-3)[:, 0]
    got = foreign_starts(certain, fault, 1, np.arange(2))
    np.testing.assert_allclose(got[:, 0], [expected, expected], atol=1e-6)


def test_foreign_starts_are_of_textbook_motors() -> None:
    with pytest.raises(ValueError, match="has a field"):
        foreign_starts(load_recipe("field"), UNKNOWN_FAULTS[0], 0, np.arange(2))


Table = pd.DataFrame


def test_costs_of_the_linearised_area() -> None:
    """Two known cases, and one and two of the unknown kinds; ties count half (DeLong et al. 1988)."""
    task = load_task("unknown")
    truth = np.array([0, 0, 1, 2, 3, 3])
    score = np.array([1.0, 3.0, 3.0, 4.0, 0.0, 2.0])
    # Kind 1: above 1, equal to 3: loses 1/4. Kind 2: above both. Kind 3: below both, and above one: loses 1 and 1/2.
    lost, lost_known = [[0.25], [0.0], [1.0, 0.5]], [[0.0, 0.5], [0.0, 0.0], [0.5, 1.0]]
    missing = np.mean([np.mean(one) for one in lost])
    known = [missing + 4 * (np.mean([row[n] for row in lost_known]) - missing) for n in range(2)]
    foreign = [missing + 4 * (value - np.mean(one)) / 3 for one in lost for value in one]
    np.testing.assert_allclose(task.costs(truth, score[:, None]), [*known, *foreign])


NAN = np.nan
FLAT = [0.2] * 5


@pytest.mark.parametrize(
    ("name", "truth", "answers", "costs"),
    [
        ("severity", [0.10, 0.20], [[0.13], [0.16]], [9.0, 16.0]),  # points squared
        ("bench", [1, 1], [[0.3, 0.4, 0.1, 0.1, 0.1], FLAT], [0.0, 1.0]),
        (
            "stream",
            [0.2, 0.2, 0.2, NAN, 0.2, NAN, 0.2, 0.2],
            [[0.2], [0.3], [0.4], [NAN], [0.19], [0.0], [0.6], [NAN]],
            [0.0, 0.5, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0],
        ),
    ],
)
def test_costs_of_a_case(
    name: str, truth: list[float], answers: list[list[float]], costs: list[float]
) -> None:
    task = load_task(name)
    task.check(np.array(answers))
    np.testing.assert_allclose(task.costs(np.array(truth), np.array(answers)), costs)


def test_figures_are_percent_and_points() -> None:
    weights = np.array([[1.0, 1.0], [2.0, 0.0]])
    assert load_task("severity").figures(np.array([9.0, 16.0]), weights) == pytest.approx([12.5**0.5, 3.0])
    assert load_task("bench").figures(np.array([0.0, 1.0]), weights).tolist() == [50.0, 0.0]


@pytest.mark.parametrize(
    ("name", "answer", "sentence"),
    [
        ("bench", [0.2 + 1.005e-3, 0.2, 0.2, 0.2, 0.2], "its probabilities must sum to 1"),
        ("bench", [0.2 - 1.005e-3, 0.2, 0.2, 0.2, 0.2], "its probabilities must sum to 1"),
        ("bench", [1.0005, 0.0, 0.0, 0.0, 0.0], "healthy must be a probability from 0 to 1, got 1.0005"),
        ("bench", [0.0, 1.5, 0.0, 0.0, -0.5], "bearing_10 must be a probability from 0 to 1, got 1.5"),
        ("stream", [-0.1], "alarm_s must be >= 0 or nan, got -0.1"),
    ],
)
def test_answers_beyond_their_bounds(name: str, answer: list[float], sentence: str) -> None:
    load_task("bench").check(np.array([FLAT, [0.2 + 0.995e-3, 0.2, 0.2, 0.2, 0.2]]))
    with pytest.raises(InputError, match=f"case 1: {re.escape(sentence)}"):
        load_task(name).check(np.array([FLAT[: len(answer)], answer]))


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
    weights = resampling_weights(120, 0)
    right = best.argmax(axis=1) == cases.truth
    figures, differences = (100.0 * weights @ costs / 120 for costs in (wrong, wrong.astype(float) - ~right))
    told = [scored[name] for name in ("value", "low", "high", "limit")]
    ends = np.quantile(figures[1:], [0.025, 0.975])
    assert told == pytest.approx([25.0, *ends, 100.0 * (1.0 - right.mean())])
    told = [scored[f"above_limit{end}"] for end in ("", "_low", "_high")]
    assert told == pytest.approx([differences[0], *np.quantile(differences[1:], [0.025, 0.975])])


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
    assert (told["task"], told["version"], told["n_train"], told["n_test"]) == (name, "2.0", 60, len(X))
    assert told["columns"] == ["case", *task.columns]
    count, rng = len(task.columns), np.random.default_rng(1)
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


def written(folder: Path, name: str, answers: np.ndarray) -> Path:
    """A file of answers to a task."""
    table = Table(answers, columns=list(load_task(name).columns))
    table.insert(0, "case", np.arange(len(table)))
    table.to_csv(folder / "answers.csv", index=False)
    return folder / "answers.csv"


@pytest.mark.usefixtures("small")
def test_rows_and_columns_may_come_in_any_order_and_no_alarm_is_an_empty_field(tmp_path: Path) -> None:
    answers = {"bench": np.random.default_rng(0).dirichlet(np.ones(5), 120), "stream": np.full((120, 1), NAN)}
    for name, given in answers.items():
        path = written(tmp_path, name, given)
        table = pd.read_csv(path)
        table.sample(frac=1.0, random_state=0)[list(table)[::-1]].to_csv(path, index=False)
        np.testing.assert_allclose(read_answers(path, load_task(name)), given, rtol=1e-12)


def healthy(value: float) -> Callable[[Table], Table]:
    """Another probability of being healthy in case 3."""
    return lambda table: table.assign(healthy=table["healthy"].where(table["case"] != 3, value))


# What is done to a table of good answers to task bench, or to its file, by the sentence that is said of it.
BAD_TABLES: dict[str, Callable[[Table], Table]] = {
    "must have the cases 0 to 119 and no others: 1 are missing, the first is 119": lambda table: table[:119],
    "case 6 stands in it twice": lambda table: table.assign(case=table["case"].replace(7, 6)),
    "others: 1 too many, the first is 120": lambda table: pd.concat([table, table[:1].assign(case=120)]),
    "case 3: healthy must be a number, got nan": healthy(np.nan),
    "case 3: healthy must be a number, got inf": healthy(np.inf),
    "column healthy must hold numbers": lambda table: table.assign(healthy="sure"),
    "column case must hold whole numbers": lambda table: table.assign(case=table["case"] + 0.5),
    "must have the columns case, healthy,": lambda table: table.drop(columns="healthy"),
}
BAD_FILES: dict[str, Callable[[Path], object]] = {
    "no such file": lambda path: path.unlink(),
    "is larger than 20 MB": lambda path: path.write_bytes(b"x" * (LARGEST_TABLE_BYTES + 1)),
    "is no table of CSV (": lambda path: path.write_bytes(b"\xff\xfe\x00,\x00"),
    "must have the columns case, healthy": lambda path: path.write_bytes(b"case,case,case\n1,2,3\n"),
}


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("sentence", [*BAD_TABLES, *BAD_FILES])
def test_bad_answers_are_one_sentence(sentence: str, tmp_path: Path) -> None:
    path = written(tmp_path, "bench", np.full((120, 5), 0.2))
    if sentence in BAD_TABLES:
        BAD_TABLES[sentence](pd.read_csv(path)).to_csv(path, index=False)
    else:
        BAD_FILES[sentence](path)
    assert sentence in refused(lambda: main(["score", "bench", str(path)]), path)


@pytest.mark.timeout(30)
def test_only_regular_files_of_answers_are_read(tmp_path: Path) -> None:
    for odd in odd_places(tmp_path / "answers.csv"):
        assert "is no regular file" in refused(partial(read_answers, odd, load_task("bench")), odd)
