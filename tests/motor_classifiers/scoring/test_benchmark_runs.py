"""The command `motor-classifiers benchmark`: the page, the limit, sweeps that go on, kept answers, wrong use."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import Poison, refused
from output_schema import follows

from motor_classifiers.cli.main import main

# Reaches in: a run ends with its table and its page, which have to take the results as they come.
from motor_classifiers.cli.sweep import table_lines
from motor_classifiers.report.page import write_results
from motor_classifiers.scoring import benchmark as benchmark_module
from motor_classifiers.scoring.benchmark import (
    PEERS,
    AnswerStore,
    Plan,
    Unit,
    identity,
    make_tasks,
    read_peers,
    run_plan,
    units,
)
from motor_classifiers.scoring.judging import (
    LIMIT,
    Answer,
    Cost,
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
TWO_NOISES: dict[str, Any] = {"noises_a": (0.02, 0.1), "train_sizes": (300,), "n_test": 200, "seed": 0}
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
        assert (row["recipe"], row["sampling_rate_hz"], row["noise_a"]) == ("bench", 1000.0, 0.02)
        assert row["accuracy"] < row["bayes_accuracy"] + 0.05
        assert sum(map(sum, row["confusion"])) == 200
    with (tmp_path / "results.csv").open() as file:
        flat = list(csv.DictReader(file))
    assert [float(row["accuracy"]) for row in flat] == [row["accuracy"] for row in rows]
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r"src\s*=|href\s*=\s*\"?[^#\"]|@import|url\(|https?://", page)
    assert page.count("<svg") == 1 + 3 + 4  # accuracy, three sub-scores, four curves of confidence
    assert not (tmp_path / "answers").exists()
    # Two accuracies side by side cannot be compared: the tiles tell the paired difference.
    best = max(rows[1:], key=lambda row: row["accuracy"])
    points = f"{-100.0 * best['below_bayes']:.2f}".replace("-", "−")
    assert f"<b>{points} points</b><span>accuracy of {best['method']}, the best method here" in page


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
    # 1,000 noise-free starts of 100 samples and their singular vectors: some MB, and not the libraries.
    assert sys.platform != "linux" or 0.0 <= (apart.train.memory_mb or 0.0) < 200.0


class _Deadly(ClassTask):
    """A setting whose starts kill the process that asks for them, as too little memory would."""

    def train(self) -> Any:
        os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_dies_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"residual-qda on deadly: its process ended without an answer"):
        judge_in_subprocess("residual-qda", _Deadly("", "deadly", 200, recipe=SLOW))


def test_a_method_that_fails_is_named_and_costs_no_other_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judged(name: str, cell: ClassTask) -> Answer:
        if name == "residual-qda":
            raise InputError(f"{name} on {cell.title}: no")
        return judge(name, cell)

    monkeypatch.setattr(benchmark_module, "judge_in_subprocess", judged)
    store, plan = AnswerStore(tmp_path), Plan((class_task(SLOW, 50, 50),), ("residual-qda", "raw-logistic"))
    with pytest.raises(InputError, match=r"1 of 3 answers failed, the first: residual-qda on bench"):
        run_plan(plan, store)
    assert [store.find(unit) is not None for unit in units(plan)] == [True, False, True]


def test_answers_that_sizes_share_are_had_once() -> None:
    cells = make_tasks((SLOW,), rates_hz=(1e3, 1e4), **TWO_NOISES | {"train_sizes": (300, 100)})
    names = [unit.name for unit in units(Plan(cells, ("residual-qda", "posterior-network")))]
    # Neither the limit nor a network with a stream of its own depends on the given training starts.
    assert names.count(LIMIT) == names.count("posterior-network") == 4
    assert names.count("residual-qda") == 6


def test_answers_survive_and_damaged_ones_are_had_again(tmp_path: Path) -> None:
    answer, path = posterior(TASK), tmp_path / "answer.npz"
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
    arrays: dict[str, Any] = {"probabilities": answer.probabilities, "costs": np.ones(4)}
    for changed in ({"costs": np.float64(1.0)}, {"probabilities": np.zeros((4, 5))}, {"more": np.zeros(1)}):
        np.savez(path, allow_pickle=False, **arrays | changed)
        assert load_answer(path, TASK) is None
    np.savez(path, allow_pickle=False, **arrays)
    assert load_answer(path, TASK) is not None


def test_the_key_holds_all_that_an_answer_depends_on() -> None:
    other = load_recipe("bench", timing=Timing(2_000.0, 0.1))
    settings = ((SLOW, 301, 200), (SLOW, 300, 201), (SLOW, 300, 200, 1), (other, 300, 200))
    cells = [TASK, *(class_task(*setting) for setting in settings)]
    assert len({answer_key("residual-qda", cell) for cell in cells}) == len(cells)
    assert answer_key(LIMIT, cells[0]) == answer_key(LIMIT, cells[1])
    assert answer_key("network", TASK) != answer_key("residual-qda", TASK)


@pytest.mark.usefixtures("at_once")
def test_an_interrupted_sweep_goes_on_where_it_stopped(tmp_path: Path) -> None:
    plan = Plan(make_tasks((SLOW,), rates_hz=(), **TWO_NOISES), ("residual-qda",))
    third = units(plan)[2]

    def interrupt(unit: Unit, known: bool) -> None:
        if unit == third:
            raise KeyboardInterrupt

    def known(*, fresh: bool = False) -> list[bool]:
        asked: list[bool] = []
        results.append(
            run_plan(plan, AnswerStore(tmp_path, fresh=fresh), lambda _, is_known: asked.append(is_known))
        )
        return asked

    results: list[Any] = []
    with pytest.raises(KeyboardInterrupt):
        run_plan(plan, AnswerStore(tmp_path), interrupt)
    assert known() == [True, True, False, False]
    assert known() == [True] * 4
    assert known(fresh=True) == [False] * 4
    page = write_results(plan, results[0], tmp_path / "page").read_text()
    assert "Against the noise of the sensor" in page
    settings = page.split('id="settings"')[1].split("</tbody>")[0]
    assert settings.split("<tbody>")[1].count("<tr>") == 2
    assert len(json.loads((tmp_path / "page" / "results.json").read_text())) == 4


@pytest.mark.long
@pytest.mark.timeout(400)
@pytest.mark.parametrize("after_s", [0.0, 10.0], ids=["as its process begins", "in its training"])
def test_a_terminated_run_does_not_wait_for_its_method(tmp_path: Path, after_s: float) -> None:
    arguments = [*FAST, "--methods", "posterior-network", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "motor_classifiers", *arguments]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any("posterior-network on bench" in line for line in iter(process.stderr.readline, ""))
        time.sleep(after_s)
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        said = process.stderr.read()  # ends when no process holds the pipe
        assert process.wait(30.0) == 128 + signal.SIGTERM
        assert time.monotonic() - begin < 30.0
    assert said.endswith("motor-classifiers: interrupted\n")
    assert "Traceback" not in said


SMALL = class_task(load_recipe("bench", timing=Timing(1_000.0, 0.1)), 100, 60)
KEPT = Path(__file__).resolve().parents[3] / "benchmarks" / "results" / "peers.npz"


def written(folder: Path) -> Path:
    """A peer that calls every second start of `SMALL` healthy, and the others the next class."""
    found = np.full((60, 5), 0.125)
    found[::2, 0] = 0.5
    found[1::2] = 2.0 * np.eye(5)[1]
    costs = {"train_s": 1.5, "microseconds_per_transient": 200.0}
    told = costs | {"train_memory_mb": None, "inference_memory_mb": 3.0}
    facts = {"date": "2026-11-21", "machine": "one", "aeon": "1.6.0", "command": "test"}
    arrays = {
        "facts": np.array(json.dumps(facts | {"methods": {"quant": told}})),
        "quant": found.astype(np.float16),
    }
    np.savez(folder / "peers.npz", allow_pickle=False, **arrays, **identity(SMALL.train(), SMALL.starts()))
    return folder / "peers.npz"


def test_peers_are_scaled_to_probabilities_and_stand_in_the_table(tmp_path: Path) -> None:
    (result,) = run_plan(Plan((SMALL,), (), written(tmp_path)))
    got, expected = result.methods[0].answer, np.where(np.arange(60) % 2 == 0, 0, 1)
    assert got.probabilities[:2].tolist() == [[0.5, 0.125, 0.125, 0.125, 0.125], [0.0, 1.0, 0.0, 0.0, 0.0]]
    assert got.train == Cost(1.5, None)
    assert list(got.inference) == pytest.approx([0.012, 3.0])
    assert table_lines(result)[-1] == "quant: kept answers, 2026-11-21, one, aeon 1.6.0, test"
    row = result_rows([result])[1]
    assert (row["method"], row["family"], row["train_memory_mb"]) == ("quant", "peer", None)
    assert row["accuracy"] == pytest.approx((expected == SMALL.starts().class_index).mean())


def test_answers_to_other_starts_are_left_out(tmp_path: Path) -> None:
    recipe, path = SMALL.recipe, written(tmp_path)
    assert read_peers(path, class_task(recipe, 100, 50))  # the first of its starts
    faster = load_recipe("bench", timing=Timing(2_000.0, 0.1))
    for setting in ((recipe, 101, 60), (recipe, 100, 61), (recipe, 100, 60, 1), (faster, 100, 60)):
        assert read_peers(path, class_task(*setting)) == {}
    with pytest.raises(InputError, match="holds answers to other starts than those of this benchmark"):
        run_plan(Plan((class_task(recipe, 100, 60, seed=1),), (), path))


def test_poisoned_and_damaged_files_are_refused(tmp_path: Path) -> None:
    whole = written(tmp_path).read_bytes()
    np.savez(tmp_path / "poisoned.npz", facts=np.array([Poison(tmp_path / "mark")], dtype=object))
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    for name in ("poisoned", "cut", "none"):
        path = tmp_path / f"{name}.npz"
        refused(partial(read_peers, path, SMALL), path)
    assert not (tmp_path / "mark").exists()


def test_kept_answers_are_those_of_the_default_setting() -> None:
    usual = class_task(load_recipe("bench"))
    found = read_peers(KEPT, usual)
    truth = usual.starts().class_index
    accuracy = {name: (answer.decided == truth).mean() for name, answer in found.items()}
    # Measured before: QUANT 0.932, MiniRocket 0.817, MultiRocket-Hydra 0.828 on other starts of the recipe.
    assert accuracy == pytest.approx(dict(zip(PEERS, (0.935, 0.82, 0.83), strict=True)), abs=0.03)
    assert [name for name, answer in found.items() if answer.is_graded] == ["quant"]
