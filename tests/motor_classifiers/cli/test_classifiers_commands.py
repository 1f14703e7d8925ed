"""What the commands print, pass on and refuse: signs, percentages, exit statuses, and which methods are run."""

import json
from pathlib import Path
from typing import Any

import pytest
from made_results import RECIPE, TASK, answer, decisions, made_results
from saved_models import content

from motor_classifiers import METHODS, Prediction
from motor_classifiers.cli.main import main
from motor_classifiers.cli.sweep import numbers, plan_lines, table_lines, whole_numbers
from motor_classifiers.cli.training import noise_factors
from motor_classifiers.estimators.methods import AT_WORK
from motor_classifiers.prediction import prediction_lines
from motor_classifiers.scoring.benchmark import AnswerStore, Plan, units
from motor_classifiers.scoring.judging import Cost

# Reaches in: made-up answers and costs fill a plan at once; defaults are the rooms' own.
from motor_classifiers.scoring.task import class_task
from motor_env import InputError


@pytest.mark.parametrize(
    ("options", "methods"),
    [
        ("", list(METHODS)),
        ("--methods network,threshold", ["network", "threshold"]),
        ("--recipe operation", list(AT_WORK)),
        ("--recipe operation,bench --methods rules", ["rules"]),
    ],
)
def test_the_methods_that_are_named_are_run(
    options: str, methods: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--dry-run", "--json", "--out", str(tmp_path / "o"), *options.split()]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [name for name in dict.fromkeys(row["method"] for row in rows) if name != "limit"] == methods
    assert not any(row["done"] for row in rows)
    assert all(row["about_s"] > 0.0 for row in rows)
    assert not list(tmp_path.iterdir())


def test_the_table_tells_how_far_below_the_limit() -> None:
    _, result = made_results(
        answer(decisions(slice(0, 10)))._replace(inference=Cost(0.006, 30.0)),
        threshold=answer(decisions(slice(0, 16))), network=answer(decisions(slice(0, 4))),
    )  # fmt: skip
    title, head, *rows = table_lines(result)
    assert title == TASK.title
    assert " ".join(head.split()) == "method accuracy 95 % interval below limit winding bearing level us MB"
    assert [row[:14].strip() for row in rows] == ["Bayes limit", "network", "threshold"]
    limit, best, worst = (row[len("Bayes limit") :].replace("..", " ").split() for row in rows)
    assert (limit[0], limit[3], limit[-2:]) == ("0.8333", "0.0000", ["100.0", "30"])
    # Above it: below by less than nothing.
    assert (best[0], best[3], best[-1]) == ("0.9333", "-0.1000", "50.0")
    assert (worst[0], worst[3]) == ("0.7333", "0.1000")
    of = result.methods[0].scores
    expected = (of.accuracy.low, of.accuracy.high, of.winding.value, of.bearing.value, of.level.value)
    assert [*worst[1:3], *worst[4:7]] == [f"{value:.4f}" for value in expected]


def test_a_plan_tells_what_is_there_and_the_minutes_left() -> None:
    plan = Plan((TASK, class_task(RECIPE, 200, 60)), ("threshold", "network"))
    store, todo = AnswerStore(), units(plan)
    store.put(todo[1], answer(decisions(slice(0, 4))))
    left = sum(unit.seconds for unit in todo) - todo[1].seconds
    *lines, last = plan_lines(plan, store, as_json=False)
    told = [" ".join(line.split()[-5:]) for line in lines]
    assert told == ["1 of 3 answers there", "0 of 2 answers there"]  # the limit, two methods
    assert last == f"2 settings, 5 answers, about {left / 60:.0f} minutes of one core to go"


SECOND: dict[str, Any] = {
    "verdict": "bearing", "confidence": 0.97, "severity": 0.2, "severity_interval": [0.1, 0.304], "reasons": ["a", "b"],
}  # fmt: skip
BEARING = Prediction("bearing", "bearing_25", 0.875, 0.1825, severity_interval=(0.0512, 0.2988))


@pytest.mark.parametrize(
    ("opinion", "words"),
    [
        (BEARING, "bearing, probability 0.88, severity near 18 % (5 to 30)"),
        (Prediction("winding", "w", 0.4, 0.25), "winding (undecided), probability 0.40, severity near 25 %"),
        (Prediction("healthy", "", 0.93, 0.02), "healthy, probability 0.93"),
        (
            Prediction("healthy", "", 0.9, candidates=()),
            "healthy, probability 0.90, could be none of its classes",
        ),
        (
            Prediction("healthy", "", 0.99, candidates=("a", "b")),
            "healthy, probability 0.99, could be a or b",
        ),
        (Prediction("outside what I know", reason="likely load"), "outside what I know: likely load"),
        (Prediction("unusable", reason="too short"), "no opinion: too short"),
    ],
)
def test_an_opinion_in_words(opinion: Prediction, words: str) -> None:
    assert prediction_lines(Path("x"), [opinion], SECOND)[0] == f"x: {words}"


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (SECOND, "bearing, confidence 0.97, severity near 20 % (10 to 30): a; b"),
        (SECOND | {"severity_interval": [None, 0.3]}, "bearing, confidence 0.97, severity near 20 %: a; b"),
        (dict.fromkeys(SECOND) | {"verdict": "unusable", "reasons": ["c"]}, "unusable: c"),
    ],
)
def test_a_diagnosis_in_words(second: dict[str, Any], words: str) -> None:
    assert prediction_lines(Path("x"), [BEARING], second)[1] == f"  motor-env diagnose: {words}"


def test_opinions_on_a_data_set_are_counted() -> None:
    many = [BEARING] * 2 + [Prediction("healthy")] * 3
    assert prediction_lines(Path("set"), many, None) == ["set: 5 cases: 3 healthy, 2 bearing"]


def test_options_with_several_numbers() -> None:
    assert [numbers("x", text) for text in (None, "1,2.5")] == [(), (1.0, 2.5)]
    assert whole_numbers("x", "3,1e3") == [3, 1000]
    with pytest.raises(InputError, match="whole numbers"):
        whole_numbers("x", "3,2.5")
    told = [
        noise_factors(text, for_motor=is_motor)
        for text, is_motor in (("0.5,2", True), (None, True), (None, False))
    ]
    assert told == [(0.5, 2.0), (0.15, 5.0), None]
    with pytest.raises(InputError, match="two factors"):
        noise_factors("1,2,3", for_motor=True)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("benchmark --methods none", "none"),
        ("benchmark --recipe none", "none"),
        ("benchmark --n-train 3", "must be >= 50, got 3"),
        ("benchmark --n-train 300,300", "must not name a value twice"),
        ("benchmark --sampling-rate-hz fast", "fast"),
        ("benchmark --peers none.npz", "none.npz"),
        ("predict none.csv --model none", "none"),
        ("train none --out x", "none"),
        ("train --out x", "give one of a data set, --motor and --recipe"),
        ("train --motor paper --out x", "gives no nominal_voltage_v; say --voltage"),
        ("train --motor none.toml --out x", "no such motor file"),
        ("train --recipe bench --noise-range 2,1 --out x", "noise_range must be 0 < low < high"),
        ("train --recipe bench-full --noise-range 1,2 --out x", "they look the same"),
        ("train --recipe bench --method residual-qda --out x", "learns from a data set"),
        ("train --recipe bench --current-noise-a -1 --out x", "current_noise_a must be"),
        ("export qda.model -o a.onnx", "only a posterior-network becomes an ONNX graph"),
        ("export none.model -o a.onnx", "no such file"),
        ("export -o there.onnx", "exists already"),
    ],
)
def test_wrong_use_is_one_sentence(
    command: str,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "qda.model").write_bytes(content("residual-qda"))
    (tmp_path / "there.onnx").touch()
    capsys.readouterr()  # that something was compiled
    assert main(command.split()) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"qda.model", "there.onnx"}
