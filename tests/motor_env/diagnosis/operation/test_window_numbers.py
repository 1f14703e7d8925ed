"""The judgement of windows and of looks part by part: rates, borders, spreads, what is chosen, what is said."""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from judged_by_hand import spread
from scipy import stats

from motor_env import Recording
from motor_env.diagnosis.estimation import parameter_index as index

# Reaches in: judgements rest on fits and records made by hand, off in the direction of a fault.
from motor_env.diagnosis.estimation.operation_fit import WindowFit
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.operation import window_baseline, windows
from motor_env.diagnosis.operation.window_baseline import learn_windows
from motor_env.diagnosis.operation.windows import (
    WARMTH,
    WindowJudge,
    averaged,
    judge_of,
    rms_volts,
    viscous,
    windows_of,
    with_drag_over_speed,
)
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference, motor_of_windows
from motor_env.diagnosis.verdict.hypotheses import (
    EXPONENTS,
    NAMES,
    FittedWindow,
    covariance_at_one_temperature,
    joint_share,
)
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.diagnosis.verdict.sensor_diagnosis import physical_values
from motor_env.motor.healthy import Healthy, Starts, Windows
from motor_env.motor.parameters import FloatArray

WHITE: FloatArray = np.random.default_rng(3).standard_normal((200, 2))
PHYSICAL = np.zeros(index.N_VALUES)
PHYSICAL[[index.R, index.L, index.K, index.J]] = 2.1, 1e-3, 0.031, 4.2e-6
PHYSICAL[[index.B, index.COULOMB, index.SQUARE]] = 2e-6, 3e-4, 1e-8
WINDOWS = Windows(
    window_s=0.5,
    terms=("R", "K", "J"),
    physical=PHYSICAL,
    hold="late",
    dt_s=1e-3,
    speed_rad_s=200.0,
    one_way=True,
    rms_volts=(6.0, 8.0),
    peaks=(9.0, 3.0, 200.0),
    window_excess=0.7,
)
HEALTHY = Healthy(
    pieces=12,
    degrees_of_freedom=15.0,
    quantities=NAMES,
    values=np.array([2.0, 0.03, 4e-6, 6.6e-6]),
    log_covariance=np.diag([4e-4, 1e-4, 9e-4, 16e-4]),
    temperature_k=0.0,
    windows=WINDOWS,
)
JUDGE = judge_of(HEALTHY)
DRAG = 1.2  # of the healthy windows over that of the physical values: 2e-6 + 3e-4 / 200 + 1e-8 * 200


def recording(n: int, volts: float = 7.0, dt_s: float = 1e-3) -> Recording:
    time_s: FloatArray = dt_s * np.arange(float(n))
    sine = math.sqrt(2.0) * np.sin(2.0 * math.pi * np.arange(n) / 100.0)
    return Recording(Path("log"), time_s, np.arange(float(n)), volts * sine, 30.0 * np.arange(float(n)))


def test_windows_are_cut_at_exact_samples() -> None:
    parts = windows_of(recording(1999), 0.5)
    assert [len(part.time_s) for part in parts] == [500, 500, 500]
    assert [float(part.current_a[0]) for part in parts] == [0.0, 500.0, 1000.0]
    long = recording(24_000, dt_s=1e-4)
    assert averaged(long, 0.6) is long  # 6,000 samples are kept as they are
    pairs = averaged(long, 0.61)
    assert (pairs.current_a[0], pairs.time_s[0], pairs.dt_s) == pytest.approx((0.5, 5e-5, 2e-4))
    assert rms_volts(recording(400, 3.0)) == pytest.approx(3.0)
    with pytest.raises(UnusableError, match="only if voltage, current and speed"):
        rms_volts(replace(long, speed_rad_s=None))


def test_the_drag_of_a_window_is_told_over_the_speed() -> None:
    """Viscous friction, dry friction over the speed, and the square law times it; none at all stays a number."""
    assert viscous(PHYSICAL, 200.0) == pytest.approx(2e-6 + 1.5e-6 + 2e-6)
    assert viscous(PHYSICAL, 50.0) == pytest.approx(2e-6 + 6e-6 + 0.5e-6)
    assert viscous(np.zeros(index.N_VALUES), 200.0) == 1e-300
    window = WindowFit(np.log([2.0, 0.03, 4e-6, 1.5]), spread(4), PHYSICAL, WHITE, 0.0)
    fit = with_drag_over_speed(window, PHYSICAL, 200.0)
    np.testing.assert_allclose(np.exp(fit.log_values), [2.0, 0.03, 4e-6, 1.5 * 5.5e-6])
    np.testing.assert_allclose(fit.log_covariance, spread(4))


def test_only_windows_that_tell_all_four_have_a_judge() -> None:
    as_starts = replace(HEALTHY, windows=None, starts=Starts(log_noise=0.0, log_noise_sd=0.1))
    fewer = replace(HEALTHY, quantities=NAMES[:3], values=np.ones(3), log_covariance=np.eye(3))
    for healthy in (as_starts, fewer):
        with pytest.raises(UnusableError, match="healthy recordings of it do not give R, K, J, B of windows"):
            judge_of(healthy, "it")


def test_sensors_are_checked_against_what_windows_have_taught(monkeypatch: pytest.MonkeyPatch) -> None:
    """R, K and J of the windows' mean, not those of the fit of all of them; and their drag."""
    given: list[FloatArray] = []
    monkeypatch.setattr(windows, "find_failure", lambda _, physical: given.append(physical))
    assert JUDGE.failed_sensor(recording(500)) is None
    for physical in (*given, physical_values(motor_of_windows(HEALTHY, "m"))):
        told = physical[[index.R, index.K, index.J, index.L, index.B, index.COULOMB]]
        assert told == pytest.approx([2.0, 0.03, 4e-6, 1e-3, 2e-6, 3e-4])
    assert given[0][index.DRAG] == pytest.approx(DRAG)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Instead of fits: a window is off by nearly nothing; and its rates are noted."""
    rates: list[float] = []

    def deciding(fit: FittedWindow, reference: Reference, rate: float, *, alarm: bool | None) -> Judgement:
        assert alarm is None  # each window by itself
        rates.append(rate)
        return decide(fit, reference, rate)

    def fitting(record: Record, known: FloatArray, terms: Sequence[str], *, one_way: bool) -> WindowFit:
        assert (one_way, record.hold, terms) == (WINDOWS.one_way, "late", WINDOWS.terms)
        logs = np.log([*HEALTHY.values[:3], DRAG]) + 0.01
        return WindowFit(logs, np.eye(4) * 1e-6, np.zeros(index.N_VALUES), WHITE, 0.0)

    monkeypatch.setattr(windows, "fit_window", fitting)
    monkeypatch.setattr(windows, "decide", deciding)
    return rates


def test_windows_of_a_record_share_its_rate(fits: list[float]) -> None:
    found, count = JUDGE.judge(recording(2600), 0.03)
    assert ([one.verdict for one in found], count) == (["healthy"] * 5, 5)
    assert [one.begin_s for one in found] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    assert [one.duration_s for one in found] == pytest.approx([0.5] * 5)
    assert fits == pytest.approx([0.03 / 5.0] * 5)
    width = stats.t.isf(0.025, 15.0) * math.sqrt(0.7 * 4e-4)
    resistance = found[0].changes[0]
    assert (resistance.ratio, resistance.low, resistance.high) == pytest.approx(
        np.exp([0.01, 0.01 - width, 0.01 + width])
    )


def test_a_window_that_cannot_be_fitted_is_unusable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "fit_window", Mock(side_effect=UnusableError("at rest")))
    found, _ = JUDGE.judge(recording(1000), 0.03)
    told = [(one.verdict, one.reasons, one.begin_s) for one in found]
    assert told == [("unusable", ("at rest",), 0.0), ("unusable", ("at rest",), 0.5)]


def test_of_many_windows_some_are_judged_and_the_rate_is_still_shared_by_all(
    fits: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = {7, 20, 33}

    def predict(self: Record, values: FloatArray) -> tuple[FloatArray, float]:
        assert (self.hold, values[index.R], values[index.KNEE]) == ("late", pytest.approx(2.0), 0.0)
        out, window = np.zeros((len(self.voltage_v), 6)), (self.readings[:, 0] // 500.0).astype(int)
        out[:, 0] = np.where(np.isin(window, list(odd)), 5.0, 1.0 + 1e-3 * window)
        return out, 0.0

    monkeypatch.setattr(Record, "predict", predict)
    monkeypatch.setattr(WindowJudge, "failed_sensor", lambda *_: None)
    assert len(JUDGE.judge(recording(40 * 500), 0.03)[0]) == 40
    many, count = JUDGE.judge(recording(41 * 500), 0.03)
    begins = [round(one.begin_s / 0.5) for one in many]
    evenly = set(np.linspace(0, 40, 10).round().astype(int).tolist())
    assert begins == sorted(evenly | odd | set(range(34, 41)))
    assert (fits[-1], count) == pytest.approx((0.03 / 41.0, 41))


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"volts": 2.9}, "outside the commissioned regime: 2.9 V effective, commissioned 6 to 8 V"),
        ({"volts": 3.1}, ""),
        ({"volts": 15.9}, ""),
        ({"volts": 16.1}, "outside the commissioned regime"),
        ({"dt_s": 1.09e-3}, ""),
        ({"dt_s": 1.2e-3}, "another sampling interval, 0.0012 s where it was 0.001 s"),
        ({"dt_s": 0.8e-3}, "another sampling interval"),
        ({"dt_s": 2.0}, "another sampling interval"),  # a window is none
        ({"n": 499}, "shorter than a window of 0.5 s"),
    ],
)
def test_a_record_is_judged_near_the_commissioned_regime(
    changed: dict[str, Any], reason: str, fits: list[float]
) -> None:
    given = recording(**({"n": 2000} | changed))
    with pytest.raises(UnusableError, match=reason) if reason else nullcontext():
        assert JUDGE.judge(given, 0.01)[0]
    anywhere = replace(JUDGE, windows=replace(WINDOWS, rms_volts=None))
    assert anywhere.judge(recording(500, volts=70.0), 0.01)[0]  # no regime was commissioned


def decided(
    ratios: FloatArray, covariance: FloatArray, rate: float, freedom: float, temperature_k: float = 0.0
) -> Judgement:
    reference = Reference(
        "it", NAMES, np.zeros(4), covariance, freedom, includes_fit_error=True, temperature_k=temperature_k
    )
    return decide(FittedWindow(ratios, covariance), reference, rate)


def limit_of(covariance: FloatArray, freedom: float, rate: float) -> float:
    return float(stats.t.isf(joint_share(rate, covariance, EXPONENTS, freedom), freedom))


def test_a_window_alarms_from_its_joint_limit_on() -> None:
    """Along a fault by Student's t; where no fault explains it, the whole by Fisher's F."""
    rate, freedom, covariance = 0.02, 30.0, 4e-4 * np.eye(4)
    share = joint_share(rate, covariance, EXPONENTS, freedom)
    friction = 0.02 * limit_of(covariance, freedom, rate)
    inertia = 0.02 * math.sqrt(4.0 * stats.f.isf(share, 4, freedom))
    for size, bearing, other in ((0.998, "healthy", "healthy"), (1.002, "bearing", "other")):
        found = decided(np.array([0.0, 0.0, 0.0, size * friction]), covariance, rate, freedom)
        assert (found.verdict, found.changes[3].significant) == (bearing, size > 1.0)
        assert decided(np.array([0.0, 0.0, size * inertia, 0.0]), covariance, rate, freedom).verdict == other


def test_warmth_widens_what_is_healthy() -> None:
    """Along the direction of warmth 15 K are one standard deviation; R by 0.393 % a kelvin."""
    covariance, ratios = np.diag([1e-3, 1e-3, 1.0, 1e-3]) ** 2, np.log1p(20.0 * WARMTH)
    np.testing.assert_allclose(WARMTH, [0.00393, -0.001, 0.0, -0.003])
    for kelvin, is_fault in ((0.0, True), (2.0, True), (15.0, False)):
        assert decided(ratios, covariance, 0.01, 1e3, kelvin).verdict.is_fault is is_fault
    # A colder motor with more resistance would have that K; but its R is that of the healthy one.
    off, wider = np.array([0.0, 0.04, 0.0, 0.0]), np.diag([0.01, 0.01, 0.01, 0.05]) ** 2 / 2.0
    assert decided(off, wider, 0.01, 30.0, 15.0).verdict == "other"


LOGS = np.random.default_rng(6).normal(0.0, 0.03, (6, 4))
RECORD = np.diag([1e-4, 0.25e-4, 1e-4, 25e-4])  # from record to record


class Lesson:
    """Instead of fits: windows with these logarithms, errors and noises."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, load_sd: float = 0.2, seen: float = 1.0) -> None:
        self.seen, self.logs = seen, LOGS
        self.names: tuple[str, ...] = ("R", "K", "offset_speed")
        self.speeds = (140.0, -20.0)  # 100 effective
        self.again: list[float] = []
        self.wanted: list[tuple[str, ...]] = []
        self.joint: list[int] = []
        self.error = np.diag([1e-4, 1e-4, 1e-4, load_sd**2])
        self.values = np.pad([2.0, 1e-3, 0.03, 4e-6, 2e-6, 3e-4], (0, index.N_VALUES - 6))
        monkeypatch.setattr(window_baseline, "identify_operation", self.identify)
        monkeypatch.setattr(window_baseline, "fit_window", self.fit)
        monkeypatch.setattr(window_baseline, "without_load", self.without_load)

    def identify(self, recordings: Sequence[Recording], *, most: int) -> Any:
        self.joint.append(sum(len(one.time_s) for one in recordings))
        assert most == max(10_000, self.joint[-1])
        record = SimpleNamespace(recorded=np.ones(2), hold="late", visible_step_share=self.seen)
        solution = SimpleNamespace(values=self.values, names=self.names)
        speeds = np.column_stack([[9.0, 9.0], self.speeds])
        return SimpleNamespace(record=record, solution=solution, expected=speeds)

    def without_load(self, best: Any, speed_rad_s: float) -> Any:
        assert best.names == self.names
        self.again.append(speed_rad_s)
        values = self.values.copy()
        values[[index.COULOMB, index.LOAD]] = 7e-4, 0.0
        return SimpleNamespace(values=values)

    def fit(
        self, record: Record, known: FloatArray, wanted: tuple[str, ...], *, one_way: bool = False
    ) -> WindowFit:
        assert record.hold == "late"
        assert one_way is bool(abs(np.mean(self.speeds)) > 0.9 * np.mean(np.abs(self.speeds)))
        number, values = len(self.wanted) % 6, self.values.copy()
        self.wanted.append(wanted)
        values[index.WALK] = 0.1 if "load_walk" in wanted else known[index.WALK]
        values[index.NOISE_I] = [1.0, 2.0, 3.0, 4.0, 5.0, 9.0][number]
        error = self.error if len(self.wanted) <= 6 else 1e-4 * np.eye(4)
        return WindowFit(self.logs[number], error.copy(), values, WHITE, 0.0)


@pytest.mark.parametrize("steady", [False, True])
def test_windows_teach_the_next_one(steady: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    Lesson(monkeypatch)
    found, learned = learn_windows([recording(3100)], 0.5, steady=steady)
    taught = found.windows
    assert taught is not None
    # The drag over the effective speed: the factor times 2e-6 + 3e-4 / 100.
    logs = LOGS + np.log([1.0, 1.0, 1.0, 5e-6])
    np.testing.assert_allclose([fit.log_values for fit in learned], logs)
    off = logs - logs.mean(axis=0)
    covariance = (off.T @ off + 4.0 * 1e-4 * np.eye(4)) / 9.0 * 7.0 / 6.0 + (0.0 if steady else RECORD)
    np.testing.assert_allclose(np.log(found.values), logs.mean(axis=0))
    np.testing.assert_allclose(found.log_covariance, covariance)
    assert (found.pieces, found.degrees_of_freedom, found.quantities) == (6, 9.0, NAMES)
    assert (taught.window_s, taught.dt_s, taught.speed_rad_s) == pytest.approx((0.5, 1e-3, 100.0))
    assert (found.temperature_k, taught.hold) == (0.0 if steady else 15.0, "late")
    assert taught.terms == (("R", "K") if steady else ("R", "K", "offset_speed"))
    assert taught.rms_volts == pytest.approx((7.0, 7.0))
    assert (taught.peaks or ())[1:] == pytest.approx(
        np.quantile(np.arange(2500.0, 3000.0), 0.999) * np.array([1.0, 30.0])
    )
    assert taught.physical[index.NOISE_I] == 3.5  # the median of the windows
    as_believed = replace(judge_of(found).reference, excess=1.0)
    spreads = (covariance_at_one_temperature(learned[0], as_believed), covariance)
    squares = [np.einsum("np,pq,nq", off, np.linalg.inv(spread), off) for spread in spreads]
    assert taught.window_excess == pytest.approx(squares[0] / squares[1])
    assert len(taught.drives) == (0 if steady else 1)  # the voltage is the same in all windows
    assert taught.calibration is not None
    drift = taught.calibration.drift_covariance - np.cov(logs.T) / 6.0
    believed = RECORD + 15.0**2 * np.outer(WARMTH, WARMTH)
    np.testing.assert_allclose(drift, 0.0 if steady else believed, atol=1e-12)


@pytest.mark.parametrize(
    ("place", "torque", "times"),
    [(index.NOISE_T, 0.9 * 5e-5, 3.0), (index.NOISE_T, 1.1 * 5e-5, 1.0), (index.WALK, 1e-9, 1.0)],
)
def test_a_model_that_lacks_nothing_errs_under_far_drives_only(
    monkeypatch: pytest.MonkeyPatch, place: int, torque: float, times: float
) -> None:
    """Of 1e-3 N m of friction at the effective speed 5 % are another torque in each interval; or a load walks."""
    lesson = Lesson(monkeypatch)
    lesson.values[[index.B, index.COULOMB, place]] = 4e-6, 6e-4, torque
    assert taught([recording(3100)], 0.5).alike == pytest.approx(0.12 * times)


def taught(
    recordings: Sequence[Recording], window_s: float | None = None, *, steady: bool = False
) -> Windows:
    windows = learn_windows(recordings, window_s, steady=steady)[0].windows
    assert windows is not None
    return windows


@pytest.mark.parametrize(
    ("sd", "scatter", "is_determined"),
    [(0.099, 0.0, True), (0.101, 0.0, False), (0.05, 0.099, True), (0.05, 0.101, False)],
)
def test_a_load_is_unknown_in_windows_that_tell_it_from_friction(
    monkeypatch: pytest.MonkeyPatch, sd: float, scatter: float, is_determined: bool
) -> None:
    lesson = Lesson(monkeypatch, load_sd=sd)
    lesson.logs = LOGS * [1.0, 1.0, 1.0, 0.0] + scatter * np.outer([1.0, -1.0] * 3, [0.0, 0.0, 0.0, 1.0])
    found = taught([recording(3000)], 0.5)
    assert ("load_walk" in found.terms) is is_determined
    assert bool(found.physical[index.WALK] > 0.0) is is_determined  # or a constant load would be unknown
    assert lesson.wanted[0] == ("R", "K", "offset_speed", "load_constant", "load_walk")


@pytest.mark.parametrize(
    ("load_sd", "back", "again"),
    [
        (0.05, 5.0, False),  # it is told
        (0.05, 4.0, True),  # the motor turns one way, and it only seems to be told
        (0.2, 5.0, False),  # it turns back for more than a twentieth of its turns
    ],
)
@pytest.mark.parametrize("load", ["load_constant", "load_walk", "gear_loss"])
@pytest.mark.parametrize("steady", [False, True])
def test_a_load_that_nothing_tells_from_friction_is_a_part_of_it(
    monkeypatch: pytest.MonkeyPatch, load_sd: float, back: float, again: bool, load: str, steady: bool
) -> None:
    """The joint fit is made again where it had a load, and one that walks stays. On a test bench no constant one is."""
    lesson = Lesson(monkeypatch, load_sd=load_sd)
    lesson.names, lesson.speeds = ("R", load, "K", "offset_speed"), (90.0, -back)
    lesson.values[[index.COULOMB, index.LOAD, index.WALK]] = 3e-4, 2e-4, 9.0
    found, loads = taught([recording(3100)], 0.5, steady=steady), {"load_constant", "load_walk"}
    anew = again and load in loads
    assert lesson.again == ([45.0 - 0.5 * back] if anew else [])  # the mean speed
    expected = [7e-4, 0.0] if anew else [3e-4, 2e-4]
    np.testing.assert_allclose(found.physical[[index.COULOMB, index.LOAD]], expected)
    told = {load} & {"load_walk"} if again else loads if load_sd < 0.1 and not steady else {load} & loads
    assert set(found.terms) & loads == (told - {"load_constant"} if steady else told)
    assert found.one_way is again
    assert ("offset_speed" in found.terms) is not steady
    assert bool(found.physical[index.WALK] > 0.0) is ("load_walk" in found.terms)


def test_a_lesson_needs_four_windows_and_chooses_some_of_many(monkeypatch: pytest.MonkeyPatch) -> None:
    lesson = Lesson(monkeypatch)
    with pytest.raises(UnusableError, match=r"3 windows of 0\.5 s; at least 4 are needed"):
        learn_windows([recording(1999)], 0.5)
    assert learn_windows([recording(1000), recording(1000)], 0.5)[0].pieces == 4
    assert taught([recording(500), recording(1500, dt_s=1.004e-3)], 0.5).dt_s == pytest.approx(1e-3)
    for n in (10_000, 10_500, 30_000):
        learn_windows([recording(n)], 0.5)
    assert lesson.joint[-3:] == [10_000, 5500, 10_000]  # all; every second window; every third
    assert taught([recording(4500), recording(4500)]).window_s == pytest.approx(0.45)  # a twentieth of all


def test_logs_whose_holes_hide_the_steps_of_the_voltage_teach_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Lesson(monkeypatch, seen=0.21)
    assert learn_windows([recording(3100)], 0.5)[0].pieces == 6
    Lesson(monkeypatch, seen=0.19)
    with pytest.raises(UnusableError, match="samples are missing at the voltage's steps"):
        learn_windows([recording(3100)], 0.5)


@pytest.mark.parametrize(
    ("lengths", "dt_s", "least_s", "window_s"),
    [
        ((20_000, 10_000), 1e-3, 0.0, 1.5),  # a twentieth of both
        ((3000, 4000), 1e-3, 0.0, 0.4),  # 400 samples at least
        ((90_000, 91_000), 1e-3, 0.0, 6.0),  # 6,000 at most
        ((350, 4000), 1e-3, 0.0, 0.35),  # no longer than the shortest
        ((2000, 18_000), 5e-3, 0.0, 5.0),
        ((90_000,), 1e-3, 8.0, 8.0),  # as long as is asked for
        ((20_000,), 1e-3, 40.0, 20.0),  # but no longer than there is
    ],
)
def test_the_length_of_a_window(
    lengths: tuple[int, ...], dt_s: float, least_s: float, window_s: float
) -> None:
    logs = [recording(n, dt_s=dt_s) for n in lengths]
    assert window_baseline.window_length_s(logs, 20, least_s) == pytest.approx(window_s)
