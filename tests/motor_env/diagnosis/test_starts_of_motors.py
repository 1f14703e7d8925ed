"""What starts tell of their motors, and what no sensor, supply or temperature may hide or feign."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import SHEET, bearing, by_starts, contact, current_alone, in_a_row, warmed, with_defect
from present import present
from simulated_captures import Defect, captures

from motor_env import (
    PAPER_MOTOR,
    Channel,
    Diagnosis,
    InputError,
    Recording,
    Scenario,
    SensorParameters,
    Timing,
    Verdict,
    cli,
    commission,
    diagnose,
    identify,
    read_recording,
    simulate,
)
from motor_env.diagnosis.file_verdicts import diagnose_files
from motor_env.diagnosis.readers.start import Circuit, chosen_starts
from motor_env.motor.parameters import FloatArray

# Reaches in: the supply comes on between two samples, which `simulate` cannot do.
from motor_env.simulation.fast_path import measure
from motor_env.simulation.nonlinear import Effects

EXAMPLES = Path(__file__).parents[3] / "examples"
CAPTURE, MOTOR = str(EXAMPLES / "startup_capture.csv"), str(EXAMPLES / "motor.toml")


@pytest.mark.parametrize(("hertz", "size_a", "begin_s"), [(59.9, 0.02, 0.0), (100.2, 0.1, 0.1)])
def test_hum_hides_no_friction(hertz: float, size_a: float, begin_s: float) -> None:
    """Of a probe throughout, or of the supply from the onset on: as found, and the friction as without it."""
    start = with_defect("none", bearing(0.3))
    wave = np.sin(2.0 * np.pi * hertz * start.time_s + 1.0) * (start.time_s >= start.time_s[0] + begin_s)
    plain, hummed = (
        diagnose(replace(start, current_a=start.current_a + a * wave), SHEET) for a in (0.0, size_a)
    )
    assert (plain.verdict, hummed.verdict) == (Verdict.BEARING, Verdict.BEARING)
    assert hummed.severity == pytest.approx(plain.severity, abs=0.06)
    fit = present(hummed.decisive.identified)
    assert fit.start.hum_hz == pytest.approx([hertz], abs=0.2)
    assert math.hypot(*fit.start.sizes) == pytest.approx(size_a, abs=0.003)
    assert fit.start.is_hum_of_supply is (begin_s > 0.0)


def assert_friction_is_undecided(found: Diagnosis) -> None:
    """A healthy resistance, and nothing of the friction: each is told."""
    assert found.verdict is Verdict.HEALTHY
    assert found.reasons[1].startswith("the friction is undecided: the recording is too coarse")
    said = {change.name: change.verdict for change in found.changes}
    assert (said["R"], said["B/J"]) == ("healthy", "undecided")


def test_a_sensor_that_hides_small_currents_is_told_by_the_evidence() -> None:
    (plain,) = captures(Defect(noise_a=0.005), (), SHEET.parameters, 8, 1)
    hiding = replace(plain, current_a=np.where(plain.current_a > 0.3, plain.current_a, 0.0))
    (fit,), (true,) = identify(hiding).usable, identify(plain).usable
    assert (fit.model, true.model) == (("dead_zone",), ())
    assert fit.fitted_extension["dead_zone"][0] == pytest.approx(0.3, abs=0.03)
    assert any(defect.startswith("dead zone: ") for defect in fit.defects)
    assert fit.log_values[0] == pytest.approx(true.log_values[0], abs=0.01)
    assert_friction_is_undecided(diagnose(hiding, SHEET))


def test_a_known_lag_and_a_known_shunt_are_taken_off() -> None:
    (recording,) = captures(Defect(lag_s=0.0003, shunt_ohm=0.5), (), SHEET.parameters, 6, 1)
    (fit,) = identify(recording, circuit=Circuit(0.5, 0.0003)).usable
    (expected,) = identify(with_defect("none", seed=6)).usable
    np.testing.assert_allclose(fit.values[[0, 2, 3]], expected.values[[0, 2, 3]], rtol=0.03)
    assert fit.values[1] == pytest.approx(expected.values[1], rel=0.1)


def rippled(constant: float = 1.0) -> tuple[Recording, float]:
    """A start whose current is modulated 14 times a turn of the simulated motor, and its last speed."""
    motor = PAPER_MOTOR.scaled(back_emf_constant_v_s_per_rad=constant, torque_constant_n_m_per_a=constant)
    sensor = SensorParameters((Channel.CURRENT, Channel.SPEED), 0.002, 1e-9)
    scenario = Scenario(motor, sensor=sensor, timing=Timing(10_000.0, 0.2, 0.02))
    current, speed = simulate(scenario, 3, [0]).measurements[0]
    time = scenario.timing.time_s
    angle = np.cumsum(speed) * scenario.timing.dt_s
    current = current * (1.0 + 0.1 * np.cos(14.0 * angle)) * (time > 0.0)
    voltage = np.where(time > 1e-9, 12.0, 0.0)
    return Recording(Path("x"), time, current, voltage), float(speed[-100:].mean())


def test_the_ripple_tells_the_speed_and_the_constants() -> None:
    recording, speed = rippled(1.2)
    told = diagnose(recording, periods_per_turn=14.0)
    found = told.to_json()["commutation"]
    assert found["speed_rad_s"] == pytest.approx(speed, rel=0.002)
    assert f"{found['speed_rad_s']:.5g} rad/s (" in told.text(verbose=True)
    assert found["K"]["value"] == pytest.approx(
        1.2 * float(PAPER_MOTOR.back_emf_constant_v_s_per_rad), rel=0.01
    )
    assert found["J"]["value"] == pytest.approx(float(PAPER_MOTOR.inertia_kg_m2), rel=0.05)
    assert identify(with_defect("none")).to_json()[0]["commutation"] is None


def test_the_ripple_compares_speeds_between_recordings() -> None:
    motor = commission([rippled()[0]] * 2, fewest=2).motor  # two alike
    found = diagnose(rippled(1.2)[0], motor)
    moved = {change.name: change.ratio for change in found.changes if change.significant}
    assert (moved["K"], moved["speed"]) == pytest.approx((1.2, 1.0 / 1.2), rel=0.02)


def test_the_starts_of_a_recording_share_its_rate() -> None:
    two = in_a_row(with_defect("none"), with_defect("none", contact(0.3)))
    parts = chosen_starts(two)
    both = diagnose(two, SHEET, false_alarm_rate=0.02)
    assert (both.taken.regime, both.of) == ("start", 2)
    assert [piece.verdict for piece in both.pieces] == [Verdict.HEALTHY, Verdict.WINDING]
    assert (both.verdict, both.decisive) == (Verdict.WINDING, both.pieces[1])
    assert [piece.begin_s for piece in both.pieces] == [float(part.time_s[0]) for part in parts]
    second = diagnose(two, SHEET, false_alarm_rate=0.02, start=2)
    assert (second.taken, second.of) == (("start", "as asked"), 1)
    half = diagnose(parts[1], SHEET, false_alarm_rate=0.01)
    assert both.decisive.smallest_changes == half.decisive.smallest_changes
    assert both.decisive.smallest_changes["bearing"] > second.decisive.smallest_changes["bearing"]
    ((chosen, _),) = identify(two, start=2).starts
    assert chosen.path.name == "two.csv#2"
    with pytest.raises(InputError, match=r"--start must lie in 1 \.\. 2, got 3"):
        identify(two, start=3)


def test_a_recording_that_the_model_does_not_explain_is_said_to_be_inconsistent() -> None:
    good = with_defect("none")
    wavy = replace(good, current_a=good.current_a + 0.1 * np.sin(60.0 * good.time_s))
    assert diagnose(good, SHEET).decisive.warning == ""
    assert "correlated in time" in diagnose(wavy, SHEET).decisive.warning


def delayed(timing: Timing, share: float, noise_a: float) -> tuple[FloatArray, FloatArray]:
    """Times, and the current of a motor that is switched on so far into an interval."""
    scenario = Scenario(SHEET.parameters, sensor=SensorParameters(current_noise_a=noise_a), timing=timing)
    effects = Effects(delay_s=share * timing.dt_s) if share else None
    shown = measure(scenario, 3, np.arange(1), effects=effects, nominal=SHEET.parameters)
    return timing.time_s, shown[0, 0].astype(float)


@pytest.mark.parametrize(("delay", "skew"), [(0.0, -1), (0.0, 1), (0.4, 0), (0.9, -1), (0.9, 1)])
def test_inductance_is_told_wherever_a_measured_voltage_changes(delay: float, skew: int) -> None:
    """L/R is as long as an interval: a step taken half an interval late would look like half the inductance."""
    timing = Timing(10_000.0, 0.2, 0.05)
    time_s, current_a = delayed(timing, delay, 0.005)
    switched = np.where(time_s > (skew + 1e-3) * timing.dt_s, 12.0, 0.0)
    voltage = switched + np.random.default_rng(1).normal(0.0, 0.01, len(time_s))
    (fit,) = identify(Recording(Path("start"), time_s, current_a, voltage)).usable
    told = dict(zip(fit.quantity_names, fit.values.tolist(), strict=True))
    assert told["L"] == pytest.approx(0.238e-3, rel=0.1)
    assert told["R"] == pytest.approx(2.18, rel=0.02)
    assert fit.onset_s == pytest.approx(0.0, abs=2.5 * timing.dt_s)


def test_a_measured_temperature_makes_a_smaller_change_visible() -> None:
    motor, recording = by_starts(), current_alone(motor=warmed(40.0), seed=10)
    assert motor.healthy is not None
    known = replace(motor, healthy=replace(motor.healthy, temperature_c=20.0))
    warm, cold = (diagnose(recording, known, temperature_c=celsius) for celsius in (60.0, 20.0))
    assert warm.verdict is Verdict.HEALTHY
    assert cold.verdict is not Verdict.HEALTHY
    assert warm.smallest_changes["winding_contact"] < cold.smallest_changes["winding_contact"] * 1.01


def test_standard_errors_agree_with_the_scatter_of_repetitions() -> None:
    """Repetitions of one motor: the estimates scatter as the standard errors say, and about the truth."""
    starts = simulate(Scenario(SHEET.parameters, timing=Timing(10_000.0, 0.1, 0.05)), 5, np.arange(12))
    voltage, p = np.where(starts.time_s > 1e-9, 12.0, 0.0), SHEET.parameters
    rows = [Recording(Path("x"), starts.time_s, row[0], voltage) for row in starts.measurements]
    fits = [identify(row).usable[0] for row in rows]
    k2 = float(p.back_emf_constant_v_s_per_rad) * float(p.torque_constant_n_m_per_a)
    true = np.array([p.resistance_ohm, p.inductance_h, k2, p.viscous_friction_n_m_s_per_rad], dtype=float)
    true[2:] /= float(p.inertia_kg_m2)
    errors = np.sqrt(np.array([np.diag(f.log_covariance) for f in fits]))
    z = (np.array([f.log_values for f in fits]) - np.log(true)) / errors
    assert np.all(np.abs(z.mean(axis=0)) < 4.0 / np.sqrt(12))
    assert np.all((z.std(axis=0) > 0.6) & (z.std(axis=0) < 1.5))


def test_without_a_voltage_only_ratios_are_told_and_the_sheet_is_no_reference() -> None:
    alone = diagnose(current_alone())
    fit = present(alone.decisive.identified)
    assert (alone.verdict, fit.quantity_names) == (Verdict.NO_REFERENCE, ("R/V", "L/V", "K^2/(J V)", "B/J"))
    np.testing.assert_allclose(fit.values[0], 2.18 / 12.0, rtol=0.05)
    compared = diagnose(current_alone(), replace(SHEET, nominal_voltage_v=None))
    assert compared.verdict is Verdict.NO_REFERENCE
    assert compared.reasons[0].startswith(
        "this recording determines R/V, L/V, K^2/(J V), B/J, and the reference"
    )
    mixed = diagnose(current_alone(), by_starts(), voltage_v=12.0)
    assert mixed.verdict is Verdict.NO_REFERENCE
    assert mixed.reasons[0].startswith(
        "the motor file was commissioned without a voltage, and this recording has"
    )


def test_noise_is_no_start_and_never_healthy() -> None:
    noise = 0.02 * np.random.default_rng(0).standard_normal(1000)
    found = diagnose(Recording(Path("x"), np.linspace(0.0, 0.1, 1000), noise), SHEET)
    assert found.verdict is Verdict.UNUSABLE
    assert "the current never rises above its noise" in found.reasons[0]


def test_exit_status_and_json_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["diagnose", CAPTURE, "--motor", MOTOR, "--json", "--out", str(tmp_path)]) == 1
    (answer,) = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "bearing"
    assert answer["severity_interval"][0] < 0.30 < answer["severity_interval"][1]
    assert [p.suffix for p in tmp_path.iterdir()] == [".html"]
    assert cli.main(["diagnose", CAPTURE]) == 3
    assert cli.main(["diagnose", CAPTURE, "nosuch.csv", "--motor", MOTOR]) == 2
    printed = capsys.readouterr()
    assert "bearing" in printed.out
    assert "nosuch.csv: no such file" in printed.err


def test_the_example_is_what_its_script_writes(tmp_path: Path) -> None:
    for name in ("make_startup_capture.py", "motor.toml"):
        (tmp_path / name).write_bytes((EXAMPLES / name).read_bytes())
    subprocess.run([sys.executable, str(tmp_path / "make_startup_capture.py")], check=True)
    assert (tmp_path / "startup_capture.csv").read_bytes() == Path(CAPTURE).read_bytes()


recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")
needs_recordings = pytest.mark.skipif(
    recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings of real motors"
)
RECORDINGS = Path(recordings_path or "recordings")
LONG, SLOW = pytest.mark.long, [pytest.mark.long, pytest.mark.timeout(900)]
REAL = [
    ("lieskjur/startup_120v.csv", None, 0.995, 1.0),
    ("oscillo_lab/startup_F0000.csv", 12.3, 0.97, 0.5),
    ("oscillo_lab/startup_F0001.csv", 12.3, 0.97, 0.9),
    pytest.param("jhg/pwm_100.csv", 11.33, 0.95, 1.0, marks=LONG),
    ("jhg/pwm_900.csv", 6.0, 0.95, 1.0),
    pytest.param("jhg/pwm_1600.csv", 1.333, 0.95, 1.0, marks=LONG),
    pytest.param("jhg/pwm_2000.csv", 1.333, 0.95, 1.0, marks=LONG),
    pytest.param("jhg/pwm_2700.csv", 6.0, 0.95, 1.0, marks=LONG),
    ("jhg/pwm_3500.csv", 11.33, 0.95, 1.0),
    ("aalborg/startup_12v.csv", None, 0.80, 0.5),
    ("aalborg/square_growing.csv", None, 0.97, 0.95),
    pytest.param("waam/Jan-15-2022_11-00-14.csv", None, 0.95, 1.0, marks=SLOW),
    pytest.param("waam/Jan-27-2022_17-23-00.csv", None, 0.95, 1.0, marks=SLOW),
]


@needs_recordings
@pytest.mark.parametrize(("file", "voltage_v", "r2", "largest_correlation"), REAL)
def test_real_starts_are_fitted(
    file: str, voltage_v: float | None, r2: float, largest_correlation: float
) -> None:
    """R2 of the current with the model that the evidence chooses, and how far the residual is from white."""
    ((_, fit),) = identify(read_recording(RECORDINGS / file), voltage_v=voltage_v, regime="start").starts
    assert fit.r2_current >= r2
    assert abs(fit.lag_one) <= largest_correlation
    if file.endswith("F0000.csv"):
        assert "an outlier of 13.6 A at 0.05 s, left out" in [str(defect) for defect in fit.defects]


@needs_recordings
@pytest.mark.parametrize(
    ("n_healthy", "sound", "faulty"),
    [(3, ["ok_06"], ["ng_01"]), pytest.param(5, ["ok_06", "ok_08"], ["ng_01", "ng_05"], marks=LONG)],
)
def test_production_line_starts(n_healthy: int, sound: list[str], faulty: list[str]) -> None:
    folder = RECORDINGS / "production_line"
    healthy = [folder / f"ok_{n:02d}.csv" for n in range(1, n_healthy + 1)]
    others = [folder / f"{name}.csv" for name in (*sound, *faulty)]
    found = [o.diagnosis for o in diagnose_files(others, healthy=healthy) if o.diagnosis is not None]
    assert [d.verdict.is_fault for d in found] == [False] * len(sound) + [True] * len(faulty)
    fits = [d.decisive.identified for d in found if d.decisive.identified is not None]
    assert [fit.r2_current >= 0.99 and abs(fit.lag_one) <= 0.8 for fit in fits] == [True] * len(others)
    for one in found[len(sound) :]:
        moved = {c.name: c.ratio for c in one.changes if c.significant}
        assert min(moved["R/V"], moved["K^2/(J V)"]) > 1.05
        assert moved["speed"] == pytest.approx(0.82, abs=0.02)
        assert moved["K/V"] > 1.15
