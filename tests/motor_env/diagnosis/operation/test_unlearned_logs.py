"""Logs of a motor that was not commissioned at work: judged by its data sheet, or by its healthy starts."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from motor_env import (
    PAPER_MOTOR,
    Fault,
    FaultKind,
    Motor,
    Recording,
    Scenario,
    SensorParameters,
    Timing,
    commission,
    diagnose,
    simulate,
    simulate_states,
)
from motor_env.diagnosis.estimation import parameter_index as index

# Reaches in: the long test judges by the joint fit itself, made once for two motors.
from motor_env.diagnosis.estimation.operation_fit import identify_operation
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.operation import log_diagnosis, window_baseline
from motor_env.diagnosis.operation.log_diagnosis import judge_for
from motor_env.diagnosis.operation.windows import viscous
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.verdict.hypotheses import NAMES
from motor_env.motor.healthy import Healthy, Windows
from motor_env.motor.parameters import FloatArray

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
    """Commissioned from three simulated starts."""
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
    """Windows of 0.8 s; the friction doubles after two of them."""
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
    """Its fit took a load for dry friction: with the load free in each window, the doubled friction would be a load.

    A window at rest tells nothing.
    """

    def one_direction(record: Record) -> Any:
        found = true_fit(record)
        found.solution.values[[index.COULOMB, index.LOAD]] = 5e-3, -5e-3
        found.solution.names = (*TERMS, "coulomb", "load_constant", "load_walk")
        return found

    monkeypatch.setattr(log_diagnosis, "identify_record", one_direction)
    monkeypatch.setattr(
        window_baseline,
        "without_load",
        lambda *_: true_fit(cast("Record", SimpleNamespace(readings=None))).solution,
    )
    whole = log(HALF_WAY, 1650, least_v=6.0)  # the last samples are no window
    assert whole.voltage_v is not None
    assert whole.speed_rad_s is not None
    works = np.arange(1650) >= at_rest
    whole = replace(
        whole,
        current_a=whole.current_a * works,
        voltage_v=whole.voltage_v * works,
        speed_rad_s=whole.speed_rad_s * works,
    )
    given: list[Record] = []

    def choose_window_terms(records: list[Record], joint: Any) -> Any:
        given.extend(records)
        return window_baseline.choose_window_terms(records, joint)

    monkeypatch.setattr(log_diagnosis, "choose_window_terms", choose_window_terms)
    judge = judge_for(whole, SHEET)
    assert [record.hold for record in given] == ["late"] * (4 - at_rest // 400)
    if at_rest == 1600:
        assert "load_walk" in judge.windows.terms  # as in the joint fit
        return
    assert judge.windows.terms == (*TERMS, "coulomb", "load_walk")
    assert judge.windows.one_way
    assert judge.windows.physical[index.COULOMB] == judge.windows.physical[index.LOAD] == 0.0
    assert said(whole, SHEET) == ["unusable" if at_rest else "healthy", "healthy", "bearing", "bearing"]


@pytest.mark.long
def test_the_fit_of_the_whole_log_tells_how_its_windows_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own friction doubles half-way; what the file says of the healthy motor counts."""
    joint = cache(lambda _: identify_operation([log(HALF_WAY)]))
    monkeypatch.setattr(log_diagnosis, "identify_record", lambda _: joint("once"))
    for motor in (SHEET, of_starts()):
        assert said(log(HALF_WAY), motor) == ["healthy"] * 2 + ["bearing"] * 2


def test_a_motor_file_may_allow_for_more_brush_drop(monkeypatch: pytest.MonkeyPatch) -> None:
    allowed: list[float] = []

    def fit(record: Record) -> Any:
        allowed.append(record.brush_drop_v)
        return true_fit(record)

    monkeypatch.setattr(log_diagnosis, "identify_record", fit)
    judge_for(log(), replace(SHEET, brush_drop_v=3.0))
    assert allowed == [3.0]


@pytest.mark.usefixtures("quick")
def test_the_reference_of_a_log_by_hand() -> None:
    """R, K and J are the file's; the drag over the effective speed is its friction, where all of it is viscous."""
    judge = judge_for(log(), SHEET)
    expected = np.array([P.resistance_ohm, K, P.inertia_kg_m2, FRICTION])
    assert judge.reference.names == NAMES
    np.testing.assert_allclose(np.exp(judge.reference.log_values), expected)
    assert not judge.reference.includes_fit_error
    taught = judge.windows
    speed = float(np.sqrt(np.mean(np.square(np.asarray(log().speed_rad_s)))))
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
    at_20 = replace(starts, healthy=replace(starts.healthy, temperature_c=20.0))
    measured = judge_for(log(), at_20, 45.0).reference
    assert (measured.temperature_k, measured.warmer_k) == (4.0, 25.0)
    rows = [starts.healthy.quantities.index(name) for name in NAMES]
    np.testing.assert_allclose(
        by_starts.log_covariance, starts.healthy.log_covariance[np.ix_(rows, rows)], rtol=1e-9, atol=1e-12
    )


def test_stretches_of_a_log_tell_how_it_is_fitted() -> None:
    """2,000 samples, or ten stretches of 20 mechanical time constants; a shorter record is taken whole."""
    whole = Record(1e-3, np.arange(9_000.0), np.zeros((9_000, 2)), np.ones(2), np.eye(1, 9_000)[0])
    for settles_s, samples in ((0.01, 2_000), (0.0125, 2_500), (0.04, 8_000)):
        part = log_diagnosis._enough(whole, settles_s)
        assert (len(part.voltage_v), int(part.begins.sum())) == (samples, 10)
        np.testing.assert_array_equal(part.voltage_v[:: samples // 10], 900.0 * np.arange(10))
    assert log_diagnosis._enough(whole, 0.045) is whole


def test_a_motor_that_was_commissioned_at_work_says_how_its_windows_are_judged() -> None:
    windows = Windows(0.4, TERMS, np.zeros(index.N_VALUES), "late", DT_S, 100.0)
    healthy = Healthy(9, 12.0, NAMES, np.ones(4), np.eye(4), temperature_c=20.0, windows=windows)
    judge = judge_for(log(), replace(SHEET, healthy=healthy), 45.0)
    assert judge.windows is windows
    assert (judge.reference.source, judge.reference.warmer_k) == ("9 healthy windows of sheet", 25.0)


def test_what_tells_too_little_of_a_log_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_diagnosis, "identify_record", true_fit)
    current_only = ("R", "L", "K^2/J", "B/J")
    healthy = replace(of_starts().healthy or pytest.fail("learned"), quantities=current_only, values=np.ones(4),
                      log_covariance=np.eye(4))  # fmt: skip
    found = diagnose(log(), replace(SHEET, healthy=healthy))
    assert (found.verdict, found.of) == ("unusable", 1)
    assert found.reasons[0].startswith("sheet does not give R, K, J, B")

    def unseen(record: Record) -> Any:
        fit = true_fit(record)
        fit.record.recorded[1] = 0.0
        return fit

    monkeypatch.setattr(log_diagnosis, "identify_record", unseen)
    with pytest.raises(UnusableError, match="only if voltage, current and speed"):
        judge_for(log(), SHEET)


def physical(b: float, coulomb: float, square: float = 0.0) -> FloatArray:
    values = np.zeros(index.N_VALUES)
    values[[index.B, index.COULOMB, index.SQUARE]] = b, coulomb, square
    return values


def test_the_friction_of_a_log_by_hand() -> None:
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


@pytest.mark.usefixtures("quick")
def test_a_file_may_give_dry_friction_alone() -> None:
    only_dry = replace(
        SHEET, parameters=replace(P, viscous_friction_n_m_s_per_rad=0.0), coulomb_friction_n_m=4e-4
    )
    no_load = 12.0 / P.back_emf_constant_v_s_per_rad
    speed = judge_for(log(), only_dry).windows.speed_rad_s
    drag = 4e-4 / no_load  # at every speed: all of this log's is viscous
    assert np.exp(judge_for(log(), only_dry).reference.log_values[3]) == pytest.approx(drag)
    assert log_diagnosis._friction_scale(only_dry, physical(0.0, 1.0), speed) * 1e-300 == pytest.approx(
        4e-4 / speed
    )
