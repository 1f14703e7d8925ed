"""`motor-env identify` on logs of a motor at work."""

import json
from pathlib import Path

import numpy as np
import pytest
from operation_simulator import draw_motor, simulate
from recording_csv import write_recording

from motor_env import Recording, load_motor
from motor_env.cli import main


def test_logs_are_identified_jointly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(8)
    motor = draw_motor(rng)
    dt_s = round(motor.mechanical_s / 8.0, 5)
    logs = [
        write_recording(tmp_path / f"{kind}.csv", simulate(motor, kind, rng, samples=600, dt_s=dt_s))
        for kind in ("reversals", "prbs")
    ]
    toml = tmp_path / "motor.toml"
    assert main(["identify", *logs, "--json", "-o", str(toml), "--out", str(tmp_path)]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["taken_for"]["regime"] == "operation"
    assert found["parameters"]["K"]["value"] == pytest.approx(motor.constant, rel=0.05)
    assert load_motor(toml).parameters.resistance_ohm == pytest.approx(motor.ohm, rel=0.05)
    assert (tmp_path / "identify.html").exists()


def test_noise_is_unusable_with_a_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(9)
    n = 400
    time, values = 1e-3 * np.arange(n, dtype=np.float64), rng.standard_normal((3, n))
    log = write_recording(tmp_path / "noise.csv", Recording(Path("x"), time, values[0], values[1], values[2]))
    assert main(["identify", log]) == 3
    assert "unusable" in capsys.readouterr().out
