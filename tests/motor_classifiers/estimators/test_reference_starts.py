"""Reference starts: the posterior against one joint fit of all starts, the limits known, and features that use them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from sklearn.base import clone
from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
from sklearn.pipeline import make_pipeline

from motor_classifiers import PosteriorNetwork, ResidualProjection
from motor_classifiers.estimators.reference_starts import (
    RecentredStarts,
    referenced_probabilities,
    referenced_starts,
    split_starts,
)
from motor_datasets import generate_arrays
from motor_env import Recipe, Timing, class_probabilities, load_recipe, simulate_states

# Reaches in: pins the prior that healthy starts leave, which no public name shows.
from motor_env.inference.posterior import prior_from_starts
from motor_env.motor.faults import apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass, Spread
from motor_env.simulation.sampling import apply_factors

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FASTER = load_recipe("bench", timing=Timing(2_000.0, 0.1))


def log_evidence(recipe: Recipe, starts: FloatArray, fault_class: FaultClass) -> float:
    """Laplace's method over all starts at once: own factors common to all, a supply for each; up to a constant."""
    faulty = apply_faults(recipe.motor, fault_class.faults)

    def current(n: int, own: FloatArray, supply: float) -> FloatArray:
        factors = 1.0 + recipe.spread.std * np.concatenate([[0.0], own])
        voltage = (1.0 + recipe.spread.supply * supply) * recipe.timing.step(12.0)
        motor = apply_factors(recipe.motor if n else faulty, factors)
        return np.asarray(simulate_states(motor, voltage, recipe.timing.dt_s)[:, 0])

    def residuals(values: FloatArray) -> FloatArray:
        off = [start - current(n, values[:4], values[4 + n]) for n, start in enumerate(starts)]
        return np.concatenate([np.concatenate(off) / recipe.sensor.current_noise_a, values])

    found = least_squares(residuals, np.zeros(4 + len(starts)))
    _, log_determinant = np.linalg.slogdet(np.asarray(found.jac).T @ found.jac)
    return float(-found.cost - 0.5 * log_determinant)


@pytest.mark.parametrize("n_references", [1, 3])
def test_the_posterior_is_that_of_all_starts_at_once(n_references: int) -> None:
    drawn = referenced_starts(BENCH, 4, np.arange(3), n_references)
    got = referenced_probabilities(BENCH, drawn.X)
    starts = split_starts(drawn.X, BENCH)[:, :, 0].astype(np.float64)
    for case, probabilities in zip(starts, got, strict=True):
        evidence = np.array([log_evidence(BENCH, case, fault) for fault in BENCH.classes])
        expected = np.exp(evidence - evidence.max())
        np.testing.assert_allclose(probabilities, expected / expected.sum(), atol=0.006)


def test_references_are_the_starts_before_the_judged_one() -> None:
    drawn = referenced_starts(BENCH, 4, [7, 2], 2)
    several = replace(BENCH, starts_per_motor=3, healthy_starts=2)
    for row, motor in enumerate((7, 2)):
        own = generate_arrays(several, 4, 3 * motor + np.array([2, 0, 1]))
        np.testing.assert_array_equal(drawn.X[row], own.X[:, 0])
        assert (drawn.case_id[row], drawn.motor_id[row]) == (3 * motor + 2, motor)
        assert own.class_name[1:].tolist() == ["healthy", "healthy"]
    assert split_starts(drawn.X, BENCH).shape == (2, 3, 1, 100)
    with pytest.raises(ValueError, match="must be starts of 1 x 100 values each, got 150 values"):
        split_starts(np.zeros((2, 150)), BENCH)


def test_without_references_nothing_changes() -> None:
    drawn, plain = referenced_starts(BENCH, 4, np.arange(20), 0), generate_arrays(BENCH, 4, 20)
    np.testing.assert_array_equal(drawn.X, plain.X)
    np.testing.assert_array_equal(drawn.class_name, plain.class_name)
    expected = class_probabilities(BENCH, plain.X)
    np.testing.assert_allclose(referenced_probabilities(BENCH, drawn.X), expected, atol=1e-9)


def test_the_prior_that_references_leave_is_as_sure_as_it_says() -> None:
    recipe, n = replace(BENCH, sensor=replace(BENCH.sensor, current_noise_a=0.005)), 200
    drawn = referenced_starts(recipe, 4, np.arange(n), 2)
    prior = prior_from_starts(recipe, split_starts(drawn.X, recipe)[:, 1:])
    truth = generate_arrays(replace(recipe, starts_per_motor=3, healthy_starts=2), 4, np.arange(n) * 3 + 2)
    resistance = truth.parameters["resistance_ohm"] / recipe.motor.resistance_ohm
    error = prior.mean[:, 1] * recipe.spread.resistance + 1.0 - resistance
    std = recipe.spread.resistance * np.sqrt(np.linalg.inv(prior.precision)[:, 1, 1])
    assert std.max() < 0.9 * recipe.spread.resistance
    assert np.square(error / std).mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n))
    # The supply of the next start is another one.
    np.testing.assert_allclose(prior.mean[:, 0], 0.0)
    np.testing.assert_allclose(prior.precision[:, 0], np.tile(np.eye(5)[0], (n, 1)), atol=1e-9)


def test_a_plain_classifier_uses_references_by_recentred_starts() -> None:
    train, test = (referenced_starts(FASTER, 6, np.arange(1500) + first, 3) for first in (0, 10_000))
    alone = make_pipeline(ResidualProjection(FASTER, 6), QuadraticDiscriminantAnalysis())
    given = make_pipeline(RecentredStarts(FASTER), clone(alone))
    one = given.fit(train.X, train.class_name).predict(test.X) == test.class_name
    other = alone.fit(train.X[:, :1], train.class_name).score(test.X[:, :1], test.class_name)
    assert one.mean() > other + 0.005
    best = referenced_probabilities(FASTER, test.X).argmax(axis=1) == test.class_index
    difference = one.astype(np.float64) - best
    assert abs(difference.mean()) < 0.005 + 3.0 * difference.std() / np.sqrt(len(best))


def test_recentred_starts_are_those_of_the_nominal_motor() -> None:
    """Of healthy motors seen without noise nothing but the supply of the judged start is left."""
    quiet = replace(BENCH, sensor=replace(BENCH.sensor, current_noise_a=1e-4))
    sound = replace(quiet, classes=(FaultClass(),), spread=replace(quiet.spread, supply=0.0))
    drawn = referenced_starts(sound, 3, np.arange(20), 4)
    nominal = generate_arrays(replace(sound, spread=Spread()), 3, 1).X[0, 0]
    recentred = RecentredStarts(sound).fit_transform(drawn.X)
    assert recentred.shape == (20, 100)
    assert np.abs(drawn.X[:, 0] - nominal).max() > 0.02
    assert np.abs(recentred - nominal).max() < 1e-3
    np.testing.assert_array_equal(RecentredStarts(sound).fit_transform(drawn.X[:, :1]), drawn.X[:, 0])


def test_a_network_learns_from_the_stream_of_referenced_starts() -> None:
    quick: dict[str, Any] = {"steps": 150, "batch_size": 128, "n_references": 1, "random_state": 0}
    model = PosteriorNetwork(BENCH, n_components=12, **quick).fit_stream()
    test = referenced_starts(BENCH, 7, np.arange(600), 1)
    own = model.predict_proba(test.X)[:, [model.classes_.tolist().index(name) for name in BENCH.class_names]]
    assert np.abs(own - referenced_probabilities(BENCH, test.X)).mean() < 0.05
    with pytest.raises(ValueError, match="a case must be 2 starts, got 1"):
        model.fit(test.X[:, :1], test.class_name)
