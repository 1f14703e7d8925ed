"""The command `motor-classifiers benchmark`: the page, the check against the limit, sweeps that go on, wrong use."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from output_schema import follows

from motor_classifiers.cli.main import main

# Reaches in: a run ends with its page, which has to take the results as they come.
from motor_classifiers.report.page import write_results
from motor_classifiers.scoring import benchmark as benchmark_module
from motor_classifiers.scoring.benchmark import AnswerStore, Plan, Unit, make_tasks, run_plan, units
from motor_classifiers.scoring.judging import (
    LIMIT,
    Answer,
    answer_key,
    judge,
    judge_in_subprocess,
    load_answer,
    posterior,
    save_answer,
)
from motor_classifiers.scoring.results import result_rows
from motor_classifiers.scoring.task import ClassTask, class_task
from motor_env import InputError, Timing, load_recipe

SLOW = load_recipe("bench", timing=Timing(1_000.0, 0.1))
TASK = class_task(SLOW, 300, 200)
FAST = ["benchmark", "--sampling-rate-hz", "1000", "--n-train", "300", "--n-test", "200"]


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge in this process: what is tested is not the isolation."""
    monkeypatch.setattr(benchmark_module, "judge_in_subprocess", judge)


@pytest.mark.usefixtures("at_once")
def test_benchmark_writes_a_page_that_needs_nothing_else(tmp_path: Path) -> None:
    methods = ["threshold", "residual-qda", "network"]
    assert main([*FAST, "--methods", ",".join(methods), "--out", str(tmp_path)]) == 0
    rows = follows("motor-classifiers benchmark", (tmp_path / "results.json").read_text())
    assert [row["method"] for row in rows] == ["Bayes limit", *methods]
    for row in rows:
        assert row["accuracy_low"] <= row["accuracy"] <= row["accuracy_high"]
        assert (row["recipe"], row["sampling_rate_hz"], row["noise_a"]) == ("bench", 1000.0, 0.02)
        assert 0.7 < row["bayes_accuracy"] < 0.9
        assert row["accuracy"] < row["bayes_accuracy"] + 0.05
        assert sum(map(sum, row["confusion"])) == 200
    with (tmp_path / "results.csv").open() as file:
        flat = list(csv.DictReader(file))
    assert [float(row["accuracy"]) for row in flat] == [row["accuracy"] for row in rows]
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r"src\s*=|href\s*=\s*\"?[^#\"]|@import|url\(|https?://", page)
    assert page.count("<svg") == 1 + 3 + 4  # accuracy, three sub-scores, four curves of confidence
    assert not (tmp_path / "answers").exists()
    # Two accuracies side by side cannot be compared: the tiles tell the paired difference, with its interval.
    best = max(rows[1:], key=lambda row: row["accuracy"])
    points = f"{-100.0 * best['below_bayes']:.2f}".replace("-", "−")
    assert (
        f"<b>{points} points</b><span>accuracy of {best['method']}, the best method here, minus that of the Bayes"
        in page
    )


@pytest.mark.usefixtures("at_once")
def test_a_method_above_the_limit_fails_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The limit is made worse here, so that an honest method stands above it."""

    def worse(cell: ClassTask) -> Answer:
        true = posterior(cell)
        return true._replace(probabilities=np.roll(true.probabilities, 1, axis=1))

    monkeypatch.setattr(benchmark_module, "posterior", worse)
    assert main([*FAST, "--methods", "residual-qda", "--out", str(tmp_path)]) == 1
    assert "residual-qda scored above the Bayes limit" in capsys.readouterr().err
    assert "Failing check: residual-qda" in (tmp_path / "report.html").read_text()


def test_a_process_of_its_own_gives_the_same_answer() -> None:
    here, apart = judge("residual-qda", TASK), judge_in_subprocess("residual-qda", TASK)
    np.testing.assert_array_equal(here.probabilities, apart.probabilities)
    assert apart.train.seconds > 0.0
    if sys.platform == "linux":
        assert apart.train.memory_mb is not None
        # 1,000 noise-free starts of 100 samples and their singular vectors: some MB, and not the libraries.
        assert 0.0 <= apart.train.memory_mb < 200.0


def test_a_process_that_dies_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"residual-qda on deadly: its process ended without an answer"):
        judge_in_subprocess("residual-qda", _Deadly("", "deadly", 200, recipe=SLOW))


class _Monotonous(ClassTask):
    """A setting whose training starts are all healthy."""

    def train(self) -> Any:
        starts = ClassTask.train(self)
        return starts.select(np.flatnonzero(starts.class_index == 0))


class _Deadly(ClassTask):
    """A setting whose starts kill the process that asks for them, as too little memory would."""

    def train(self) -> Any:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_method_that_fails_is_named_and_costs_no_other_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judged(name: str, cell: ClassTask) -> Answer:
        return (
            judge_in_subprocess(name, _Monotonous("", "bench, healthy", 50, recipe=SLOW, n_train=50))
            if name == "residual-qda"
            else judge(name, cell)
        )

    monkeypatch.setattr(benchmark_module, "judge_in_subprocess", judged)
    store = AnswerStore(tmp_path)
    plan = Plan((class_task(SLOW, 50, 50),), ("residual-qda", "raw-logistic"))
    with pytest.raises(InputError, match=r"1 of 3 answers failed, the first: residual-qda on bench.*class"):
        run_plan(plan, store)
    assert [store.find(unit) is not None for unit in units(plan)] == [True, False, True]


def test_answers_that_sizes_share_are_had_once() -> None:
    cells = make_tasks(
        (SLOW,), rates_hz=(1e3, 1e4), noises_a=(0.02, 0.1), train_sizes=(300, 100), n_test=200, seed=0
    )
    plan = Plan(cells, ("residual-qda", "posterior-network"))
    names = [unit.name for unit in units(plan)]
    # Neither the limit nor a network with a stream of its own depends on the given training starts.
    assert names.count(LIMIT) == names.count("posterior-network") == 4
    assert names.count("residual-qda") == 6


def test_answers_survive_and_damaged_ones_are_had_again(tmp_path: Path) -> None:
    answer = posterior(TASK)
    path = tmp_path / "answer.npz"
    save_answer(answer, path)
    found = load_answer(path, TASK)
    assert found is not None
    np.testing.assert_array_equal(found.probabilities, answer.probabilities)
    assert (found.train, found.inference) == (answer.train, answer.inference)
    assert load_answer(path, class_task(SLOW, 300, 201)) is None
    whole = path.read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 3):
        path.write_bytes(whole[:cut])
        assert load_answer(path, TASK) is None
    assert load_answer(tmp_path / "none.npz", TASK) is None


def test_the_key_holds_all_that_an_answer_depends_on() -> None:
    other = load_recipe("bench", timing=Timing(2_000.0, 0.1))
    cells = [
        TASK,
        class_task(SLOW, 301, 200),
        class_task(SLOW, 300, 201),
        class_task(SLOW, 300, 200, 1),
        class_task(other, 300, 200),
    ]
    assert len({answer_key("residual-qda", cell) for cell in cells}) == len(cells)
    assert answer_key(LIMIT, cells[0]) == answer_key(LIMIT, cells[1])
    assert answer_key("network", TASK) != answer_key("residual-qda", TASK)


@pytest.mark.usefixtures("at_once")
def test_an_interrupted_sweep_goes_on_where_it_stopped(tmp_path: Path) -> None:
    plan = Plan(
        make_tasks((SLOW,), rates_hz=(), noises_a=(0.02, 0.1), train_sizes=(300,), n_test=200, seed=0),
        ("residual-qda",),
    )
    first = units(plan)[2]

    def interrupt(unit: Unit, known: bool) -> None:
        if unit == first:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_plan(plan, AnswerStore(tmp_path), interrupt)
    asked: list[bool] = []
    results = run_plan(plan, AnswerStore(tmp_path), lambda unit, known: asked.append(known))
    assert asked == [True, True, False, False]
    asked.clear()
    run_plan(plan, AnswerStore(tmp_path), lambda unit, known: asked.append(known))
    assert all(asked)
    asked.clear()
    run_plan(plan, AnswerStore(tmp_path, fresh=True), lambda unit, known: asked.append(known))
    assert not any(asked)
    for result in results:
        assert result.methods[0].scores.accuracy.value > 0.4
    page = write_results(plan, results, tmp_path / "page").read_text()
    assert "Against the noise of the sensor" in page
    settings = page.split('id="settings"')[1].split("</tbody>")[0]
    assert settings.split("<tbody>")[1].count("<tr>") == 2
    assert len(json.loads((tmp_path / "page" / "results.json").read_text())) == 4


@pytest.mark.long
@pytest.mark.timeout(400)
def test_a_killed_sweep_goes_on_where_it_stopped(tmp_path: Path) -> None:
    """Killed without warning after the first answers; then only the others are asked for."""
    arguments = [
        *FAST,
        "--current-noise-a",
        "0.02,0.1",
        "--methods",
        "residual-qda,threshold",
        "--out",
        str(tmp_path),
    ]
    command = [sys.executable, "-m", "motor_classifiers", *arguments]
    answers = tmp_path / "answers"
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
        until = time.monotonic() + 300.0
        while (
            len(list(answers.glob("[!.]*.npz"))) < 2 and time.monotonic() < until and process.poll() is None
        ):
            time.sleep(0.02)
        process.kill()
    kept = {path.name: path.stat().st_mtime_ns for path in answers.glob("[!.]*.npz")}
    assert len(kept) >= 2
    asked: list[str] = []
    plan = Plan(
        make_tasks((SLOW,), rates_hz=(1e3,), noises_a=(0.02, 0.1), train_sizes=(300,), n_test=200, seed=0),
        ("residual-qda", "threshold"),
    )
    results = run_plan(plan, AnswerStore(answers), lambda unit, known: asked.append(f"{unit.name} {known}"))
    assert len(asked) == 6
    assert sum(line.endswith("True") for line in asked) == len(kept)
    assert {name: (answers / name).stat().st_mtime_ns for name in kept} == kept
    fresh = run_plan(plan)
    for one, other in zip(results, fresh, strict=True):
        for mine, theirs in zip(one.methods, other.methods, strict=True):
            np.testing.assert_array_equal(mine.answer.probabilities, theirs.answer.probabilities)


@pytest.mark.long
@pytest.mark.timeout(400)
@pytest.mark.parametrize("after_s", [0.0, 10.0], ids=["as its process begins", "in its training"])
def test_a_terminated_run_does_not_wait_for_its_method(tmp_path: Path, after_s: float) -> None:
    arguments = [*FAST, "--methods", "posterior-network", "--out", str(tmp_path)]
    with subprocess.Popen(
        [sys.executable, "-m", "motor_classifiers", *arguments], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        told = iter(process.stderr.readline, "")
        assert any("posterior-network on bench" in line for line in told)
        time.sleep(after_s)
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()  # ends when no process holds the pipe
        assert process.wait(30.0) == 128 + signal.SIGTERM
        assert time.monotonic() - begin < 30.0
    assert said.endswith("motor-classifiers: interrupted\n")
    assert "Traceback" not in said


def test_dry_run_tells_what_is_there_and_makes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--full", "--dry-run", "--json", "--out", str(tmp_path / "none")]) == 0
    rows = json.loads(capsys.readouterr().out)
    settings = {row["setting"] for row in rows}
    assert len(settings) == 4 * (2 * 3 + 2 * 4)
    assert not any(row["done"] for row in rows)
    assert all(row["about_s"] > 0.0 for row in rows)
    assert not list(tmp_path.iterdir())


def test_the_limit_of_the_field_is_called_an_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate itself is made elsewhere; here a quick method stands for it."""
    monkeypatch.setattr(
        benchmark_module, "judge_in_subprocess", lambda name, cell: judge("residual-qda", cell)
    )
    field = class_task(load_recipe("field", timing=Timing(1_000.0, 0.1, 0.02)), 200, 100)
    plan = Plan((field,), ("residual-qda",))
    results = run_plan(plan)
    rows = result_rows(results)
    assert rows[0]["method"] == "Bayes estimate"
    assert all(row["bayes_is_estimate"] for row in rows)
    page = write_results(plan, results, tmp_path).read_text()
    assert "estimate of the limit" in page
    assert "Bayes limit on these motors" not in page


@pytest.mark.parametrize(
    "arguments",
    [
        ["benchmark", "--methods", "none"],
        ["benchmark", "--recipe", "none"],
        ["benchmark", "--n-train", "3"],
        ["benchmark", "--n-train", "300,300"],
        ["benchmark", "--sampling-rate-hz", "fast"],
        ["benchmark", "--peers", "none.npz"],
        ["train", "none", "--out", "x"],
        ["predict", "none.csv", "--model", "none"],
    ],
)
def test_wrong_use_is_one_sentence(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
