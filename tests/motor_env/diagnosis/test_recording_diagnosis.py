from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from motor_env import (
    Fault,
    FaultKind,
    Recording,
    Scenario,
    SensorParameters,
    SupplyParameters,
    Timing,
    Verdict,
    cli,
    diagnose,
    draw,
    identify,
    load_motor,
    load_recipe,
    read_recording,
    simulate,
)
from motor_env.diagnosis.file_verdicts import diagnose_files
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.start import prepare

EXAMPLES = Path(__file__).parents[3] / "examples"
MOTOR = load_motor(EXAMPLES / "motor.toml")
recordings_path = os.environ.get("MOTOR_ENV_RECORDINGS")
needs_recordings = pytest.mark.skipif(
    recordings_path is None, reason="MOTOR_ENV_RECORDINGS does not point to the recordings of real motors"
)
RECORDINGS = Path(recordings_path or "recordings")
HEAD = b"time_s,current_a\n" + b"".join(b"%d,%d\n" % (n, n % 3) for n in range(30))


def captures(
    count: int,
    *faults: Fault,
    seed: int = 11,
    quiet_s: float = 0.05,
    channels: tuple[str, ...] = ("current",),
    known_voltage: bool = True,
    offset_a: float = 0.0,
) -> list[Recording]:
    recipe = load_recipe(
        "bench",
        motor=MOTOR.parameters,
        supply=SupplyParameters(12.0),
        sensor=SensorParameters(channels, 0.02, 1.0),  # type: ignore[arg-type]  # names become channels
        timing=Timing(10_000.0, 0.2, quiet_s),
    )
    scenario = replace(draw(recipe, seed, np.arange(count)).scenario, faults=faults)
    starts = simulate(scenario, seed, np.arange(count))
    voltage = np.where(starts.time_s > 1e-9, 12.0, 0.0)
    return [
        Recording(
            Path(f"simulated-{n}"),
            starts.time_s,
            starts.measurements[n, 0] + offset_a,
            voltage if known_voltage else None,
            starts.measurements[n, 1] if len(channels) > 1 else None,
        )
        for n in range(count)
    ]


def verdicts(recordings: list[Recording]) -> list[Verdict]:
    return [diagnose(recording, MOTOR).verdict for recording in recordings]


@pytest.mark.parametrize("channels", [("current",), ("current", "speed")])
@pytest.mark.parametrize(
    ("fault", "verdict"),
    [
        (None, Verdict.HEALTHY),
        (Fault(FaultKind.BEARING, 0.35), Verdict.BEARING),
        (Fault(FaultKind.WINDING_CONTACT, 0.35), Verdict.WINDING),
        (Fault(FaultKind.WINDING_SHORT, 0.15), Verdict.WINDING),
        (Fault(FaultKind.NOISE, 2.0), Verdict.NOISE),
    ],
)
def test_verdicts_against_the_data_sheet(
    channels: tuple[str, ...], fault: Fault | None, verdict: Verdict
) -> None:
    faults = () if fault is None else (fault,)
    assert verdicts(captures(2, *faults, channels=channels)) == [verdict] * 2


def test_a_weak_magnet_is_other_and_names_the_direction() -> None:
    recording = captures(1)[0]
    weak = MOTOR.parameters.scaled(back_emf_constant_v_s_per_rad=0.7, torque_constant_n_m_per_a=0.7)
    start = simulate(Scenario(weak, timing=Timing(10_000.0, 0.2, 0.05)), 3, [0])
    changed = Recording(recording.path, start.time_s, start.measurements[0, 0], recording.voltage_v)
    diagnosis = diagnose(changed, MOTOR)
    assert diagnosis.verdict is Verdict.OTHER
    assert any("K^2/J is down" in reason for reason in diagnosis.reasons)


def test_severity_interval_holds_the_truth() -> None:
    found = [diagnose(r, MOTOR) for r in captures(6, Fault(FaultKind.WINDING_CONTACT, 0.40))]
    intervals = [d.severity_interval for d in found if d.severity_interval is not None]
    inside = [low <= 0.40 <= high for low, high in intervals]
    assert sum(inside) >= 5
    assert np.mean([d.severity or 0.0 for d in found]) == pytest.approx(0.40, abs=0.03)


def test_standard_errors_agree_with_the_scatter_of_repetitions() -> None:
    """Repetitions of one motor: the estimates scatter as the standard errors say, and about the truth."""
    starts = simulate(Scenario(MOTOR.parameters, timing=Timing(10_000.0, 0.1, 0.05)), 5, np.arange(24))
    voltage = np.where(starts.time_s > 1e-9, 12.0, 0.0)
    fits = [
        identify(Recording(Path("x"), starts.time_s, row[0], voltage)).usable[0]
        for row in starts.measurements
    ]
    z = (np.array([f.log_values for f in fits]) - np.log(true_quantities())) / np.sqrt(
        np.array([np.diag(f.log_covariance) for f in fits])
    )
    assert np.all(np.abs(z.mean(axis=0)) < 4.0 / np.sqrt(24))
    assert np.all((z.std(axis=0) > 0.6) & (z.std(axis=0) < 1.5))


def true_quantities() -> list[float]:
    p = MOTOR.parameters
    k2 = np.multiply(p.back_emf_constant_v_s_per_rad, p.torque_constant_n_m_per_a)
    ratios = (p.resistance_ohm, p.inductance_h, k2 / p.inertia_kg_m2)
    return [float(q) for q in (*ratios, np.divide(p.viscous_friction_n_m_s_per_rad, p.inertia_kg_m2))]


def test_an_offset_is_taken_off() -> None:
    fits = identify(captures(3, offset_a=0.25)).usable
    assert np.mean([f.offset_a for f in fits]) == pytest.approx(0.25, abs=0.002)


def test_without_a_voltage_only_ratios_are_told_and_the_sheet_is_no_reference() -> None:
    recording = captures(1, known_voltage=False)[0]
    alone = diagnose(recording)
    assert alone.verdict is Verdict.NO_REFERENCE
    fit = alone.decisive.identified
    assert fit is not None
    assert fit.quantity_names == ("R/V", "L/V", "K^2/(J V)", "B/J")
    np.testing.assert_allclose(fit.values[0], 2.18 / 12.0, rtol=0.05)
    compared = diagnose(recording, replace(MOTOR, nominal_voltage_v=None))
    assert compared.verdict is Verdict.NO_REFERENCE
    assert compared.reasons[0].startswith(
        "this recording determines R/V, L/V, K^2/(J V), B/J, and the reference"
    )


def test_a_capture_without_a_start_is_unusable_and_never_healthy() -> None:
    rng = np.random.default_rng(0)
    time = np.linspace(0.0, 0.1, 1000)
    noise = Recording(Path("x"), time, 0.02 * rng.standard_normal(1000))
    with pytest.raises(UnusableError):
        prepare(noise)
    assert diagnose(noise, MOTOR).verdict is Verdict.UNUSABLE


@pytest.mark.parametrize(
    ("content", "needle"),
    [
        (b"", "is empty"),
        (b"time_s,current_a\n0,0\n", "at least 20 samples, got 1"),
        (b"time_s,volts\n0,0\n1,0\n", "line 1: the column current_a is missing"),
        (
            HEAD + b"30,inf\n",
            "line 32: the column current_a must hold finite numbers, got 'inf'",
        ),
        (HEAD + b"30,x\n", "line 32: the column current_a must hold numbers, got 'x'"),
        (HEAD + b"30\n", "line 32: the column current_a has no value"),
        (b"time_s,current_a\n0,x\n" + HEAD[18:], "line 2: the column current_a must hold numbers"),
        (b"\x89PNG\x01\x02\x03" * 40, "is not"),
        (b"\x00" * 300, "is not"),
        (
            b"time_s,current_a\n" + b"".join(b"%d,0\n" % n for n in [*range(20), 5]),
            "line 22: the column time_s must rise, got 5 after 19",
        ),
    ],
)
def test_bad_recordings_get_one_sentence(tmp_path: Path, content: bytes, needle: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.csv") as error:
        read_recording(path)
    assert needle in str(error.value)
    assert "\n" not in str(error.value)


def test_exit_status_and_json_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture, motor = str(EXAMPLES / "startup_capture.csv"), str(EXAMPLES / "motor.toml")
    assert cli.main(["diagnose", capture, "--motor", motor, "--json", "--out", str(tmp_path)]) == 1
    (answer,) = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "bearing"
    assert answer["severity_interval"][0] < 0.30 < answer["severity_interval"][1]
    assert {"file", "verdict", "severity", "confidence", "parameters", "r2_current"} <= set(answer)
    assert [p.suffix for p in tmp_path.iterdir()] == [".html"]
    assert cli.main(["diagnose", capture]) == 3
    assert cli.main(["diagnose", capture, "nosuch.csv", "--motor", motor]) == 2
    printed = capsys.readouterr()
    assert "bearing" in printed.out
    assert "nosuch.csv: no such file" in printed.err


def test_the_example_is_what_its_script_writes(tmp_path: Path) -> None:
    script = tmp_path / "make_startup_capture.py"
    script.write_bytes((EXAMPLES / "make_startup_capture.py").read_bytes())
    (tmp_path / "motor.toml").write_bytes((EXAMPLES / "motor.toml").read_bytes())
    subprocess.run([sys.executable, str(script)], check=True)
    assert (tmp_path / "startup_capture.csv").read_bytes() == (EXAMPLES / "startup_capture.csv").read_bytes()


SLOW = [pytest.mark.long, pytest.mark.timeout(900)]
REAL = [
    ("lieskjur/startup_120v.csv", None, 0.995, 1.0),
    ("oscillo_lab/startup_F0000.csv", 12.3, 0.97, 0.5),
    ("oscillo_lab/startup_F0001.csv", 12.3, 0.97, 0.9),
    pytest.param("jhg/pwm_100.csv", 11.33, 0.95, 1.0, marks=pytest.mark.long),
    ("jhg/pwm_900.csv", 6.0, 0.95, 1.0),
    pytest.param("jhg/pwm_1600.csv", 1.333, 0.95, 1.0, marks=pytest.mark.long),
    pytest.param("jhg/pwm_2000.csv", 1.333, 0.95, 1.0, marks=pytest.mark.long),
    pytest.param("jhg/pwm_2700.csv", 6.0, 0.95, 1.0, marks=pytest.mark.long),
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
    ("n_healthy", "ends"),
    [
        (3, {"ok_06": False, "ng_01": True}),
        pytest.param(
            5, {"ok_06": False, "ok_08": False, "ng_01": True, "ng_05": True}, marks=pytest.mark.long
        ),
    ],
    ids=["few", "more"],
)
def test_production_line_starts(n_healthy: int, ends: dict[str, bool]) -> None:
    folder = RECORDINGS / "production_line"
    healthy = [folder / f"ok_{n:02d}.csv" for n in range(1, n_healthy + 1)]
    others = [folder / f"{name}.csv" for name in ends]
    found = [o.diagnosis for o in diagnose_files(others, healthy=healthy) if o.diagnosis is not None]
    assert [d.verdict.is_fault for d in found] == [*ends.values()]
    fits = [d.decisive.identified for d in found if d.decisive.identified is not None]
    assert [fit.r2_current >= 0.99 and abs(fit.lag_one) <= 0.8 for fit in fits] == [True] * len(ends)
    for faulty in found[len(ends) // 2 :]:
        moved = {c.name: c.ratio for c in faulty.changes if c.significant}
        assert moved["R/V"] > 1.05
        assert moved["K^2/(J V)"] > 1.05
        assert moved["speed"] == pytest.approx(0.82, abs=0.02)
        assert moved["K/V"] > 1.15
