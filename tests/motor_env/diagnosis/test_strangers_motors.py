"""Motors, probes, sheets and files of strangers: no verdict that the recording or the table below it denies."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import started
from judged_by_hand import SHEET, moved, start
from scipy.signal import lfilter

from motor_env import (
    PAPER_MOTOR,
    InputError,
    Recording,
    Verdict,
    commission,
    diagnose,
    load_motor,
    simulate_states,
    watch,
)
from motor_env.apps.folder import appearing
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.readers import tables

# Reaches in: the rows of a log that count as missing, and what says that a log's probe is coupled.
from motor_env.diagnosis.readers.noise import lone_outliers
from motor_env.diagnosis.readers.recording import read_recording
from motor_env.diagnosis.verdict.healthy_motor import reference_of
from motor_env.diagnosis.verdict.hypotheses import NAMES
from motor_env.diagnosis.verdict.judgement import NOTHING_ELSE, percent
from motor_env.diagnosis.verdict.sensor_diagnosis import explain_coupling
from motor_env.motor.healthy import Healthy, Windows
from motor_env.motor.parameters import FloatArray

DT_S = 2e-3


@pytest.mark.parametrize(("run", "are_outliers"), [(1, True), (2, True), (3, True), (4, False)])
def test_a_few_outliers_in_a_row_are_no_readings(run: int, are_outliers: bool) -> None:
    values = np.sin(0.01 * np.arange(2000.0))
    values[700 : 700 + run] *= 10.0
    assert np.flatnonzero(lone_outliers(values)).tolist() == list(range(700, 700 + run)) * are_outliers
    recording = start()
    recording.current_a[320 : 320 + run] *= 10.0
    assert (diagnose(recording, SHEET).verdict is Verdict.HEALTHY) is are_outliers


def in_steps(recording: Recording, step_a: float) -> Recording:
    return replace(recording, current_a=step_a * np.round(recording.current_a / step_a))


def test_coarser_steps_than_those_of_the_healthy_starts_are_no_noise_fault() -> None:
    learned = commission([in_steps(started(np.random.default_rng(seed)), 0.01) for seed in range(5)]).motor
    for step_a in (0.1, 0.3):
        found = diagnose(in_steps(started(np.random.default_rng(9)), step_a), learned)
        assert found.verdict in (Verdict.HEALTHY, Verdict.UNUSABLE)


def log(seconds: float = 4.0, tau_s: float = math.inf) -> Recording:
    """The paper's motor under steps of voltage, seen through a probe whose capacitor was charged before."""
    rng = np.random.default_rng(1)
    volts = np.repeat(rng.uniform(-10.0, 10.0, round(seconds / 0.05)), 25)
    current, speed = simulate_states(PAPER_MOTOR, np.repeat(volts, 4), DT_S / 4.0)[3::4].T
    kept = 1.0 if tau_s == math.inf else tau_s / (tau_s + DT_S)
    current = (
        current if kept == 1.0 else lfilter([kept, -kept], [1.0, -kept], current, zi=[-kept * current[0]])[0]
    )
    noise = rng.standard_normal((2, len(volts)))
    time_s = DT_S * np.arange(float(len(volts)))
    return Recording(Path("log"), time_s, current + 0.02 * noise[0], volts, speed + noise[1])


@pytest.mark.parametrize("tau_s", [0.5, 1.0, 2.0])
def test_a_log_tells_a_slow_coupling(tau_s: float) -> None:
    assert explain_coupling(log()) is None
    assert "the current is AC-coupled: a high pass of about" in (explain_coupling(log(tau_s=tau_s)) or "")


def taught() -> Healthy:
    """The paper's motor, as windows of a second would have taught it."""
    p, physical = PAPER_MOTOR, np.zeros(index.N_VALUES)
    known = (p.resistance_ohm, p.inductance_h, p.back_emf_constant_v_s_per_rad, p.inertia_kg_m2)
    physical[[index.R, index.L, index.K, index.J]] = [float(np.mean(one)) for one in known]
    physical[index.B] = 10.0 * float(np.mean(p.viscous_friction_n_m_s_per_rad))
    physical[[index.NOISE_I, index.NOISE_W]] = 0.02, 1.0
    terms = ("R", "K", "J", "B", "noise_current", "noise_speed")
    windows = Windows(1.0, terms, physical, "late", DT_S, 200.0, (3.0, 9.0), (10.0, 6.0, 430.0))
    values = physical[[index.R, index.K, index.J, index.B]]
    return Healthy(20, 23.0, NAMES, values, 0.02**2 * np.eye(4), temperature_k=0.0, windows=windows)


def test_a_watch_says_that_a_probe_may_be_coupled_where_drag_is_gone() -> None:
    """Nine tenths of the drag that was learned are."""
    recording = log(3.0)
    columns = (recording.time_s, recording.voltage_v, recording.current_a, recording.speed_rad_s)
    rows = np.column_stack([np.asarray(column, dtype=float) for column in columns])
    lines = ["time_s,voltage_v,current_a,speed_rad_s", *(",".join(map(str, row)) for row in rows.tolist())]
    windows = [
        event for event in watch(replace(load_motor("paper"), healthy=taught()), lines) if event.ratios
    ]
    assert windows
    assert all("AC-coupled" in event.reason for event in windows)


@pytest.mark.parametrize("tau_s", [1.0, 2.0])
def test_starts_of_a_slow_coupling_are_no_healthy_ones(tau_s: float) -> None:
    """Such a start does not always tell the time constant, but that no level stays."""

    def behind(seed: int) -> Recording:
        time_s = 1e-4 * np.arange(10_000.0) - 0.02
        volts = np.where(time_s >= 0.0, 12.0, 0.0)
        current = simulate_states(PAPER_MOTOR, volts, 1e-4)[:, 0]
        current = current + 0.02 * np.random.default_rng(seed).standard_normal(len(time_s))
        kept = tau_s / (tau_s + 1e-4)
        shown = lfilter([kept, -kept], [1.0, -kept], current, zi=[-kept * current[0]])[0]
        return Recording(Path(f"start{seed}"), time_s, shown, volts)

    with pytest.raises(InputError, match="the current is AC-coupled: a high pass"):
        commission([behind(seed) for seed in range(5)])


def with_shared(off: FloatArray, sd: float) -> FloatArray:
    """Errors of R, L, K^2/J and B/J, of which one is shared."""
    return np.diag(np.square([0.045, 0.1, 0.03, 0.3])) + sd**2 * np.outer(off, off)


@pytest.mark.parametrize(
    ("off", "changed", "verdicts"),
    [
        # By three healthy starts, at one temperature or another: K^2/J falls by 0.2 % a kelvin, and friction by 0.3 %.
        ((0.18, 0.0, -0.10, -0.1), {"temperature_k": 15.0, "degrees_of_freedom": 6.0}, "healthy"),
        ((0.18, 0.0, -0.29, 0.0), {"temperature_k": 15.0, "degrees_of_freedom": 6.0}, "other"),
        # A friction of five times, with a resistance beside it.
        ((0.18, 0.0, 0.0, 1.6), {"log_covariance": with_shared(np.zeros(4), 0.0)}, "bearing winding"),
        ((0.0, 0.0, 0.0, 1.6), {"log_covariance": with_shared(np.zeros(4), 0.0)}, "bearing"),
        # A sheet without inertia.
        (
            (0.18, 0.0, 0.0, 1.0),
            {"log_covariance": with_shared(np.array([0, 0, 1, 1]), 1.5)},
            "winding bearing",
        ),
    ],
)
def test_what_moved_is_what_the_verdict_says(
    off: tuple[float, ...], changed: dict[str, float], verdicts: str
) -> None:
    if "temperature_k" in changed:
        changed |= {"log_covariance": 0.04**2 * np.eye(4)}  # type: ignore[dict-item]
    found = moved(*off, **changed)
    assert [str(fault.verdict) for fault in (found, *found.also)] == verdicts.split()
    undecided = any(change.verdict == "undecided" for change in found.changes)
    assert not (undecided and any(NOTHING_ELSE in reason for reason in found.reasons))


def test_a_file_of_a_folder_is_judged_when_it_stands_still_and_again_when_it_has_changed(
    tmp_path: Path,
) -> None:
    copied, pauses = tmp_path / "1.csv", 0
    copied.write_text("1\n")

    def sleep(_: float) -> None:
        nonlocal pauses
        pauses += 1
        if pauses in (2, 9):
            copied.write_text(copied.read_text() + "1\n")

    found = appearing(tmp_path, follow=True, sleep=sleep)
    judged = [(next(found).name, pauses, copied.read_text().count("1")) for _ in range(2)]
    assert judged == [("1.csv", 6, 2), ("1.csv", 13, 3)]


SHOP = """
[motor]
resistance_ohm = 2.18
inductance_mh = 0.238
torque_constant_mnm_per_a = 23.5
rotor_inertia_g_cm2 = 10.7
no_load_current_ma = 26.3
nominal_voltage_v = 12.0
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "no_load_current_ma",
            "no_load_current_a",
            "R i0 / V is 4.78, which no motor has: no_load_current_a = 26.3",
        ),
        (
            "inductance_mh",
            "inductance_h",
            "L / R is 0.109 s, which no motor has: inductance_h = 0.238 looks like",
        ),
        ("torque_constant_mnm", "torque_constant_n_m", "looks like torque_constant_mnm_per_a"),
        ("rotor_inertia_g_cm2", "rotor_inertia_kg_m2", "looks like rotor_inertia_g_cm2"),
        ("resistance_ohm = 2.18", "resistance_mohm = 2180.0", ""),
    ],
)
def test_a_number_in_another_unit_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(SHOP.replace(old, new))
    if words:
        with pytest.raises(InputError) as error:
            load_motor(path)
        assert words in str(error.value)
    else:
        assert load_motor(path).notes == ()


def test_a_friction_of_0_is_none_that_a_recording_is_compared_with(tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(SHOP.replace("no_load_current_ma = 26.3", "viscous_friction_n_m_s_per_rad = 0.0"))
    motor = load_motor(path)
    found = diagnose(start(), motor)
    assert found.verdict is Verdict.HEALTHY
    assert {change.name: change.verdict for change in found.changes}["B/J"] == "undecided"
    assert "its friction is 0" in found.to_json()["warnings"][0]
    assert [percent(share) for share in (0.5, 100.0, 101.0)] == ["+50.0%", "+10000.0%", "over 10,000%"]


def test_an_identified_motor_is_named_once() -> None:
    for name, source in (("identified motor", "identified motor"), ("mine", "identified motor mine")):
        reference = reference_of(replace(SHEET, kind="identified", name=name), ("R",))
        assert reference is not None
        assert reference.source == source


def test_bytes_of_0_in_a_long_file_are_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "LARGEST_WHOLE_BYTES", 1000)
    path = tmp_path / "long.csv"
    rows = [f"{1e-3 * n:.3f},{math.sin(0.1 * n):.4f}" for n in range(1000)]
    path.write_text("time_s,current_a\n" + "\n".join(rows).replace("0.500", "0.5\0" + "00", 1) + "\n\0")
    recording = read_recording(path)
    assert len(recording.time_s) == 1000
    assert "2 NUL bytes are skipped" in recording.columns
