"""Confirmation by thresholds: its rate of false alarms, its diagnosis, its bad inputs."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from motor_classifiers import ThresholdConfirmationClassifier
from motor_env import FaultKind, Recipe, Timing, draw, load_recipe, simulate
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

Tuned = tuple[Recipe, ThresholdConfirmationClassifier]


def cases(recipe: Recipe, seed: int, count: int) -> tuple[FloatArray, NDArray[np.int64]]:
    drawn = draw(recipe, seed, range(count))
    return simulate(drawn.scenario, seed, drawn.cases).measurements, drawn.class_index


def names(recipe: Recipe, labels: NDArray[np.int64]) -> NDArray[np.str_]:
    return np.array(recipe.class_names)[labels]


@pytest.fixture(scope="module")
def tuned() -> Tuned:
    recipe = load_recipe("bench", timing=Timing(sampling_rate_hz=10_000.0))
    measurements, labels = cases(recipe, 1, 1000)
    rule = ThresholdConfirmationClassifier(recipe, false_alarm_rate=0.05)
    return recipe, rule.fit(measurements, names(recipe, labels))


def test_healthy_cases_alarm_at_the_wanted_rate_in_spite_of_tolerances(tuned: Tuned) -> None:
    recipe, rule = tuned
    measurements, _ = cases(replace(recipe, classes=(FaultClass(),)), 2, 2000)
    alarms = int((rule.decide(measurements).alarm_index >= 0).sum())
    # One factor on the thresholds is an order statistic of about 100 healthy cases: the rate is spread by 0.022.
    assert len(rule.rule_.windows) > 1
    assert binom.ppf(1e-3, 2000, 0.01) <= alarms <= binom.ppf(1 - 1e-3, 2000, 0.12)


def test_windings_are_told_and_alarms_carry_a_time(tuned: Tuned) -> None:
    recipe, rule = tuned
    measurements, labels = cases(recipe, 3, 600)
    result = rule.decide(measurements)
    windings = np.isin(labels, (3, 4))
    assert (result.class_index == labels)[windings].mean() > 0.97
    assert np.array_equal(result.alarm_index >= 0, result.statistic > 1.0)
    assert np.array_equal(result.class_index != 0, result.alarm_index >= 0)
    assert result.alarm_index.max() < measurements.shape[-1]
    np.testing.assert_allclose(result.probabilities.sum(axis=1), 1.0)


def test_a_rise_of_the_noise_is_told_from_a_bearing() -> None:
    classes = (FaultClass(), FaultClass(FaultKind.BEARING, 0.25), FaultClass(FaultKind.NOISE, 0.5))
    recipe = load_recipe("paper", classes=classes)
    measurements, labels = cases(recipe, 1, 300)
    rule = ThresholdConfirmationClassifier(recipe).fit(measurements, names(recipe, labels))
    measurements, labels = cases(recipe, 2, 300)
    result = rule.decide(measurements)
    assert (result.class_index == labels).mean() > 0.95


def test_bad_training_cases_are_refused_in_one_sentence() -> None:
    recipe = load_recipe("bench")
    measurements, labels = cases(recipe, 1, 60)
    classes = names(recipe, labels)
    with pytest.raises(ValueError, match=r"false_alarm_rate 0\.01 needs at least 198 healthy training cases"):
        ThresholdConfirmationClassifier(recipe, false_alarm_rate=0.01).fit(measurements, classes)
    with pytest.raises(ValueError, match="class must be one of healthy"):
        ThresholdConfirmationClassifier(recipe).fit(measurements, np.where(labels > 0, "odd", "healthy"))
    with pytest.raises(ValueError, match="must hold healthy ones"):
        ThresholdConfirmationClassifier(recipe).fit(measurements[labels > 0], classes[labels > 0])
    sound = replace(recipe, classes=recipe.classes[1:])
    with pytest.raises(ValueError, match="must have one healthy class, got 0"):
        ThresholdConfirmationClassifier(sound).fit(measurements[labels > 0], classes[labels > 0])
    rule = ThresholdConfirmationClassifier(recipe).fit(measurements, classes)
    with pytest.raises(ValueError, match="1 x 1000 values a case"):
        rule.decide(measurements[..., :-1])
