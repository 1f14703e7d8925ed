"""Scores against scikit-learn's and by hand."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.metrics import (
    accuracy_score,
    balanced_accuracy_score,
    confusion_matrix,
    f1_score,
    recall_score,
)

from motor_classifiers.scoring.metrics import (
    resampling_weights,
    scores,
)
from motor_env import Timing, load_recipe

RECIPE = load_recipe("bench", timing=Timing(1_000.0, 0.1))


def test_scores_agree_with_scikit_learn() -> None:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 5, 800)
    decided = np.where(rng.random(800) < 0.7, truth, rng.integers(0, 5, 800))
    found = scores(RECIPE, truth, decided, resampling_weights(800, 1, 50))
    assert found.accuracy.value == pytest.approx(accuracy_score(truth, decided))
    assert found.macro_f1.value == pytest.approx(f1_score(truth, decided, average="macro"))
    assert [r.value for r in found.recall] == pytest.approx(recall_score(truth, decided, average=None))
    np.testing.assert_array_equal(found.confusion, confusion_matrix(truth, decided))
    assert found.false_alarm_rate.value == pytest.approx((decided[truth == 0] != 0).mean())
    assert found.missed_detection_rate.value == pytest.approx((decided[truth != 0] == 0).mean())
    kinds = np.array([c.label_kind for c in RECIPE.classes])
    for kind, score in (("bearing", found.bearing), ("winding_contact", found.winding)):
        expected = balanced_accuracy_score(kinds[truth] == kind, kinds[decided] == kind)
        assert score.value == pytest.approx(expected)
        assert score.low < score.value < score.high
    told = (kinds[truth] == kinds[decided]) & (truth > 0)
    assert found.level.value == pytest.approx((truth == decided)[told].mean())


def test_bootstrap_interval_is_that_of_the_binomial() -> None:
    truth = np.zeros(1000, dtype=np.int64)
    decided = (np.arange(1000) < 200).astype(np.int64)
    found = scores(RECIPE, truth, decided, resampling_weights(1000, 3)).accuracy
    deviation = np.sqrt(0.8 * 0.2 / 1000)
    assert (found.low, found.high) == pytest.approx(
        (0.8 - 1.96 * deviation, 0.8 + 1.96 * deviation), abs=0.003
    )


def test_a_recipe_without_windings_has_no_winding_score() -> None:
    bearings = replace(RECIPE, classes=RECIPE.classes[:3])
    truth = np.arange(90) % 3
    found = scores(bearings, truth, truth, resampling_weights(90, 0, 20))
    assert np.isnan(found.winding.value)
    assert found.bearing.value == 1.0
