"""Logs of a motor at work: commissioned ones, and those judged by a data sheet or by healthy starts."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from operation_simulator import draw_motor, simulate as simulate_log

from motor_env import (
    PAPER_MOTOR,
    Fault,
    FaultKind,
    InputError,
    Motor,
    Recording,
    Scenario,
    SensorParameters,
    Timing,
    Verdict,
    commission,
    diagnose,
    load_motor,
    simulate,
    simulate_states,
)
from motor_env.common.console import worst
from motor_env.diagnosis import file_verdicts
from motor_env.diagnosis.estimation import parameter_index as index

# Reaches in: joint fits of logs, and what windows have taught, are made by hand.
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.operation import log_diagnosis, window_baseline
from motor_env.diagnosis.operation.log_diagnosis import judge_for
from motor_env.diagnosis.operation.windows import WindowJudge, viscous
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.verdict.hypotheses import NAMES
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.motor.healthy import Healthy, Windows
from motor_env.motor.parameters import FloatArray

PHYSICAL = np.zeros(index.N_VALUES)
WINDOWS = Windows(
    window_s=0.01, terms=("R", "K"), physical=PHYSICAL, hold="held", dt_s=1e-3, speed_rad_s=100.0
)
HEALTHY = Healthy(12, 15.0, NAMES, np.array([2.0, 0.03, 4e-6, 1e-6]), np.eye(4) * 4e-4, windows=WINDOWS)
MOTOR = replace(load_motor("paper"), healthy=HEALTHY)


@pytest.mark.parametrize(("load", "seed", "share"), [("square", (5, 4), 0.05), ("walk", (6, 0), 0.02)])
def test_friction_of_a_motor_that_never_turns_back_is_told(
    load: str, seed: tuple[int, int], share: float
) -> None:
    """With a fan, where a fitted load would balance too much dry friction; with a load that walks, which hides none."""
    rng = np.random.default_rng(seed)
    motor = draw_motor(rng)
    dt_s, torque = motor.mechanical_s / 10.0, share * motor.constant * motor.stall_a

    def log(factor: float, samples: int) -> Recording:
        worn = replace(motor, viscous=factor * motor.viscous, coulomb=factor * motor.coulomb)
        torque_n_m = torque * np.sqrt(samples / 600.0) if load == "walk" else torque
        return simulate_log(
            worn, "one way", rng, samples=samples, dt_s=dt_s, usual=motor, load=load, torque_n_m=torque_n_m
        )

    known = commission([log(1.0, 1200), log(1.0, 1200)], window_s=300 * dt_s).motor
    assert diagnose(log(1.0, 600), known).verdict is Verdict.HEALTHY
    found = diagnose(log(4.0, 600), known)
    assert found.verdict is Verdict.BEARING
    low, high = found.severity_interval or (0.0, 0.0)
    assert low < 3.0 < high < 9.0


def judging(monkeypatch: pytest.MonkeyPatch, *pieces: Judgement, of: int = 1) -> None:
    monkeypatch.setattr(WindowJudge, "judge", lambda *_: (list(pieces), of))


def test_one_bad_log_costs_no_other_its_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tmp_path / f"{n}.csv" for n in range(4)]
    record = Recording(paths[2], np.arange(30.0), np.ones(30))
    errors = [OverflowError("too large"), TypeError("a bug"), None, InputError("b.csv: is empty")]

    def reading(path: Path, *_: object) -> Recording:
        if (error := errors[paths.index(path)]) is not None:
            raise error
        return record

    monkeypatch.setattr(file_verdicts, "read_recording", reading)
    monkeypatch.setattr(file_verdicts, "load_motor", lambda _: MOTOR)
    judging(monkeypatch, *[Judgement(Verdict.HEALTHY, ())] * 2, of=3)
    outcomes = file_verdicts.diagnose_files(paths, motor="m.toml", regime="operation")
    assert [one.as_json()["verdict"] for one in outcomes] == ["unusable", "unusable", "healthy", "unusable"]
    assert [one.is_bug for one in outcomes] == [False, True, False, False]
    assert "2 of 2 windows judged, of 3" in repr(outcomes[2].diagnosis)
    assert outcomes[0].error == f"{paths[0]}: cannot be judged (too large)"
    assert worst(one.status for one in outcomes) == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("has_levels", "reason"), [(True, "more slowly than it switches"), (False, "at rest")]
)
def test_a_log_without_a_usable_window_says_why(
    has_levels: bool, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    noise, sine = rng.standard_normal((2, 400)), 12.0 * np.sin(np.arange(400.0) / 20.0)
    volts = rng.choice([0.0, 12.0], 400) if has_levels else sine
    record = Recording(Path("a.csv"), 1e-3 * np.arange(400.0), noise[0], volts, noise[1])
    judging(monkeypatch, *[Judgement(Verdict.UNUSABLE, ("at rest",))] * 2, of=2)
    found = diagnose(record, MOTOR, regime="operation")
    assert (found.verdict, found.of) == ("unusable", 1 if has_levels else 2)
    assert reason in found.reasons[0]
    (whole, *_) = found.pieces
    assert whole.duration_s == (pytest.approx(0.4) if has_levels else 0.0)
    assert file_verdicts.Outcome(record.path, found).status == 3


P, DT_S = PAPER_MOTOR, 0.002
FRICTION = float(P.viscous_friction_n_m_s_per_rad)
K = float(np.sqrt(P.torque_constant_n_m_per_a * P.back_emf_constant_v_s_per_rad))
SHEET = Motor("sheet", "data_sheet", P, nominal_voltage_v=12.0)
TERMS = ("R", "K", "J", "B", "noise_current", "noise_speed", "noise_voltage")


@cache
def log(faults: tuple[Fault, ...] = (), samples: int = 1600, least_v: float = -10.0) -> Recording:
    """A controller sets another voltage every 50 ms."""
    rng, time_s = np.random.default_rng(1), DT_S * np.arange(float(samples))
    voltage_v = np.repeat(rng.uniform(least_v, 10.0, samples // 25), 25)
    current_a, speed_rad_s = simulate_states(P, voltage_v, DT_S, faults=faults).T
    current_a = current_a + rng.normal(0.0, 0.02, samples)
    return Recording(Path("log"), time_s, current_a, voltage_v, speed_rad_s + rng.normal(0.0, 1.0, samples))


HALF_WAY = (Fault(FaultKind.BEARING, 1.0, onset_s=1.6),)


def true_fit(record: Record) -> Any:
    """Instead of the joint fit of a log, which takes many seconds: its motor as simulated."""
    values = np.zeros(index.N_VALUES)
    told = [index.R, index.L, index.K, index.J, index.B]
    values[told] = P.resistance_ohm, P.inductance_h, K, P.inertia_kg_m2, P.viscous_friction_n_m_s_per_rad
    values[[index.NOISE_I, index.NOISE_W, index.NOISE_V]] = 0.02, 1.0, 0.005
    return SimpleNamespace(
        record=SimpleNamespace(recorded=np.ones(2), hold="late"),
        solution=SimpleNamespace(values=values, names=TERMS),
        expected=record.readings,
    )


@cache
def of_starts() -> Motor:
    starts = []
    for seed in (1, 2, 3):
        sensor = SensorParameters(channels=("current", "speed"))  # type: ignore[arg-type]  # names do as well
        scenario = Scenario(P, sensor=sensor, timing=Timing(duration_s=0.2, quiet_s=0.02))
        made = simulate(scenario, seed, [0])
        current_a, speed_rad_s = made.measurements[0]
        starts.append(Recording(Path("start"), made.time_s, current_a, made.voltage_v[0], speed_rad_s))
    return commission(starts, "m").motor


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_diagnosis, "identify_record", true_fit)


def said(recording: Recording, motor: Motor) -> list[str]:
    return [str(piece.verdict) for piece in diagnose(recording, motor).pieces]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("motor", [lambda: SHEET, of_starts], ids=["sheet", "starts"])
def test_a_log_is_judged_without_a_commissioning_at_work(motor: Any) -> None:
    assert said(log(), motor()) == ["healthy"] * 4
    found = diagnose(log(HALF_WAY), motor())
    assert [piece.verdict for piece in found.pieces] == ["healthy"] * 2 + ["bearing"] * 2
    assert [piece.begin_s for piece in found.pieces] == pytest.approx([0.0, 0.8, 1.6, 2.4])
    assert (found.verdict, found.taken.regime, found.of) == ("bearing", "operation", 4)
    for piece in found.pieces[2:]:
        low, high = piece.severity_interval or (0.0, 0.0)
        assert low < 1.0 < high


@pytest.mark.parametrize("at_rest", [0, 400, 1600])
def test_friction_is_told_of_a_motor_that_turns_in_one_direction(
    monkeypatch: pytest.MonkeyPatch, at_rest: int
) -> None:
    """Its fit took a load for dry friction: free in each window, it would be the doubled one. At rest nothing tells."""

    def one_direction(record: Record) -> Any:
        found = true_fit(record)
        found.solution.values[[index.COULOMB, index.LOAD]] = 5e-3, -5e-3
        found.solution.names = (*TERMS, "coulomb", "load_constant", "load_walk")
        return found

    whole = log(HALF_WAY, 1650, least_v=6.0)  # the last samples are no window
    without = true_fit(cast("Record", SimpleNamespace(readings=None))).solution
    monkeypatch.setattr(log_diagnosis, "identify_record", one_direction)
    monkeypatch.setattr(window_baseline, "without_load", lambda *_: without)
    for name in ("current_a", "voltage_v", "speed_rad_s"):
        whole = replace(whole, **{name: getattr(whole, name) * (np.arange(1650) >= at_rest)})
    judge = judge_for(whole, SHEET)
    if at_rest == 1600:
        assert "load_walk" in judge.windows.terms  # as in the joint fit
        return
    assert judge.windows.terms == (*TERMS, "coulomb", "load_walk")
    assert judge.windows.one_way
    assert judge.windows.physical[index.COULOMB] == judge.windows.physical[index.LOAD] == 0.0
    assert said(whole, SHEET) == ["unusable" if at_rest else "healthy", "healthy", "bearing", "bearing"]


@pytest.mark.usefixtures("quick")
def test_the_reference_of_a_log() -> None:
    """R, K and J are the file's; the drag over the effective speed is its friction, where all of it is viscous."""
    judge = judge_for(log(), SHEET)
    expected = np.array([P.resistance_ohm, K, P.inertia_kg_m2, FRICTION])
    np.testing.assert_allclose(np.exp(judge.reference.log_values), expected)
    assert (judge.reference.names, judge.reference.includes_fit_error) == (NAMES, False)
    taught, speed = judge.windows, float(np.sqrt(np.mean(np.square(np.asarray(log().speed_rad_s)))))
    assert (taught.window_s, taught.speed_rad_s, taught.dt_s) == pytest.approx((0.8, speed, DT_S))
    assert (taught.terms, taught.hold, taught.rms_volts, taught.calibration) == (TERMS, "late", None, None)
    heavy = P.scaled(inertia_kg_m2=10.0)  # a window lasts 40 of its mechanical time constants
    window_s = judge_for(log(), replace(SHEET, parameters=heavy)).windows.window_s
    assert window_s == pytest.approx(40.0 * float(np.mean(heavy.mechanical_time_constant_s)))
    # Starts hold errors of other fits: the windows' own come on top, and their scatter is that of starts.
    starts = of_starts()
    assert starts.healthy is not None
    by_starts = judge_for(log(), starts).reference
    assert (by_starts.source, by_starts.includes_fit_error) == ("3 healthy starts of m", False)
    assert (by_starts.log_noise, by_starts.excess, by_starts.temperature_k) == (None, 1.0, 15.0)
    rows = [starts.healthy.quantities.index(name) for name in NAMES]
    own = starts.healthy.log_covariance[np.ix_(rows, rows)]
    np.testing.assert_allclose(by_starts.log_covariance, own, rtol=1e-9, atol=1e-12)
    at_20 = replace(starts, healthy=replace(starts.healthy, temperature_c=20.0))
    measured = judge_for(log(), at_20, 45.0).reference
    assert (measured.temperature_k, measured.warmer_k) == (4.0, 25.0)
    at_work = judge_for(log(), replace(SHEET, healthy=replace(HEALTHY, temperature_c=20.0)), 45.0)
    assert (at_work.windows, at_work.reference.warmer_k) == (WINDOWS, 25.0)


def test_stretches_of_a_log_tell_how_it_is_fitted() -> None:
    """2,000 samples, or ten stretches of 20 mechanical time constants; a shorter record is taken whole."""
    whole = Record(1e-3, np.arange(9_000.0), np.zeros((9_000, 2)), np.ones(2), np.eye(1, 9_000)[0])
    for settles_s, samples in ((0.01, 2_000), (0.0125, 2_500), (0.04, 8_000)):
        part = log_diagnosis._enough(whole, settles_s)
        assert (len(part.voltage_v), int(part.begins.sum())) == (samples, 10)
        np.testing.assert_array_equal(part.voltage_v[:: samples // 10], 900.0 * np.arange(10))
    assert log_diagnosis._enough(whole, 0.045) is whole


def test_what_tells_too_little_of_a_log_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    starts, current_only = of_starts(), ("R", "L", "K^2/J", "B/J")
    assert starts.healthy is not None
    healthy = replace(starts.healthy, quantities=current_only, values=np.ones(4), log_covariance=np.eye(4))
    monkeypatch.setattr(log_diagnosis, "identify_record", true_fit)
    found = diagnose(log(), replace(SHEET, healthy=healthy))
    assert (found.verdict, found.of) == ("unusable", 1)
    assert found.reasons[0].startswith("sheet does not give R, K, J, B")
    unseen = true_fit(cast("Record", SimpleNamespace(readings=None)))
    unseen.record.recorded[1] = 0.0
    monkeypatch.setattr(log_diagnosis, "identify_record", lambda _: unseen)
    with pytest.raises(UnusableError, match="only if voltage, current and speed"):
        judge_for(log(), SHEET)


def physical(b: float, coulomb: float, square: float = 0.0) -> FloatArray:
    values = np.zeros(index.N_VALUES)
    values[[index.B, index.COULOMB, index.SQUARE]] = b, coulomb, square
    return values


def test_the_friction_of_a_log() -> None:
    """The file's friction is that of the no-load speed; to this speed it goes as the drag of the log does."""
    friction, parts = log_diagnosis._friction_scale, physical(2e-6, 3e-4, 1e-8)
    b, kt = FRICTION, float(P.torque_constant_n_m_per_a)
    no_load = 12.0 * kt / (float(P.resistance_ohm) * b + K**2)
    at = {speed: 2e-6 + 3e-4 / speed + 1e-8 * speed for speed in (100.0, no_load)}
    assert viscous(parts, 100.0) == pytest.approx(at[100.0])
    assert friction(SHEET, parts, 100.0) == pytest.approx(at[100.0] / at[no_load])
    assert friction(SHEET, parts, no_load) == pytest.approx(1.0)
    # A file that gives dry friction beside the viscous one has both at its no-load speed.
    dry = replace(SHEET, coulomb_friction_n_m=4e-4)
    assert friction(dry, parts, no_load) == pytest.approx((b + 4e-4 / no_load) / b)
    assert friction(dry, parts, 100.0) == pytest.approx((b + 4e-4 / no_load) / b * at[100.0] / at[no_load])
    # Where log and file agree, the drag is the file's at any speed; and without a voltage nothing is known of a speed.
    assert friction(dry, physical(b, 4e-4), 100.0) == pytest.approx((b + 4e-4 / 100.0) / b)
    assert friction(replace(dry, nominal_voltage_v=None), parts, 100.0) == 1.0
    alone = replace(dry, parameters=replace(P, viscous_friction_n_m_s_per_rad=0.0))
    assert friction(alone, physical(0.0, 1.0), 100.0) * 1e-300 == pytest.approx(4e-4 / 100.0)
