"""A motor that is warmer than its healthy starts were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from motor_env import (
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
    load_motor,
    simulate,
)

MOTOR = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml").parameters
TIMING = Timing(10_000.0, 0.2, 0.05)


def warmed(kelvin: float) -> MotorParameters:
    constant = 1.0 - 0.001 * kelvin
    return MOTOR.scaled(
        resistance_ohm=1.0 + 0.00393 * kelvin,
        back_emf_constant_v_s_per_rad=constant,
        torque_constant_n_m_per_a=constant,
        viscous_friction_n_m_s_per_rad=1.0 - 0.003 * kelvin,
    )


def starts(motor: MotorParameters, numbers: range, *faults: Fault) -> list[Recording]:
    scenario = Scenario(motor, faults, SupplyParameters(12.0), SensorParameters(current_noise_a=0.02), TIMING)
    currents = simulate(scenario, 11, numbers).measurements[:, 0]
    return [Recording(Path("x"), TIMING.time_s, row) for row in currents]


@pytest.fixture(scope="module")
def healthy() -> Motor:
    return commission(starts(MOTOR, range(5)), voltage_v=12.0).motor


@pytest.mark.parametrize("kelvin", [-20.0, 10.0, 25.0])
def test_another_temperature_is_no_fault(healthy: Motor, kelvin: float) -> None:
    for recording in starts(warmed(kelvin), range(5, 9)):
        found = diagnose(recording, healthy, voltage_v=12.0)
        assert found.verdict is Verdict.HEALTHY
        if kelvin == 25.0:
            assert "K warmer" in found.reasons[-1]


@pytest.mark.parametrize("kelvin", [0.0, 15.0])
def test_a_bad_contact_is_still_one(healthy: Motor, kelvin: float) -> None:
    fault = Fault(FaultKind.WINDING_CONTACT, 0.25)
    for recording in starts(warmed(kelvin), range(5, 8), fault):
        assert diagnose(recording, healthy, voltage_v=12.0).verdict is Verdict.WINDING


def test_a_measured_temperature_makes_a_smaller_change_visible(healthy: Motor) -> None:
    (recording,) = starts(warmed(40.0), range(5, 6))
    assert healthy.healthy is not None
    known = replace(healthy, healthy=replace(healthy.healthy, temperature_c=20.0))
    warm = diagnose(recording, known, voltage_v=12.0, temperature_c=60.0)
    cold = diagnose(recording, known, voltage_v=12.0, temperature_c=20.0)
    assert warm.verdict is Verdict.HEALTHY
    assert cold.verdict is not Verdict.HEALTHY
    assert (
        warm.telling.smallest_changes["winding_contact"]
        < cold.telling.smallest_changes["winding_contact"] * 1.01
    )
