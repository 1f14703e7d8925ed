"""Motors, probes, sheets and files of strangers: no verdict that the recording or the table below it denies."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import at_work, high_pass, start_behind, started, taught_by_windows
from judged_by_hand import EXAMPLES, SHEET, moved, start
from present import present
from recording_csv import QUANTITIES, csv_text

from motor_env import (
    InputError,
    Recording,
    Verdict,
    commission,
    diagnose,
    load_motor,
    watch,
)
from motor_env.apps.folder import appearing
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.readers import tables

# Reaches in: the rows of a log that count as missing, and what says that a log's probe is coupled.
from motor_env.diagnosis.readers.noise import lone_outliers
from motor_env.diagnosis.readers.recording import read_recording
from motor_env.diagnosis.verdict.healthy_motor import reference_of
from motor_env.diagnosis.verdict.judgement import NOTHING_ELSE, percent
from motor_env.diagnosis.verdict.sensor_diagnosis import explain_coupling
from motor_env.motor.parameters import FloatArray


@pytest.mark.parametrize(("run", "are_outliers"), [(1, True), (2, True), (3, True), (4, False)])
def test_a_few_outliers_in_a_row_are_no_readings(run: int, are_outliers: bool) -> None:
    values = np.sin(0.01 * np.arange(2000.0))
    values[700 : 700 + run] *= 10.0
    assert np.flatnonzero(lone_outliers(values)).tolist() == list(range(700, 700 + run)) * are_outliers
    recording = start()
    recording.current_a[320 : 320 + run] *= 10.0
    assert (diagnose(recording, SHEET).verdict is Verdict.HEALTHY) is are_outliers


def test_coarser_steps_than_those_of_the_healthy_starts_are_no_noise_fault() -> None:
    def in_steps(seed: int, step_a: float) -> Recording:
        recording = started(np.random.default_rng(seed))
        return replace(recording, current_a=step_a * np.round(recording.current_a / step_a))

    learned = commission([in_steps(seed, 0.01) for seed in range(5)]).motor
    for step_a in (0.1, 0.3):
        assert diagnose(in_steps(9, step_a), learned).verdict in (Verdict.HEALTHY, Verdict.UNUSABLE)


@pytest.mark.parametrize("tau_s", [0.5, 1.0, 2.0])
def test_a_log_tells_a_slow_coupling(tau_s: float) -> None:
    log = at_work(np.random.default_rng(1))
    assert explain_coupling(log) is None
    settled = high_pass(log, tau_s, float(log.current_a[0]))
    assert "the current is AC-coupled: a high pass of about" in (explain_coupling(settled) or "")


def test_a_watch_says_that_a_probe_may_be_coupled_where_drag_is_gone() -> None:
    """Nine tenths of the drag that was learned are."""
    log, motor = at_work(np.random.default_rng(1), seconds=3.0), taught_by_windows()
    healthy, windows = present(motor.healthy), present(present(motor.healthy).windows)
    physical = windows.physical * np.where(np.arange(len(windows.physical)) == index.B, 10.0, 1.0)
    heavy = replace(
        healthy, values=healthy.values * [1.0, 1.0, 1.0, 10.0], windows=replace(windows, physical=physical)
    )
    lines = csv_text({name: getattr(log, name) for name in QUANTITIES}).splitlines()
    events = [event for event in watch(replace(motor, healthy=heavy), lines) if event.ratios]
    assert events
    assert all("AC-coupled" in event.reason for event in events)


@pytest.mark.parametrize("tau_s", [1.0, 2.0])
def test_starts_of_a_slow_coupling_are_no_healthy_ones(tau_s: float) -> None:
    """Such a start does not always tell the time constant, but that no level stays."""
    with pytest.raises(InputError, match="the current is AC-coupled: a high pass"):
        commission([start_behind(1.0, tau_s, 2.0, seed) for seed in range(5)])


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


def test_a_friction_of_0_is_none_that_a_recording_is_compared_with(tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    sheet = (EXAMPLES / "motor.toml").read_text(encoding="utf-8")
    path.write_text(sheet.replace("no_load_current_ma = 26.3", "viscous_friction_n_m_s_per_rad = 0.0"))
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
