"""A running motor judged by windows of its logs."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from recording_csv import write_recording
from scipy import stats

from motor_env import InputError, Recording
from motor_env.cli import main
from motor_env.diagnosis.explanations import alarm_share, joint_share
from motor_env.diagnosis.running import logs, windows
from motor_env.diagnosis.running.lessons import learn_windows
from motor_env.diagnosis.running.windows import WindowVerdict
from motor_env.motor import identifiable as quantities

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))
from operation_simulator import Motor, draw_motor, simulate

COLUMNS = ("current_a", "voltage_v", "speed_rad_s")


@pytest.mark.long
def test_faults_show_in_windows_and_warmth_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng([77, 2])
    motor = draw_motor(rng)
    dt_s = motor.mechanical_s / 10.0

    def log(name: str, changed: Motor = motor, samples: int = 800, warm_k: float = 0.0) -> str:
        recording = simulate(changed, "reversals", rng, samples=samples, dt_s=dt_s, warm_k=warm_k)
        return write_recording(tmp_path / f"{name}.csv", recording)

    toml = str(tmp_path / "motor.toml")
    healthy = [log("a", samples=1200), log("b", samples=1200)]
    assert main(["commission", *healthy, "--window", str(300 * dt_s), "-o", toml]) == 0
    friction = replace(motor, viscous=1.5 * motor.viscous, coulomb=1.5 * motor.coulomb)
    logs = [
        log("healthy"),
        log("warm", warm_k=20.0),
        log("contact", replace(motor, ohm=1.25 * motor.ohm)),
        log("friction", friction),
        log("magnet", replace(motor, constant=0.9 * motor.constant)),
        write_recording(
            tmp_path / "weak.csv",
            simulate(replace(motor, volts=0.1 * motor.volts), "reversals", rng, dt_s=dt_s),
        ),
    ]
    capsys.readouterr()
    assert main(["diagnose", *logs, "--motor", toml, "--json", "--out", str(tmp_path)]) == 1
    verdicts = [record["verdict"] for record in json.loads(capsys.readouterr().out)]
    assert verdicts == ["healthy", "healthy", "winding_contact", "bearing", "magnet", "unusable"]
    assert (tmp_path / "003-contact-csv.png").exists()
    monkeypatch.setattr(windows, "MANY", 4)
    monkeypatch.setattr(windows, "MOST_JUDGED", 4)
    parts = [simulate(one, "reversals", rng, samples=1500, dt_s=dt_s) for one in (motor, friction, motor)]
    columns = [np.concatenate([getattr(one, name) for one in parts]) for name in COLUMNS]
    long = write_recording(
        tmp_path / "long.csv",
        Recording(Path("long"), dt_s * np.arange(4500.0), columns[0], columns[1], columns[2]),
    )
    assert main(["diagnose", long, "--motor", toml, "--json"]) == 1
    (record,) = json.loads(capsys.readouterr().out)
    assert (record["verdict"], len(record["windows"]), record["windows_of_record"]) == ("bearing", 4, 15)


def test_one_bad_log_costs_no_other_its_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record = Recording(tmp_path / "a.csv", np.arange(30.0), np.ones(30))
    read: Iterator[Recording | Exception] = iter(
        [OverflowError("too large"), TypeError("a bug"), record, InputError("b.csv: is empty")]
    )

    def reading(*_: object) -> Recording:
        found = next(read)
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr(logs, "read_recording", reading)
    monkeypatch.setattr(logs, "judge_windows", lambda *_: [WindowVerdict(0.0, "healthy", ())])
    motor = SimpleNamespace(operation=SimpleNamespace(window_s=10.0))
    records = logs.diagnose_running([tmp_path / f"{n}.csv" for n in range(4)], cast("Any", motor), 0.01, None)
    assert [record.verdict for record in records] == ["unusable", "unusable", "healthy", "unusable"]
    assert "1 of 3 windows are judged" in records[2].as_text()
    assert [record.is_bug for record in records] == [False, True, False, False]
    assert logs.exit_status(records) == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("has_levels", "reason"), [(True, "more slowly than it switches"), (False, "no motor")]
)
def test_a_log_without_a_usable_window_says_why(
    has_levels: bool, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    noise, sine = rng.standard_normal((2, 400)), 12.0 * np.sin(np.arange(400.0) / 20.0)
    volts = rng.choice([0.0, 12.0], 400) if has_levels else sine
    record = Recording(Path("a.csv"), 1e-3 * np.arange(400.0), noise[0], volts, noise[1])
    monkeypatch.setattr(logs, "read_recording", lambda *_: record)
    monkeypatch.setattr(logs, "judge_windows", lambda *_: [WindowVerdict(0.0, "unusable", ())])
    motor = cast("Any", SimpleNamespace(operation=SimpleNamespace(window_s=0.1)))
    (found,) = logs.diagnose_running([record.path], motor, 0.01, None)
    assert reason in found.trouble
    assert logs.exit_status([found]) == 3


@pytest.mark.parametrize("rate", [0.15, 0.02])
def test_the_tests_of_a_window_alarm_together_at_the_rate(rate: float) -> None:
    rng, freedom, n = np.random.default_rng(5), 20.0, 200_000
    root = np.tril(rng.normal(0.0, 0.02, (4, 4))) + 0.05 * np.eye(4)
    exponents = np.array(
        [[float(name == other) for other in quantities.PARAMETERS] for name in windows.NAMES]
    )
    share = joint_share(rate, root @ root.T, exponents, freedom)
    length = np.sqrt(rng.chisquare(freedom, n) / freedom)
    drawn = rng.standard_normal((n, 4)) / length[:, None]
    axes = np.linalg.inv(root) @ np.transpose(
        [quantities.visible_direction(kind, exponents) for kind in quantities.nameable_kinds(exponents)]
    )
    along = drawn @ (axes / np.linalg.norm(axes, axis=0))
    alarms = (along > stats.t.isf(share, freedom)).any(axis=1)
    alarms |= np.sum(drawn**2, axis=1) / 4.0 > stats.f.isf(share, 4, freedom)
    assert alarms.mean() == pytest.approx(rate, rel=0.05)
    assert share > 1.3 * alarm_share(rate, exponents)


def test_a_much_warmer_motor_is_healthy_though_logarithms_bend() -> None:
    spread = np.eye(4) * 1e-3**2
    for kelvin in (-30.0, 45.0):
        ratios = np.log1p(windows.WARMTH * kelvin)
        assert windows.decided(ratios, spread, 0.01, 1e3, 15.0)[0] == "healthy"
        assert windows.decided(windows.WARMTH * kelvin, spread, 0.01, 1e3, 15.0)[0] != "healthy"
    hot = ratios + np.log([1.1, 1.0, 1.0, 1.0])
    assert windows.decided(hot, spread, 0.01, 1e3, 15.0)[0] == "winding_contact"


def test_windows_are_believed_to_scatter_as_healthy_ones_did() -> None:
    recording = simulate(
        draw_motor(np.random.default_rng(3)), "reversals", np.random.default_rng(4), samples=1600
    )
    reference = learn_windows([recording], 200 * recording.dt_s, steady=True)
    assert 0.3 < reference.window_excess <= 1.0
    same = windows.spread_of(reference.log_covariance, reference)
    np.testing.assert_allclose(same, reference.log_covariance * reference.window_excess)
    wider = windows.spread_of(4.0 * reference.log_covariance, reference)
    np.testing.assert_allclose(wider, 4.0 * same)
