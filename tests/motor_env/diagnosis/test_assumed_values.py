"""Motor files tell what was measured from what was assumed; healthy starts with a speed serve a start without."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from recording_csv import write_csv

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Fault,
    FaultKind,
    InputError,
    Scenario,
    SensorParameters,
    Timing,
    cli,
    diagnose,
    identify,
    load_motor,
    load_recipe,
    read_recording,
    simulate,
)

# Reaches in: the motor file of fits that no recording gives.
from motor_env.diagnosis.verdict.healthy_motor import to_motor
from motor_env.envs import MonitorOptions
from motor_env.motor.data_sheet import to_toml

SENSOR = SensorParameters(
    current_noise_a=0.02, speed_noise_rad_s=0.2, channels=(Channel.CURRENT, Channel.SPEED)
)


def write(path: Path, seed: int, faults: tuple[Fault, ...] = (), *, columns: int = 4) -> str:
    """One start as CSV, with voltage and speed, or without."""
    scenario = Scenario(PAPER_MOTOR, faults, sensor=SENSOR, timing=Timing(duration_s=0.1, quiet_s=0.02))
    start = simulate(scenario, seed=seed, cases=[0])
    current, speed = start.measurements[0]
    table = {
        "time_s": start.time_s,
        "current_a": current,
        "voltage_v": start.voltage_v[0],
        "speed_rad_s": speed,
    }
    return str(write_csv(path, dict(list(table.items())[:columns]), form=".7g"))


def commissioned(folder: Path, *options: str, columns: int = 3) -> Path:
    """The motor file of three healthy starts."""
    files = [write(folder / f"{n}.csv", n, columns=columns) for n in range(3)]
    assert cli.main(["commission", *files, "-o", str(folder / "m.toml"), *options]) == 0
    return folder / "m.toml"


@pytest.fixture(scope="module")
def current_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return commissioned(tmp_path_factory.mktemp("current"))


def test_a_guessed_constant_is_marked_warned_of_and_refused_where_speeds_are_seen(current_only: Path) -> None:
    path, motor = current_only, load_motor(current_only)
    assert "a guess, 1/100 of the voltage" in motor.assumed["torque_constant_n_m_per_a"]
    assert motor.parameters.torque_constant_n_m_per_a == pytest.approx(0.12)
    recipe = load_recipe("bench")
    with pytest.warns(
        UserWarning, match=r"--torque-constant\. Currents are right, speeds and torques are not"
    ):
        MonitorOptions(recipe=recipe, motor=path)
    with pytest.raises(ValueError, match="commission or identify it with a speed"):
        MonitorOptions(recipe=replace(recipe, sensor=SENSOR), motor=path)


def test_what_was_assumed_is_a_value_of_the_motor(current_only: Path, tmp_path: Path) -> None:
    path, text = tmp_path / "m.toml", current_only.read_text()
    path.write_text(text.replace("[assumed]", '[assumed]\nbrush_drop = "?"'))
    with pytest.raises(InputError, match=r"assumed\.brush_drop is no value"):
        load_motor(path)


def test_a_constant_that_the_user_knows_makes_all_known(tmp_path: Path) -> None:
    path = commissioned(tmp_path, "--torque-constant", "0.02351")
    assert load_motor(path).assumed == {}
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('base = "bench"\nmotor = "m.toml"\n[sensor]\nchannels = ["current", "speed"]\n')
    # Speeds are asked for, so that a guess would be refused.
    assert load_recipe(recipe).motor.inertia_kg_m2 == pytest.approx(PAPER_MOTOR.inertia_kg_m2, rel=0.02)


@pytest.mark.long
def test_without_a_voltage_nothing_can_be_simulated(tmp_path: Path) -> None:
    path = commissioned(tmp_path, columns=2)
    with pytest.raises(ValueError, match="its voltage is unknown"):
        MonitorOptions(motor=path)
    assert "per volt" in to_toml(load_motor(path))


def test_healthy_starts_with_a_speed_serve_a_start_without(tmp_path: Path) -> None:
    motor = load_motor(commissioned(tmp_path, columns=4))
    assert motor.assumed == {}
    healthy = diagnose(read_recording(write(tmp_path / "h.csv", 5, columns=3)), motor)
    faulty = diagnose(
        read_recording(write(tmp_path / "f.csv", 6, (Fault(FaultKind.WINDING_CONTACT, 0.4),), columns=3)),
        motor,
    )
    assert (healthy.verdict, faulty.verdict) == ("healthy", "winding")
    assert faulty.severity == pytest.approx(0.4, abs=0.1)
    assert {change.name for change in healthy.changes} >= {"K^2/J", "B/J"}
    # The voltage of the healthy starts is that of a start without one.
    without = diagnose(read_recording(write(tmp_path / "v.csv", 7, columns=2)), motor)
    assert without.verdict == "healthy"
    assert [change.name for change in without.changes] == ["R", "L", "K^2/J", "B/J"]
    assert len(without.reasons) == 1


def test_terms_that_are_not_different_from_0_are_not_written(tmp_path: Path) -> None:
    ((_, fit),) = identify(read_recording(write(tmp_path / "a.csv", 8)), regime="start").starts
    for error, written in ((0.071, 0.0), (0.010, 0.070)):
        seen = replace(fit, fitted_extension={"brush_drop": (0.070, error)})
        assert to_motor([seen], "m").brush_drop_v == written
