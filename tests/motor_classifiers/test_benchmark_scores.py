"""Scores against scikit-learn's and by hand, the check against the limit, and the commands."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest
from sklearn.metrics import accuracy_score, confusion_matrix, f1_score, recall_score

from motor_classifiers import benchmark as benchmark_module
from motor_classifiers.cli import main
from motor_classifiers.metrics import compare, level_distance, resampling_weights, scores
from motor_classifiers.networks import NetworkClassifier
from motor_datasets.generate import generate_arrays
from motor_env.posterior import class_probabilities
from motor_env.recipes import named_recipe
from motor_env.simulation import Timing

RECIPE = named_recipe("bench", timing=Timing(1_000.0, 0.1))
FAST = ["benchmark", "--sampling-rate-hz", "1000", "--n-train", "300", "--n-test", "200"]


def test_scores_agree_with_scikit_learn() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 5, 500)
    decided = np.where(rng.random(500) < 0.7, truth, rng.integers(0, 5, 500))
    found = scores(RECIPE, truth, decided, resampling_weights(500, 1, 200))
    assert found.accuracy.value == pytest.approx(accuracy_score(truth, decided))
    assert found.macro_f1.value == pytest.approx(f1_score(truth, decided, average="macro"))
    assert [r.value for r in found.recall] == pytest.approx(recall_score(truth, decided, average=None))
    np.testing.assert_array_equal(found.confusion, confusion_matrix(truth, decided))
    assert found.false_alarm_rate.value == pytest.approx((decided[truth == 0] != 0).mean())
    assert found.missed_detection_rate.value == pytest.approx((decided[truth != 0] == 0).mean())


def test_bootstrap_interval_is_that_of_the_binomial() -> None:
    truth = np.zeros(1000, dtype=np.int64)
    decided = (np.arange(1000) < 200).astype(np.int64)
    found = scores(RECIPE, truth, decided, resampling_weights(1000, 3)).accuracy
    deviation = np.sqrt(0.8 * 0.2 / 1000)
    assert (found.low, found.high) == pytest.approx(
        (0.8 - 1.96 * deviation, 0.8 + 1.96 * deviation), abs=0.003
    )


def test_a_wrong_kind_costs_both_severities() -> None:
    names = RECIPE.class_names
    distance = level_distance(RECIPE)
    assert distance[names.index("bearing_10"), names.index("bearing_25")] == pytest.approx(0.15)
    assert distance[names.index("bearing_10"), names.index("winding_contact_25")] == pytest.approx(0.35)
    assert distance[0, 0] == 0.0


def test_comparison_is_the_exact_sign_test() -> None:
    first = np.array([True] * 30 + [False] * 10 + [True] * 60)
    second = np.array([False] * 30 + [True] * 10 + [True] * 60)
    found = compare(first, second, resampling_weights(100, 0, 100))
    assert (found.only_first, found.only_second) == (30, 10)
    assert found.p_above == pytest.approx(binomtest(30, 40, alternative="greater").pvalue)
    assert found.difference.value == pytest.approx(0.2)


def test_the_network_repeats_itself_to_the_bit_and_learns() -> None:
    train, test = generate_arrays(RECIPE, 1, 400), generate_arrays(RECIPE, 2, 400)
    first, second = (
        NetworkClassifier(RECIPE, random_state=3).fit(train.X, train.class_name) for _ in range(2)
    )
    np.testing.assert_array_equal(first.predict_proba(test.X), second.predict_proba(test.X))
    assert first.score(test.X, test.class_name) > 0.65  # the limit at 1 kHz is 0.80


def test_benchmark_writes_a_page_that_needs_nothing_else(tmp_path: Path) -> None:
    methods = ["threshold", "residual-qda", "network"]
    assert main([*FAST, "--methods", ",".join(methods), "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "results.json").read_text())
    assert [row["method"] for row in rows] == methods
    for row in rows:
        assert row["accuracy_low"] <= row["accuracy"] <= row["accuracy_high"]
        assert (row["recipe"], row["sampling_rate_hz"], row["noise_a"]) == ("bench", 1000.0, 0.02)
        assert 0.7 < row["bayes_accuracy"] < 0.9
        assert row["accuracy"] < row["bayes_accuracy"] + 0.05
    page = (tmp_path / "report.html").read_text()
    assert not re.search(r"(?:src|href)\s*=|@import|url\(|https?://", page)
    assert page.count("<svg") >= 1 + 3 + 15


def test_a_method_above_the_limit_fails_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The limit is made worse here, so that an honest method stands above it."""
    monkeypatch.setattr(
        benchmark_module,
        "class_probabilities",
        lambda recipe, X: np.roll(class_probabilities(recipe, X), 1, axis=1),
    )
    assert main([*FAST, "--methods", "residual-qda", "--out", str(tmp_path)]) == 1
    assert "residual-qda scored above the Bayes limit" in capsys.readouterr().err
    assert "Failing check: residual-qda" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    "arguments",
    [
        ["benchmark", "--methods", "none"],
        ["benchmark", "--recipe", "none"],
        ["benchmark", "--n-train", "3"],
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
