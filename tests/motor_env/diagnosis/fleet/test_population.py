"""The healthy core of a population: found while sick motors are in it, and no tighter than it is."""

from dataclasses import replace

import numpy as np
import pytest

from motor_env.diagnosis.fleet.population import Motors, floor_covariance, learn_population
from motor_env.motor.parameters import FloatArray

BETWEEN = np.diag(np.square([0.065, 0.025, 0.065, 0.25]))
WITHIN = np.diag(np.square([0.02, 0.01, 0.02, 0.05]))
ERROR = np.diag(np.square([0.01, 0.005, 0.01, 0.03]))
CENTRE = np.log([4.0, 0.09, 8e-5, 3e-4])
BELIEF = np.diag(np.square([0.075, 0.03, 0.075, 0.35]))


def motors(logs: FloatArray, *, repeats: int = 1, positions: int = 1) -> Motors:
    """Motors with so many records each, in so many places of their machines."""
    count = len(logs) // repeats
    return Motors(
        logs,
        np.tile(ERROR, (len(logs), 1, 1)),
        np.repeat(np.arange(count), repeats),
        np.arange(count) % positions,
        BELIEF,
        np.eye(4) * 0.02**2,
    )


def healthy(rng: np.random.Generator, count: int) -> FloatArray:
    return CENTRE + rng.multivariate_normal(np.zeros(4), BETWEEN + WITHIN + ERROR, count)


def test_the_core_is_that_of_the_healthy_ones_with_a_fifth_sick() -> None:
    rng = np.random.default_rng(3)
    logs = healthy(rng, 100)
    logs[:20, 3] += np.log(8.0)
    core = learn_population(motors(logs))
    assert np.abs(core.centres[0] - CENTRE) == pytest.approx(0.0, abs=0.06)
    ratio = np.sqrt(np.diag(core.between + core.within) / np.diag(BETWEEN + WITHIN))
    assert ratio == pytest.approx(1.0, abs=0.25)
    assert (core.probability[:20] < 0.1).all()
    assert np.mean(core.probability[20:] > 0.5) > 0.95


def test_gains_that_move_several_quantities_are_told_from_the_core() -> None:
    """A fifth of the motors has a speed that reads 15 or 20 % high: each quantity alone is not far off."""
    rng, gain = np.random.default_rng(6), np.array([0.0, -1.0, -2.0, -2.0])
    logs = healthy(rng, 100)
    logs[:20] += np.outer(np.log(np.repeat([1.15, 1.2], 10)), gain)
    everyone = motors(logs)
    blind, known = learn_population(everyone), learn_population(replace(everyone, directions=gain[None]))
    assert known.probability[:20].mean() < 0.5 * blind.probability[:20].mean()
    assert known.between[1, 1] < blind.between[1, 1]


def test_ten_healthy_motors_are_no_tighter_than_they_are() -> None:
    ratios = []
    for seed in range(40):
        core = learn_population(motors(healthy(np.random.default_rng(seed), 10)))
        ratios.append(np.diag(core.next_motor() + core.within) / np.diag(BETWEEN + WITHIN))
        assert 9.0 < core.degrees_of_freedom <= 13.0
    mean = np.mean(ratios, axis=0)
    assert (mean > 0.8).all()
    assert (mean < 1.7).all()


def test_the_order_of_motors_does_not_matter() -> None:
    logs = healthy(np.random.default_rng(1), 30)
    logs[3] += 1.0
    order = np.random.default_rng(0).permutation(30)
    one, other = learn_population(motors(logs)), learn_population(motors(logs[order]))
    assert other.between == pytest.approx(one.between, rel=1e-4, abs=1e-9)
    assert other.probability == pytest.approx(one.probability[order], abs=1e-4)


def test_a_core_that_begins_near_ends_where_one_from_afar_does() -> None:
    everyone = motors(healthy(np.random.default_rng(5), 40))
    kept = np.arange(40) > 0
    near = learn_population(everyone.subset(kept), begin=learn_population(everyone))
    afar = learn_population(everyone.subset(kept))
    assert near.centres == pytest.approx(afar.centres, abs=1e-4)
    assert near.between == pytest.approx(afar.between, rel=1e-2, abs=1e-6)


def test_left_and_right_have_centres_of_their_own() -> None:
    logs = healthy(np.random.default_rng(2), 60)
    logs[1::2, 0] += 0.3
    core = learn_population(motors(logs, positions=2))
    assert core.centres[1, 0] - core.centres[0, 0] == pytest.approx(0.3, abs=0.06)
    assert np.sqrt(core.between[0, 0]) < 0.1


def test_repeats_tell_how_records_scatter_and_one_wrong_record_does_not() -> None:
    rng = np.random.default_rng(8)
    own = CENTRE + rng.multivariate_normal(np.zeros(4), BETWEEN, 30)
    noise = rng.multivariate_normal(np.zeros(4), 25.0 * WITHIN + ERROR, 90)
    logs = np.repeat(own, 3, axis=0) + noise
    logs[4] += 3.0
    core = learn_population(motors(logs, repeats=3))
    assert np.sqrt(np.diag(core.within) / np.diag(25.0 * WITHIN)) == pytest.approx(1.0, abs=0.35)


def test_records_of_one_motor_count_as_one_motor() -> None:
    logs = healthy(np.random.default_rng(4), 12)
    once = learn_population(motors(logs))
    everyone = motors(np.repeat(logs, 2, axis=0), repeats=2)
    twice = learn_population(replace(everyone, errors=2.0 * everyone.errors))
    assert twice.degrees_of_freedom == pytest.approx(once.degrees_of_freedom, abs=0.5)
    assert twice.centres == pytest.approx(once.centres, abs=0.02)


def test_a_covariance_is_raised_in_the_directions_that_it_lacks_alone() -> None:
    raised = floor_covariance(np.diag([4.0, -1.0]), np.eye(2))
    assert raised == pytest.approx(np.diag([4.0, 1.0]))
