"""The judgement of windows and of looks part by part: rates, borders, spreads, what is chosen, what is said."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from judged_by_hand import spread
from scipy import integrate, optimize, stats

from motor_env import Diagnosis, FaultKind, InputError, Motor, Recording, Verdict, diagnose
from motor_env.cli import main
from motor_env.diagnosis import file_verdicts
from motor_env.diagnosis.commission import Commissioned, commission
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
    condition_distance,
    condition_features,
    judge_of,
    rms_volts,
    viscous,
    windows_of,
    with_drag_over_speed,
)
from motor_env.diagnosis.readers.recording import UnusableError
from motor_env.diagnosis.readers.regime import RegimeDecision
from motor_env.diagnosis.readers.start import Circuit
from motor_env.diagnosis.verdict import hypotheses, report_text
from motor_env.diagnosis.verdict.decision import decide
from motor_env.diagnosis.verdict.healthy_motor import Reference, motor_of_windows
from motor_env.diagnosis.verdict.healthy_spread import learn_without, predictive_t
from motor_env.diagnosis.verdict.hypotheses import (
    EXPONENTS,
    NAMES,
    Change,
    FittedWindow,
    covariance_at_one_temperature,
    joint_share,
)
from motor_env.diagnosis.verdict.judgement import Judgement
from motor_env.diagnosis.verdict.sensor_diagnosis import physical_values
from motor_env.motor.healthy import Healthy, Starts, Windows
from motor_env.motor.identifiable import matrix, visible_direction, warmth_direction
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
    assert len(pairs.time_s) == 12_000
    assert (pairs.current_a[0], pairs.time_s[0], pairs.dt_s) == pytest.approx((0.5, 5e-5, 2e-4))
    assert averaged(long, 1.21).current_a[0] == 1.0
    assert rms_volts(recording(400, 3.0)) == pytest.approx(3.0)
    with pytest.raises(UnusableError, match="only if voltage, current and speed"):
        rms_volts(replace(long, speed_rad_s=None))


def test_the_spread_of_a_window_by_hand() -> None:
    """What windows have taught, or a fit's own error where it is larger; and by how much windows scatter less."""
    error = np.diag([9e-4, 0.5e-4, 9e-4, 20e-4])
    expected = 0.7 * np.diag([9e-4, 1e-4, 9e-4, 20e-4])
    found = covariance_at_one_temperature(FittedWindow(np.zeros(4), error), JUDGE.reference)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_the_drag_of_a_window_is_told_over_the_speed() -> None:
    """Viscous friction, dry friction over the speed, and the square law times it; none at all stays a number."""
    assert viscous(PHYSICAL, 200.0) == pytest.approx(2e-6 + 1.5e-6 + 2e-6)
    assert viscous(PHYSICAL, 50.0) == pytest.approx(2e-6 + 6e-6 + 0.5e-6)
    assert viscous(np.zeros(index.N_VALUES), 200.0) == 1e-300
    window = WindowFit(np.log([2.0, 0.03, 4e-6, 1.5]), spread(4), PHYSICAL, WHITE, 0.0)
    fit = with_drag_over_speed(window, PHYSICAL, 200.0)
    np.testing.assert_allclose(np.exp(fit.log_values), [2.0, 0.03, 4e-6, 1.5 * 5.5e-6])
    assert fit.log_covariance is fit.white_covariance
    np.testing.assert_allclose(fit.log_covariance, spread(4))
    assert fit.quantity_names == ("R", "K", "J", "B")
    np.testing.assert_allclose(fit.exponents, matrix(("R", "K", "J", "B")))


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
    given.append(physical_values(motor_of_windows(HEALTHY, "m")))
    for physical in given:
        assert physical[[index.R, index.K, index.J]] == pytest.approx([2.0, 0.03, 4e-6])
        assert physical[[index.L, index.B, index.COULOMB]] == pytest.approx([1e-3, 2e-6, 3e-4])
    assert given[0][index.DRAG] == pytest.approx(DRAG)


def test_the_temperature_of_healthy_logs_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("motor_env.diagnosis.commission.learn_windows", lambda *_, **__: (HEALTHY, []))
    monkeypatch.setattr("motor_env.diagnosis.commission.detectable_changes", lambda *_: ({}, {}))
    for celsius in (None, 21.0):
        found = commission([recording(2000)], window_s=0.5, temperature_c=celsius)
        assert found.healthy.temperature_c == celsius


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Instead of fits: a window is off by nearly nothing; and its rates are noted."""
    rates: list[float] = []

    def deciding(fit: FittedWindow, reference: Reference, rate: float, *, alarm: bool | None) -> Judgement:
        assert alarm is None  # each window by itself
        rates.append(rate)
        return decide(fit, reference, rate)

    def fitting(record: Record, known: FloatArray, terms: Sequence[str], *, one_way: bool) -> WindowFit:
        assert one_way is WINDOWS.one_way
        assert (record.hold, terms, known[index.DRAG]) == ("late", WINDOWS.terms, pytest.approx(DRAG))
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
    half = stats.t.isf(0.025, 15.0)
    for change, variance in zip(found[0].changes, [4e-4, 1e-4, 9e-4, 16e-4], strict=True):
        width = half * math.sqrt(0.7 * variance)
        assert (change.ratio, change.low, change.high) == pytest.approx(
            np.exp([0.01, 0.01 - width, 0.01 + width])
        )


def test_a_window_that_cannot_be_fitted_is_unusable(monkeypatch: pytest.MonkeyPatch) -> None:
    def fitting(*_: object, **__: object) -> WindowFit:
        raise UnusableError("at rest")

    monkeypatch.setattr(windows, "fit_window", fitting)
    found, _ = JUDGE.judge(recording(1000), 0.03)
    assert [(one.verdict, one.reasons, one.begin_s) for one in found] == [
        ("unusable", ("at rest",), 0.0),
        ("unusable", ("at rest",), 0.5),
    ]


def test_of_many_windows_some_are_judged_and_the_rate_is_still_shared_by_all(
    fits: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = {7, 20, 33}

    def predict(self: Record, values: FloatArray) -> tuple[FloatArray, float]:
        assert (self.hold, values[index.R], values[index.KNEE]) == ("late", pytest.approx(2.0), 0.0)
        out = np.zeros((len(self.voltage_v), 6))
        window = (self.readings[:, 0] // 500.0).astype(int)
        out[:, 0] = np.where(np.isin(window, list(odd)), 5.0, 1.0 + 1e-3 * window)
        return out, 0.0

    monkeypatch.setattr(Record, "predict", predict)
    monkeypatch.setattr(WindowJudge, "failed_sensor", lambda *_: None)
    few, _ = JUDGE.judge(recording(40 * 500), 0.03)
    assert len(few) == 40
    many, count = JUDGE.judge(recording(41 * 500), 0.03)
    begins = {round(one.begin_s / 0.5) for one in many}
    evenly = set(np.linspace(0, 40, 10).round().astype(int).tolist())
    worst = odd | set(range(34, 41))
    assert begins == evenly | worst
    assert [one.begin_s for one in many] == sorted(one.begin_s for one in many)
    assert (fits[-1], count) == pytest.approx((0.03 / 41.0, 41))


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"volts": 2.99}, "outside the commissioned regime: 2.99 V effective, commissioned 6 to 8 V"),
        ({"volts": 3.01}, ""),
        ({"volts": 15.99}, ""),
        ({"volts": 16.01}, "outside the commissioned regime"),
        ({"dt_s": 1.09e-3}, ""),
        ({"dt_s": 1.11e-3}, "another sampling interval, 0.00111 s where it was 0.001 s"),
        ({"dt_s": 0.92e-3}, ""),
        ({"dt_s": 0.90e-3}, "another sampling interval"),
        ({"dt_s": 0.5}, "another sampling interval"),  # a window is one sample, or none
        ({"dt_s": 2.0}, "another sampling interval"),
        ({"n": 499}, "shorter than a window of 0.5 s"),
    ],
)
def test_a_record_is_judged_near_the_commissioned_regime(
    changed: dict[str, Any], reason: str, fits: list[float]
) -> None:
    given = recording(**({"n": 2000} | changed))
    if reason:
        with pytest.raises(UnusableError, match=reason):
            JUDGE.judge(given, 0.01)
    else:
        assert JUDGE.judge(given, 0.01)[0]
        anywhere = replace(JUDGE, windows=replace(WINDOWS, rms_volts=None))
        assert anywhere.judge(recording(500, volts=70.0), 0.01)[0]  # no regime was commissioned


def decided(
    ratios: FloatArray, covariance: FloatArray, rate: float, freedom: float, temperature_k: float = 0.0
) -> Judgement:
    """On a window that is off so far; its own error and the spread of healthy ones are alike."""
    reference = Reference(
        "it", NAMES, np.zeros(4), covariance, freedom, includes_fit_error=True, temperature_k=temperature_k
    )
    return decide(FittedWindow(ratios, covariance), reference, rate)


def limit_of(covariance: FloatArray, freedom: float, rate: float) -> float:
    """Standard deviations beyond which a fault alarms."""
    return float(stats.t.isf(joint_share(rate, covariance, EXPONENTS, freedom), freedom))


def off_by(kind: str, size: float, covariance: FloatArray, freedom: float, rate: float) -> FloatArray:
    """So many times the limit of the tests of a window along a fault."""
    g = visible_direction(FaultKind(kind), EXPONENTS)
    sd = (g @ np.linalg.inv(covariance) @ g) ** -0.5
    return np.asarray(size * limit_of(covariance, freedom, rate) * sd * g)


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("bearing", "bearing"),
        ("winding_contact", "winding"),
        ("magnet", "magnet"),
        ("winding_short", "other"),
    ],
)
def test_a_window_alarms_from_its_joint_limit_on(kind: str, named: str) -> None:
    covariance, freedom, rate = spread(4), 30.0, 0.02
    for size, verdict in ((0.998, "healthy"), (1.002, named)):
        off = off_by(kind, size, covariance, freedom, rate)
        found = decided(off, covariance, rate, freedom)
        assert (found.verdict, found.fault_kind) == (
            verdict,
            None if verdict in ("healthy", "other") else kind,
        )
    limit = limit_of(covariance, freedom, rate)
    for change, ratio, sd in zip(found.changes, off, np.sqrt(np.diag(covariance)), strict=True):
        assert change.significant is bool(abs(ratio) > limit * sd)


def test_shorted_turns_are_named_where_the_resistance_alone_shows_them() -> None:
    """Their K may be that of a weak magnet: R lies by 1.645 standard deviations off, and they beyond their limit."""
    covariance, freedom, rate = spread(4), 30.0, 0.02
    g = visible_direction(FaultKind("winding_short"), EXPONENTS)
    at = stats.norm.isf(0.05) * math.sqrt(covariance[0, 0]) / abs(g[0])
    assert at > abs(off_by("winding_short", 1.1, covariance, freedom, rate)[0])
    for size, verdict in ((0.998, "magnet"), (1.002, "winding")):
        assert decided(size * at * g, covariance, rate, freedom).verdict == verdict


@pytest.mark.parametrize(("rate", "left"), [(0.004, 0.004), (0.01, 0.01), (0.3, 0.01)])
def test_what_a_fault_leaves_unexplained_makes_it_something_else(rate: float, left: float) -> None:
    """The rest, squared, per dimension of the three that are left; however often healthy windows may alarm.

    Beside a fault of step 0.9 each parameter may move by 0.04 of its square.
    """
    covariance, freedom = np.diag([4e-4, 4e-4, 4e-4, 4e-4]), 30.0
    for size, verdict in ((0.995, "bearing"), (1.005, "other")):
        rest = size * math.sqrt(3.0 * stats.f.isf(left, 3, freedom)) * math.hypot(0.02, 0.04 * 0.9**2)
        off = np.array([0.0, 0.0, rest, 0.9])  # no fault moves the inertia
        assert decided(off, covariance, rate, freedom).verdict == verdict


def test_something_else_is_said_where_it_is_more_probable_than_the_fault() -> None:
    """Though the rest is not significant at so small a rate. Densities of Student's t, and the priors, by hand."""
    covariance, freedom, rate = np.eye(4) * 4e-4, 30, 1e-9
    beside = (4e-4 + (0.04 * 0.4**2) ** 2) * np.eye(4)
    faulty = stats.multivariate_t(np.zeros(4), beside, df=freedom)
    anything = stats.multivariate_t(np.zeros(4), covariance + 0.09 * np.eye(4), df=freedom)

    def more(rest: float) -> float:
        """By which factor something else is more probable; both have the same prior."""
        steps = np.linspace(0.0, 0.8, 20_001)
        points = np.array([0.0, 0.0, rest, 0.4]) - steps[:, None] * [0.0, 0.0, 0.0, 1.0]
        prior = stats.halfcauchy.pdf(steps, scale=0.3)
        return float(
            anything.pdf([0.0, 0.0, rest, 0.4]) / integrate.simpson(faulty.pdf(points) * prior, x=steps)
        )

    at = optimize.brentq(lambda rest: math.log(more(rest)), 0.02, 0.2)
    assert stats.f.sf(at**2 / beside[0, 0] / 3.0, 3, freedom) > 100.0 * rate
    for size, verdict in ((0.995, "bearing"), (1.005, "other")):
        assert decided(np.array([0.0, 0.0, size * at, 0.4]), covariance, rate, freedom).verdict == verdict


def test_the_whole_alarms_where_no_fault_does() -> None:
    covariance, freedom, rate = np.diag([4e-4, 4e-4, 4e-4, 4e-4]), 30.0, 0.02
    share = joint_share(rate, covariance, EXPONENTS, freedom)
    at = 0.02 * math.sqrt(4.0 * stats.f.isf(share, 4, freedom))
    for size, verdict in ((0.998, "healthy"), (1.002, "other")):
        assert decided(np.array([0.0, 0.0, size * at, 0.0]), covariance, rate, freedom).verdict == verdict


def test_a_quiet_window_decides_nothing_where_no_doubling_would_show() -> None:
    """Found in 95 of 100 cases is what lies by 1.645 standard deviations of its own error beyond the limit."""
    shape = np.diag([1.0, 0.01, 0.01, 1.0]) ** 2
    alone = math.log(2.0) / (limit_of(shape, 30.0, 0.02) + stats.norm.isf(0.05))
    for size, verdict in ((0.995, "healthy"), (1.005, "unusable")):
        assert decided(np.zeros(4), (size * alone) ** 2 * shape, 0.02, 30.0).verdict == verdict
    # Healthy windows that scatter more are no defect of one that tells enough; and an alarm is one in any case.
    wide = Reference("it", NAMES, np.zeros(4), (2.0 * alone) ** 2 * shape, 30.0, includes_fit_error=True)
    assert decide(FittedWindow(np.zeros(4), 1e-4 * shape), wide, 0.02).verdict == "healthy"
    far = np.array([0.0, 0.0, 0.0, 2.0])
    assert decided(far, (1.005 * alone) ** 2 * shape, 0.02, 30.0).verdict == "bearing"


@pytest.mark.parametrize(
    ("off", "verdict"),
    [
        ((0.0, 0.0, 0.0, 0.0), "healthy"),
        ((0.0, 0.0, 0.0, 0.4), "bearing"),
        ((0.3, 0.3, 0.3, 0.3), "sensor"),  # of the voltage: it is in all of them
        ((0.3, 0.3, 0.0, 0.0), "other"),
    ],
)
def test_a_window_is_judged_by_what_moved_in_it(off: tuple[float, ...], verdict: str) -> None:
    reference = replace(JUDGE.reference, temperature_k=15.0, warmer_k=3.0, own_friction=0.8)
    window = FittedWindow(JUDGE.reference.log_values + off, spread(4) * 0.5)
    (view,) = hypotheses.form_hypotheses(window, reference, 0.01)
    # No load falls with the temperature.
    np.testing.assert_allclose(view.load.warmth, [0.00393, -0.001, 0.0, -0.003 * 0.8])
    assert decide(window, reference, 0.01).verdict == verdict


def test_warmth_widens_what_is_healthy() -> None:
    """Along the direction of warmth 15 K are one standard deviation; R by 0.393 % a kelvin."""
    covariance = np.diag([1e-3, 1e-3, 1.0, 1e-3]) ** 2
    np.testing.assert_allclose(WARMTH, [0.00393, -0.001, 0.0, -0.003])
    ratios = np.log1p(20.0 * WARMTH)
    assert decided(ratios, covariance, 0.01, 1e3).verdict.is_fault
    assert decided(ratios, covariance, 0.01, 1e3, 15.0).verdict == "healthy"
    assert decided(ratios, covariance, 0.01, 1e3, 2.0).verdict.is_fault
    # A colder motor with more resistance would have that K; but its R is that of the healthy one.
    off, wider = np.array([0.0, 0.04, 0.0, 0.0]), np.diag([0.01, 0.01, 0.01, 0.05]) ** 2 / 2.0
    assert decided(off, wider, 0.01, 30.0, 15.0).verdict == "other"
    np.testing.assert_array_equal(hypotheses._linearise_warming(ratios, spread(4), WARMTH, 0.0), ratios)
    # At most 100 K are taken for warmth when logarithms are straightened.
    tight = np.diag([1e-5, 1e-5, 1.0, 1e-5]) ** 2
    for kelvin in (99.0, 101.0, 130.0):
        found = hypotheses._linearise_warming(np.log1p(kelvin * WARMTH), tight, WARMTH, 1e3)
        slope = np.linalg.solve(tight, WARMTH)
        least = slope @ np.log1p(kelvin * WARMTH) / (slope @ WARMTH + 1e-6)
        kept = min(float(least), 100.0) * WARMTH
        np.testing.assert_allclose(found, np.log1p(kelvin * WARMTH) + kept - np.log1p(kept), rtol=1e-9)
    # And no quantity is taken for less than half: a load may answer to warmth by more than 1 % a kelvin.
    steep = np.array([0.004, -0.012, 0.0, -0.003])
    found = hypotheses._linearise_warming(99.0 * steep, tight, steep, 1e3)
    assert found[1] == pytest.approx(-99.0 * 0.012 - 0.5 - math.log(0.5), rel=1e-6)


@pytest.mark.parametrize("warmer_k", [-20.0, 20.0])
def test_a_measured_temperature_is_taken_off_as_if_it_were_that_of_the_healthy_windows(
    warmer_k: float,
) -> None:
    """Changes and the severity included."""
    off = np.log([1.2, 1.0, 1.0, 1.0])
    reference = replace(JUDGE.reference, temperature_k=4.0, own_friction=1.0)
    fits_ = [FittedWindow(reference.log_values + off + k * WARMTH, 1e-6 * np.eye(4)) for k in (0.0, warmer_k)]
    as_warm = decide(fits_[0], reference, 0.01)
    found = decide(fits_[1], replace(reference, warmer_k=warmer_k), 0.01)
    assert (found.verdict, found.reasons) == (as_warm.verdict, as_warm.reasons)
    assert found.verdict == "winding"
    assert [one.ratio for one in found.changes] == pytest.approx([1.2, 1.0, 1.0, 1.0])
    assert found.severity == pytest.approx(as_warm.severity)


LOGS = np.random.default_rng(6).normal(0.0, 0.03, (6, 4))


class Lesson:
    """Instead of fits: windows with these logarithms, errors and noises."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        *,
        load_sd: float = 0.2,
        scatter: float = 1.0,
        visible_step_share: float = 1.0,
    ) -> None:
        self.visible_step_share = visible_step_share
        self.logs = scatter * LOGS
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
        record = SimpleNamespace(recorded=np.ones(2), hold="late", visible_step_share=self.visible_step_share)
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
        number = len(self.wanted)
        self.wanted.append(wanted)
        values = self.values.copy()
        values[index.WALK] = 0.1 if "load_walk" in wanted else known[index.WALK]
        values[index.NOISE_I] = [1.0, 2.0, 3.0, 4.0, 5.0, 9.0][number % 6]
        error = self.error.copy() if len(self.wanted) <= 6 else np.diag([1e-4, 1e-4, 1e-4, 1e-4])
        return WindowFit(self.logs[number % 6], error, values, WHITE, 0.0)


@pytest.mark.parametrize(("temperature_k", "times"), [(15.0, 1.0), (0.0, 0.0)])
def test_each_healthy_window_is_judged_by_the_others(temperature_k: float, times: float) -> None:
    """With the spread from record to record that is believed of them: a steady motor has none."""
    fits = [FittedWindow(row, 1e-4 * np.eye(4)) for row in LOGS]
    found = learn_without(replace(HEALTHY, temperature_k=temperature_k), fits, 2)
    centre, covariance, freedom = predictive_t(np.delete(LOGS, 2, axis=0), 1e-4 * np.eye(4))
    np.testing.assert_allclose(np.log(found.values), centre)
    record = np.diag([1e-4, 0.25e-4, 1e-4, 25e-4])
    np.testing.assert_allclose(found.log_covariance, covariance + times * record)
    assert (found.pieces, found.degrees_of_freedom) == (5, freedom)


@pytest.mark.parametrize("steady", [False, True])
def test_windows_teach_the_next_one(steady: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    Lesson(monkeypatch)
    found, learned = learn_windows([recording(3100)], 0.5, steady=steady)
    assert found.windows is not None
    # The drag over the effective speed: the factor times 2e-6 + 3e-4 / 100.
    logs = LOGS + np.log([1.0, 1.0, 1.0, 5e-6])
    np.testing.assert_allclose([fit.log_values for fit in learned], logs)
    centre, error = logs.mean(axis=0), np.eye(4) * 1e-4
    record = (0.0 if steady else 1.0) * np.diag([1e-4, 0.25e-4, 1e-4, 25e-4])
    scatter = (logs - centre).T @ (logs - centre)
    covariance = (scatter + 4.0 * error) / 9.0 * 7.0 / 6.0 + record
    np.testing.assert_allclose(found.values, np.exp(centre))
    np.testing.assert_allclose(found.log_covariance, covariance)
    taught = found.windows
    assert (found.pieces, taught.window_s, found.degrees_of_freedom, taught.dt_s) == pytest.approx(
        (6, 0.5, 9.0, 1e-3)
    )
    assert (found.quantities, taught.hold) == (NAMES, "late")
    assert taught.speed_rad_s == pytest.approx(100.0)
    assert found.temperature_k == (0.0 if steady else 15.0)
    assert taught.terms == (("R", "K") if steady else ("R", "K", "offset_speed"))
    assert taught.rms_volts == pytest.approx((7.0, 7.0))
    assert taught.peaks is not None
    volts = np.quantile(np.abs(recording(500).voltage_v), 0.999)  # type: ignore[arg-type]  # it has a voltage
    amps = np.quantile(np.arange(2500.0, 3000.0), 0.999)
    assert taught.peaks == pytest.approx((volts, amps, 30.0 * amps))
    assert taught.physical[index.NOISE_I] == 3.5  # the median of the windows
    as_believed = replace(judge_of(found).reference, excess=1.0)
    believed = np.linalg.inv(covariance_at_one_temperature(learned[0], as_believed))
    squares = [
        sum(off @ inverse @ off for off in logs - centre) for inverse in (believed, np.linalg.inv(covariance))
    ]
    assert taught.window_excess == pytest.approx(squares[0] / squares[1])
    assert (
        taught.window_excess < 0.99
    ) is steady  # where there is no prior some errors are larger than the spread
    assert (taught.drives == ()) is steady
    for drive in taught.drives:  # one: the voltage is the same in all windows
        np.testing.assert_allclose(drive.values, found.values)
        np.testing.assert_allclose(drive.log_covariance, found.log_covariance)
        assert (drive.pieces, drive.degrees_of_freedom) == (tuple(range(6)), 9.0)
        levels, lags = np.linspace(0.05, 0.95, 10), np.array([62, 31, 15, 7, 3, 1, 1])
        amps = np.hstack(
            [500.0 * np.arange(6.0)[:, None] + 499.0 * levels, np.tile(lags.astype(float), (6, 1))]
        )
        np.testing.assert_allclose(drive.moved[:, 1:], np.stack([amps, 30.0 * amps], axis=1))
        sine = np.append(
            -7.0 * np.cos(math.pi * levels), 14.0 * np.sin(math.pi * lags / 100.0) / math.sqrt(2.0)
        )
        np.testing.assert_allclose(drive.moved[:, 0], np.tile(sine * math.sqrt(2.0), (6, 1)), atol=0.3)
    assert taught.calibration is not None
    assert taught.calibration.windows == 6


@pytest.mark.parametrize(
    ("place", "torque", "times"),
    [
        (index.NOISE_T, 0.0, 3.0),
        (index.NOISE_T, 0.99 * 5e-5, 3.0),
        (index.NOISE_T, 1.01 * 5e-5, 1.0),
        (index.WALK, 1e-9, 1.0),
    ],
)
@pytest.mark.parametrize("is_alike", [True, False])
def test_a_model_that_lacks_nothing_errs_under_far_drives_only(
    monkeypatch: pytest.MonkeyPatch, place: int, torque: float, times: float, is_alike: bool
) -> None:
    """Of 1e-3 N m of friction at the effective speed 5 % are another torque in each interval; or a load walks.

    Beyond 0.12 windows are driven alike that are as far apart as the healthy one is that is farthest from all others.
    """
    lesson, log, among = Lesson(monkeypatch), recording(3100), 0.12
    lesson.values[[index.B, index.COULOMB, place]] = 4e-6, 6e-4, torque
    if not is_alike:  # the voltage is the same in all windows otherwise
        log = replace(log, voltage_v=log.current_a)
        parts = [condition_features(part) for part in windows_of(log, 0.5)]
        among = max(
            min(condition_distance(one, other[None])[0] for other in parts if other is not one)
            for one in parts
        )
        assert among > 0.3
    healthy, _ = learn_windows([log], 0.5)
    assert healthy.windows is not None
    assert healthy.windows.alike == pytest.approx(among * times)


def test_a_healthy_motor_may_stay_off_as_from_record_to_record_and_by_its_warmth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drift = []
    for steady in (True, False):
        Lesson(monkeypatch)
        healthy, _ = learn_windows([recording(3100)], 0.5, steady=steady)
        assert healthy.windows is not None
        assert healthy.windows.calibration is not None
        drift.append(healthy.windows.calibration.drift_covariance)
    warmth = warmth_direction(matrix(NAMES))
    expected = np.diag([1e-4, 0.25e-4, 1e-4, 25e-4]) + 15.0**2 * np.outer(warmth, warmth)
    np.testing.assert_allclose(drift[1] - drift[0], expected, atol=1e-12)


def taught(recordings: Sequence[Recording], window_s: float | None = None) -> Windows:
    healthy, fits = learn_windows(recordings, window_s)
    assert healthy.windows is not None
    assert healthy.pieces == len(fits)
    return healthy.windows


def test_a_load_is_unknown_in_windows_that_tell_it_from_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    for sd, scatter, is_determined in (
        (0.0999, 0.0, True),
        (0.1001, 0.0, False),
        (0.05, 0.0999, True),
        (0.05, 0.1001, False),
    ):
        lesson = Lesson(monkeypatch, load_sd=sd)
        drag = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
        lesson.logs = np.column_stack([lesson.logs[:, :3], lesson.logs[:, 3].mean() + scatter * drag])
        found = taught([recording(3000)], 0.5)
        assert ("load_walk" in found.terms) is is_determined
        assert (
            bool(found.physical[index.WALK] > 0.0) is is_determined
        )  # none, or a constant load would be unknown
        assert lesson.wanted[0] == ("R", "K", "offset_speed", "load_constant", "load_walk")


@pytest.mark.parametrize(
    ("load_sd", "back", "again"),
    [
        (0.05, 5.0, False),  # it is told
        (0.05, 4.0, True),  # the motor turns one way, and it only seems to be told
        (0.2, 4.0, True),
        (0.2, 5.0, False),  # it turns back for more than a twentieth of its turns
    ],
)
@pytest.mark.parametrize("load", ["load_constant", "load_walk", "gear_loss"])
@pytest.mark.parametrize("steady", [False, True])
def test_a_load_that_nothing_tells_from_friction_is_a_part_of_it(
    monkeypatch: pytest.MonkeyPatch,
    load_sd: float,
    back: float,
    again: bool,
    load: str,
    steady: bool,
) -> None:
    """The joint fit is made again where it had a load, and one that walks stays. On a test bench no constant one is."""
    lesson = Lesson(monkeypatch, load_sd=load_sd)
    lesson.names, lesson.speeds = ("R", load, "K", "offset_speed"), (90.0, -back)
    lesson.values[[index.COULOMB, index.LOAD, index.WALK]] = 3e-4, 2e-4, 9.0
    found = learn_windows([recording(3100)], 0.5, steady=steady)[0].windows
    assert found is not None
    had_load = load != "gear_loss"
    assert lesson.again == ([45.0 - 0.5 * back] if again and had_load else [])  # the mean speed
    np.testing.assert_allclose(
        found.physical[[index.COULOMB, index.LOAD]], [7e-4, 0.0] if again and had_load else [3e-4, 2e-4]
    )
    loads = {"load_constant", "load_walk"}
    expected = {load} & loads if steady or load_sd > 0.1 else loads
    if again:
        expected = {load} & {"load_walk"}
    assert found.one_way is again
    assert set(found.terms) & loads == (expected - {"load_constant"} if steady else expected)
    assert ("offset_speed" in found.terms) is not steady
    assert bool(found.physical[index.WALK] > 0.0) is ("load_walk" in found.terms)


def test_a_lesson_needs_four_windows_and_chooses_some_of_many(monkeypatch: pytest.MonkeyPatch) -> None:
    lesson = Lesson(monkeypatch)
    with pytest.raises(UnusableError, match=r"3 windows of 0\.5 s; at least 4 are needed"):
        learn_windows([recording(1999)], 0.5)
    assert learn_windows([recording(1000), recording(1000)], 0.5)[0].pieces == 4
    assert taught([recording(500), recording(1500, dt_s=1.004e-3)], 0.5).dt_s == pytest.approx(1e-3)
    lesson.joint.pop()
    learn_windows([recording(10_000)], 0.5)
    learn_windows([recording(10_500)], 0.5)
    learn_windows([recording(30_000)], 0.5)
    assert lesson.joint == [2000, 10_000, 5500, 10_000]  # all; all; every second window; every third


def test_logs_whose_holes_hide_the_steps_of_the_voltage_teach_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Lesson(monkeypatch, visible_step_share=0.21)
    assert learn_windows([recording(3100)], 0.5)[0].pieces == 6
    Lesson(monkeypatch, visible_step_share=0.19)
    with pytest.raises(UnusableError, match="samples are missing at the voltage's steps: the inductance is"):
        learn_windows([recording(3100)], 0.5)


@pytest.mark.parametrize(
    ("lengths", "dt_s", "least_s", "window_s"),
    [
        ((20_000, 10_000), 1e-3, 0.0, 1.5),  # a twentieth of both
        ((3000, 4000), 1e-3, 0.0, 0.4),  # 400 samples at least
        ((90_000, 91_000), 1e-3, 0.0, 6.0),  # 6,000 at most
        ((19_000, 1000), 1e-3, 0.0, 1.0),  # no longer than the shortest
        ((350, 4000), 1e-3, 0.0, 0.35),
        ((2000, 18_000), 5e-3, 0.0, 5.0),
        ((20_000,), 1e-3, 2.8, 2.8),  # as long as is asked for
        ((90_000,), 1e-3, 8.0, 8.0),
        ((20_000,), 1e-3, 40.0, 20.0),  # but no longer than there is
    ],
)
def test_the_length_of_a_window_by_hand(
    lengths: tuple[int, ...], dt_s: float, least_s: float, window_s: float
) -> None:
    logs = [recording(n, dt_s=dt_s) for n in lengths]
    assert window_baseline.window_length_s(logs, 20, least_s) == pytest.approx(window_s)


def test_a_window_is_a_twentieth_of_all_logs_unless_given(monkeypatch: pytest.MonkeyPatch) -> None:
    Lesson(monkeypatch)
    assert taught([recording(4500), recording(4500)]).window_s == pytest.approx(0.45)


CHANGES = tuple(
    Change(name, ratio, ratio - 0.1, ratio + 0.1, "healthy")
    for name, ratio in zip(NAMES, (1.25, 0.98, 1.0, 1.333), strict=True)
)


def pieces(*said: str) -> tuple[Judgement, ...]:
    """Windows that say so."""
    return tuple(
        Judgement(Verdict(one), (f"it is {one}",), changes=CHANGES, begin_s=0.5 * n, duration_s=0.5)
        for n, one in enumerate(said)
    )


def record(*said: str, of: int | None = None) -> Diagnosis:
    taken = RegimeDecision("operation", "reversed")
    return Diagnosis(recording(500), taken, pieces(*said), len(said) if of is None else of)


def test_text_and_json_of_a_record_say_the_same() -> None:
    found = record("healthy", "bearing", of=7)
    assert report_text.as_text(found).splitlines() == [
        "log: bearing; 1 of 2 windows judged, of 7",
        "  it is bearing.",
        "  taken for a motor at work (reversed)",
        "  from 0 s: healthy; R +25.0%, K -2.0%, J +0.0%, B +33.3%",
        "  from 0.5 s: bearing; R +25.0%, K -2.0%, J +0.0%, B +33.3% <",
    ]
    told = report_text.as_json(found)
    assert told["taken_for"] == {"regime": "operation", "why": "reversed"}
    assert [(one["verdict"], one["begin_s"], one["duration_s"]) for one in told["pieces"]] == [
        ("healthy", 0.0, 0.5),
        ("bearing", 0.5, 0.5),
    ]
    whole = report_text.as_text(record("bearing", "bearing", "healthy"))
    assert whole.startswith("log: bearing; 2 of 3 windows\n")
    torn = Judgement(Verdict.UNUSABLE, ("torn", "worn"), begin_s=1.0)
    assert "  from 1 s: unusable; torn; worn" in report_text.as_text(
        replace(found, pieces=(*found.pieces, torn))
    )
    one = replace(found, taken=RegimeDecision("start", "it rises"), pieces=(torn,), of=1)
    lines = ["log: unusable", "  torn.", "  worn.", "  taken for a start (it rises)"]
    assert report_text.as_text(one).splitlines() == lines


def test_a_log_has_no_reference_without_a_motor() -> None:
    found = diagnose(recording(500), regime="operation")
    assert (found.verdict, found.of) == ("no_reference", 1)
    assert found.decisive.duration_s == pytest.approx(0.5)


def test_words_of_a_commissioning_by_windows() -> None:
    """The interval of the next healthy window at the rate, on both sides together."""
    warm = motor_of_windows(replace(HEALTHY, temperature_k=15.0), "m")
    fit = FittedWindow(np.log(HEALTHY.values), HEALTHY.log_covariance)
    result = Commissioned(warm, (fit,) * 12, {"bearing": 0.123, "magnet": 0.05}, {"J": 2})
    head, *rows = replace(result, false_alarm_rate=0.05).text().splitlines()
    assert head == (
        "12 healthy windows of 0.5 s; prediction interval of the next healthy window (95%, Student t, 15 degrees)"
    )
    assert rows[3].split() == ["B", "6.6e-06", "N", "m", "s/rad", "-8.2%", "to", "+8.9%"]
    assert rows[4] == (
        "  smallest change that is found in 95 of 100 cases: bearing 12.3%, magnet 5.0%"
        " (bearing: of the whole drag, any load included)"
    )
    assert rows[5] == "  J is left undecided by 2 of these 12 windows: a doubling would not show"
    assert rows[6].startswith("  a motor that is warmer or colder by 15 K (1 sd) is healthy too: R +0.39 %")
    assert rows[7] == "  few windows give wide intervals, more windows narrow them"
    cold = replace(result, motor=motor_of_windows(HEALTHY, "m"), undecided={})
    assert len(replace(cold, false_alarm_rate=0.05).text().splitlines()) == len(rows) + 1 - 2


def log_file(folder: Path) -> Path:
    one = recording(2750)
    rows = np.stack([one.time_s, cast("FloatArray", one.voltage_v), one.current_a % 7.0 + 0.5], axis=1)
    path = folder / "log.csv"
    np.savetxt(path, rows, delimiter=",", header="time_s,voltage_v,current_a", comments="", fmt="%.6f")
    return path


def test_the_command_counts_all_windows_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[float] = []

    def judge(_: WindowJudge, __: Recording, rate: float) -> tuple[list[Judgement], int]:
        given.append(rate)
        return list(pieces("healthy", "bearing")), 5

    def known(_: str) -> Motor:
        return motor_of_windows(HEALTHY, "m")

    monkeypatch.setattr(WindowJudge, "judge", judge)
    monkeypatch.setattr(file_verdicts, "load_motor", known)
    log = str(log_file(tmp_path))
    assert main(["diagnose", log, "--motor", "m.toml", "--json", "--false-alarm-rate", "0.2"]) == 1
    (told,) = json.loads(capsys.readouterr().out)
    assert (told["verdict"], told["pieces_of_recording"], given) == ("bearing", 5, [0.2])
    assert told["taken_for"]["regime"] == "operation"


@pytest.mark.parametrize(
    ("option", "given"),
    [
        ("start", {"start": 1}),
        ("torque-constant", {"constant": 0.03}),
        ("no-load-current", {"no_load_current_a": 0.1}),
        ("sensor-lag", {"circuit": Circuit(sensor_lag_s=1e-4)}),
    ],
)
def test_logs_refuse_what_belongs_to_starts(option: str, given: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"--{option} belongs to starts"):
        commission([log_file(tmp_path)], "m", window_s=0.5, **given)


@pytest.mark.parametrize("given", [{"steady": True}, {"window_s": 0.5}])
def test_starts_refuse_what_belongs_to_logs(given: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--steady and --window belong to logs"):
        commission([log_file(tmp_path)], "m", regime="start", **given)
