"""The rules' statistics as features."""

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from motor_classifiers.rule_statistics import RuleStatistics
from motor_datasets.generate import generate_arrays
from motor_env.faults import Fault, FaultKind
from motor_env.marginal import MatchedTest
from motor_env.posterior import class_probabilities
from motor_env.recipes import named_recipe
from motor_env.simulation import Timing

BENCH = named_recipe("bench", timing=Timing(1_000.0, 0.1))


def test_columns_are_the_rules_own() -> None:
    cases = generate_arrays(BENCH, 0, 200)
    features = RuleStatistics(BENCH).fit(cases.X)
    names = list(features.get_feature_names_out())
    got = features.transform(cases.X)
    test = MatchedTest.of(BENCH, Fault(FaultKind.BEARING, 0.25))
    np.testing.assert_allclose(got[:, names.index("matched_bearing_25")], test.statistic(cases.X))
    healthy = cases.kind == "healthy"
    assert got[healthy, names.index("cusum")].max() < got[:, names.index("cusum")].max()
    assert len(names) == got.shape[1] == 6


def test_a_linear_classifier_on_them_is_near_the_limit() -> None:
    train, test = generate_arrays(BENCH, 0, 2000), generate_arrays(BENCH, 0, np.arange(2000) + 10_000)
    model = make_pipeline(RuleStatistics(BENCH), StandardScaler(), LogisticRegression(max_iter=1000))
    right = model.fit(train.X, train.class_name).predict(test.X) == test.class_name
    best = class_probabilities(BENCH, test.X).argmax(axis=1) == test.class_index
    error = (right.astype(float) - best).std() / np.sqrt(len(best))
    assert -0.02 < right.mean() - best.mean() < 4.0 * error
