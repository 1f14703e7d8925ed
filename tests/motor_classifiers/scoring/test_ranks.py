"""Ranks of the truth in the posterior: their band by simulation, and the shipped network within it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

# Reaches in: the shipped network is judged on the severities that it was trained on.
from motor_classifiers.estimators.networks.severity_density import severity_recipe
from motor_classifiers.model_files.persistence import PRETRAINED, load_model
from motor_classifiers.scoring.judging import in_recipe_order
from motor_datasets import generate_arrays

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))
from ranks import class_ranks, confidence_ranks, rank_check, severity_ranks, severity_shares

ERROR = 0.001  # of all bands of the shipped network


def test_ranks_of_classes_by_hand() -> None:
    probabilities = np.array([[0.25, 0.5, 0.25], [0.125, 0.375, 0.5]])
    np.testing.assert_allclose(class_ranks(probabilities, np.array([1, 2]), np.array([0.5, 0.0])), [0.5, 0.5])
    got = confidence_ranks(probabilities, np.array([1, 0]), np.array([0.5, 1.0]))
    np.testing.assert_allclose(got, [0.25, 1.0])
    shares = np.array([[0.25, 0.5, 0.25]])
    assert severity_ranks(shares, np.array([0.25])) == pytest.approx(0.5 * (0.125 + 0.5))


def test_uniform_ranks_leave_the_band_as_often_as_it_says() -> None:
    generator = np.random.default_rng(3)
    left = [not rank_check(generator.uniform(size=200), 0.2).inside for _ in range(1_000)]
    assert abs(np.mean(left) - 0.2) < 4.0 * np.sqrt(0.2 * 0.8 / 1_000)
    check = rank_check(generator.uniform(size=200), 0.2)
    assert check.largest == pytest.approx(np.abs(check.share - check.position).max())
    assert not rank_check(generator.uniform(size=200) ** 1.4, 0.001).inside
    with pytest.raises(ValueError, match="ranks must be 100 or more, got 99"):
        rank_check(np.zeros(99), 0.1)
    with pytest.raises(ValueError, match=r"error must be in \(0, 1\), got 1"):
        rank_check(np.zeros(100), 1.0)


def test_the_shipped_network_is_within_all_bands() -> None:
    model, recipe, _ = load_model(PRETRAINED)
    n_cases, priors = 1_000, model.severity_priors_
    # At 60 mA a fifth of the decisions are wrong: at 20 mA nearly all are sure, and temper changes little.
    loud = replace(recipe, sensor=recipe.sensor.with_noise(3.0))
    cases = generate_arrays(loud, 47, 2 * n_cases)
    probabilities = in_recipe_order(model, model.predict_proba(cases.X), recipe)
    uniform = np.random.default_rng(1).uniform(size=2 * n_cases)
    unsure = probabilities.max(axis=1) < 0.99  # where it is sure, a rank is but a random number
    probabilities, truth, uniform = probabilities[unsure], cases.class_index[unsure], uniform[unsure]
    ranks = [class_ranks(probabilities, truth, uniform), confidence_ranks(probabilities, truth, uniform)]
    ranges = severity_recipe(recipe)
    for prior, own in zip(priors, ranges.classes, strict=True):
        drawn = generate_arrays(replace(ranges, classes=(own,)), 48, n_cases)
        shares = severity_shares(model, drawn.X, str(prior.kind))
        ranks.append(severity_ranks(shares, drawn.severity / prior.largest))
    assert [rank_check(each, ERROR / len(ranks)).inside for each in ranks] == [True] * 5
    # Powers of the probabilities: too sure, and not sure enough.
    for power in (1.5, 0.5):
        tempered = probabilities**power / (probabilities**power).sum(axis=1, keepdims=True)
        assert not rank_check(confidence_ranks(tempered, truth, uniform), ERROR / len(ranks)).inside
