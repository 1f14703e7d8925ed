"""Commissioning: what is no healthy start, what was assumed, and for which recordings a motor file serves."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from captures import loaded, started, with_defect, without
from present import present
from recording_csv import write_recording
from scipy.signal import lfilter
from simulated_captures import DEFECTS, captures

from motor_env import (
    PAPER_MOTOR,
    InputError,
    Recording,
    SensorParameters,
    diagnose,
    load_motor,
    load_recipe,
)
from motor_env.cli import main
from motor_env.envs import MonitorOptions

DT_S = 1e-4
WITH_SPEED = SensorParameters(("current", "speed"), 0.02, 0.2)  # type: ignore[arg-type]  # names become channels


@pytest.fixture
def healthy(tmp_path: Path) -> list[str]:
    starts = captures(DEFECTS["none"], (), PAPER_MOTOR, 5, 3)
    return [write_recording(tmp_path / f"healthy_{n}.csv", start) for n, start in enumerate(starts)]


@pytest.fixture
def log(tmp_path: Path) -> str:
    time_s = DT_S * np.arange(4000.0)
    voltage = np.where(time_s % 0.02 < 0.01, 12.0, 0.0)
    current = 0.1 * voltage + 1e-3 * np.sin(1e4 * time_s)
    return write_recording(tmp_path / "pwm.csv", Recording(Path("x"), time_s, current, voltage))


def in_one(first: Recording, second: Recording) -> Recording:
    """Two starts in one recording, whose voltage is on throughout each."""
    assert first.voltage_v is not None
    assert second.voltage_v is not None
    current = np.append(first.current_a, second.current_a)
    time_s = DT_S * np.arange(float(len(current)))
    return Recording(Path("x"), time_s, current, np.append(first.voltage_v, second.voltage_v))


def test_a_log_is_no_healthy_start_and_without_a_speed_it_is_undecided(
    healthy: list[str], log: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = tmp_path / "motor.toml"
    assert main(["commission", *healthy, log, "-o", str(toml)]) == 2
    assert "some are starts, and some logs of a motor at work" in capsys.readouterr().err
    assert not toml.exists()
    assert main(["diagnose", log, "--healthy", *healthy]) == 3
    said = capsys.readouterr().out
    assert "unusable\n  windows of a running motor are judged only if voltage, current and speed" in said
    assert "\n  taken for a motor at work (" in said


def coupled(start: Recording) -> Recording:
    """Behind a high pass of 0.05 s."""
    kept = 0.05 / (0.05 + DT_S)
    return replace(start, current_a=lfilter([kept, -kept], [1.0, -kept], start.current_a))


def sawtooth(start: Recording) -> Recording:
    return replace(
        start, current_a=start.current_a + np.where(start.time_s > 0.0, start.time_s % 0.05 * 200.0, 0.0)
    )


def begun(start: Recording) -> Recording:
    return replace(start, voltage_v=np.full(len(start.time_s), 12.0), current_a=2.0 + 0.01 * start.current_a)


def other_motor(_: Recording) -> Recording:
    return captures(DEFECTS["none"], (), replace(PAPER_MOTOR, resistance_ohm=4.0), 6, 1)[0]


@pytest.mark.parametrize(
    ("change", "count", "said"),
    [
        (coupled, 3, "the current is AC-coupled"),  # all alike, so that none is an outlier
        (sawtooth, 1, "no motor model explains the current"),
        (begun, 1, "odd0.csv: a healthy start cannot be used: "),
        (other_motor, 1, "times that of the others"),
    ],
)
def test_a_start_that_cannot_be_a_healthy_one_is_named(
    change: Callable[[Recording], Recording],
    count: int,
    said: str,
    healthy: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    odd = [change(with_defect("none", seed=6 + n)) for n in range(count)]
    files = [write_recording(tmp_path / f"odd{n}.csv", one) for n, one in enumerate(odd)]
    assert main(["commission", *healthy[: 3 - count], *files, "-o", str(tmp_path / "motor.toml")]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert "odd0.csv: a healthy start cannot be used" in told


def test_one_start_of_each_file_is_commissioned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    starts = captures(DEFECTS["none"], (), PAPER_MOTOR, 7, 4)
    both = [in_one(*two) for two in pairwise(starts)]
    files = [write_recording(tmp_path / f"two_{n}.csv", one) for n, one in enumerate(both)]
    toml = str(tmp_path / "motor.toml")
    assert main(["commission", *files, "--start", "2", "-o", toml]) == 0
    assert capsys.readouterr().out.startswith("3 healthy starts")
    assert main(["commission", *files, "--start", "3", "-o", toml]) == 2
    assert main(["commission", *files, "--window", "0.1", "--start", "1", "-o", toml]) == 2
    assert "--start belongs to starts" in capsys.readouterr().err


def commissioned(folder: Path, *options: str, missing: tuple[str, ...] = ("speed_rad_s",)) -> Path:
    """The motor file of three healthy starts, and such as lacks these columns."""
    starts = [without(started(np.random.default_rng(n)), *missing) for n in range(3)]
    files = [write_recording(folder / f"{n}.csv", start) for n, start in enumerate(starts)]
    assert main(["commission", *files, "-o", str(folder / "m.toml"), *options]) == 0
    return folder / "m.toml"


@pytest.fixture(scope="module")
def current_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return commissioned(tmp_path_factory.mktemp("current"))


def test_a_guessed_constant_is_marked_warned_of_and_refused_where_speeds_are_seen(
    current_only: Path, tmp_path: Path
) -> None:
    motor, recipe = load_motor(current_only), load_recipe("bench")
    assert "a guess, 1/100 of the voltage" in motor.assumed["torque_constant_n_m_per_a"]
    assert motor.parameters.torque_constant_n_m_per_a == pytest.approx(0.12, rel=1e-2)
    with pytest.warns(
        UserWarning, match=r"--torque-constant\. Currents are right, speeds and torques are not"
    ):
        MonitorOptions(recipe=recipe, motor=current_only)
    with pytest.raises(ValueError, match="commission or identify it with a speed"):
        MonitorOptions(recipe=replace(recipe, sensor=WITH_SPEED), motor=current_only)
    text = current_only.read_text().replace("[assumed]", '[assumed]\nbrush_drop = "?"')
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(InputError, match=r"assumed\.brush_drop is no value"):
        load_motor(tmp_path / "m.toml")


def test_a_constant_that_the_user_knows_makes_all_known(tmp_path: Path) -> None:
    path = commissioned(tmp_path, "--torque-constant", "0.02351")
    assert load_motor(path).assumed == {}
    recipe = tmp_path / "recipe.toml"
    recipe.write_text('base = "bench"\nmotor = "m.toml"\n[sensor]\nchannels = ["current", "speed"]\n')
    # Speeds are asked for, so that a guess would be refused.
    assert load_recipe(recipe).motor.inertia_kg_m2 == pytest.approx(PAPER_MOTOR.inertia_kg_m2, rel=0.02)


def test_healthy_starts_with_a_speed_serve_a_start_without(tmp_path: Path) -> None:
    """And their voltage is that of a start without one."""
    motor = load_motor(commissioned(tmp_path, missing=()))
    assert motor.assumed == {}
    found = diagnose(without(started(np.random.default_rng(5)), "speed_rad_s", "voltage_v"), motor)
    assert found.verdict == "healthy"
    assert [change.name for change in found.changes] == ["R", "L", "K^2/J", "B/J"]
    assert len(found.reasons) == 1


def test_a_commissioned_motor_judges_its_own_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    motor = str(commissioned(tmp_path, missing=("speed_rad_s",)))
    read = [line for line in capsys.readouterr().out.splitlines() if "read: " in line]
    columns = "time is column 1 (time_s); current is column 3 (current_a); voltage is column 2 (voltage_v)"
    assert read == [f"  read: {columns}"]
    start = without(started(np.random.default_rng(9)), "speed_rad_s")
    for factor, status in ((1.0, 0), (0.8, 1)):
        judged = write_recording(tmp_path / "j.csv", replace(start, current_a=factor * start.current_a))
        assert main(["diagnose", judged, "--motor", motor]) == status


def smallest_bearing(text: str) -> float:
    return float(re.findall(r"bearing ([\d.]+)%", text)[0])


def test_a_no_load_current_makes_the_bearing_fault_one_of_the_bearing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [write_recording(tmp_path / f"{n}.csv", loaded("constant", n)) for n in range(4)]
    command = ["commission", *files, "--voltage", "12", "-o", str(tmp_path / "motor.toml")]
    assert main(command) == 0
    whole = capsys.readouterr().out
    assert "of the whole drag, any load included" in whole
    assert main([*command, "--no-load-current", "0.15"]) == 0
    assert re.search(r"of the motor's own friction, \d\d% of the drag", own := capsys.readouterr().out)
    healthy = present(load_motor(tmp_path / "motor.toml").healthy)
    assert healthy.own_friction is not None
    assert smallest_bearing(own) == pytest.approx(smallest_bearing(whole) / healthy.own_friction, rel=0.1)
