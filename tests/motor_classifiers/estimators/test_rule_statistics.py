"""The rules' statistics as features."""

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from motor_classifiers import RuleStatistics
from motor_datasets import generate_arrays
from motor_env import Cusum, Fault, FaultKind, Timing, TolerantFilter, class_probabilities, load_recipe

# Reaches in: the matched test is the oracle that these statistics hold.
from motor_env.inference.whitening import MatchedTest

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))


def test_columns_are_the_rules_own() -> None:
    cases = generate_arrays(BENCH, 0, 200)
    features = RuleStatistics(BENCH).fit(cases.X)
    names = list(features.get_feature_names_out())
    got = dict(zip(names, features.transform(cases.X).T, strict=True))
    test = MatchedTest.from_recipe(BENCH, Fault(FaultKind.BEARING, 0.25))
    np.testing.assert_allclose(got["matched_bearing_25"], test.statistic(cases.X), rtol=1e-9, atol=1e-9)
    white = TolerantFilter.from_recipe(BENCH).white(cases.X)
    np.testing.assert_allclose(np.expm1(got["nis"]), np.square(white).max(axis=(1, 2)))
    np.testing.assert_allclose(np.expm1(got["mean_nis"]), np.square(white).mean(axis=(1, 2)))
    np.testing.assert_allclose(
        np.expm1(got["cusum"]), Cusum(0.2, two_sided=True).statistic(white).max(axis=1)
    )
    assert len(names) == 7


def test_the_noise_is_told_by_the_mean_nis() -> None:
    full = load_recipe("bench-full", timing=Timing(1_000.0, 0.1))
    cases = generate_arrays(full, 0, 500)
    features = RuleStatistics(full).fit(cases.X)
    mean = np.expm1(features.transform(cases.X)[:, features.feature_names_.index("mean_nis")])
    for severity in (0.5, 1.0):
        noisy = mean[cases.class_name == f"noise_{100 * severity:g}"]
        assert noisy.mean() == pytest.approx(1.0 + severity, abs=5.0 * noisy.std() / np.sqrt(len(noisy)))


def test_a_linear_classifier_on_them_is_near_the_limit() -> None:
    train, test = generate_arrays(BENCH, 0, 2000), generate_arrays(BENCH, 0, np.arange(2000) + 10_000)
    model = make_pipeline(RuleStatistics(BENCH), StandardScaler(), LogisticRegression(C=100.0, max_iter=2000))
    right = model.fit(train.X, train.class_name).predict(test.X) == test.class_name
    best = class_probabilities(BENCH, test.X).argmax(axis=1) == test.class_index
    error = (right.astype(float) - best).std() / np.sqrt(len(best))
    assert -0.02 < right.mean() - best.mean() < 4.0 * error
