"""`motor-env identify` on logs of a motor at work, and which it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from operation_simulator import draw_motor, simulate
from recording_csv import write_recording

from motor_env import Recording, load_motor
from motor_env.cli import main
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError

# Reaches in: what a recording is refused for, without the fit that public names go on to.
from motor_env.recordings.regime import refuse_aliased


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
    assert (tmp_path / "001-reversals-csv.png").exists()


def test_noise_is_unusable_with_a_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(9)
    n = 400
    time, values = 1e-3 * np.arange(n, dtype=np.float64), rng.standard_normal((3, n))
    log = write_recording(tmp_path / "noise.csv", Recording(Path("x"), time, values[0], values[1], values[2]))
    assert main(["identify", log]) == 3
    assert "unusable" in capsys.readouterr().out


def pulses(share: float, every: int) -> tuple[FloatArray, FloatArray]:
    """Voltage and current of 60 % duty, ten steps a period, of which one in some is recorded."""
    rng, n = np.random.default_rng(6), 60_000
    voltage = np.where(np.arange(n) % 10 < 6, 12.0, 0.0)
    current = np.zeros(n)
    for k in range(1, n):
        current[k] = (1.0 - share) * current[k - 1] + share * voltage[k - 1]
    return voltage[::every], (current + 0.05 * rng.standard_normal(n))[::every]


def test_pulses_sampled_more_slowly_than_they_switch_are_refused() -> None:
    with pytest.raises(UnusableError, match="sampled more slowly than it switches"):
        refuse_aliased(*pulses(0.0005, every=23))
    refuse_aliased(*pulses(0.05, every=1))
