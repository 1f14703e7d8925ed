"""The sequential monitor: calibrated scores of windows, an e-detector over them, and its rate of false alarms."""

import itertools
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from motor_env import InputError, Recording
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.operation import sequential_monitor
from motor_env.diagnosis.operation.sequential_monitor import (
    EFFECT_SIZES,
    YEAR_S,
    SequentialMonitor,
    checked_calibration,
    fault_directions,
    is_alarm,
    learn_calibration,
    normal_scores,
    updated_sums,
)
from motor_env.diagnosis.operation.windows import WindowJudge, condition_features, judge_of

# Reaches in: windows are fits made by hand.
from motor_env.diagnosis.verdict.hypotheses import NAMES, FittedWindow
from motor_env.diagnosis.verdict.judgement import Judgement, Verdict
from motor_env.motor.healthy import Healthy, OperatingCondition, ScoreCalibration, Windows
from motor_env.motor.parameters import FloatArray

WINDOW_S, ERROR = 600.0, np.diag([0.002, 0.002, 0.005, 0.01]) ** 2
HOUR = YEAR_S / 3600.0
UP_IN_R = int(np.flatnonzero((fault_directions()[0] == [1.0, 0.0, 0.0, 0.0]).all(axis=1))[0])
Random = np.random.Generator


def run_lengths(rng: Random, windows: float, runs: int, sd: float = 1.0) -> FloatArray:
    """Windows until an alarm, of correlated normal scores in five directions."""
    found = []
    root = np.linalg.cholesky(0.5 * np.eye(5) + 0.5)
    for _ in range(runs):
        sums, count, weights = np.zeros((5, 2)), 0, np.array([4.0, 4.0, 1.0, 1.0, 1.0]) / 11.0
        while not is_alarm(sums, weights, windows):
            count += 1
            sums = updated_sums(sums, sd * root @ rng.standard_normal(5))
        found.append(count)
    return np.array(found, dtype=np.float64)


def test_false_alarms_are_as_far_apart_as_was_asked() -> None:
    """The mean is no less, by three standard errors; and not more than three times as much."""
    rng = np.random.default_rng(1)
    for windows in (6.0, 40.0, 160.0):
        lengths = run_lengths(rng, windows, 150)
        error = lengths.std() / math.sqrt(len(lengths))
        assert windows - 3.0 * error < lengths.mean() < 2.0 * windows
    assert run_lengths(rng, 160.0, 60, sd=1.5).mean() < 0.6 * 160.0  # scores that are no normal ones


def test_a_shift_is_found_in_its_direction() -> None:
    """Of two standard deviations, at one false alarm in a million: in about seven windows."""
    rng, counts, shares = np.random.default_rng(2), [], []
    for _ in range(40):
        sums, count = np.zeros((4, 2)), 0
        for _ in range(50):
            sums = updated_sums(sums, rng.standard_normal(4))
        while not is_alarm(sums, np.full(4, 0.25), 1e6):
            count += 1
            sums = updated_sums(sums, rng.standard_normal(4) + np.array([0.0, 2.0, 0.0, 0.0]))
        counts.append(count)
        shares.append(sums[1].sum() / sums.sum())
    assert 5.0 <= np.median(counts) <= 11.0
    assert np.median(shares) > 0.9


def test_a_sum_is_that_of_shiryaev_and_roberts() -> None:
    """By hand: the sum over begins of the products of e-values since; and it stays finite."""
    sums, scores = np.zeros((1, 2)), [0.3, -1.0, 2.0]
    for score in scores:
        sums = updated_sums(sums, np.array([score]))
    e_values = [np.exp(EFFECT_SIZES * score - 0.5 * EFFECT_SIZES**2) for score in scores]
    np.testing.assert_allclose(sums[0], sum(np.prod(e_values[k:], axis=0) for k in range(3)))
    for _ in range(300):
        sums = updated_sums(sums, np.array([math.inf]))
    np.testing.assert_array_equal(sums, 1e100)


def windows_of(
    rng: Random, count: int, level: FloatArray, scale: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Logarithms that scatter more than their errors say, by a factor on the standard deviation; and the errors."""
    logs = level + scale * rng.multivariate_normal(np.zeros(4), ERROR, count)
    return logs, np.tile(ERROR, (count, 1, 1))


def learned(rng: Random, count: int = 30, scale: float = 1.0, kelvin: float = 0.0) -> ScoreCalibration:
    prior = np.full(4, 0.01 * (kelvin > 0.0))
    return learn_calibration(*windows_of(rng, count, np.zeros(4), scale), prior, temperature_k=kelvin)


def scored(of: ScoreCalibration, logs: FloatArray, windows: float = 1e3) -> FloatArray:
    """Normal scores of several windows, at one false alarm in so many."""
    return np.array([normal_scores(of, each, ERROR, fault_directions()[0], windows) for each in logs])


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_scores_of_healthy_windows_are_normal_or_less_whatever_the_fit_believes(scale: float) -> None:
    """As e-values their mean is 1 at most, over commissionings; along a fault they are as large as it."""
    e_values, ups = [], []
    for seed in range(16):
        rng = np.random.default_rng([3, seed])
        of = learned(rng, scale=scale)
        scores = scored(of, windows_of(rng, 300, np.zeros(4), scale)[0])
        e_values.append([np.exp(lean * scores - 0.5 * lean**2).mean(axis=0) for lean in (0.7, 1.5)])
        off = scale * np.sqrt(np.diag(ERROR)) * [3.0, 0.0, 0.0, 0.0]
        ups.append(scored(of, windows_of(rng, 100, off, scale)[0])[:, UP_IN_R].mean())
    assert (np.mean(e_values, axis=0) > 0.4).all()
    assert (np.mean(e_values, axis=0) < 1.1).all()
    assert np.mean(ups) > 1.8


def test_the_covariance_is_that_of_what_is_whitened() -> None:
    """Of 400 windows that scatter three times as much as they believe; and the drift is the mean's error."""
    of = learned(np.random.default_rng(4), 400, 3.0)
    assert np.diag(of.covariance) == pytest.approx([9.0] * 4, rel=0.2)
    assert np.diag(of.drift_covariance) == pytest.approx(9.0 * np.diag(ERROR) / 400.0, rel=0.2)
    assert of.degrees_of_freedom > 15.0


def test_heavy_tails_are_fitted() -> None:
    """A distance says less where healthy windows have tails of a t with three degrees."""
    rng = np.random.default_rng(5)
    logs, errors = windows_of(rng, 60, np.zeros(4))
    heavy = learn_calibration(logs * rng.standard_t(3.0, (60, 1)), errors, np.zeros(4), temperature_k=0.0)
    assert heavy.degrees_of_freedom < 10.0
    far = np.full((1, 4), 0.03)
    assert scored(heavy, far).max() < 0.7 * scored(learned(rng, 60), far).max()


def test_a_healthy_motor_may_drift_by_what_is_believed() -> None:
    """Two per cent of R and 15 K are allowed where 1 % is; 15 % more of R are not."""
    rng = np.random.default_rng(6)
    of = learned(rng, 12, kelvin=15.0)
    warm = 15.0 * np.array([0.00393, -0.001, 0.0, -0.003])
    for off, least, most in (
        (np.array([0.02, 0.0, 0.0, 0.0]), -9.0, 0.0),
        (warm, -9.0, 0.0),
        (warm + np.array([0.15, 0.0, 0.0, 0.0]), 1.0, 9.0),
    ):
        scores = scored(of, windows_of(rng, 400, off)[0]).mean(axis=0)
        assert least < scores.max() < most


def test_the_allowed_drift_is_wider_for_rarer_alarms() -> None:
    """Up to one in 200 windows, by the t of the windows that have taught it."""
    of, far = learned(np.random.default_rng(7), 12, kelvin=15.0), np.array([[0.2, 0.0, 0.0, 0.0]])
    often, seldom, never = (scored(of, far, windows)[0, UP_IN_R] for windows in (10.0, 200.0, 1e9))
    assert often > seldom
    assert seldom == never


@pytest.mark.parametrize(("sd", "holds"), [(0.0, True), (12.0, False)])
def test_tails_hold_where_windows_judged_by_the_others_alarm_as_they_should(sd: float, holds: bool) -> None:
    """Of 30 normal windows one may not be twelve standard deviations off."""
    logs, errors = windows_of(np.random.default_rng(8), 30, np.zeros(4))
    logs[20, 0] += sd * 0.002
    assert checked_calibration(logs, errors, np.zeros(4), temperature_k=0.0).tails_hold is holds


@pytest.mark.parametrize(("alarms", "holds"), [(1, True), (2, False)])
def test_tails_are_held_against_poissons_distribution(
    alarms: int, holds: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each threshold by itself: of 12 windows two are no chance at one in 1,024, and one is up to there."""
    told = itertools.count()

    def alarm(_: FloatArray, __: FloatArray, threshold: float) -> bool:
        return threshold == 4.0**5 and next(told) < alarms

    monkeypatch.setattr(sequential_monitor, "is_alarm", alarm)
    logs, errors = windows_of(np.random.default_rng(8), 12, np.zeros(4))
    assert checked_calibration(logs, errors, np.zeros(4), temperature_k=0.0).tails_hold is holds


@cache
def commissioned(*, steady: bool, scatter: float = 1.0, seed: int = 8) -> Healthy:
    """Twelve windows of ten minutes."""
    rng = np.random.default_rng(seed)
    kelvin, prior = (0.0, np.zeros(4)) if steady else (15.0, np.full(4, 0.01))
    calibration = checked_calibration(*windows_of(rng, 12, np.zeros(4), scatter), prior, temperature_k=kelvin)
    windows = Windows(WINDOW_S, (), np.zeros(index.N_VALUES), "held", 1.0, 100.0, calibration=calibration)
    return Healthy(12, 15.0, NAMES, np.ones(4), scatter**2 * ERROR, temperature_k=kelvin, windows=windows)


def monitor(
    healthy: Healthy, per_year: float = HOUR, state: dict[str, list[float]] | None = None
) -> SequentialMonitor:
    return SequentialMonitor(judge_of(healthy), healthy, false_alarms_per_year=per_year, state=state)


def draw(rng: Random, level: FloatArray, scatter: float = 1.0) -> tuple[FloatArray, FloatArray]:
    return level + scatter * rng.multivariate_normal(np.zeros(4), ERROR), ERROR


@pytest.mark.parametrize("steady", [False, True])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
def test_a_drift_of_one_per_cent_an_hour_is_told(direction: list[float], steady: bool) -> None:
    """In R, K or friction, up to 25 %; before that 12 hours pass without a fault."""
    rng, watch = np.random.default_rng(9), monitor(commissioned(steady=steady), HOUR / 24.0)
    for _ in range(72):
        watch.update(*draw(rng, np.zeros(4)))
    assert not watch.alarm_active
    told = [watch.update(*draw(rng, math.log1p(0.01 * k / 6.0) * np.array(direction))) for k in range(150)]
    assert any(told)
    assert all(told[-6:])  # and it goes on being told


def test_an_alarm_goes_on_while_a_window_is_off_in_any_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = monitor(commissioned(steady=True))
    for highest, is_active in ((2.1, True), (1.9, False)):
        scores = np.append(np.full(8, -3.0), highest)
        monkeypatch.setattr(sequential_monitor, "normal_scores", lambda *_, row=scores: row)
        watch.alarm_active = True
        assert watch.update(np.zeros(4), ERROR) is is_active
        assert watch.alarm_active is is_active


def test_evidence_begins_anew_at_an_alarm() -> None:
    watch = monitor(commissioned(steady=True))
    assert watch.update(np.array([0.5, 0.0, 0.0, 0.0]), ERROR)
    assert not any(watch.state_dict["sums"])


def test_false_alarms_of_windows_are_no_more_than_was_asked() -> None:
    """Commissionings with windows that scatter three times as much as their errors say; one alarm in 10 windows."""
    alarms, runs, windows = 0, 8, 100
    for seed in range(runs):
        rng = np.random.default_rng([10, seed])
        watch = monitor(commissioned(steady=True, scatter=3.0, seed=100 + seed), HOUR * 0.6)
        told = [watch.update(*draw(rng, np.zeros(4), 3.0)) for _ in range(windows)]
        alarms += sum(now and not before for before, now in itertools.pairwise([False, *told]))
    assert 0 < alarms <= stats.poisson.ppf(0.99, runs * windows / 10.0)


def test_a_monitor_says_what_holds_of_its_rate() -> None:
    healthy = commissioned(steady=False)
    assert healthy.windows is not None
    assert healthy.windows.calibration is not None
    assert monitor(healthy, 1.0).describe_false_alarm_rate() == (
        "12 healthy windows of 600 s: one false alarm in 1 year if the fitted tails hold, as they do on these windows"
    )
    for per_year, words in (
        (3.0 * HOUR, "in 20 minutes if"),
        (HOUR / 48.0, "in 2 days if"),
        (HOUR, "1 hour if"),
    ):
        assert words in monitor(healthy, per_year).describe_false_alarm_rate()
    heavy = replace(healthy.windows.calibration, tails_hold=False)
    said = monitor(replace(healthy, windows=replace(healthy.windows, calibration=heavy)))
    assert said.describe_false_alarm_rate() == (
        "12 healthy windows of 600 s do not follow the fitted tails: one false alarm in 1 hour is not supported;"
        " 18 windows without a false alarm would support it"
    )
    untaught = replace(healthy, windows=replace(healthy.windows, calibration=None))
    assert "commission the motor anew" in monitor(untaught).describe_false_alarm_rate()


def test_a_motor_whose_windows_were_not_compared_is_watched_by_what_is_believed_of_it() -> None:
    """Its spread may all be drift: two standard deviations of it are no fault, and thirty are."""
    healthy = commissioned(steady=False)
    assert healthy.windows is not None
    untaught = replace(healthy, windows=replace(healthy.windows, calibration=None))
    for sd, is_fault in ((2.0, False), (30.0, True)):
        watch, off = monitor(untaught), np.array([sd * 0.002, 0.0, 0.0, 0.0])
        assert any(watch.update(off, ERROR) for _ in range(20)) is is_fault


def test_a_monitor_goes_on_from_its_state_as_if_it_had_never_ended() -> None:
    rng, healthy = np.random.default_rng(11), commissioned(steady=True)
    fits = [draw(rng, np.array([0.004 * (k > 60), 0.0, 0.0, 0.0])) for k in range(90)]
    whole = monitor(healthy)
    told = [whole.update(*each) for each in fits]
    part, again = monitor(healthy), []
    for k, each in enumerate(fits):
        if k % 7 == 0:
            part = monitor(healthy, HOUR, part.state_dict)
        again.append(part.update(*each))
    assert any(told)
    assert again == told
    assert part.state_dict == whole.state_dict
    state = part.state_dict
    for broken in (
        {**state, "sums": state["sums"][1:]},
        {**state, "sums": [-1.0, *state["sums"][1:]]},
        {**state, "sums": [1e308, *state["sums"][1:]]},
        {**state, "strange": [1.0]},
        {"sums": state["sums"]},
    ):
        with pytest.raises(
            InputError, match=r"the memory of the state (is not that of this motor|must lie in 0 \.\.)"
        ):
            monitor(healthy, HOUR, broken)


def driven_by(size: float, count: int = 600) -> Recording:
    values = size * np.resize([1.0, -1.0], count)
    return Recording(Path("it"), np.arange(count, dtype=np.float64), values, values, values)


def with_conditions(logs: dict[float, FloatArray]) -> Healthy:
    """Driven by each of these and its negative, with these logarithms of R, K, J and B."""
    healthy = commissioned(steady=True)
    assert healthy.windows is not None
    conditions = tuple(
        OperatingCondition(
            (n,), condition_features(driven_by(size))[None], np.exp(at), healthy.log_covariance, 15.0
        )
        for n, (size, at) in enumerate(logs.items())
    )
    return replace(healthy, windows=replace(healthy.windows, drives=conditions, alike=0.12))


@pytest.fixture
def rates(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The rates at which windows are judged: each is fitted as if it were of R twice as large, and 10 % more K."""
    given: list[float] = []

    def judge(
        judge: WindowJudge, window: Recording, rate: float, is_alarm: Any
    ) -> tuple[list[Judgement], int]:
        given.append(rate)
        if is_alarm is None:
            return [Judgement(Verdict.UNUSABLE, ("driven otherwise",))], 1
        fit = FittedWindow(judge.reference.log_values * 0.0 + np.array([0.7, 0.1, 0.0, 0.0]), ERROR)
        return [Judgement(Verdict.WINDING if is_alarm(fit) else Verdict.HEALTHY, ("because",))], 1

    monkeypatch.setattr(WindowJudge, "judge", judge)
    return given


def test_a_window_under_an_unknown_condition_is_judged_by_itself_and_is_no_evidence(
    rates: list[float],
) -> None:
    watch = monitor(with_conditions({1.0: np.zeros(4)}), HOUR)
    assert watch.diagnose(driven_by(1.1)).verdict is Verdict.WINDING
    before = watch.state_dict
    assert before["alarm"] == [1.0]
    assert watch.diagnose(driven_by(2.0)).verdict is Verdict.UNUSABLE
    assert watch.state_dict == before | {"alarm": [0.0]}
    assert rates == pytest.approx([WINDOW_S / 3600.0] * 2)


def test_a_window_is_compared_with_healthy_ones_under_its_own_condition(rates: list[float]) -> None:
    """What is a fault under one is healthy under the other; at most every other window alarms."""
    watch = monitor(with_conditions({1.0: np.zeros(4), 2.0: np.array([0.7, 0.1, 0.0, 0.0])}), 1e12)
    assert [watch.diagnose(driven_by(size)).verdict for size in (2.0, 1.0)] == [
        Verdict.HEALTHY,
        Verdict.WINDING,
    ]
    assert rates == [0.5, 0.5]
