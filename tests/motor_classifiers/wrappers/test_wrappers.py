"""Wrappers: conformal sets, early verdicts, and starts that the recipe does not explain."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest, multivariate_normal
from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
from sklearn.frozen import FrozenEstimator
from sklearn.linear_model import LogisticRegression
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import make_pipeline

from motor_classifiers import (
    ConformalClassifier,
    ConformalSets,
    EarlyClassifier,
    OutsideDetector,
    ResidualProjection,
)

# Reaches in: a state without a file, and starts of other motors than any recipe has by name.
from motor_classifiers.scoring.frozen_tasks import ForeignFault, foreign_starts
from motor_classifiers.wrappers.conformal import measured_coverage
from motor_classifiers.wrappers.early import (
    Stopped,
    limit_by_samples,
    shortened,
    stop_when_sure,
    stopping_score,
)
from motor_classifiers.wrappers.outlier_detector import ADVICE, GaussianMixture, StartDensity
from motor_datasets import generate_arrays
from motor_env import Channel, Recipe, Timing, class_probabilities, load_recipe
from motor_env.simulation.disturbances import Field

# Strangeness of the true class: 1/8, 1/4 and 1/2, which are exact in binary.
KNOWN = np.array([[0.875, 0.125], [0.75, 0.25], [0.5, 0.5]])


def test_p_values_of_three_calibration_cases() -> None:
    """(1 + how many are at least as strange) / (1 + 3): ties count, and no p-value is 0."""
    sets = ConformalSets.calibrate(KNOWN, [0, 0, 0])
    new = np.array([[0.9375, 0.0625], [0.875, 0.125], [0.75, 0.25], [0.625, 0.375], [0.25, 0.75]])
    expected = np.array([[1.0, 0.25], [1.0, 0.25], [0.75, 0.25], [0.5, 0.25], [0.25, 0.75]])
    np.testing.assert_array_equal(sets.p_values(new), expected)
    for coverage in (0.75, 0.5):
        np.testing.assert_array_equal(sets.sets(new, coverage), expected > 1.0 - coverage)
    assert sets.sets(new, 0.76).all()
    each = ConformalSets.calibrate(KNOWN, [0, 0, 1], label_conditional=True)
    expected = np.array([[1.0, 0.5], [1.0, 0.5], [2 / 3, 0.5], [1 / 3, 0.5], [1 / 3, 1.0]])
    np.testing.assert_array_equal(each.p_values(new), expected)
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
    X, y = np.random.default_rng(0).normal(size=(2 * per_class, 3)), np.repeat(["a", "b"], per_class)
    model = ConformalClassifier(random_state=0).fit(X, y)
    assert [len(scores) for scores in model.sets_.nonconformity] == [kept, kept]
    whole = FrozenEstimator(LogisticRegression().fit(X, y))
    frozen = ConformalClassifier(whole, label_conditional=False).fit(X, y)
    assert [len(scores) for scores in frozen.sets_.nonconformity] == [2 * per_class]
    np.testing.assert_array_equal(model.predict_set(X), model.sets_.sets(model.predict_proba(X), 0.9))


def test_a_classifier_calibrates_on_cases_it_did_not_train_on() -> None:
    """Labels by chance, and a model that knows its training by heart: half of its own answers must be wrong."""
    rng = np.random.default_rng(7)
    X, guessed = rng.normal(size=(200, 2)), np.where(rng.random(200) < 0.5, "a", "b")
    by_heart = ConformalClassifier(KNeighborsClassifier(1), random_state=1).fit(X, guessed)
    assert 0.3 < np.concatenate(by_heart.sets_.nonconformity).mean() < 0.7
    frozen = ConformalClassifier(FrozenEstimator(LogisticRegression().fit(X, guessed)))
    with pytest.raises(ValueError, match="does not know the class 'd'"):
        frozen.fit(X, np.where(guessed == "a", "d", "b"))


def test_stops_by_hand() -> None:
    probabilities = np.array([[[0.6, 0.4], [0.5, 0.5]], [[0.9, 0.1], [0.4, 0.6]], [[0.2, 0.8], [0.3, 0.7]]])
    stopped = stop_when_sure(probabilities, 0.1)
    assert [part.tolist() for part in (stopped.moment, stopped.decided, stopped.sure)] == [
        [1, 2],
        [0, 1],
        [True, False],
    ]
    score = stopping_score(stopped, [1, 1], np.array([1.0, 2.0, 4.0]))
    assert (score.error, score.stopped, score.accuracy, score.mean_time_s) == (1.0, 0.5, 0.5, 3.0)
    assert stop_when_sure(np.array([[[0.75, 0.25]]]), 0.25).sure.all()  # as sure as asked for is sure enough
    nobody = stop_when_sure(np.full((2, 3, 2), 0.5), 0.25)
    got = stopping_score(nobody, [0, 0, 1], [1.0, 2.0])
    assert nobody.moment.tolist() == [1, 1, 1]
    assert not nobody.sure.any()
    assert np.isnan(got.error)
    assert (got.error_low, got.error_high, got.stopped) == (0.0, 1.0, 0.0)


@pytest.mark.parametrize("misses", [0, 3, 8])
def test_the_interval_of_a_stopping_error_is_the_exact_one(misses: int) -> None:
    decided = (np.arange(10) < misses).astype(np.int64)
    stopped = Stopped(decided, np.arange(10) % 2, np.arange(10) < 8)
    got = stopping_score(stopped, np.zeros(10, dtype=np.int64), [0.25, 0.75])
    exact = binomtest(misses, 8).proportion_ci(0.95, "exact")
    assert (got.error, got.stopped, got.mean_time_s) == (misses / 8, 0.8, 0.5)
    assert got.accuracy == pytest.approx(1.0 - misses / 10)
    assert (got.error_low, got.error_high) == pytest.approx((exact.low, exact.high))


def test_lengths_of_what_is_seen() -> None:
    X, y = np.random.default_rng(1).normal(size=(12, 50)), np.repeat([0, 1], 6)
    assert EarlyClassifier().fit(X, y).samples_.tolist() == [1, 2, 5, 10, 20, 30, 40, 50]
    assert EarlyClassifier().fit(X[:, :2], y).samples_.tolist() == [1, 2]
    first = EarlyClassifier(samples=(1, 50)).fit(X, y).probabilities_by_samples(X)[0]
    alone = LogisticRegression(max_iter=1000).fit(X[:, :1], y).predict_proba(X[:, :1])
    np.testing.assert_allclose(first, alone)
    for wrong in ((0, 50), (1, 51)):
        with pytest.raises(ValueError, match="samples must be from 1 to 50"):
            EarlyClassifier(samples=wrong).fit(X, y)


def test_a_recipe_is_cut_after_its_quiet_part() -> None:
    recipe = replace(BENCH, timing=Timing(1_000.0, 0.1, quiet_s=0.02))
    whole = make_pipeline(OutsideDetector(recipe))  # wherever in it the recipe is
    cut = shortened(whole, 50)[0].recipe.timing
    assert whole[0].recipe.timing.n_samples == 120
    assert (cut.n_samples, cut.n_quiet, cut.duration_s) == (50, 20, pytest.approx(0.03))


class _Remembering(LogisticRegression):  # type: ignore[misc]  # scikit-learn has no types
    def __init__(self, recipe: Any = None) -> None:
        super().__init__()
        self.recipe = recipe

    def fit(self, X: Any, y: Any) -> "_Remembering":
        self.given_ = X.copy()
        super().fit(X, y)
        return self


def test_the_first_samples_are_those_of_each_channel() -> None:
    both = replace(BENCH, sensor=replace(BENCH.sensor, channels=(Channel.CURRENT, Channel.SPEED)))
    X = np.arange(4 * 2 * 100, dtype=np.float64).reshape(4, 2, 100)
    model = EarlyClassifier(_Remembering(both), samples=(3, 100)).fit(X, [0, 1, 0, 1])
    np.testing.assert_array_equal(model.estimators_[0].given_, X[:, :, :3].reshape(4, 6))


@pytest.fixture(scope="module")
def model() -> EarlyClassifier:
    train = generate_arrays(BENCH, 0, 3000)
    pipeline = make_pipeline(ResidualProjection(BENCH, 6), QuadraticDiscriminantAnalysis())
    return EarlyClassifier(pipeline, samples=(10, 30, 100), error=0.1).fit(train.X, train.class_name)


def test_an_early_verdict_does_not_look_ahead(model: EarlyClassifier) -> None:
    test = generate_arrays(BENCH, 0, np.arange(400) + 10_000)
    stopped = model.stop(test.X)
    blind = test.X.copy()
    blind[np.arange(100) >= model.samples_[stopped.moment][:, None, None]] = 0.0
    early = stopped.sure
    assert 0.2 < early.mean() < 0.9
    np.testing.assert_array_equal(model.predict(blind[early]), model.predict(test.X[early]))


def test_accuracy_by_samples_follows_the_limit(model: EarlyClassifier) -> None:
    test = generate_arrays(BENCH, 0, np.arange(1500) + 10_000)
    limit = limit_by_samples(BENCH, test.X, model.samples_)
    np.testing.assert_array_equal(limit[-1], class_probabilities(BENCH, test.X))
    columns = np.searchsorted(model.classes_, test.class_name)
    hits = (model.probabilities_by_samples(test.X).argmax(axis=2) == columns).mean(axis=1)
    best = (limit.argmax(axis=2) == test.class_index).mean(axis=1)
    assert (best[:-1] < best[1:]).all()
    assert (np.abs(hits - best) < 0.025).all()
    score = stopping_score(stop_when_sure(limit, 0.1), test.class_index, model.samples_ / 1000.0)
    assert score.error_low < 0.1
    assert score.mean_time_s < 0.1


BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FIELD = replace(
    load_recipe("field", timing=Timing(1_000.0, 0.05, 0.01)), starts_per_motor=1, healthy_starts=0
)


@cache
def fitted(recipe: Recipe) -> OutsideDetector:
    return OutsideDetector(recipe).fit()


def refused(detector: OutsideDetector, recipe: Recipe, n: int, seed: int = 6) -> float:
    """Share of a recipe's starts."""
    return float((detector.predict(generate_arrays(recipe, seed, n).X) < 0).mean())


def test_a_cloud_is_a_normal_distribution_of_whole_starts() -> None:
    """Differences of log densities, noise given, are those of the joint normal of all values."""
    rng = np.random.default_rng(4)
    directions = np.linalg.qr(rng.normal(size=(7, 3)))[0].T
    factor, mean = rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 3))
    covariance = factor @ factor.swapaxes(1, 2)
    noise, nominal = rng.uniform(0.5, 2.0, 7), rng.normal(size=7)
    mixture = GaussianMixture(np.log([0.3, 0.7]), mean, covariance, np.array([1.0, 1.5]))
    density = StartDensity(BENCH, nominal, noise, directions, mixture, mixture, {})
    X = nominal + noise * rng.normal(size=(5, 7))
    level = 2.0
    joint = [
        weight
        * multivariate_normal(
            nominal + noise * (centre @ directions),
            np.outer(noise, noise) * (directions.T @ spread @ directions + level * own * np.eye(7)),
        ).pdf(X)
        for weight, centre, spread, own in zip([0.3, 0.7], mean, covariance, mixture.noise, strict=True)
    ]
    got = mixture.log_density(density.coordinates(X), density.freedom, (level, level))
    np.testing.assert_allclose(np.diff(got), np.diff(np.log(np.sum(joint, axis=0))), rtol=1e-9)


@pytest.mark.parametrize("recipe", [BENCH, FIELD], ids=lambda recipe: recipe.name)
def test_one_in_a_hundred_of_its_own_starts_is_refused(recipe: Recipe) -> None:
    # Threshold and count both scatter: four standard deviations of both.
    error = 4.0 * np.sqrt(0.01 * 0.99 * (1 / 4_000 + 1 / 10_000))
    assert abs(refused(fitted(recipe), recipe, 4_000, 91) - 0.01) < error


@pytest.mark.parametrize(
    ("off", "recipe", "moved"),
    [
        ("offset", BENCH, replace(BENCH, field=Field(sensor_offset_a=(0.05, 0.05)))),
        ("load", FIELD, FIELD.shifted("loaded")),
        ("noise", BENCH, replace(BENCH, sensor=BENCH.sensor.with_noise(2.0))),
        ("another motor", BENCH, None),
    ],
    ids=lambda part: part if isinstance(part, str) else "",
)
def test_the_likely_shift_is_named(off: str, recipe: Recipe, moved: Recipe | None) -> None:
    heavy = ForeignFault("heavy", inertia=1.25)
    X = generate_arrays(moved, 6, 200).X if moved else foreign_starts(recipe, heavy, 6, np.arange(200))
    named = fitted(recipe).likely_shift(X)
    assert (named == off).mean() > 0.7
    assert set(named.tolist()) <= {"", *ADVICE}


def test_a_noise_that_is_read_off_is_not_refused_within_its_range() -> None:
    detector = OutsideDetector(BENCH, noise_range=(0.25, 4.0)).fit()
    shares = [
        refused(detector, replace(BENCH, sensor=BENCH.sensor.with_noise(factor)), 2_000)
        for factor in (0.3, 1.0, 3.5, 8.0)
    ]
    assert max(shares[:3]) < 0.02
    assert shares[3] > 0.99


def test_the_threshold_is_a_quantile_of_starts_given_or_drawn() -> None:
    few, X = OutsideDetector(BENCH), generate_arrays(BENCH, 8, 500).X
    assert OutsideDetector(BENCH, false_alarm_rate=0.2).fit().offset_ > few.fit().offset_
    assert few.fit(X).offset_ == pytest.approx(np.quantile(few.score_samples(X), 0.01))
    with pytest.raises(ValueError, match="false_alarm_rate must be > 0 and < 1, got 1"):
        OutsideDetector(BENCH, 1.0).fit()
    with pytest.raises(ValueError, match="fit needs starts or a recipe"):
        OutsideDetector().fit()
