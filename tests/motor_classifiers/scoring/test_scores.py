"""Scores, comparisons, rows and plans on made answers: every number has an oracle of its own."""

import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_results import RECIPE, TASK, answer, decisions, made_results
from scipy.stats import binom
from sklearn.metrics import brier_score_loss, confusion_matrix, log_loss

from motor_classifiers.scoring import judging
from motor_classifiers.scoring.benchmark import Plan, make_tasks
from motor_classifiers.scoring.judging import Cost, expected_severity, in_recipe_order, with_cost
from motor_classifiers.scoring.metrics import (
    BIN_EDGES,
    calibration_scores,
    compare,
    confusion_matrices,
    level_distance,
    reliability,
    resampling_weights,
    root_mean_square,
    scores,
)
from motor_classifiers.scoring.results import as_csv, evaluation_lines, result_rows
from motor_classifiers.scoring.task import class_task, judged_cases

# Reaches in: a score is compared with the posterior below it.
from motor_datasets import generate_arrays
from motor_env import FaultKind, load_recipe
from motor_env.inference.work_features import work_probabilities
from motor_env.simulation.recipes import FaultClass


def identity(n: int) -> Any:
    """Weights whose rows each see one case: the "resamples" are then the values themselves."""
    return np.vstack([np.ones(n), np.eye(n)])


def test_intervals_are_the_middle_95_percent() -> None:
    """Of 41 values 0 .. 40 the quantiles 2.5 and 97.5 % are the second and the last but one."""
    got = root_mean_square(np.arange(41.0), identity(41))
    assert got == pytest.approx((np.sqrt(np.square(np.arange(41)).mean()), 1.0, 39.0))


def test_weights_are_draws_of_motors_with_replacement() -> None:
    weights = resampling_weights(6, 3)
    assert (weights[0] == 1.0).all()
    drawn = np.random.default_rng(3).multinomial(6, [1 / 6] * 6, size=2000)
    np.testing.assert_array_equal(weights[1:], drawn)
    grouped = resampling_weights(6, 3, groups=np.array([7, 7, 9, 9, 9, 2]))
    drawn = np.random.default_rng(3).multinomial(3, [1 / 3] * 3, size=2000)
    np.testing.assert_array_equal(grouped[1:], drawn[:, [1, 1, 2, 2, 2, 0]])


def test_scores_of_a_small_table_of_confusions() -> None:
    """Healthy, bearing 10 and 25, contact 10 and 25; eight cases by hand."""
    truth = np.array([0, 0, 1, 1, 2, 3, 4, 4])
    decided = np.array([0, 1, 1, 2, 3, 3, 0, 4])
    got = scores(RECIPE, truth, decided, resampling_weights(8, 0))
    expected = {
        "accuracy": 4 / 8, "false_alarm_rate": 1 / 2, "missed_detection_rate": 1 / 6,
        # 0 -> 10 %, 10 -> 25 %, 25 of one kind -> 10 of the other, 25 -> 0
        "level_error": (0.10 + 0.15 + 0.35 + 0.25) / 8, "winding": 0.5 * (2 / 3 + 4 / 5),
        "bearing": 0.5 * (2 / 3 + 4 / 5), "level": 3 / 4, "macro_f1": (0.5 + 0.5 + 0.0 + 2 / 3 + 2 / 3) / 5,
    }  # fmt: skip
    assert {name: getattr(got, name).value for name in expected} == pytest.approx(expected)
    assert [one.value for one in got.recall] == [0.5, 0.5, 0.0, 1.0, 0.5]
    np.testing.assert_array_equal(got.confusion, confusion_matrix(truth, decided))
    weight, back = np.arange(1.0, 9.0), slice(None, None, -1)  # each case keeps its own, whatever their order
    weighted = confusion_matrices(truth[back], decided[back], 5, weight[None])[0]
    oracle = confusion_matrix(truth[back], decided[back], sample_weight=weight)
    np.testing.assert_array_equal(weighted, oracle)
    assert level_distance(RECIPE)[2, 3] == pytest.approx(0.35)
    never = scores(RECIPE, truth[:2], decided[:2], resampling_weights(2, 0))
    assert np.isnan([never.missed_detection_rate.value, never.recall[4].value]).all()
    bearings = replace(RECIPE, classes=RECIPE.classes[:3])
    found = scores(bearings, truth[:5], truth[:5], resampling_weights(5, 0))
    assert np.isnan(found.winding.value)
    assert found.bearing.value == 1.0


def test_a_comparison_counts_wins() -> None:
    first, second = np.array([0.0, 0, 0, 1, 1]), np.array([0.0, 1, 1, 0, 1])
    got = compare(TASK, first, second, identity(5))
    assert (got.only_first, got.only_second) == (2, 1)
    assert got.p_above == pytest.approx(4 / 8)  # two or three heads of three
    assert got.difference == pytest.approx((-20.0, -100.0, 90.0))
    assert compare(TASK, second, second, identity(5)).p_above == 1.0
    assert compare(TASK, np.array([1.0, 0.0]), np.zeros(2), identity(2)).p_above == 1.0


def test_calibration_against_scikit_learn_and_on_the_edges() -> None:
    rng = np.random.default_rng(4)
    told, truth = rng.dirichlet(np.ones(3), size=50), rng.integers(3, size=50)
    got = calibration_scores(told, truth)
    assert got.log_loss == pytest.approx(log_loss(truth, told))
    happened = np.eye(3)[truth]
    assert got.brier == pytest.approx(sum(brier_score_loss(happened[:, n], told[:, n]) for n in range(3)))
    sure, right = told.max(axis=1), told.argmax(axis=1) == truth
    bins = np.ceil(15.0 * sure).astype(int)  # fifteen bins, closed above
    gaps = [
        abs(right[bins == n].mean() - sure[bins == n].mean()) * (bins == n).sum() for n in np.unique(bins)
    ]
    assert got.ece == pytest.approx(sum(gaps) / 50)
    edges = BIN_EDGES[[9, 12, 15]]
    edge = reliability(np.column_stack([edges, 1.0 - edges]), [0, 0, 0])
    assert np.flatnonzero(edge.n_cases).tolist() == [8, 11, 14]
    lost = calibration_scores(np.array([[1.0, 0.0]]), [1])
    assert lost.log_loss == pytest.approx(15.0 * np.log(10.0))
    assert (lost.accuracy, lost.ece, lost.brier) == (0.0, 1.0, 2.0)


def test_rows_of_a_run_on_made_answers() -> None:
    limit, worse = answer(decisions(slice(0, 10)), 0.8125), answer(decisions(slice(5, 21)))
    _, result = made_results(limit, threshold=worse, residual_qda=answer(decisions(slice(2, 12)), 1.0))
    rows = result_rows([result])
    assert [row["method"] for row in rows] == ["Bayes limit", "threshold", "residual-qda"]
    assert [row["family"] for row in rows] == ["limit", "threshold", "scikit-learn"]
    _, second, third = rows
    severity = worse.probabilities @ np.array([0.0, 0.1, 0.25, 0.1, 0.25])
    expected = {
        "accuracy": 44 / 60, "bayes_accuracy": 50 / 60, "below_bayes": 6 / 60, "only_method_right": 5,
        "only_bayes_right": 11, "p_above_bayes": binom.sf(4, 16, 0.5), "bayes_expected_accuracy": 0.8125,
        "train_s": 1.5, "train_memory_mb": 20.0, "microseconds_per_transient": 0.003 / 60 * 1e6,
        "log_loss": -(44 * np.log(0.75) + 16 * np.log(0.0625)) / 60, "ece": 0.75 - 44 / 60,
        "severity_rmse": np.sqrt(np.square(severity - TASK.starts().severity).mean()),
    }  # fmt: skip
    assert {name: second[name] for name in expected} == pytest.approx(expected)
    assert (second["inference_memory_mb"], second["origin"]) == (None, "this run")
    difference = result.methods[0].against_limit.difference
    assert difference == pytest.approx([100.0 * second[f"below_bayes{end}"] for end in ("", "_low", "_high")])
    assert second["below_bayes_low"] < second["below_bayes"] < second["below_bayes_high"]
    assert third["log_loss"] is None  # it decides and grades nothing
    assert result.leaks == ()
    assert [one.name for one in result.ranked()] == ["residual-qda", "threshold"]
    between = result.difference(*reversed(result.methods))
    assert (between.only_first, between.only_second) == (9, 3)
    (flat, *_) = csv.DictReader(io.StringIO(as_csv([second])))
    assert float(flat["below_bayes"]) == second["below_bayes"]
    assert not {"recall", "confusion", "channels"} & set(flat)


@pytest.mark.parametrize(
    ("wins", "losses", "n_methods", "leaks"),
    [(23, 9, 1, False), (29, 13, 1, True), (7, 0, 2, False), (8, 0, 2, True), (6, 0, 1, False)],
)
def test_a_leak_is_one_in_a_hundred_shared_among_the_comparisons(
    wins: int, losses: int, n_methods: int, leaks: bool
) -> None:
    """Of the sign test: 23 of 32 have p = 0.01003, 29 of 42 have 0.0098, 7 of 7 have 0.0078."""
    limit = answer(decisions(slice(0, wins)))
    better = answer(decisions(slice(wins, wins + losses)))
    _, result = made_results(limit, **dict.fromkeys(("threshold", "network")[:n_methods], better))
    assert ("threshold" in result.leaks) is leaks


def test_settings_say_what_they_are() -> None:
    assert TASK.title == "bench, 1 kHz, 20 mA, 100 training starts"
    assert TASK.setting() == {
        "recipe": "bench", "sampling_rate_hz": 1000.0, "duration_s": 0.1, "noise_a": 0.02, "channels": ["current"],
        "n_train": 100, "n_test": 60, "seed": 0,
    }  # fmt: skip
    assert class_task(RECIPE, 50, 50).n_test == 50
    for numbers in ((49, 50), (50, 49)):
        with pytest.raises(ValueError, match="must be >= 50, got 49"):
            class_task(RECIPE, *numbers)
    assert TASK.starts().case_id.tolist() == list(range(10**9, 10**9 + 60))
    assert TASK.train().case_id.tolist() == list(range(100))


@pytest.mark.parametrize(("starts", "healthy"), [(1, 0), (5, 3), (4, 1), (2, 0)])
def test_judged_starts_are_those_after_the_commissioning(starts: int, healthy: int) -> None:
    recipe = replace(RECIPE, starts_per_motor=starts, healthy_starts=healthy)
    for first, count in ((0, 7), (11, 4), (20, 1)):
        numbers = -(-first // starts) * starts + np.arange(100)  # from the first whole motor
        expected = numbers[numbers % starts >= healthy][:count]
        assert judged_cases(recipe, first, count).tolist() == expected.tolist()


def test_columns_come_in_the_order_of_the_recipe() -> None:
    class Model:
        classes_ = np.array(["bearing_25", "healthy"])

    ordered = in_recipe_order(Model(), np.array([[0.3, 0.7]]), RECIPE)
    assert ordered.tolist() == [[0.7, 0.0, 0.3, 0.0, 0.0]]
    assert expected_severity(RECIPE, ordered).tolist() == pytest.approx([0.3 * 0.25])
    joint = FaultClass(FaultKind.BEARING, 0.1, also=(FaultClass(FaultKind.WINDING_CONTACT, 0.25),))
    both = replace(RECIPE, classes=(FaultClass(), joint))
    assert expected_severity(both, np.array([[0.5, 0.5]])).tolist() == pytest.approx([0.175])
    assert [answer(np.zeros(4, dtype=np.int64), sure).is_graded for sure in (1.0, 0.5)] == [False, True]


@pytest.mark.parametrize(
    ("rates_hz", "noises_a", "settings"),
    [
        ((), (), [(1e3, 0.02, 200), (1e3, 0.02, 100)]),
        ((1e3,), (0.1, 0.02), [(1e3, 0.1, 200), (1e3, 0.02, 200), (1e3, 0.02, 100)]),
        ((1e3,), (0.1, 0.05), [(1e3, 0.1, 200), (1e3, 0.1, 100), (1e3, 0.05, 200)]),
    ],
)
def test_a_sweep_tries_sizes_at_the_usual_noise(rates_hz: Any, noises_a: Any, settings: Any) -> None:
    sweep: dict[str, Any] = {"rates_hz": rates_hz, "noises_a": noises_a, "n_test": 60, "seed": 0}
    cells = make_tasks([RECIPE], train_sizes=[200, 100], **sweep)
    told = [(c.recipe.timing.sampling_rate_hz, c.recipe.sensor.current_noise_a, c.n_train) for c in cells]
    assert told == settings


def test_the_reference_of_a_plan_is_nearest_to_the_usual_setting() -> None:
    sweep: dict[str, Any] = {"rates_hz": (1e3, 1e4), "noises_a": (0.1, 0.02), "n_test": 60, "seed": 0}
    plan = Plan(make_tasks([RECIPE], train_sizes=[200], **sweep), ("threshold", "posterior-network"))
    assert (plan.reference, plan.n_comparisons) == (3, 8)  # 10 kHz and 20 mA


def test_costs_are_those_of_the_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Peaks from /proc in units of 1,024 bytes, told in millions of bytes."""
    monkeypatch.setattr(judging, "_PROCESS", tmp_path)
    clock = iter([2.0, 5.5, 2.0, 2.5])
    monkeypatch.setattr("time.process_time", lambda: next(clock))

    def work(kilobytes: int = 4000) -> str:
        (tmp_path / "status").write_text(f"Name:\tx\nVmHWM:\t{kilobytes} kB\nVmRSS:\t1 kB\n")
        return "done"

    work(1000)
    done, cost = with_cost(work)
    assert done == "done"
    assert list(cost) == pytest.approx([3.5, 3.072])
    assert (tmp_path / "clear_refs").read_text() == "5"
    monkeypatch.setattr(judging, "_PROCESS", tmp_path / "none")
    assert with_cost(lambda: 1) == (1, Cost(0.5, None))


def test_lines_of_an_evaluation() -> None:
    """The limit's accuracy minus the model's, in points; shares with four digits."""
    _, result = made_results(answer(decisions(slice(0, 10))), threshold=answer(decisions(slice(5, 21))))
    row = result_rows([result])[1] | {"winding": None, "below_bayes": 0.0325, "below_bayes_low": -0.00004}
    lines = evaluation_lines(RECIPE, row | {"accuracy_low": 0.25, "accuracy_high": 0.75})
    assert lines[0] == "  accuracy                0.7333   0.2500 to 0.7500"
    assert not any(line.startswith("  winding ") for line in lines)
    assert "  Bayes limit accuracy    0.8333   on the same cases" in lines
    (below,) = [line for line in lines if "below it by 3.25 percentage points (0.00 to " in line]
    assert "only the model is right on 5 cases, only the limit on 11; one-sided p 0.962" in below
    assert lines[-6].split() == ["1", "2", "3", "4", "5"]
    assert [line.split() for line in lines[-5:]] == [
        [str(n + 1), name, *map(str, counts)]
        for n, (name, counts) in enumerate(zip(RECIPE.class_names, row["confusion"], strict=True))
    ]
    assert "its estimate accuracy" in str(evaluation_lines(RECIPE, row | {"bayes_is_estimate": True}))


def test_motors_at_work_have_the_posterior_around_their_fit() -> None:
    recipe = load_recipe("operation")
    X = generate_arrays(recipe, 1, 3).X
    expected = work_probabilities(recipe, X.astype(np.float64))
    np.testing.assert_array_equal(class_task(recipe).best(X), expected)
