"""Early verdicts: the stopping rule keeps its error where probabilities are honest, and nothing looks ahead."""

import numpy as np
import pytest
from scipy.special import expit
from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
from sklearn.pipeline import make_pipeline

from motor_classifiers import EarlyClassifier, ResidualProjection
from motor_classifiers.wrappers.early import limit_by_samples, stop_when_sure, stopping_score
from motor_datasets import generate_arrays
from motor_env import Timing, class_probabilities, load_recipe

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))


def walks(rng: np.random.Generator, n: int, boast: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Posterior of two hypotheses, a drift of 0.1 up or down, after each sample; with boast > 1 it is too sure."""
    truth = rng.integers(2, size=n)
    steps = 0.1 * (2 * truth - 1)[:, None] + rng.normal(size=(n, 400))
    log_odds = boast * 0.2 * np.cumsum(steps, axis=1)
    up = expit(log_odds)
    return np.moveaxis(np.stack([1.0 - up, up], axis=2), 1, 0), truth


def test_honest_probabilities_keep_the_stated_error() -> None:
    rng = np.random.default_rng(1)
    probabilities, truth = walks(rng, 8_000)
    time_s = np.arange(1, 401) * 1e-3
    scores = [stopping_score(stop_when_sure(probabilities, e), truth, time_s) for e in (0.2, 0.05, 0.01)]
    for error, score in zip((0.2, 0.05, 0.01), scores, strict=True):
        assert score.error_low < error  # no more than stated
        assert 0.4 * error < score.error < score.error_high  # and not far less
    assert scores[0].mean_time_s < scores[1].mean_time_s < scores[2].mean_time_s
    # Wald's approximation of the expected length, an overshoot short, for those that stop well before the end.
    log_odds = np.log(0.8 / 0.2)
    expected = ((1 - 0.2) * log_odds - 0.2 * log_odds) / 0.02
    assert 1.0 < scores[0].mean_time_s * 1e3 / expected < 1.25
    boasting, truth = walks(rng, 8_000, boast=2.0)
    assert stopping_score(stop_when_sure(boasting, 0.05), truth, time_s).error_low > 0.1


def test_stops_by_hand() -> None:
    probabilities = np.array([[[0.6, 0.4], [0.5, 0.5]], [[0.9, 0.1], [0.4, 0.6]], [[0.2, 0.8], [0.3, 0.7]]])
    stopped = stop_when_sure(probabilities, 0.1)
    np.testing.assert_array_equal(stopped.moment, [1, 2])
    np.testing.assert_array_equal(stopped.decided, [0, 1])
    np.testing.assert_array_equal(stopped.sure, [True, False])
    score = stopping_score(stopped, [1, 1], np.array([1.0, 2.0, 4.0]))
    assert (score.error, score.stopped, score.accuracy, score.mean_time_s) == (1.0, 0.5, 0.5, 3.0)


@pytest.fixture(scope="module")
def model() -> EarlyClassifier:
    train = generate_arrays(BENCH, 0, 3000)
    pipeline = make_pipeline(ResidualProjection(BENCH, 6), QuadraticDiscriminantAnalysis())
    return EarlyClassifier(pipeline, samples=(10, 30, 100), error=0.1).fit(train.X, train.class_name)


def test_an_early_verdict_does_not_look_ahead(model: EarlyClassifier) -> None:
    test = generate_arrays(BENCH, 0, np.arange(400) + 10_000)
    stopped = model.stop(test.X)
    blind = test.X.copy()
    seen = model.samples_[stopped.moment]
    blind[np.arange(100) >= seen[:, None, None]] = 0.0
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
