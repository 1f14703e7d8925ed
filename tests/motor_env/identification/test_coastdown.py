from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motor_env.identification.coastdown import fit_coastdown
from scipy.optimize import curve_fit

from motor_env import Recording, read_recording
from motor_env.cli import main
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.defects import UnusableError

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


@pytest.mark.parametrize("coulomb", [0.0, 15.0])
def test_the_fit_is_that_of_scipy_between_97_and_3_per_cent(coulomb: float) -> None:
    """Both curves, their shares of the variance, and the fall of the Bayesian information criterion between them."""
    recording = fall(0.5, coulomb)
    assert recording.speed_rad_s is not None
    speed = recording.speed_rad_s
    top = np.median(speed[:20])
    begin = int((speed < 0.97 * top).argmax())
    end = begin + int((speed[begin:] < 0.03 * top).argmax()) if (speed < 0.03 * top).any() else len(speed)
    time, left = recording.time_s[begin:end] - recording.time_s[begin], speed[begin:end]

    def viscous(t: FloatArray, start: float, rate: float) -> FloatArray:
        return start * np.exp(-rate * t)

    def both(t: FloatArray, start: float, rate: float, dry: float) -> FloatArray:
        return (start + dry / rate) * np.exp(-rate * t) - dry / rate

    simple, _ = curve_fit(viscous, time, left, [100.0, 0.5])
    rich, _ = curve_fit(both, time, left, [100.0, 0.5, 1.0], bounds=([0.0, 0.0, 0.0], np.inf))
    errors = [left - viscous(time, *simple), left - both(time, *rich)]
    shares = [1.0 - error @ error / np.square(left - left.mean()).sum() for error in errors]
    centred = errors[1] - errors[1].mean()
    rho = max(centred[1:] @ centred[:-1] / (centred @ centred), 0.0)
    count = len(left) * (1.0 - rho) / (1.0 + rho)
    gain = count * np.log(errors[0] @ errors[0] / (errors[1] @ errors[1])) - np.log(count)
    found = fit_coastdown(recording)
    assert found.evidence == pytest.approx(gain, rel=1e-3, abs=1e-2)
    assert found.r2_viscous == pytest.approx(shares[0], abs=1e-6)
    assert found.r2 == pytest.approx(shares[coulomb > 0.0], abs=1e-6)
    expected = (rich[1], rich[2]) if coulomb else (simple[1], 0.0)
    assert (found.viscous_per_s, found.coulomb_rad_s2) == pytest.approx(expected, rel=1e-4)


def test_a_speed_that_does_not_fall_to_rest_is_refused() -> None:
    recording = fall(0.5, 15.0)
    for speed in (None, np.full(1000, 50.0), np.linspace(100.0, 60.0, 1000), np.zeros(1000)):
        with pytest.raises(UnusableError, match=r"needs the speed|does not fall to rest"):
            fit_coastdown(replace(recording, speed_rad_s=speed))


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
