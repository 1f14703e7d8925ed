"""Starts under a load, which the textbook takes for viscous friction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from motor_env.diagnosis.diagnose import diagnose
from motor_env.diagnosis.healthy_motor import fit_healthy, learn_reference
from motor_env.identification.start_model import Extension, step_start
from motor_env.motor.data_sheet import load_motor
from motor_env.motor.parameters import FloatArray, MotorParameters
from motor_env.recordings.recording import Recording

MOTOR = load_motor(Path(__file__).parents[3] / "examples" / "motor.toml").parameters
TIME_S: FloatArray = np.linspace(-0.02, 0.0999, 1200)
SPEED = float(12.0 / MOTOR.back_emf_constant_v_s_per_rad)
TORQUE = float(0.12 * MOTOR.torque_constant_n_m_per_a * 12.0 / MOTOR.resistance_ohm)
LOADS = {
    "constant": Extension(coulomb_friction_n_m=TORQUE),
    "fan": Extension(fan_n_m_s2_per_rad2=TORQUE / SPEED**2),
}


def start(motor: MotorParameters, load: str, number: int, *, has_speed: bool) -> Recording:
    rng = np.random.default_rng([5, number])
    states: FloatArray = step_start(
        motor, LOADS[load], TIME_S, 3e-5, 12.0 * (1.0 + 0.003 * rng.standard_normal())
    )
    noisy: FloatArray = states + rng.standard_normal(states.shape) * [0.01, 0.2]
    return Recording(Path(f"start-{number}"), TIME_S, noisy[:, 0], None, noisy[:, 1] if has_speed else None)


@pytest.mark.parametrize("has_speed", [False, True])
@pytest.mark.parametrize("load", LOADS)
def test_a_winding_fault_under_a_load_is_named(load: str, has_speed: bool) -> None:
    healthy = [start(MOTOR, load, n, has_speed=has_speed) for n in range(5)]
    learned = learn_reference(fit_healthy(healthy, voltage_v=12.0))
    assert (
        diagnose(start(MOTOR, load, 6, has_speed=has_speed), None, learned, voltage_v=12.0).verdict
        == "healthy"
    )
    faulty = start(MOTOR.scaled(resistance_ohm=1.25), load, 7, has_speed=has_speed)
    assert diagnose(faulty, None, learned, voltage_v=12.0).verdict == "winding"
