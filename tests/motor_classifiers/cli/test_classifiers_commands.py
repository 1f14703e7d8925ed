"""What the commands print and pass on: signs, percentages, exit statuses, and which methods are run."""

import json
from pathlib import Path
from typing import Any

import pytest
from made_results import RECIPE, TASK, answer, decisions, made_results

from motor_classifiers import METHODS, Prediction
from motor_classifiers.cli.main import main
from motor_classifiers.cli.sweep import numbers, plan_lines, require_writable, table_lines, whole_numbers
from motor_classifiers.cli.training import noise_factors
from motor_classifiers.estimators.methods import AT_WORK
from motor_classifiers.prediction import prediction_lines
from motor_classifiers.scoring.benchmark import AnswerStore, Plan, units
from motor_classifiers.scoring.judging import Cost

# Reaches in: made-up answers and costs fill a plan at once; defaults are the rooms' own.
from motor_classifiers.scoring.task import class_task
from motor_env import InputError, diagnose, load_recipe

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("options", "methods"),
    [
        ([], list(METHODS)),
        (["--methods", "network,threshold"], ["network", "threshold"]),
        (["--recipe", "operation"], list(AT_WORK)),
        (["--recipe", "operation,bench", "--methods", "rules"], ["rules"]),
    ],
)
def test_the_methods_that_are_named_are_run(
    options: list[str], methods: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--dry-run", "--json", "--out", str(tmp_path / "o"), *options]) == 0
    rows = json.loads(capsys.readouterr().out)
    named = list(dict.fromkeys(row["method"] for row in rows))
    assert [name for name in named if name != "limit"] == methods


def test_the_table_tells_how_far_below_the_limit() -> None:
    _, result = made_results(
        answer(decisions(slice(0, 10)))._replace(inference=Cost(0.006, 30.0)),
        threshold=answer(decisions(slice(0, 16))), network=answer(decisions(slice(0, 4))),
    )  # fmt: skip
    title, head, *rows = table_lines(result)
    assert title == TASK.title
    assert head.split() == [
        "method", "accuracy", "95", "%", "interval", "below", "limit", "winding", "bearing", "level", "us", "MB",
    ]  # fmt: skip
    assert [row[:14].strip() for row in rows] == ["Bayes limit", "network", "threshold"]
    limit, best, worst = (row[len("Bayes limit") :].replace("..", " ").split() for row in rows)
    assert (limit[0], limit[3], limit[-2:]) == ("0.8333", "0.0000", ["100.0", "30"])
    assert (best[0], best[3], best[-1]) == (
        "0.9333",
        "-0.1000",
        "50.0",
    )  # above it: below by less than nothing
    assert (worst[0], worst[3]) == ("0.7333", "0.1000")
    scores = result.methods[0].scores
    expected = (
        scores.accuracy.low, scores.accuracy.high, scores.winding.value, scores.bearing.value, scores.level.value
    )  # fmt: skip
    assert [*worst[1:3], *worst[4:7]] == [f"{value:.4f}" for value in expected]


def test_a_plan_tells_what_is_there_and_the_minutes_left() -> None:
    other = class_task(RECIPE, 200, 60)
    plan, store = Plan((TASK, other), ("threshold", "network")), AnswerStore()
    todo = units(plan)
    store.put(todo[1], answer(decisions(slice(0, 4))))
    left = sum(unit.seconds for unit in todo) - todo[1].seconds
    lines = plan_lines(plan, store, as_json=False)
    assert [line.split()[-5:] for line in lines[:2]] == [
        ["1", "of", "3", "answers", "there"],  # the limit, two methods
        ["0", "of", "2", "answers", "there"],
    ]
    assert lines[2] == f"2 settings, 5 answers, about {left / 60:.0f} minutes of one core to go"
    slow = class_task(load_recipe("field"), 100, 60)
    (*_, last) = plan_lines(Plan((slow,), ("posterior-network",)), AnswerStore(), as_json=False)
    assert last == "1 settings, 1 answers, about 10 minutes of one core to go"


SECOND = {
    "verdict": "bearing", "confidence": 0.97, "severity": 0.2, "severity_interval": [0.1, 0.304], "reasons": ["a", "b"],
}  # fmt: skip


@pytest.mark.parametrize(
    ("opinion", "words"),
    [
        (
            Prediction("bearing", "bearing_25", 0.875, 0.1825, severity_interval=(0.0512, 0.2988)),
            "bearing, probability 0.88, severity near 18 % (5 to 30)",
        ),
        (Prediction("winding", "w", 0.4, 0.25), "winding (undecided), probability 0.40, severity near 25 %"),
        (Prediction("healthy", "healthy", 0.93, 0.02), "healthy, probability 0.93"),
        (
            Prediction("healthy", "", 0.9, candidates=()),
            "healthy, probability 0.90, could be none of its classes",
        ),
        (
            Prediction("healthy", "", 0.99, candidates=("a", "b")),
            "healthy, probability 0.99, could be a or b",
        ),
        (
            Prediction("outside what I know", reason="most likely load: uncouple it"),
            "outside what I know: most likely load: uncouple it",
        ),
        (Prediction("unusable", reason="too short"), "no opinion: too short"),
    ],
)
def test_an_opinion_in_words(opinion: Prediction, words: str) -> None:
    first, second = prediction_lines(Path("x.csv"), [opinion], SECOND)
    assert first == f"x.csv: {words}"
    assert second == "  motor-env diagnose: bearing, confidence 0.97, severity near 20 % (10 to 30): a; b"
    bare = {
        "verdict": "unusable",
        "confidence": None,
        "severity": None,
        "severity_interval": None,
        "reasons": ["c"],
    }
    assert prediction_lines(Path("x.csv"), [opinion], bare)[1] == "  motor-env diagnose: unusable: c"
    half = SECOND | {"severity_interval": [None, 0.3]}
    assert "severity near 20 %: a; b" in prediction_lines(Path("x.csv"), [opinion], half)[1]


def test_opinions_on_a_data_set_are_counted() -> None:
    many = [Prediction("bearing")] * 2 + [Prediction("healthy")] * 3
    assert prediction_lines(Path("set"), many, None) == ["set: 5 cases: 3 healthy, 2 bearing"]


SCORED = {
    "task": "bench", "version": "2.0", "n_test": 80, "metric": "error rate, %", "value": 12.345, "low": 10.0,
    "high": 15.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("more", "lines"),
    [
        (
            {"limit": 5.0, "above_limit": 7.345, "above_limit_low": -1.25, "above_limit_high": 9.5},
            [
                "  the best possible on the same cases: 5.00",
                "  above it by 7.34 (-1.25 to 9.50, paired)",
            ],
        ),
        ({"bracket": [16.29, 16.97]}, ["  the best possible on average: between 16.29 and 16.97"]),
        ({}, ["  the best possible is not known"]),
    ],
)
def test_a_score_in_words(
    more: dict[str, Any],
    lines: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("motor_classifiers.scoring.frozen_tasks.read_answers", lambda path, task: None)
    monkeypatch.setattr(
        "motor_classifiers.scoring.frozen_tasks.score_answers", lambda task, said: SCORED | more
    )
    assert main(["score", "bench", "answers.csv"]) == 0
    head = ["task bench 2.0, 80 cases", f"  error rate, %: {12.345:.2f} (10.00 to 15.00)"]
    assert capsys.readouterr().out.splitlines() == [*head, *lines]
    assert main(["score", "bench", "answers.csv", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == SCORED | more


def test_options_with_several_numbers(tmp_path: Path) -> None:
    assert numbers("x", None) == ()
    assert numbers("x", "1,2.5") == (1.0, 2.5)
    assert whole_numbers("x", "3,1e3") == [3, 1000]
    with pytest.raises(InputError, match="whole numbers"):
        whole_numbers("x", "3,2.5")
    assert noise_factors("0.5,2", for_motor=True) == (0.5, 2.0)
    assert noise_factors(None, for_motor=True) == (0.15, 5.0)
    assert noise_factors(None, for_motor=False) is None
    for text in ("1", "1,2,3"):
        with pytest.raises(InputError, match="two factors"):
            noise_factors(text, for_motor=True)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file, not a folder"):
        require_writable(tmp_path / "file")
    require_writable(tmp_path / "new")
    assert list(tmp_path.rglob(".*")) == []


def test_predict_with_a_motor_file_has_the_diagnosis_of_motor_env(capsys: pytest.CaptureFixture[str]) -> None:
    examples = ROOT / "examples"
    capture, sheet = examples / "startup_capture.csv", examples / "motor.toml"
    assert main(["predict", str(capture), "--motor", str(sheet), "--json"]) == 1
    (said,) = json.loads(capsys.readouterr().out)
    found = diagnose(capture, sheet)
    assert said["model_based"]["severity"] == pytest.approx(found.severity)
    assert said["model_based"]["severity_interval"] == pytest.approx(list(found.severity_interval or ()))
