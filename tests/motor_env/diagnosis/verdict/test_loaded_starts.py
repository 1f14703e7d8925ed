"""Starts under a load, which the textbook takes for viscous friction."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recording_csv import write_csv
from started_motor import step_start

from motor_env import Motor, MotorParameters, Recording, commission, diagnose, load_motor
from motor_env.cli import main
from motor_env.motor.parameters import FloatArray

MOTOR = load_motor(Path(__file__).parents[4] / "examples" / "motor.toml").parameters
TIME_S: FloatArray = np.linspace(-0.02, 0.0999, 1200)
SPEED = float(12.0 / MOTOR.back_emf_constant_v_s_per_rad)
TORQUE = float(0.12 * MOTOR.torque_constant_n_m_per_a * 12.0 / MOTOR.resistance_ohm)
LOADS = {
    "constant": {"COULOMB": TORQUE},
    "fan": {"SQUARE": TORQUE / SPEED**2},
}


def start(motor: MotorParameters, load: str, number: int, *, has_speed: bool = False) -> Recording:
    rng = np.random.default_rng([5, number])
    volts = 12.0 * (1.0 + 0.003 * rng.standard_normal())
    states: FloatArray = step_start(motor, TIME_S, 3e-5, volts, **LOADS[load])
    noisy: FloatArray = states + rng.standard_normal(states.shape) * [0.01, 0.2]
    return Recording(Path(f"start-{number}"), TIME_S, noisy[:, 0], None, noisy[:, 1] if has_speed else None)


@cache
def learned_under(load: str, *, has_speed: bool = False) -> Motor:
    return commission([start(MOTOR, load, n, has_speed=has_speed) for n in range(5)], voltage_v=12.0).motor


@pytest.mark.parametrize("has_speed", [False, True])
@pytest.mark.parametrize("load", LOADS)
def test_a_winding_fault_under_a_load_is_named(load: str, has_speed: bool) -> None:
    learned = learned_under(load, has_speed=has_speed)
    sound = start(MOTOR, load, 6, has_speed=has_speed)
    assert diagnose(sound, learned, voltage_v=12.0).verdict == "healthy"
    faulty = start(MOTOR.scaled(resistance_ohm=1.25), load, 7, has_speed=has_speed)
    assert diagnose(faulty, learned, voltage_v=12.0).verdict == "winding"


@pytest.mark.parametrize("load", LOADS)
def test_a_load_does_not_cool_as_friction_does(load: str) -> None:
    learned = learned_under(load, has_speed=False)
    magnet = 1.0 - 0.001 * 35.0
    warm = MOTOR.scaled(
        resistance_ohm=1.0 + 0.00393 * 35.0,
        back_emf_constant_v_s_per_rad=magnet,
        torque_constant_n_m_per_a=magnet,
    )
    found = diagnose(start(warm, load, 8), learned, voltage_v=12.0)
    assert found.verdict == "healthy"
    assert "K warmer" in found.reasons[-1]


def test_a_no_load_current_makes_the_bearing_fault_one_of_the_bearing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = []
    for n in range(4):
        one = start(MOTOR, "constant", n)
        columns = {"time_s": one.time_s, "current_a": one.current_a}
        files.append(str(write_csv(tmp_path / f"{n}.csv", columns)))
    command = ["commission", *files, "--voltage", "12", "-o", str(tmp_path / "motor.toml")]
    assert main(command) == 0
    whole = capsys.readouterr().out
    assert "of the whole drag, any load included" in whole
    assert main([*command, "--no-load-current", "0.15"]) == 0
    assert re.search(r"of the motor's own friction, \d\d% of the drag", own := capsys.readouterr().out)
    own_friction = load_motor(tmp_path / "motor.toml").healthy.own_friction  # type: ignore[union-attr]
    assert own_friction is not None
    assert smallest_bearing(own) == pytest.approx(smallest_bearing(whole) / own_friction, rel=0.1)


def smallest_bearing(text: str) -> float:
    return float(re.findall(r"bearing ([\d.]+)%", text)[0])
