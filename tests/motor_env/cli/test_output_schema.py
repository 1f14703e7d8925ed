"""What every command prints with --json is JSON without NaN, and follows docs/output.schema.json.

Outputs that take long to make are checked where they are made: reproduce, benchmark and score.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from output_schema import follows

from motor_classifiers.cli.main import main as classifiers
from motor_datasets.cli import main as datasets
from motor_env import PAPER_MOTOR, Fault, FaultKind, simulate_states
from motor_env.cli import main

ROOT = Path(__file__).parents[3]
CAPTURE, MOTOR = str(ROOT / "examples" / "startup_capture.csv"), str(ROOT / "examples" / "motor.toml")
Printed = Callable[[list[str], int], Any]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    """What a command of motor-env prints with --json, which ends with a status."""

    def run(arguments: list[str], status: int) -> Any:
        capsys.readouterr()
        assert main([*arguments, "--json"]) == status
        return follows(f"motor-env {arguments[0]}", capsys.readouterr().out)

    return run


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motor at work whose friction doubles half-way: 4 s, another voltage every 50 ms."""
    path, rng = tmp_path_factory.mktemp("log") / "log.csv", np.random.default_rng(5)
    volts = np.repeat(rng.uniform(-10.0, 10.0, 80), 25)
    states = simulate_states(PAPER_MOTOR, volts, 2e-3, faults=(Fault(FaultKind.BEARING, 1.0, onset_s=2.0),))
    states = states + rng.normal(size=states.shape) * [0.02, 1.0]
    rows = np.column_stack([2e-3 * np.arange(len(volts)), volts, states])
    head = "time_s,voltage_v,current_a,speed_rad_s"
    np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.6g")
    return path


def test_definitions_refuse_what_does_not_follow_them() -> None:
    for command, value in (
        ("motor-env diagnose", [{"file": "a"}]),
        ("motor-env trend", {}),
        ("motor-env watch", {}),
    ):
        with pytest.raises(jsonschema.ValidationError):
            follows(command, json.dumps(value))
    with pytest.raises(ValueError, match="NaN is not JSON"):
        follows("motor-datasets verify", "[NaN]")


def test_diagnose(printed: Printed, log: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.csv"
    torn.write_text("time_s,current_a\n0,x\n")
    start, running, unread = printed(["diagnose", CAPTURE, str(log), str(torn), "--motor", MOTOR], 2)
    assert (start["taken_for"]["regime"], start["verdict"], len(start["pieces"])) == ("start", "bearing", 1)
    assert (running["taken_for"]["regime"], running["verdict"]) == ("operation", "bearing")
    verdicts = [piece["verdict"] for piece in running["pieces"]]
    assert verdicts[0] == "healthy"
    assert verdicts[-1] == "bearing"
    assert unread["error"].startswith(str(torn))
    alone = printed(["diagnose", CAPTURE, str(log)], 3)
    assert [one["verdict"] for one in alone] == ["no_reference", "no_reference"]


def test_identify(printed: Printed, log: Path) -> None:
    start, running = printed(["identify", CAPTURE, str(log)], 0)
    assert running["parameters"]["R"]["determined"]
    for one in (start["parameters"]["R"], running["parameters"]["R"]):
        low, high = one["interval"]
        assert low < one["value"] < high
        assert high - low == pytest.approx(2.0 * 1.96 * one["standard_error"], rel=0.02)


def test_trend(printed: Printed, tmp_path: Path) -> None:
    days = np.arange(40.0)
    rows = [f"{day:g},{2.0 + 0.02 * day + 0.004 * (-1) ** day:.4f}" for day in days]
    table = tmp_path / "table.csv"
    table.write_text("\n".join(["time,R", *rows]) + "\n")
    (found,) = printed(["trend", str(table), "--out", str(tmp_path / "trend.html")], 1)
    assert (found["quantity"], found["state"]) == ("R", "reached")
    noise = np.random.default_rng(2).normal(0.0, 0.01, 40)
    rising = [f"{day:g},{2.0 + 0.008 * day + more:.4f}" for day, more in zip(days, noise, strict=True)]
    table.write_text("\n".join(["time,R", *rising]) + "\n")
    (found,) = printed(["trend", str(table), "--out", str(tmp_path / "trend.html")], 1)
    assert any(limit["remaining_life"] for limit in found["limits"])


def test_lines_of_watch(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motor = tmp_path / "m.toml"
    lines = log.read_text().splitlines()
    lines.insert(1800, "torn")
    stream = tmp_path / "stream.csv"
    stream.write_text("\n".join(lines) + "\n")
    learn = ["--learn", "1.6", "--window", "0.4"]
    assert main(["watch", str(motor), str(stream), *learn, "--false-alarms-per-year", "1e7"]) == 1
    told = [follows("motor-env watch", line) for line in capsys.readouterr().out.splitlines()]
    assert {"learning", "learned", "window", "malformed"} <= {one["event"] for one in told}
    assert "bearing" in {one.get("verdict") for one in told}


def test_data_sets_and_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, model = str(tmp_path / "set"), str(tmp_path / "m.model")
    small = ["--sampling-rate-hz", "1000", "--seed", "1", "--out", folder]

    def ran(run: Callable[[list[str]], int], program: str, *arguments: str) -> str:
        assert run([*arguments, "--json"]) in (0, 1)
        text = capsys.readouterr().out
        follows(f"{program} {arguments[0]}", text)
        return text

    ran(datasets, "motor-datasets", "generate", "bench", "--cases", "200", *small)
    ran(datasets, "motor-datasets", "verify", folder)
    ran(classifiers, "motor-classifiers", "train", folder, "--out", model)
    ran(classifiers, "motor-classifiers", "evaluate", model, folder)
    ran(classifiers, "motor-classifiers", "predict", folder, "--model", model, "--split", "test")
    ran(classifiers, "motor-classifiers", "predict", CAPTURE)
