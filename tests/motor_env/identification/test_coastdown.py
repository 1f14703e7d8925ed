from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from motor_env.cli import main
from motor_env.identification.coastdown import fit_coastdown
from motor_env.recordings.recording import Recording, read_recording

recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")


def fall(viscous_per_s: float, coulomb_rad_s2: float) -> Recording:
    """A coast-down by Euler steps far finer than the samples: an oracle apart from the closed form."""
    speed, rows = 100.0, []
    for n in range(200_000):
        if n % 200 == 0:
            rows.append(speed)
        if n > 10_000:
            speed = max(speed - 5e-5 * (viscous_per_s * speed + coulomb_rad_s2), 0.0)
    values = np.array(rows) + 0.3 * np.random.default_rng(1).standard_normal(len(rows))
    time = np.linspace(0.0, 9.99, len(rows))
    return Recording(Path("x"), time, np.zeros_like(time), speed_rad_s=values)


@pytest.mark.parametrize("coulomb", [0.0, 15.0])
def test_coulomb_friction_is_found_where_it_is(coulomb: float) -> None:
    found = fit_coastdown(fall(0.5, coulomb))
    assert found.viscous_per_s == pytest.approx(0.5, rel=0.05)
    assert found.coulomb_rad_s2 == pytest.approx(coulomb, rel=0.05)


def test_the_command_takes_columns_of_another_instrument(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = fall(0.5, 15.0)
    assert recording.speed_rad_s is not None
    rows = zip(recording.time_s, recording.speed_rad_s, strict=True)
    (tmp_path / "fall.csv").write_text("time_s,CH1,CH2\n" + "".join(f"{t},0,{w}\n" for t, w in rows))
    command = ["coastdown", str(tmp_path / "fall.csv"), "--json"]
    assert main(command) == 2
    assert "fall.csv" in capsys.readouterr().err
    assert main([*command, "--column", "current=CH1", "--column", "speed=CH2:rad/s"]) == 0
    assert json.loads(capsys.readouterr().out)["viscous_per_s"] == pytest.approx(0.5, rel=0.05)


@pytest.mark.skipif(recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings")
def test_a_real_coast_down() -> None:
    found = fit_coastdown(read_recording(Path(recordings_path or "") / "lieskjur" / "coastdown.csv"))
    assert found.coulomb_rad_s2 > 0.0
    assert found.r2 > 0.995 > found.r2_viscous
