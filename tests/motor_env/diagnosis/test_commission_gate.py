"""What is no healthy start: logs of a motor at work, starts that no motor explains, starts of another motor."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from recording_csv import write_recording
from scipy.signal import lfilter
from simulated_captures import DEFECTS, captures

from motor_env import PAPER_MOTOR, Recording
from motor_env.cli import main
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import split_starts

DT_S = 1e-4


@pytest.fixture
def healthy(tmp_path: Path) -> list[str]:
    starts = captures(DEFECTS["none"], (), PAPER_MOTOR, 5, 3)
    return [write_recording(tmp_path / f"healthy_{n}.csv", start) for n, start in enumerate(starts)]


@pytest.fixture
def log(tmp_path: Path) -> str:
    time_s = DT_S * np.arange(4000, dtype=np.float64)
    voltage = np.where(time_s % 0.02 < 0.01, 12.0, 0.0)
    current = 0.1 * voltage + 1e-3 * np.sin(1e4 * time_s)
    return write_recording(tmp_path / "pwm.csv", Recording(Path("x"), time_s, current, voltage))


def test_a_log_is_no_healthy_start(
    healthy: list[str], log: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = tmp_path / "motor.toml"
    assert main(["commission", *healthy, log, "-o", str(toml)]) == 2
    said = capsys.readouterr().err
    assert "some are starts, and some logs of a motor at work: give starts of one kind, or --regime" in said
    assert not toml.exists()


def test_a_motor_that_is_switched_on_and_off_is_at_work(
    healthy: list[str],
    log: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its records may look like several starts, or like work: they go together, and with no single start."""
    (start,) = captures(DEFECTS["none"], (), PAPER_MOTOR, 7, 1)
    n = len(start.time_s)
    again = replace(
        start,
        time_s=DT_S * np.arange(2 * n, dtype=np.float64),
        voltage_v=np.tile(np.where(start.time_s > 0.0, 12.0, 0.0), 2),
        current_a=np.tile(start.current_a, 2),
    )
    assert len(split_starts(again)) == 2
    twice = write_recording(tmp_path / "twice.csv", again)

    def learn_windows(recordings: list[Recording], *_: object, **__: object) -> None:
        raise UnusableError(f"{len(recordings)} came here")

    monkeypatch.setattr("motor_env.diagnosis.commission.learn_windows", learn_windows)
    for together, said in (
        ([twice, log], "the logs cannot be used: 2 came here"),
        ([twice, log, healthy[0]], "some are starts, and some logs of a motor at work"),
    ):
        assert main(["commission", *together, "-o", str(tmp_path / "motor.toml")]) == 2
        assert said in capsys.readouterr().err


def test_a_log_without_a_speed_is_undecided(
    healthy: list[str], log: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diagnose", log, "--healthy", *healthy]) == 3
    said = capsys.readouterr().out
    assert (
        "pwm.csv: unusable\n  windows of a running motor are judged only if voltage, current and speed"
        in said
    )
    assert "\n  taken for a motor at work (" in said


def test_starts_of_a_probe_that_is_coupled_are_no_healthy_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All alike, so that none is an outlier: their friction is 0."""
    kept = 0.05 / (0.05 + DT_S)  # a high pass of 0.05 s
    coupled = [
        replace(start, current_a=lfilter([kept, -kept], [1.0, -kept], start.current_a), speed_rad_s=None)
        for start in captures(DEFECTS["none"], (), PAPER_MOTOR, 5, 3)
    ]
    files = [write_recording(tmp_path / f"{n}.csv", start) for n, start in enumerate(coupled)]
    assert main(["commission", *files, "-o", str(tmp_path / "motor.toml")]) == 2
    assert "0.csv: a healthy start cannot be used: the current is AC-coupled" in capsys.readouterr().err


def test_a_start_that_no_motor_explains_is_named(
    healthy: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (start,) = captures(DEFECTS["none"], (), PAPER_MOTOR, 6, 1)
    triangle = np.where(start.time_s > 0.0, start.time_s % 0.05 * 200.0, 0.0)
    odd = write_recording(tmp_path / "odd.csv", replace(start, current_a=start.current_a + triangle))
    command = ["commission", *healthy[:2], odd, "-o", str(tmp_path / "motor.toml")]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert "odd.csv: a healthy start cannot be used: no motor model explains the current" in said
    begun = replace(start, voltage_v=np.full(len(start.time_s), 12.0), speed_rad_s=None)
    begun = replace(begun, current_a=2.0 + 0.01 * start.current_a)
    write_recording(tmp_path / "odd.csv", begun)
    assert main(command) == 2
    assert "odd.csv: a healthy start cannot be used: " in capsys.readouterr().err
    (other,) = captures(DEFECTS["none"], (), replace(PAPER_MOTOR, resistance_ohm=4.0), 6, 1)
    write_recording(tmp_path / "odd.csv", other)
    assert main(command) == 2
    assert "times that of the others" in capsys.readouterr().err


def test_one_start_of_each_file_is_commissioned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    starts = captures(DEFECTS["none"], (), PAPER_MOTOR, 7, 4)
    files = []
    for n, (first, second) in enumerate(pairwise(starts)):
        assert first.voltage_v is not None
        assert second.voltage_v is not None
        current = np.concatenate([first.current_a, second.current_a])
        voltage = np.concatenate([first.voltage_v, second.voltage_v])
        both = Recording(Path("x"), DT_S * np.arange(len(current), dtype=np.float64), current, voltage)
        files.append(write_recording(tmp_path / f"two_{n}.csv", both))
    toml = str(tmp_path / "motor.toml")
    assert main(["commission", *files, "--start", "2", "-o", toml]) == 0
    assert capsys.readouterr().out.startswith("3 healthy starts")
    assert main(["commission", *files, "--start", "3", "-o", toml]) == 2
    assert main(["commission", *files, "--window", "0.1", "--start", "1", "-o", toml]) == 2
    assert "--start belongs to starts" in capsys.readouterr().err


@pytest.mark.parametrize("rate_hz", [1_000.0, 10_000.0, 100_000.0])
@pytest.mark.parametrize("has_voltage", [True, False])
def test_a_switch_that_bounces_for_milliseconds_makes_one_start(rate_hz: float, has_voltage: bool) -> None:
    time_s = np.arange(round(0.4 * rate_hz)) / rate_hz
    on = (time_s > 0.1) & ~((time_s > 0.106) & (time_s < 0.114)) & ~((time_s > 0.120) & (time_s < 0.126))
    recording = Recording(
        Path("x"), time_s, np.where(on, 2.0, 0.0), np.where(on, 12.0, 0.0) if has_voltage else None
    )
    assert len(split_starts(recording)) == 1


def test_starts_that_do_not_agree_teach_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = []
    for n, inertia in enumerate((5e-7, 1e-6, 2e-6, 4e-6)):
        (one,) = captures(DEFECTS["none"], (), replace(PAPER_MOTOR, inertia_kg_m2=inertia), n, 1)
        files.append(write_recording(tmp_path / f"{n}.csv", one))
    assert main(["commission", *files, "-o", str(tmp_path / "motor.toml")]) == 2
    assert re.search(r"their K\^2/J lies between .* starts of one motor", capsys.readouterr().err)
