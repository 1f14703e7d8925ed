"""What experiments can tell: against the Cramer-Rao bound, and against transients that must look the same."""

from dataclasses import replace

import numpy as np
import pytest

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Experiment,
    Fault,
    SensorParameters,
    Timing,
    cramer_rao_bound,
    identifiability,
    simulate_states,
)
from motor_env.inference.identifiability import Identifiability
from motor_env.inference.parametrisation import QUANTITIES, Coordinates
from motor_env.motor.faults import apply_fault, motor_kinds

TIMING = Timing(10_000.0, 0.1)
CURRENT = SensorParameters()
BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED), speed_noise_rad_s=2.0)
START = Experiment.start(TIMING, CURRENT)
STEADY = replace(Experiment.start(Timing(10_000.0, 0.2), CURRENT), first_sample=1000)


def test_bounds_are_those_of_cramer_and_rao() -> None:
    free = ("resistance", "inductance", "friction")
    got = identifiability(PAPER_MOTOR, START, free)
    covariance = cramer_rao_bound(PAPER_MOTOR, START, free)
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(got.std, std, rtol=1e-9)
    np.testing.assert_allclose(got.correlation, covariance / np.outer(std, std), atol=1e-9)
    assert got.open_directions.shape == (0, 3)
    assert got.sentences()[0] == "resistance: known to 0.11 %"


def test_current_alone_leaves_one_direction_open() -> None:
    got = identifiability(PAPER_MOTOR, START)
    np.testing.assert_array_equal(got.open_directions, [[0.0, 0.0, 1.0, 2.0, 2.0]])
    assert np.isfinite(got.std).tolist() == [True, True, False, False, False]
    assert "constants by a, inertia by a^2, friction by a^2 changes no sample, for any a" in got.sentences()
    assert got.sentences()[2] == "constants: not identifiable"
    assert not np.isfinite(got.correlation[2]).any()


@pytest.mark.parametrize(("sensor", "n_open"), [(CURRENT, 2), (BOTH, 1)])
def test_open_directions_change_no_sample(sensor: SensorParameters, n_open: int) -> None:
    experiment = Experiment.start(TIMING, sensor)
    got = identifiability(PAPER_MOTOR, experiment, QUANTITIES)
    assert got.open_directions.shape == (n_open, 6)
    coordinates = Coordinates.from_names(PAPER_MOTOR, QUANTITIES)
    nominal = simulate_states(PAPER_MOTOR, experiment.voltage_v, experiment.dt_s) @ sensor.observation.T
    for direction in got.open_directions:
        motor, supply = coordinates.motors(0.2 * direction)
        same = simulate_states(motor, supply * experiment.voltage_v, experiment.dt_s) @ sensor.observation.T
        np.testing.assert_allclose(same, nominal, rtol=1e-9, atol=1e-12)


def test_a_prior_closes_the_open_direction() -> None:
    prior = [np.inf, np.inf, 0.01, np.inf, np.inf]
    got = identifiability(PAPER_MOTOR, START, prior_std=prior)
    assert got.open_directions.size == 0
    np.testing.assert_allclose(got.std[2:4], [0.01, 0.02], rtol=0.01)
    assert [pair[:2] for pair in got.correlated_pairs(0.99)] == [("inertia", "constants")]
    expected = np.sqrt(np.diag(cramer_rao_bound(PAPER_MOTOR, START, got.names, prior)))
    np.testing.assert_allclose(got.std, expected, rtol=1e-6)


def test_unloaded_steady_state_hides_the_winding_and_load_shows_it() -> None:
    waits = identifiability(PAPER_MOTOR, STEADY, ("resistance",)).std[0]
    starts = identifiability(PAPER_MOTOR, START, ("resistance",)).std[0]
    assert waits > 1.0 > 0.01 > starts
    assert identifiability(PAPER_MOTOR, STEADY, ("friction",)).std[0] < 0.03
    both = replace(STEADY, sensor=BOTH)
    driven = np.full(len(STEADY.voltage_v), 0.028)
    loaded = identifiability(PAPER_MOTOR, replace(both, load_torque_n_m=driven), ("resistance",)).std[0]
    assert loaded < 0.1 * identifiability(PAPER_MOTOR, both, ("resistance",)).std[0]


def test_a_direction_of_less_than_a_hundredth_is_open() -> None:
    """Of a noise so large that a factor of e would move the samples by just more, and just less."""
    loud = identifiability(PAPER_MOTOR, START, ("resistance",)).std[0]
    for size, is_open in ((0.0101, False), (0.0099, True)):
        sensor = SensorParameters(current_noise_a=0.02 / (loud * size))
        got = identifiability(PAPER_MOTOR, Experiment.start(TIMING, sensor), ("resistance",))
        assert np.isinf(got.std[0]) == is_open
        assert got.sentences()[0] == f"resistance: {'not identifiable' if is_open else 'known to 9.9e+03 %'}"


def test_pairs_are_told_from_a_correlation_of_nine_tenths_on() -> None:
    correlation = np.array([[1.0, 0.901, 0.899], [0.901, 1.0, -0.95], [0.899, -0.95, 1.0]])
    got = Identifiability(("a", "b", "c"), np.full(3, 0.01), correlation, np.array([[1.0, 0.0, -0.5]]))
    assert got.correlated_pairs() == [("c", "b", -0.95), ("b", "a", 0.901)]
    assert got.sentences()[3:] == [
        "a by a, c by a^-0.5 changes no sample, for any a",
        "c and b are hard to tell apart: correlation -0.950",
        "b and a are hard to tell apart: correlation 0.901",
    ]


def test_fault_directions_are_those_of_apply_fault() -> None:
    step = 1e-6
    coordinates = Coordinates.from_names(PAPER_MOTOR, QUANTITIES)
    for kind in motor_kinds():
        motor, _ = coordinates.motors(step * kind.direction(QUANTITIES))
        faulty = apply_fault(PAPER_MOTOR, Fault(kind, step))
        for field in (
            "resistance_ohm",
            "inductance_h",
            "torque_constant_n_m_per_a",
            "viscous_friction_n_m_s_per_rad",
        ):
            assert getattr(motor, field) == pytest.approx(getattr(faulty, field), rel=1e-11)


def test_bad_experiments_are_named() -> None:
    with pytest.raises(ValueError, match=r"first_sample must be in 0 .. 999, got 1000"):
        replace(START, first_sample=1000)
    with pytest.raises(ValueError, match="noise of each channel must be > 0"):
        replace(START, sensor=SensorParameters(current_noise_a=0.0))
