"""Confirmation by thresholds: its rate of false alarms, its diagnosis, its bad inputs."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom

from motor_env.detection.confirmation import ThresholdConfirmation, window_features
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Recipe, draw, named_recipe
from motor_env.simulation.simulate import Timing, simulate

Tuned = tuple[Recipe, ThresholdConfirmation]


def cases(recipe: Recipe, seed: int, count: int) -> tuple[FloatArray, NDArray[np.int64]]:
    drawn = draw(recipe, seed, range(count))
    return simulate(drawn.scenario, seed, drawn.cases).measurements, drawn.class_index


@pytest.fixture(scope="module")
def tuned() -> Tuned:
    recipe = named_recipe("bench", timing=Timing(sampling_rate_hz=10_000.0))
    measurements, labels = cases(recipe, 1, 1000)
    rule = ThresholdConfirmation.tune(recipe, measurements, labels, false_alarm_rate=0.05)
    return recipe, rule


def test_window_features_of_white_noise_are_standard_normal() -> None:
    noise = np.random.default_rng(1).standard_normal((4000, 64, 2))
    features = window_features(noise, (0, 8, 32, 64), True)
    assert features.shape == (4000, 3, 4)
    np.testing.assert_allclose(features.mean(axis=0), 0.0, atol=4.0 / np.sqrt(4000))
    np.testing.assert_allclose(features.var(axis=0), 1.0, atol=0.15)


def test_healthy_cases_alarm_at_the_wanted_rate_in_spite_of_tolerances(tuned: Tuned) -> None:
    recipe, rule = tuned
    measurements, _ = cases(replace(recipe, classes=(FaultClass(),)), 2, 2000)
    alarms = int((rule.decide(measurements, recipe.nominal_voltage_v).alarm_index >= 0).sum())
    # The threshold is an order statistic of about 200 healthy cases: the rate itself is spread by 0.016.
    assert binom.ppf(1e-3, 2000, 0.01) <= alarms <= binom.ppf(1 - 1e-3, 2000, 0.11)


def test_windings_are_told_and_alarms_carry_a_time(tuned: Tuned) -> None:
    recipe, rule = tuned
    measurements, labels = cases(recipe, 3, 600)
    result = rule.decide(measurements, recipe.nominal_voltage_v)
    windings = np.isin(labels, (3, 4))
    assert (result.class_index == labels)[windings].mean() > 0.97
    assert np.array_equal(result.alarm_index >= 0, result.statistic > 1.0)
    assert np.array_equal(result.class_index != 0, result.alarm_index >= 0)
    assert result.alarm_index.max() < measurements.shape[-1]
    np.testing.assert_allclose(result.probabilities.sum(axis=1), 1.0)


def test_a_case_is_decided_alike_alone_and_in_company(tuned: Tuned) -> None:
    recipe, rule = tuned
    measurements, _ = cases(recipe, 4, 20)
    together = rule.decide(measurements, recipe.nominal_voltage_v)
    alone = rule.decide(measurements[7:8], recipe.nominal_voltage_v)
    assert alone.class_index[0] == together.class_index[7]
    np.testing.assert_allclose(alone.probabilities[0], together.probabilities[7], rtol=1e-9)


def test_a_rise_of_the_noise_is_told_from_a_bearing() -> None:
    classes = (FaultClass(), FaultClass(FaultKind.BEARING, 0.25), FaultClass(FaultKind.NOISE, 0.5))
    recipe = named_recipe("paper", classes=classes)
    rule = ThresholdConfirmation.tune(recipe, *cases(recipe, 1, 300))
    measurements, labels = cases(recipe, 2, 300)
    result = rule.decide(measurements, recipe.nominal_voltage_v)
    assert (result.class_index == labels).mean() > 0.95


def test_bad_training_cases_are_refused_in_one_sentence() -> None:
    recipe = named_recipe("bench")
    measurements, labels = cases(recipe, 1, 60)
    with pytest.raises(ValueError, match=r"false_alarm_rate 0\.01 needs at least 99 healthy training cases"):
        ThresholdConfirmation.tune(recipe, measurements, labels, false_alarm_rate=0.01)
    with pytest.raises(ValueError, match=r"class_index must lie in 0 \.\. 4"):
        ThresholdConfirmation.tune(recipe, measurements, labels + 1)
    with pytest.raises(ValueError, match="must hold healthy ones"):
        ThresholdConfirmation.tune(recipe, measurements[labels > 0], labels[labels > 0])
    rule = ThresholdConfirmation.tune(recipe, measurements, labels)
    with pytest.raises(ValueError, match="measurements must have shape"):
        rule.decide(measurements[..., :-1], recipe.nominal_voltage_v[:-1])
