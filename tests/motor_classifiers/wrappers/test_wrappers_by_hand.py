"""What wrappers compute, on a handful of cases by hand: p-values, thresholds, stops, severities along rays."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline

from motor_classifiers import (
    ConformalClassifier,
    ConformalSets,
    EarlyClassifier,
    OutsideDetector,
)

# Reaches in: pins what a wrapper makes of the state that a file holds, without a file.
from motor_classifiers.estimators.cases import State
from motor_classifiers.wrappers.conformal import measured_coverage
from motor_classifiers.wrappers.early import Stopped, shortened, stop_when_sure, stopping_score
from motor_env import Channel, Timing, load_recipe

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))
# Strangeness of the true class: 1/8, 1/4 and 1/2, which are exact in binary.
KNOWN = np.array([[0.875, 0.125], [0.75, 0.25], [0.5, 0.5]])


def test_p_values_of_three_calibration_cases() -> None:
    """(1 + how many are at least as strange) / (1 + 3): ties count, and no p-value is 0."""
    sets = ConformalSets.calibrate(KNOWN, [0, 0, 0])
    new = np.array([[0.9375, 0.0625], [0.875, 0.125], [0.75, 0.25], [0.625, 0.375], [0.25, 0.75]])
    expected = [[1.0, 0.25], [1.0, 0.25], [0.75, 0.25], [0.5, 0.25], [0.25, 0.75]]
    np.testing.assert_array_equal(sets.p_values(new), expected)
    np.testing.assert_array_equal(sets.sets(new, 0.75), np.array(expected) > 0.25)
    np.testing.assert_array_equal(sets.sets(new, 0.5), np.array(expected) > 0.5)
    assert sets.sets(new, 0.76).all()
    each = ConformalSets.calibrate(KNOWN, [0, 0, 1], label_conditional=True)
    np.testing.assert_array_equal(
        each.p_values(new), [[1.0, 0.5], [1.0, 0.5], [2 / 3, 0.5], [1 / 3, 0.5], [1 / 3, 1.0]]
    )
    for coverage in (0.0, 1.0):
        with pytest.raises(ValueError, match="coverage must be > 0 and < 1"):
            sets.sets(new, coverage)


def test_coverage_is_counted() -> None:
    sets = np.array([[1, 0, 0], [1, 1, 0], [0, 0, 0], [0, 1, 1], [1, 0, 0]], dtype=bool)
    got = measured_coverage(sets, [0, 1, 0, 0, 0])
    assert (got.overall, got.mean_size, got.empty) == (0.6, 1.2, 0.2)
    np.testing.assert_array_equal(got.by_class, [0.5, 1.0, np.nan])


@pytest.mark.parametrize(("per_class", "kept"), [(10, 3), (15, 4), (2, 1), (3, 1)])
def test_a_share_of_each_class_is_kept_to_calibrate_on(per_class: int, kept: int) -> None:
    X = np.random.default_rng(0).normal(size=(2 * per_class, 3))
    y = np.repeat(["a", "b"], per_class)
    model = ConformalClassifier(random_state=0).fit(X, y)
    assert [len(scores) for scores in model.sets_.nonconformity] == [kept, kept]
    frozen = ConformalClassifier(
        FrozenEstimator(LogisticRegression().fit(X, y)), label_conditional=False
    ).fit(X, y)
    assert [len(scores) for scores in frozen.sets_.nonconformity] == [2 * per_class]
    np.testing.assert_array_equal(model.predict_set(X), model.sets_.sets(model.predict_proba(X), 0.9))


@pytest.mark.parametrize(("strangeness", "each"), [([[0.5]], False), ([[0.5], [0.25, 0.5]], True)])
def test_sets_come_back_from_what_a_file_holds(strangeness: list[list[float]], each: bool) -> None:
    inner = LogisticRegression().fit([[0.0], [1.0]], ["a", "b"])
    model = ConformalClassifier.from_state(
        State({}, {"coverage": 0.75, "strangeness": strangeness}), inner, BENCH
    )
    assert (model.coverage, model.label_conditional, model.classes_.tolist()) == (0.75, each, ["a", "b"])
    assert [part.tolist() for part in model.sets_.nonconformity] == strangeness
    assert model.to_state().values == {"coverage": 0.75, "strangeness": strangeness}


@pytest.mark.parametrize(("misses", "count"), [(0, 8), (3, 8), (8, 8)])
def test_the_interval_of_a_stopping_error_is_the_exact_one(misses: int, count: int) -> None:
    decided = (np.arange(10) < misses).astype(np.int64)
    stopped = Stopped(decided, np.arange(10) % 2, np.arange(10) < count)
    got = stopping_score(stopped, np.zeros(10, dtype=np.int64), [0.25, 0.75])
    exact = binomtest(misses, count).proportion_ci(0.95, "exact")
    assert (got.error, got.stopped, got.mean_time_s) == (misses / count, count / 10, 0.5)
    assert got.accuracy == pytest.approx(1.0 - misses / 10)
    assert (got.error_low, got.error_high) == pytest.approx((exact.low, exact.high))


def test_nobody_stops() -> None:
    stopped = stop_when_sure(np.full((2, 3, 2), 0.5), 0.25)
    assert stopped.moment.tolist() == [1, 1, 1]
    assert not stopped.sure.any()
    got = stopping_score(stopped, [0, 0, 1], [1.0, 2.0])
    assert np.isnan(got.error)
    assert (got.error_low, got.error_high, got.stopped) == (0.0, 1.0, 0.0)
    assert stop_when_sure(np.array([[[0.75, 0.25]]]), 0.25).sure.all()  # as sure as asked for is sure enough


def test_lengths_of_what_is_seen() -> None:
    X = np.random.default_rng(1).normal(size=(12, 50))
    y = np.repeat([0, 1], 6)
    assert EarlyClassifier().fit(X, y).samples_.tolist() == [1, 2, 5, 10, 20, 30, 40, 50]
    assert EarlyClassifier().fit(X[:, :2], y).samples_.tolist() == [1, 2]
    chosen = EarlyClassifier(samples=(1, 50)).fit(X, y)
    np.testing.assert_allclose(
        chosen.probabilities_by_samples(X)[0],
        LogisticRegression(max_iter=1000).fit(X[:, :1], y).predict_proba(X[:, :1]),
    )
    for wrong in ((0, 50), (1, 51)):
        with pytest.raises(ValueError, match="samples must be from 1 to 50"):
            EarlyClassifier(samples=wrong).fit(X, y)


def test_a_recipe_is_cut_after_its_quiet_part() -> None:
    recipe = replace(BENCH, timing=Timing(1_000.0, 0.1, quiet_s=0.02))
    whole = make_pipeline(OutsideDetector(recipe))  # wherever in it the recipe is
    cut = shortened(whole, 50)[0].recipe
    assert whole[0].recipe.timing.n_samples == 120
    assert (cut.timing.n_samples, cut.timing.n_quiet) == (50, 20)
    assert cut.timing.duration_s == pytest.approx(0.03)


class _Counting(LogisticRegression):  # type: ignore[misc]  # scikit-learn has no types
    """Remembers what it was given."""

    def __init__(self, recipe: Any = None) -> None:
        super().__init__()
        self.recipe = recipe

    def fit(self, X: Any, y: Any) -> "_Counting":
        self.given_ = X.copy()
        super().fit(X, y)
        return self


def test_the_first_samples_are_those_of_each_channel() -> None:
    both = replace(BENCH, sensor=replace(BENCH.sensor, channels=(Channel.CURRENT, Channel.SPEED)))
    X = np.arange(4 * 2 * 100, dtype=np.float64).reshape(4, 2, 100)
    model = EarlyClassifier(_Counting(both), samples=(3, 100)).fit(X, [0, 1, 0, 1])
    np.testing.assert_array_equal(model.estimators_[0].given_, X[:, :, :3].reshape(4, 6))
