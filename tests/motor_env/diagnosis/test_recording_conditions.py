"""Starts that are recorded otherwise than the healthy ones, or warmer, and voltages read at other times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motor_env import (
    Diagnosis,
    Fault,
    FaultKind,
    Motor,
    MotorParameters,
    Recording,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    Verdict,
    commission,
    diagnose,
    identify,
    load_motor,
)
from motor_env.diagnosis.commission import Commissioned
from motor_env.motor.parameters import FloatArray

# Reaches in: the supply comes on between two samples, which `simulate` cannot do; its level is drawn as by recipes.
from motor_env.simulation.fast_path import measure
from motor_env.simulation.nonlinear import Effects
from motor_env.simulation.random_streams import Stream, normals

MOTOR = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml").parameters
COMMISSIONED = Timing(10_000.0, 0.2, 0.05)


def starts(
    count: int,
    timing: Timing = COMMISSIONED,
    *faults: Fault,
    motor: MotorParameters = MOTOR,
    noise_a: float = 0.02,
    seed: int = 3,
    delay_s: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Times, and currents of one motor whose supply scatters by half a percent, shape (count, n_samples)."""
    numbers = np.arange(count)
    supply = SupplyParameters(12.0 * (1.0 + 0.005 * normals(seed, Stream.SUPPLY, numbers, 1)[:, 0]))
    scenario = Scenario(motor, faults, supply, SensorParameters(current_noise_a=noise_a), timing)
    effects = Effects(delay_s=delay_s) if delay_s else None
    return timing.time_s, measure(scenario, seed, numbers, effects=effects, nominal=MOTOR)[:, 0].astype(float)


def recordings(time_s: FloatArray, current_a: FloatArray) -> list[Recording]:
    return [Recording(Path(f"start-{n}"), time_s, row) for n, row in enumerate(current_a)]


def verdicts(learned: Motor, time_s: FloatArray, current_a: FloatArray) -> list[Diagnosis]:
    return [diagnose(recording, learned) for recording in recordings(time_s, current_a)]


def always_as_warm(learned: Commissioned) -> Motor:
    """What healthy starts teach if the motor is always as warm: a change of 15 K would hide R +25 % at 2 kHz."""
    return replace(learned.motor, healthy=replace(learned.healthy, temperature_k=0.0))


@pytest.fixture(scope="module")
def healthy() -> Commissioned:
    return commission(recordings(*starts(5)))


@pytest.fixture(scope="module")
def commissioned(healthy: Commissioned) -> Motor:
    return always_as_warm(healthy)


@pytest.mark.parametrize(("delay", "skew"), [(0.0, -1), (0.0, 1), (0.4, 0), (0.9, -1), (0.9, 1)])
def test_inductance_is_told_wherever_a_measured_voltage_changes(delay: float, skew: int) -> None:
    """L/R is as long as an interval: a step taken half an interval late would look like half the inductance."""
    time_s, current_a = starts(1, noise_a=0.005, delay_s=delay * COMMISSIONED.dt_s)
    switched = np.where(time_s > (skew + 1e-3) * COMMISSIONED.dt_s, 12.0, 0.0)
    voltage = switched + np.random.default_rng(1).normal(0.0, 0.01, len(time_s))
    (fit,) = identify(Recording(Path("start"), time_s, current_a[0], voltage)).usable
    told = dict(zip(fit.quantity_names, fit.values.tolist(), strict=True))
    assert told["L"] == pytest.approx(0.238e-3, rel=0.1)
    assert told["R"] == pytest.approx(2.18, rel=0.02)
    assert fit.onset_s == pytest.approx(0.0, abs=2.5 * COMMISSIONED.dt_s)


@pytest.mark.parametrize(
    "timing", [Timing(10_000.0, 0.03, 0.01), Timing(2_000.0, 0.2, 0.05), Timing(2_000.0, 0.04, 0.01)]
)
def test_a_start_that_tells_less_than_the_healthy_ones_raises_no_alarm(
    commissioned: Motor, timing: Timing
) -> None:
    """Its own error counts where it is larger than theirs; a fault that is larger still is found."""
    assert not any(d.verdict.is_fault for d in verdicts(commissioned, *starts(5, timing, seed=5)))
    worn = verdicts(commissioned, *starts(5, timing, Fault(FaultKind.WINDING_CONTACT, 0.25), seed=6))
    assert all(d.verdict.is_fault for d in worn)
    assert sum(d.verdict is Verdict.WINDING for d in worn) >= 4


@pytest.mark.parametrize("rate_hz", [1_000.0, 10_000.0])
def test_a_verdict_is_at_least_as_probable_as_what_it_rules_out(rate_hz: float, commissioned: Motor) -> None:
    """A weak magnet moves K^2/J alone; where L cannot be told, shorted turns might explain it, barely."""
    timing = Timing(rate_hz, 0.2, 0.05)
    learned = commissioned
    if timing != COMMISSIONED:
        learned = always_as_warm(commission(recordings(*starts(5, timing))))
    constant = MOTOR.back_emf_constant_v_s_per_rad
    weak = replace(
        MOTOR, back_emf_constant_v_s_per_rad=0.9 * constant, torque_constant_n_m_per_a=0.9 * constant
    )
    for found in verdicts(learned, *starts(4, timing, motor=weak, seed=7)):
        assert found.verdict is Verdict.OTHER
        assert found.confidence is not None
        assert found.confidence > 0.45


def test_what_the_samples_cannot_tell_has_a_wide_interval() -> None:
    """L/R of 0.11 ms between samples 1 ms apart: where in the interval the step came is told by nothing either."""
    fits = []
    for place in np.linspace(0.05, 0.95, 10).tolist():
        time_s, current_a = starts(1, Timing(1_000.0, 0.2, 0.05), delay_s=place * 1e-3)
        fits += identify(recordings(time_s, current_a)[0]).usable
    assert len(fits) == 10
    off = np.array([fit.log_values for fit in fits]) - fits[0].log_values
    errors = np.array([np.sqrt(np.diag(fit.log_covariance)) for fit in fits])
    assert np.all(off.std(axis=0) < 2.0 * np.median(errors, axis=0))
    assert np.all(errors[:, 0] < 0.3)


def warmed(kelvin: float) -> MotorParameters:
    constant = 1.0 - 0.001 * kelvin
    return MOTOR.scaled(
        resistance_ohm=1.0 + 0.00393 * kelvin,
        back_emf_constant_v_s_per_rad=constant,
        torque_constant_n_m_per_a=constant,
        viscous_friction_n_m_s_per_rad=1.0 - 0.003 * kelvin,
    )


@pytest.mark.parametrize("kelvin", [-20.0, 25.0])
def test_another_temperature_is_no_fault(healthy: Commissioned, kelvin: float) -> None:
    for found in verdicts(healthy.motor, *starts(2, motor=warmed(kelvin), seed=8)):
        assert found.verdict is Verdict.HEALTHY
        assert ("K warmer" in found.reasons[-1]) is (kelvin > 0.0)


@pytest.mark.parametrize("kelvin", [0.0, 15.0])
def test_a_bad_contact_is_still_one(healthy: Commissioned, kelvin: float) -> None:
    fault = Fault(FaultKind.WINDING_CONTACT, 0.25)
    for found in verdicts(healthy.motor, *starts(2, COMMISSIONED, fault, motor=warmed(kelvin), seed=9)):
        assert found.verdict is Verdict.WINDING


def test_a_measured_temperature_makes_a_smaller_change_visible(healthy: Commissioned) -> None:
    (recording,) = recordings(*starts(1, motor=warmed(40.0), seed=10))
    known = replace(healthy.motor, healthy=replace(healthy.healthy, temperature_c=20.0))
    warm, cold = (diagnose(recording, known, temperature_c=celsius) for celsius in (60.0, 20.0))
    assert warm.verdict is Verdict.HEALTHY
    assert cold.verdict is not Verdict.HEALTHY
    assert warm.smallest_changes["winding_contact"] < cold.smallest_changes["winding_contact"] * 1.01
