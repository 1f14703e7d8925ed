"""Confirmation by thresholds: windows, thresholds and shares in closed form, and the rate of false alarms."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import expit, softmax
from scipy.stats import binom
from sklearn.linear_model import LogisticRegression

from motor_classifiers import ThresholdConfirmationClassifier
from motor_classifiers.estimators.threshold_rule import (
    LEAST_STATISTIC,
    UNLIMITED,
    ThresholdRule,
    window_features,
)
from motor_datasets import generate_arrays
from motor_env import Timing, load_recipe
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

WINDOWS = np.array([[0, 1], [1, 2], [2, 4]])
Training = tuple[FloatArray, NDArray[np.str_]]


def rule(**changes: Any) -> ThresholdRule:
    """Three classes, the healthy one in the middle; windows of one and two samples."""
    plain: dict[str, Any] = {
        "healthy_index": 1, "with_spread": False, "windows": WINDOWS, "bank_windows": WINDOWS,
        "needed": 1, "among": 1, "healthy_center": np.zeros((3, 1)), "healthy_scale": np.array([[1.0], [2.0], [4.0]]),
        "lower": np.full((3, 1), -2.0), "upper": np.full((3, 1), 2.0), "own_scale": np.array([[1.0], [2.0], [2.0]]),
        "prior": np.array([0.25, 0.5, 0.25]), "temperature": 2.0, "slope": 3.0, "intercept": -0.5,
    }  # fmt: skip
    return ThresholdRule(**plain | changes)


def residuals(*of_class: list[float]) -> FloatArray:
    """One case of four samples, its residual under each class: shape (n_classes, 1, 4, 1)."""
    return np.array(of_class, dtype=np.float64)[:, None, :, None]


def test_windows_are_sums_over_roots() -> None:
    white = np.array([[1.0, 2.0, 3.0, 5.0, 1.0, 1.0]])[..., None]
    got = window_features(white, np.array([[0, 2], [2, 6]]), True)
    mean = np.array([3.0, 10.0]) / np.sqrt([2.0, 4.0])
    spread = [
        (np.square(part - part.mean()).sum() - (len(part) - 1)) / np.sqrt(2.0 * (len(part) - 1))
        for part in (white[0, :2, 0], white[0, 2:, 0])
    ]
    np.testing.assert_allclose(got[0], np.column_stack([mean, spread]))
    overlapping = window_features(white, np.array([[3, 5], [2, 4], [0, 2]]), False)[0, :, 0]
    np.testing.assert_allclose(overlapping, np.array([6.0, 8.0, 3.0]) / np.sqrt(2.0))


@pytest.mark.parametrize(
    ("needed", "among", "statistic", "alarm"),
    [
        (1, 1, [1.0, 3.0, 2.5], 1),
        (1, 2, [3.0, 3.0], 1),
        (2, 2, [1.0, 2.5], 3),
        (2, 3, [2.5], 3),
        (3, 3, [1.0], -1),
    ],
)
def test_m_of_n_windows_beyond_the_threshold_confirm(
    needed: int, among: int, statistic: list[float], alarm: int
) -> None:
    """Distances in the windows are 1, 3 and 2.5; the thresholds are 2."""
    white = residuals([0.0] * 4, [-1.0, 6.0, 10.0 / np.sqrt(2.0), 10.0 / np.sqrt(2.0)], [0.0] * 4)
    own, height = rule(needed=needed, among=among), np.array(statistic) / 2.0
    np.testing.assert_allclose(own.statistic(window_features(white[1], own.windows, False))[0], height)
    got = own.decide(white)
    assert got.alarm_index.tolist() == [alarm]
    assert got.statistic == pytest.approx([max(height)])
    assert got.class_index.tolist() == [1 if alarm < 0 else 0]  # both faults fit as well: the first one


def test_probabilities_are_platts_times_the_shares_of_the_bank() -> None:
    """Likelihoods are those of standard normal windows, divided by the temperature, times the priors."""
    white = residuals([2.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 0.0], [0.0, 4.0, 2.0, 2.0])
    got = rule(prior=np.array([0.125, 0.5, 0.375])).decide(white)
    log_likelihood = np.array([-0.5 * 4.0, -0.5 * (4.0 + 8.0 / 4.0)])
    weights = np.exp(log_likelihood / 2.0) * [0.125, 0.375]
    share = weights / weights.sum()
    faulty = expit(-0.5 + 3.0 * np.log(1.5 / 2.0))  # what goes furthest is 3 of 4
    np.testing.assert_allclose(got.probabilities[0], [share[0] * faulty, 1.0 - faulty, share[1] * faulty])
    assert got.class_index.tolist() == [1]


def test_the_temperature_is_the_best_of_its_grid_and_platt_is_logistic_regression() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(3, size=200)
    white = rng.normal(size=(3, 200, 4, 1)) + 1.5 * (np.arange(3)[:, None] != labels)[..., None, None]
    own = rule(temperature=1.0)
    got = own.calibrated(white, labels)
    features = np.stack([window_features(one, own.windows, False) for one in white])
    faulty = labels != 1
    log_likelihood = -0.5 * np.square(features / own.own_scale).sum(axis=(2, 3)).T[faulty][:, [0, 2]]
    columns = np.where(labels[faulty] == 0, 0, 1)

    def loss(temperature: float) -> float:
        share = softmax(log_likelihood / temperature + np.log([0.25, 0.25]), axis=1)
        return float(-np.log(share[np.arange(len(columns)), columns]).mean())

    grid = np.geomspace(0.5, 200.0, 40)
    assert got.temperature == grid[np.argmin([loss(t) for t in grid])]
    assert 0.6 < got.temperature < 100.0
    heights = np.maximum(np.abs(features[1] / own.healthy_scale).max(axis=(1, 2)) / 2.0, LEAST_STATISTIC)
    design = np.column_stack([np.ones(200), np.log(heights)])
    platt = LogisticRegression(C=100.0, fit_intercept=False, tol=1e-8, max_iter=1000).fit(design, faulty)
    assert (got.intercept, got.slope) == pytest.approx(tuple(platt.coef_[0]), abs=1e-3)


def test_each_side_of_each_window_has_its_own_threshold() -> None:
    """Below the center the first window has 1, above it 4; the second has none below, 0.5 above."""
    own = rule(
        windows=WINDOWS[:2], healthy_center=np.array([[1.0], [0.0]]), healthy_scale=np.ones((2, 1)),
        lower=np.array([[-1.0], [-UNLIMITED]]), upper=np.array([[4.0], [0.5]]),
    )  # fmt: skip
    features = np.array([[-0.5, -90.0], [4.0, 0.4], [1.0, 0.51], [5.5, 0.0]])[..., None]
    height = [[1.5, 90.0 / UNLIMITED], [0.75, 0.8], [0.0, 1.02], [1.125, 0.0]]
    np.testing.assert_allclose(own.statistic(features), height)


def tuned(height: list[float], healthy: list[bool], rate: float | None = None) -> ThresholdRule:
    """Two classes, one sample a case, which is the statistic but for the healthy cases' center and scale."""
    white = np.zeros((2, len(height), 1, 1))
    white[0, :, 0, 0] = height
    return ThresholdRule.tune(white, np.where(healthy, 0, 1), 0, false_alarm_rate=rate)


def test_the_threshold_is_between_the_cases_that_it_parts() -> None:
    """Most right decisions: below 5 four of four are healthy, above it three of four are not."""
    height = [-4.0, -3.0, -2.0, -1.0, 6.0, 7.0, 8.0, 9.0, 0.0]
    got = tuned(height, [True, True, True, True, False, False, True, False, True])
    center = -1.5
    scale = np.sqrt(np.square(np.array([-4.0, -3.0, -2.0, -1.0, 8.0, 0.0]) - center).mean())
    assert got.healthy_center.tolist() == [[center]]
    assert got.healthy_scale.tolist() == [[pytest.approx(scale)]]
    # One threshold for both sides: 2.5 below is healthy, 7.5 above is not.
    assert got.upper[0, 0] == pytest.approx(0.5 * (2.5 + 7.5) / scale)
    assert got.lower[0, 0] == -got.upper[0, 0]
    assert got.prior.tolist() == pytest.approx([6.0 / 9.0, 3.0 / 9.0])
    assert (got.needed, got.among, got.windows.tolist()) == (1, 1, [[0, 1]])


def test_a_side_on_which_no_fault_is_has_no_threshold() -> None:
    """Healthy ones reach -9; a fault lies above 1.5: one threshold for both sides errs in three of nine cases."""
    height = [-9.0, -8.0, -7.0, 0.0, 1.0, 1.0, 1.0, 2.0, 3.0, 4.0]
    got = tuned(height, [True] * 7 + [False] * 3)
    assert got.lower.tolist() == [[-UNLIMITED]]
    assert got.upper[0, 0] * got.healthy_scale[0, 0] + got.healthy_center[0, 0] == pytest.approx(1.5)


def test_windows_need_not_cover_the_start() -> None:
    """One fault lowers the first of ten samples, one raises the last eight; tolerances go the other way."""
    rng = np.random.default_rng(0)
    labels = np.repeat([0, 1, 2], 300)
    white = rng.normal(size=(3, 900, 10, 1))
    tolerance = rng.exponential(10.0, (900, 2))
    white[0, :, 0, 0] += np.where(labels == 1, -8.0, tolerance[:, 0])
    white[0, :, 2:, 0] += np.where(labels == 2, 2.0, -tolerance[:, 1])[:, None]
    white[1, labels == 2] += 9.0
    white[2, labels == 1] += 9.0  # the bank is always right
    got = ThresholdRule.tune(white, labels, 0)
    (first, end), (late, last) = got.windows.tolist()
    assert (first, end) == (0, 1)
    assert late > 0
    assert (got.upper[0, 0], got.lower[1, 0]) == (UNLIMITED, -UNLIMITED)
    decided = got.decide(white)
    assert (decided.class_index == labels).mean() > 0.97
    assert set(decided.alarm_index.tolist()) == {-1, 0, last - 1}


@pytest.mark.parametrize(("rate", "expected"), [(0.2, 8.0), (0.5, 5.0), (0.1, 9.0), (0.3, 7.0)])
def test_the_factor_of_a_rate_is_an_order_statistic_of_cases_not_seen(rate: float, expected: float) -> None:
    """Of nine held cases 1 .. 9 the ceil(10 (1 - rate))-th: a tenth one exceeds it with at most that chance."""
    height = [*np.linspace(-5.0, 5.0, 9).tolist(), *np.arange(1.0, 10.0).tolist(), 20.0]
    got = tuned(height, [True] * 18 + [False], rate)
    assert got.healthy_center.tolist() == [[0.0]]
    assert got.upper[0, 0] * got.healthy_scale[0, 0] == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"needs at least 20 healthy training cases, got 18"):
        tuned(height, [True] * 18 + [False], 0.091)


def test_scales_are_root_mean_squares_under_the_own_class() -> None:
    white = np.zeros((2, 4, 1, 1))
    white[0, :, 0, 0] = [1.0, 3.0, 50.0, 60.0]
    white[1, :, 0, 0] = [7.0, 9.0, 2.0, 4.0]
    got = ThresholdRule.tune(white, np.array([0, 0, 1, 1]), 0)
    assert (got.healthy_center[0, 0], got.healthy_scale[0, 0]) == (2.0, 1.0)
    assert got.own_scale[0, 0] == pytest.approx(np.sqrt((1.0 + 9.0 + 4.0 + 16.0) / 4))


def test_decision_and_largest_probability_are_swapped_where_they_disagree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    X = np.random.default_rng(0).normal(size=(40, 3)) + np.repeat([[0.0], [4.0]], 20, axis=0)
    model = ThresholdConfirmationClassifier().fit(X, np.repeat(["healthy", "worn"], 20))
    graded = np.array([[0.7, 0.3], [0.2, 0.8], [0.4, 0.6]])
    decided = model.decide(X[:3])._replace(probabilities=graded, class_index=np.array([1, 1, 0]))
    monkeypatch.setattr(ThresholdConfirmationClassifier, "decide", lambda self, X: decided)
    np.testing.assert_allclose(model.predict_proba(X[:3]), [[0.3, 0.7], [0.2, 0.8], [0.6, 0.4]])


def test_healthy_motors_alarm_at_the_wanted_rate_and_windings_are_told() -> None:
    recipe = load_recipe("bench", timing=Timing(sampling_rate_hz=10_000.0))
    train, test = generate_arrays(recipe, 1, 1000), generate_arrays(recipe, 3, 600)
    own = ThresholdConfirmationClassifier(recipe, false_alarm_rate=0.05).fit(train.X, train.class_name)
    healthy = generate_arrays(replace(recipe, classes=(FaultClass(),)), 2, 2000)
    alarms = int((own.decide(healthy.X).alarm_index >= 0).sum())
    # One factor on the thresholds is an order statistic of about 100 healthy cases: the rate is spread by 0.022.
    assert len(own.rule_.windows) > 1
    assert binom.ppf(1e-3, 2000, 0.01) <= alarms <= binom.ppf(1 - 1e-3, 2000, 0.12)
    got = own.decide(test.X)
    assert (got.class_index == test.class_index)[test.kind == "winding_contact"].mean() > 0.97
    np.testing.assert_array_equal(got.alarm_index >= 0, got.statistic > 1.0)
    np.testing.assert_array_equal(got.class_index != 0, got.alarm_index >= 0)
    assert got.alarm_index.max() < test.X.shape[-1]


@pytest.mark.parametrize(
    ("rate", "change", "sentence"),
    [
        (0.01, lambda *given: given, "false_alarm_rate 0.01 needs at least 198 healthy training cases"),
        (None, lambda X, y: (X, np.where(y == "healthy", y, "odd")), "class must be one of healthy"),
        (None, lambda X, y: (X[y != "healthy"], y[y != "healthy"]), "must hold healthy ones"),
    ],
)
def test_bad_training_cases_are_refused(
    rate: float | None, change: Callable[..., Training], sentence: str
) -> None:
    recipe = load_recipe("bench")
    given = generate_arrays(recipe, 1, 60)
    with pytest.raises(ValueError, match=sentence):
        ThresholdConfirmationClassifier(recipe, false_alarm_rate=rate).fit(*change(given.X, given.class_name))
