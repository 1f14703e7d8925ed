"""Scores, comparisons, plans and keys on made answers and by hand: every number of a row has its own oracle."""

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
from trust_figures import scored_severities, set_figures

from motor_classifiers.scoring import judging
from motor_classifiers.scoring.benchmark import Plan, make_tasks, unit_of, units
from motor_classifiers.scoring.frozen_tasks import UNKNOWN_FAULTS, foreign_starts
from motor_classifiers.scoring.judging import LIMIT, Cost, expected_severity, in_recipe_order, with_cost
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

# Reaches in: stand-ins for models answer in the types of real ones; a score is compared with the posterior below it.
from motor_env import FaultKind, load_recipe
from motor_env.simulation.recipes import FACTORS, FaultClass, Spread


def identity(values: list[float]) -> Any:
    """Weights whose rows each see one case: the "resamples" are then the given values."""
    return np.vstack([np.ones(len(values)), np.eye(len(values))])


def test_intervals_are_the_middle_95_percent() -> None:
    """Of 41 values 0 .. 40 the quantiles 2.5 and 97.5 % are the second and the last but one."""
    got = root_mean_square(np.arange(41.0), identity(list(range(41))))
    assert (got.value, got.low, got.high) == pytest.approx(
        (np.sqrt(np.square(np.arange(41)).mean()), 1.0, 39.0)
    )


def test_weights_are_draws_of_motors_with_replacement() -> None:
    weights = resampling_weights(6, 3)
    assert weights.shape == (2001, 6)
    assert (weights[0] == 1.0).all()
    assert (weights.sum(axis=1) == 6.0).all()
    np.testing.assert_array_equal(
        weights[1:], np.random.default_rng(3).multinomial(6, [1 / 6] * 6, size=2000)
    )
    grouped = resampling_weights(6, 3, groups=np.array([7, 7, 9, 9, 9, 2]))
    drawn = np.random.default_rng(3).multinomial(3, [1 / 3] * 3, size=2000)
    np.testing.assert_array_equal(grouped[1:], drawn[:, [1, 1, 2, 2, 2, 0]])


def test_scores_of_a_small_table_of_confusions() -> None:
    """Healthy, bearing 10 and 25, contact 10 and 25; eight cases by hand."""
    truth = np.array([0, 0, 1, 1, 2, 3, 4, 4])
    decided = np.array([0, 1, 1, 2, 3, 3, 0, 4])
    got = scores(RECIPE, truth, decided, resampling_weights(8, 0))
    assert got.accuracy.value == 4 / 8
    assert got.false_alarm_rate.value == 1 / 2
    assert got.missed_detection_rate.value == 1 / 6
    # 0 -> 10 %, 10 -> 25 %, 25 of one kind -> 10 of the other, 25 -> 0
    assert got.level_error.value == pytest.approx((0.10 + 0.15 + 0.35 + 0.25) / 8)
    assert got.winding.value == pytest.approx(0.5 * (2 / 3 + 4 / 5))
    assert got.bearing.value == pytest.approx(0.5 * (2 / 3 + 4 / 5))
    assert got.level.value == pytest.approx(3 / 4)
    assert [one.value for one in got.recall] == [0.5, 0.5, 0.0, 1.0, 0.5]
    assert got.macro_f1.value == pytest.approx((0.5 + 0.5 + 0.0 + 2 / 3 + 2 / 3) / 5)
    np.testing.assert_array_equal(got.confusion, confusion_matrix(truth, decided))
    weight, back = np.arange(1.0, 9.0), slice(None, None, -1)  # each case keeps its own, whatever their order
    weighted = confusion_matrices(truth[back], decided[back], 5, weight[None])[0]
    expected = confusion_matrix(truth[back], decided[back], sample_weight=weight)
    np.testing.assert_array_equal(weighted, expected)
    assert level_distance(RECIPE)[2, 3] == pytest.approx(0.35)
    never = scores(RECIPE, truth[:2], decided[:2], resampling_weights(2, 0))
    assert np.isnan(never.missed_detection_rate.value)
    assert np.isnan(never.recall[4].value)


def test_a_recipe_without_windings_has_no_winding_score() -> None:
    bearings = replace(RECIPE, classes=RECIPE.classes[:3])
    truth = np.arange(90) % 3
    found = scores(bearings, truth, truth, resampling_weights(90, 0))
    assert np.isnan(found.winding.value)
    assert found.bearing.value == 1.0


def test_a_comparison_counts_wins() -> None:
    first, second = np.array([0.0, 0, 0, 1, 1]), np.array([0.0, 1, 1, 0, 1])
    got = compare(TASK, first, second, identity([0.0] * 5))
    assert (got.only_first, got.only_second) == (2, 1)
    assert got.p_above == pytest.approx(4 / 8)  # two or three heads of three
    assert got.difference.value == pytest.approx(-20.0)
    assert (got.difference.low, got.difference.high) == pytest.approx((-100.0, 90.0))
    assert compare(TASK, second, second, identity([0.0] * 5)).p_above == 1.0
    assert compare(TASK, np.array([1.0, 0.0]), np.zeros(2), identity([0.0] * 2)).p_above == 1.0


def test_calibration_against_scikit_learn_and_on_the_edges() -> None:
    rng = np.random.default_rng(4)
    told, truth = rng.dirichlet(np.ones(3), size=50), rng.integers(3, size=50)
    got = calibration_scores(told, truth)
    assert got.log_loss == pytest.approx(log_loss(truth, told))
    happened = np.eye(3)[truth]
    by_class = [brier_score_loss(happened[:, n], told[:, n]) for n in range(3)]
    assert got.brier == pytest.approx(sum(by_class))
    sure = told.max(axis=1)
    bins = np.ceil(15.0 * sure).astype(int)  # fifteen bins, closed above
    gaps = [
        abs((told.argmax(axis=1) == truth)[bins == n].mean() - sure[bins == n].mean()) * (bins == n).sum()
        for n in np.unique(bins)
    ]
    assert got.ece == pytest.approx(sum(gaps) / 50)
    edges = BIN_EDGES[[9, 12, 15]]
    edge = reliability(np.column_stack([edges, 1.0 - edges]), [0, 0, 0])
    assert np.flatnonzero(edge.n_cases).tolist() == [8, 11, 14]
    lost = calibration_scores(np.array([[1.0, 0.0]]), [1])
    assert lost.log_loss == pytest.approx(15.0 * np.log(10.0))
    assert (lost.accuracy, lost.ece, lost.brier) == (0.0, 1.0, 2.0)


def test_severities_are_scored() -> None:
    got = scored_severities(  # a handful of severities hold its two figures exactly
        np.array([0.1, 0.2, 0.3, 0.0]), np.array([[0.0, 0.2], [0.1, 0.2], [0.1, 0.2], [0.0, 0.1]]),
        np.array([0.2, 0.2, 0.1, 0.2]),
    )  # fmt: skip
    assert got == pytest.approx({"rmse": np.sqrt((0.01 + 0.0 + 0.04 + 0.04) / 4), "coverage": 0.75})


def test_rows_of_a_run_on_made_answers() -> None:
    limit, worse = answer(decisions(slice(0, 10)), 0.8125), answer(decisions(slice(5, 21)))
    _, result = made_results(limit, threshold=worse, residual_qda=answer(decisions(slice(2, 12)), 1.0))
    first, second, third = result_rows([result])
    assert [row["method"] for row in (first, second, third)] == ["Bayes limit", "threshold", "residual-qda"]
    assert [row["family"] for row in (first, second, third)] == ["limit", "threshold", "scikit-learn"]
    assert (second["accuracy"], second["bayes_accuracy"]) == pytest.approx((44 / 60, 50 / 60))
    assert second["below_bayes"] == pytest.approx(6 / 60)
    assert second["below_bayes_low"] < second["below_bayes"] < second["below_bayes_high"]
    difference = result.methods[0].against_limit.difference
    assert difference == pytest.approx([100.0 * second[f"below_bayes{end}"] for end in ("", "_low", "_high")])
    assert (second["only_method_right"], second["only_bayes_right"]) == (5, 11)
    assert second["p_above_bayes"] == pytest.approx(binom.sf(4, 16, 0.5))
    assert second["bayes_expected_accuracy"] == pytest.approx(0.8125)
    assert (second["train_s"], second["train_memory_mb"], second["inference_memory_mb"]) == (1.5, 20.0, None)
    assert second["microseconds_per_transient"] == pytest.approx(0.003 / 60 * 1e6)
    assert second["log_loss"] == pytest.approx(-(44 * np.log(0.75) + 16 * np.log(0.0625)) / 60)
    assert second["ece"] == pytest.approx(0.75 - 44 / 60)
    assert third["log_loss"] is None  # it decides and grades nothing
    test = TASK.starts()
    levels = np.array([0.0, 0.1, 0.25, 0.1, 0.25])
    severity = worse.probabilities @ levels
    assert second["severity_rmse"] == pytest.approx(np.sqrt(np.square(severity - test.severity).mean()))
    assert second["origin"] == "this run"
    assert result.leaks == ()
    assert [one.name for one in result.ranked()] == ["residual-qda", "threshold"]
    between = result.difference(*reversed(result.methods))
    assert (between.only_first, between.only_second) == (9, 3)
    (flat, *_) = csv.DictReader(io.StringIO(as_csv([second])))
    assert float(flat["below_bayes"]) == second["below_bayes"]
    assert not {"recall", "confusion", "channels"} & set(flat)


@pytest.mark.parametrize(
    ("wins", "losses", "n_methods", "leaks"),
    [
        (23, 9, 1, False),
        (29, 13, 1, True),
        (7, 0, 1, True),
        (7, 0, 2, False),
        (8, 0, 2, True),
        (6, 0, 1, False),
    ],
)
def test_a_leak_is_one_in_a_hundred_shared_among_the_comparisons(
    wins: int, losses: int, n_methods: int, leaks: bool
) -> None:
    """Of the sign test: 23 of 32 have p = 0.01003, 29 of 42 have 0.0098, 7 of 7 have 0.0078."""
    limit = answer(decisions(slice(0, wins)))
    better = answer(decisions(slice(wins, wins + losses)))
    names = ("threshold", "network")[:n_methods]
    _, result = made_results(limit, **dict.fromkeys(names, better))
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
        begin = -(-first // starts) * starts  # of the first whole motor
        numbers = np.arange(begin, begin + 100)
        assert (
            judged_cases(recipe, first, count).tolist()
            == numbers[numbers % starts >= healthy][:count].tolist()
        )


def test_columns_come_in_the_order_of_the_recipe() -> None:
    class Model:
        classes_ = np.array(["bearing_25", "healthy"])

    ordered = in_recipe_order(Model(), np.array([[0.3, 0.7]]), RECIPE)
    assert ordered.tolist() == [[0.7, 0.0, 0.3, 0.0, 0.0]]
    assert expected_severity(RECIPE, ordered).tolist() == pytest.approx([0.3 * 0.25])
    joint = FaultClass(FaultKind.BEARING, 0.1, also=(FaultClass(FaultKind.WINDING_CONTACT, 0.25),))
    both = replace(RECIPE, classes=(FaultClass(), joint))
    assert expected_severity(both, np.array([[0.5, 0.5]])).tolist() == pytest.approx([0.175])
    assert answer(np.zeros(4, dtype=np.int64), 1.0).is_graded is False
    assert answer(np.zeros(4, dtype=np.int64), 0.5).is_graded is True


def test_a_sweep_tries_sizes_at_the_usual_noise() -> None:
    def told(**options: Any) -> list[tuple[float, float, int]]:
        cells = make_tasks([RECIPE], n_test=60, seed=0, **options)
        return [(c.recipe.timing.sampling_rate_hz, c.recipe.sensor.current_noise_a, c.n_train) for c in cells]

    assert told(rates_hz=(), noises_a=(), train_sizes=[200, 100]) == [(1e3, 0.02, 200), (1e3, 0.02, 100)]
    assert told(rates_hz=(1e3,), noises_a=(0.1, 0.02), train_sizes=[200, 100]) == [
        (1e3, 0.1, 200), (1e3, 0.02, 200), (1e3, 0.02, 100),
    ]  # fmt: skip
    assert told(rates_hz=(1e3,), noises_a=(0.1, 0.05), train_sizes=[200, 100]) == [
        (1e3, 0.1, 200), (1e3, 0.1, 100), (1e3, 0.05, 200),
    ]  # fmt: skip
    cells = make_tasks(
        [RECIPE], rates_hz=(1e3, 1e4), noises_a=(0.1, 0.02), train_sizes=[200], n_test=60, seed=0
    )
    plan = Plan(cells, ("threshold", "posterior-network"))
    assert plan.reference == 3  # 10 kHz and 20 mA
    assert plan.n_comparisons == 8


def test_times_that_are_expected() -> None:
    """What progress bars go by, in seconds: measured once on two cores, and linear in the work."""
    usual = class_task(load_recipe("bench"))
    by_name = {
        unit.name: unit.seconds for unit in units(Plan((usual,), ("residual-qda", "posterior-network")))
    }
    assert by_name == pytest.approx(
        {LIMIT: 0.5 + 2.0, "residual-qda": 1.0 + 1.0, "posterior-network": 1.0 + 15.0}
    )
    slow = {unit.name: unit.seconds for unit in units(Plan((TASK,), ("residual-qda",)))}
    assert slow == pytest.approx({LIMIT: 0.5 + 0.006, "residual-qda": 1.0 + 0.5 * 160 / 2000 * (0.2 + 0.08)})
    field = class_task(load_recipe("field"))
    assert unit_of(field, "posterior-network").seconds == pytest.approx(600.0)


def test_costs_are_those_of_the_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Peaks from /proc in units of 1,024 bytes, told in millions of bytes."""
    monkeypatch.setattr(judging, "_PROCESS", tmp_path)
    clock = iter([2.0, 5.5])
    monkeypatch.setattr("time.process_time", lambda: next(clock))

    def status(kilobytes: int) -> None:
        (tmp_path / "status").write_text(f"Name:\tx\nVmHWM:\t{kilobytes} kB\nVmRSS:\t1 kB\n")

    status(1000)

    def work() -> str:
        status(4000)
        return "done"

    done, cost = with_cost(work)
    assert (done, cost.seconds) == ("done", 3.5)
    assert cost.memory_mb == pytest.approx(3.072)
    assert (tmp_path / "clear_refs").read_text() == "5"
    monkeypatch.setattr(judging, "_PROCESS", tmp_path / "none")
    clock = iter([2.0, 2.5])
    assert with_cost(lambda: 1) == (1, Cost(0.5, None))


def test_unknown_faults_are_as_large_as_their_names_say() -> None:
    for fault in UNKNOWN_FAULTS:
        name, change, _ = fault.name.rsplit(" ", 2)
        field = {"motor constants": "constants"}.get(name, name)
        factors = {quantity: getattr(fault, quantity) for quantity in FACTORS}
        assert factors == pytest.approx(dict.fromkeys(FACTORS, 1.0) | {field: 1.0 + float(change) / 100.0})


def test_a_foreign_fault_is_applied_to_a_healthy_motor() -> None:
    certain = replace(RECIPE, spread=Spread(), sensor=replace(RECIPE.sensor, current_noise_a=1e-9))
    from motor_env import simulate_states

    for fault in UNKNOWN_FAULTS:
        motor = certain.motor.scaled(
            inertia_kg_m2=fault.inertia, torque_constant_n_m_per_a=fault.constants,
            back_emf_constant_v_s_per_rad=fault.constants,
        )  # fmt: skip
        expected = simulate_states(motor, fault.supply * certain.timing.step(12.0), 1e-3)[:, 0]
        got = foreign_starts(certain, fault, 1, np.arange(2))
        np.testing.assert_allclose(got[:, 0], np.stack([expected, expected]), atol=1e-6)


def test_figures_of_sets_are_those_of_the_coverage() -> None:
    test = TASK.starts()
    told = answer(test.class_index, 0.75).probabilities
    got = set_figures({"one": told}, test)
    assert (got["n_test"], got["promised"]) == (60, 0.9)
    (row,) = got["methods"]
    # All true classes are equally strange: p = 1. A wrong one is stranger than all: p = 1 / (n + 1).
    first = np.arange(60) % 2 == 0
    few_of = [[(test.class_index[half] == n).sum() <= 9 for n in range(5)] for half in (~first, first)]
    size = [1 + sum(few_of[n % 2]) - few_of[n % 2][own] for n, own in enumerate(test.class_index)]
    assert (row["method"], row["coverage"], row["empty"]) == ("one", 1.0, 0.0)
    assert row["mean_size"] == pytest.approx(np.mean(size))
    assert row["by_class"] == [1.0] * 5


def test_lines_of_an_evaluation() -> None:
    """The limit's accuracy minus the model's, in points; shares with four digits."""
    intervals = {
        f"{name}{end}": value
        for name in (
            "accuracy",
            "macro_f1",
            "false_alarm_rate",
            "missed_detection_rate",
            "level_error",
            "bearing",
            "level",
        )
        for end, value in (("", 0.5), ("_low", 0.25), ("_high", 0.75))
    }
    told: dict[str, Any] = {
        **intervals, "winding": None, "bayes_is_estimate": False, "bayes_accuracy": 0.8125, "below_bayes": 0.0325,
        "below_bayes_low": -0.01, "below_bayes_high": 0.075, "only_method_right": 3, "only_bayes_right": 8,
        "p_above_bayes": 0.9673, "confusion": (10 * np.eye(5, dtype=int) + 1).tolist(),
    }  # fmt: skip
    lines = evaluation_lines(RECIPE, told)
    assert lines[0] == "  accuracy                0.5000   0.2500 to 0.7500"
    assert not any(line.startswith("  winding ") for line in lines)
    assert "  Bayes limit accuracy    0.8125   on the same cases" in lines
    assert (
        "  below it by 3.25 percentage points (-1.00 to 7.50, paired): only the model is right on 3 cases,"
        " only the limit on 8; one-sided p 0.967"
    ) in lines
    level = evaluation_lines(RECIPE, told | {"below_bayes": -0.00004})
    assert any(line.startswith("  below it by 0.00 percentage points (-1.00") for line in level)
    assert lines[-6].split() == ["1", "2", "3", "4", "5"]
    assert [line.split() for line in lines[-5:]] == [
        [str(n + 1), name, *(str(count) for count in row)]
        for n, (name, row) in enumerate(zip(RECIPE.class_names, told["confusion"], strict=True))
    ]
    assert any(
        "its estimate accuracy" in line
        for line in evaluation_lines(RECIPE, told | {"bayes_is_estimate": True})
    )


def test_motors_at_work_have_the_posterior_around_their_fit() -> None:
    from motor_datasets import generate_arrays
    from motor_env.inference.work_features import work_probabilities

    recipe = load_recipe("operation")
    X = generate_arrays(recipe, 1, 3).X
    np.testing.assert_array_equal(
        class_task(recipe).best(X), work_probabilities(recipe, X.astype(np.float64))
    )
