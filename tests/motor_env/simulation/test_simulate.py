"""Simulation: against scipy's dlsim, batch against single, time axis, onsets, noise."""

import numpy as np
import pytest
from scipy import signal, stats

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    discretize,
    simulate,
    simulate_states,
)
from motor_env.motor.faults import NoiseSource, apply_fault
from motor_env.motor.model import State

DT_S = 1e-4
QUIET_SENSOR = SensorParameters(current_noise_a=0.0, speed_noise_rad_s=0.0)
BOTH = SensorParameters((Channel.CURRENT, Channel.SPEED))


def test_states_against_dlsim() -> None:
    rng = np.random.default_rng(0)
    voltage, load = 12.0 * rng.standard_normal(500), 1e-3 * rng.standard_normal(500)
    states = simulate_states(PAPER_MOTOR, voltage, DT_S, load_torque_n_m=load, initial_state=(0.3, -20.0))
    model = discretize(PAPER_MOTOR, DT_S)
    system = (model.transition, model.gain, np.eye(2), np.zeros((2, 2)), DT_S)
    # dlsim returns x[k] before interval k; ours is read at its end.
    inputs = np.vstack([np.column_stack([voltage, load]), [0.0, 0.0]])
    _, _, expected = signal.dlsim(system, inputs, x0=(0.3, -20.0))
    np.testing.assert_allclose(states, expected[1:], rtol=1e-12, atol=1e-12)


def test_two_runs_joined_are_one() -> None:
    voltage = np.linspace(-12.0, 12.0, 300)
    whole = simulate_states(PAPER_MOTOR, voltage, DT_S)
    first = simulate_states(PAPER_MOTOR, voltage[:120], DT_S)
    second = simulate_states(PAPER_MOTOR, voltage[120:], DT_S, initial_state=first[-1])
    assert np.array_equal(whole, np.concatenate([first, second]))


def test_time_axis_and_the_step() -> None:
    timing = Timing(sampling_rate_hz=1000.0, duration_s=0.005, quiet_s=0.003)
    transients = simulate(Scenario(PAPER_MOTOR, sensor=QUIET_SENSOR, timing=timing), 0, [0])
    np.testing.assert_allclose(transients.time_s, 1e-3 * np.arange(-2, 6), atol=1e-15)
    assert transients.voltage_v[0].tolist() == [0.0] * 3 + [12.0] * 5
    current = transients.measurements[0, 0]
    # The sample at time 0 is read at the step itself: nothing flows before the interval that begins there.
    assert np.all(current[:3] == 0.0)
    assert current[3] == pytest.approx(12.0 * discretize(PAPER_MOTOR, 1e-3).gain[0, 0], rel=1e-12)


@pytest.mark.parametrize("kind", [FaultKind.BEARING, FaultKind.WINDING_CONTACT, FaultKind.WINDING_SHORT])
def test_onset_switches_the_interval_that_begins_there(kind: FaultKind) -> None:
    fault = Fault(kind, 0.3, onset_s=0.0042)
    states = simulate_states(PAPER_MOTOR, np.full(100, 12.0), DT_S, faults=(fault,))
    healthy = simulate_states(PAPER_MOTOR, np.full(100, 12.0), DT_S)
    assert np.array_equal(states[:42], healthy[:42])
    expected = simulate_states(
        apply_fault(PAPER_MOTOR, fault), np.full(58, 12.0), DT_S, initial_state=healthy[41]
    )
    np.testing.assert_allclose(states[42:], expected, rtol=1e-13)
    assert not np.allclose(states[42], healthy[42], rtol=1e-6)


def test_growth_holds_each_interval_at_the_severity_of_its_begin() -> None:
    fault = Fault(FaultKind.WINDING_CONTACT, 0.4, onset_s=0.001, growth_s=0.004)
    states = simulate_states(PAPER_MOTOR, np.full(80, 12.0), DT_S, faults=(fault,))
    x = np.zeros(2)
    for k in range(80):
        severity = 0.4 * min(1.0, max(0.0, (k * DT_S - 0.001) / 0.004))
        model = discretize(PAPER_MOTOR.scaled(resistance_ohm=1.0 + severity), DT_S)
        x = model.transition @ x + model.gain @ [12.0, 0.0]
        np.testing.assert_allclose(states[k], x, rtol=1e-5)


def test_onset_counts_from_the_step_with_quiet_before_it() -> None:
    fault = Fault(FaultKind.WINDING_CONTACT, 0.3, onset_s=0.002)
    with_quiet, without = (
        simulate(Scenario(PAPER_MOTOR, (fault,), sensor=QUIET_SENSOR, timing=Timing(quiet_s=quiet)), 0, [0])
        for quiet in (0.01, 0.0)
    )
    np.testing.assert_allclose(with_quiet.states[:, 100:], without.states, rtol=1e-13)


def test_a_batch_is_its_motors() -> None:
    factors, severity = np.array([0.9, 1.0, 1.2]), np.array([0.0, 0.1, 0.25])
    volts = np.array([11.0, 12.0, 13.0])
    timing = Timing(duration_s=0.02, quiet_s=0.005)
    noise = (1e-3, 0.1)
    batch = Scenario(
        PAPER_MOTOR.scaled(resistance_ohm=factors),
        (Fault(FaultKind.BEARING, severity), Fault(FaultKind.WINDING_CONTACT, severity, 0.007, 0.003)),
        SupplyParameters(volts),
        BOTH,
        timing,
        process_noise_std=noise,
    )
    whole = simulate(batch, 5, [10, 11, 12])
    for n in range(3):
        faults = (
            Fault(FaultKind.BEARING, float(severity[n])),
            Fault(FaultKind.WINDING_CONTACT, float(severity[n]), 0.007, 0.003),
        )
        single = Scenario(
            batch.parameters.motor(n),
            faults,
            SupplyParameters(float(volts[n])),
            BOTH,
            timing,
            process_noise_std=noise,
        )
        alone = simulate(single, 5, [10 + n])
        np.testing.assert_allclose(alone.measurements[0], whole.measurements[n], rtol=1e-12)
        np.testing.assert_allclose(alone.states[0], whole.states[n], rtol=1e-12, atol=1e-15)


def test_noise_has_its_deviation_in_each_channel() -> None:
    scenario = Scenario(PAPER_MOTOR, sensor=SensorParameters(("current", "speed"), 0.02, 3.0))  # type: ignore[arg-type]  # names are taken too
    transients = simulate(scenario, 1, np.arange(60))
    errors = transients.measurements - np.moveaxis(transients.states, -1, -2)
    for channel, std in enumerate((0.02, 3.0)):
        assert stats.kstest(errors[:, channel].ravel() / std, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(errors[:, 0].ravel(), errors[:, 1].ravel())[0, 1]) < 4.0 / np.sqrt(
        errors[:, 0].size
    )


def test_noise_fault_raises_the_variance_from_its_onset_on() -> None:
    fault = Fault(FaultKind.NOISE, 8.0, onset_s=0.05)
    transients = simulate(Scenario(PAPER_MOTOR, (fault,)), 1, np.arange(200))
    errors = transients.measurements[:, 0] - transients.states[:, :, State.CURRENT]
    assert errors[:, :500].std() == pytest.approx(0.02, rel=0.01)
    assert errors[:, 500:].std() == pytest.approx(0.06, rel=0.01)


def test_process_noise_enters_the_states() -> None:
    fault = Fault(FaultKind.NOISE, 3.0, onset_s=0.05, noise_source=NoiseSource.PROCESS)
    scenario = Scenario(PAPER_MOTOR, (fault,), process_noise_std=(0.01, 0.5))
    states = simulate(scenario, 2, np.arange(200)).states
    model = discretize(PAPER_MOTOR, DT_S)
    noise = states[:, 1:] - states[:, :-1] @ model.transition.T - model.gain @ [12.0, 0.0]
    assert noise[:, :499].std(axis=(0, 1)) == pytest.approx([0.01, 0.5], rel=0.01)
    assert noise[:, 499:].std(axis=(0, 1)) == pytest.approx([0.02, 1.0], rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"sampling_rate_hz": 0.0}, "sampling_rate_hz must be finite and > 0, got 0"),
        ({"duration_s": -1.0}, "duration_s must be finite and > 0, got -1"),
        ({"duration_s": 1e-6}, "duration_s must hold at least one sample at 10000 Hz, got 1e-06"),
        ({"quiet_s": -0.1}, "quiet_s must be finite and >= 0, got -0.1"),
    ],
)
def test_bad_timing(arguments: dict[str, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Timing(**arguments)


def test_bad_shapes_and_values() -> None:
    with pytest.raises(ValueError, match="voltage_v must have shape"):
        simulate_states(PAPER_MOTOR, 12.0, DT_S)
    with pytest.raises(ValueError, match="voltage_v must be finite"):
        simulate_states(PAPER_MOTOR, [12.0, float("nan")], DT_S)
    batch = Scenario(PAPER_MOTOR.scaled(resistance_ohm=np.ones(3)))
    with pytest.raises(ValueError, match=r"cases must number as many as the scenario's motors \(3,\), got 2"):
        simulate(batch, 0, [0, 1])
