"""The sequential monitor: calibrated scores of windows, an e-detector over them, and its rate of false alarms."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from motor_env import InputError
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
from motor_env.diagnosis.operation.windows import judge_of

# Reaches in: windows are fits made by hand.
from motor_env.diagnosis.verdict.hypotheses import NAMES
from motor_env.motor.healthy import Healthy, ScoreCalibration, Windows
from motor_env.motor.parameters import FloatArray

WINDOW_S, ERROR = 600.0, np.diag([0.002, 0.002, 0.005, 0.01]) ** 2
HOUR = YEAR_S / 3600.0
UP_IN_R = int(np.flatnonzero((fault_directions()[0] == [1.0, 0.0, 0.0, 0.0]).all(axis=1))[0])
Random = np.random.Generator


def test_false_alarms_are_as_far_apart_as_was_asked() -> None:
    """Of correlated normal scores in five directions; the mean is no less, and not more than twice as much."""
    rng, root, weights = np.random.default_rng(1), np.linalg.cholesky(0.5 * np.eye(5) + 0.5), np.full(5, 0.2)
    sums, alarms = np.zeros((5, 2)), 0
    for scores in rng.standard_normal((4000, 5)) @ root.T:
        sums = updated_sums(sums, scores)
        if is_alarm(sums, weights, 40.0):
            sums, alarms = np.zeros_like(sums), alarms + 1
    assert 4000 / 80 < alarms < 4000 / 40 + 30


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
    return np.array([normal_scores(of, each, ERROR, fault_directions()[0], windows) for each in logs])


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_scores_of_healthy_windows_are_normal_or_less_whatever_the_fit_believes(scale: float) -> None:
    """As e-values their mean is 1 at most, over commissionings; along a fault they are as large as it."""
    e_values, ups = [], []
    for seed in range(8):
        rng = np.random.default_rng([3, seed])
        of = learned(rng, scale=scale)
        scores = scored(of, windows_of(rng, 200, np.zeros(4), scale)[0])
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
    of, warm = learned(rng, 12, kelvin=15.0), 15.0 * np.array([0.00393, -0.001, 0.0, -0.003])
    allowed, beyond = np.array([0.02, 0.0, 0.0, 0.0]), warm + np.eye(4)[0] * 0.15
    means = [scored(of, windows_of(rng, 400, off)[0]).mean(axis=0).max() for off in (allowed, warm, beyond)]
    assert max(means[:2]) < 0.0
    assert means[2] > 1.0


@pytest.mark.parametrize(("sd", "holds"), [(0.0, True), (12.0, False)])
def test_tails_hold_where_windows_judged_by_the_others_alarm_as_they_should(sd: float, holds: bool) -> None:
    """Of 30 normal windows one may not be twelve standard deviations off."""
    logs, errors = windows_of(np.random.default_rng(8), 30, np.zeros(4))
    logs[20, 0] += sd * 0.002
    assert checked_calibration(logs, errors, np.zeros(4), temperature_k=0.0).tails_hold is holds


@cache
def commissioned(*, steady: bool) -> Healthy:
    rng = np.random.default_rng(8)
    kelvin, prior = (0.0, np.zeros(4)) if steady else (15.0, np.full(4, 0.01))
    calibration = checked_calibration(*windows_of(rng, 12, np.zeros(4)), prior, temperature_k=kelvin)
    windows = Windows(WINDOW_S, (), np.zeros(index.N_VALUES), "held", 1.0, 100.0, calibration=calibration)
    return Healthy(12, 15.0, NAMES, np.ones(4), ERROR, temperature_k=kelvin, windows=windows)


def monitor(
    healthy: Healthy, per_year: float = HOUR, state: dict[str, list[float]] | None = None
) -> SequentialMonitor:
    return SequentialMonitor(judge_of(healthy), healthy, false_alarms_per_year=per_year, state=state)


def draw(rng: Random, level: FloatArray) -> tuple[FloatArray, FloatArray]:
    return level + rng.multivariate_normal(np.zeros(4), ERROR), ERROR


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


def test_a_monitor_says_what_holds_of_its_rate() -> None:
    healthy = commissioned(steady=False)
    assert healthy.windows is not None
    assert healthy.windows.calibration is not None
    for per_year, words in ((1.0, "1 year"), (3.0 * HOUR, "20 minutes"), (HOUR / 48.0, "2 days")):
        said = monitor(healthy, per_year).describe_false_alarm_rate()
        assert said.startswith(
            f"12 healthy windows of 600 s: one false alarm in {words} if the fitted tails hold"
        )
    heavy = replace(healthy.windows.calibration, tails_hold=False)
    watch = monitor(replace(healthy, windows=replace(healthy.windows, calibration=heavy)))
    assert "18 windows without a false alarm would support it" in watch.describe_false_alarm_rate()


def test_a_motor_whose_windows_were_not_compared_is_watched_by_what_is_believed_of_it() -> None:
    """Its spread may all be drift: two standard deviations of it are no fault, and thirty are."""
    healthy = commissioned(steady=False)
    assert healthy.windows is not None
    untaught = replace(healthy, windows=replace(healthy.windows, calibration=None))
    assert "commission the motor anew" in monitor(untaught).describe_false_alarm_rate()
    for sd, is_fault in ((2.0, False), (30.0, True)):
        watch, off = monitor(untaught), np.array([sd * 0.002, 0.0, 0.0, 0.0])
        assert any(watch.update(off, ERROR) for _ in range(20)) is is_fault


def test_a_monitor_goes_on_from_its_state_as_if_it_had_never_ended() -> None:
    rng, healthy = np.random.default_rng(11), commissioned(steady=True)
    fits = [draw(rng, np.array([0.004 * (k > 60), 0.0, 0.0, 0.0])) for k in range(90)]
    whole, part = monitor(healthy), monitor(healthy)
    told, again = [whole.update(*each) for each in fits], []
    for k, each in enumerate(fits):
        if k % 7 == 0:
            part = monitor(healthy, HOUR, part.state_dict)
        again.append(part.update(*each))
    assert any(told)
    assert (again, part.state_dict) == (told, whole.state_dict)


@pytest.mark.parametrize(
    "broken",
    [{"sums": [1.0]}, {"sums": [-1.0] * 18}, {"sums": [1e308] * 18}, {"strange": [1.0]}, {"alarm": []}],
)
def test_a_state_of_another_motor_is_refused(broken: dict[str, list[float]]) -> None:
    healthy = commissioned(steady=True)
    state = {name: row for name, row in (monitor(healthy).state_dict | broken).items() if row}
    with pytest.raises(InputError, match="the memory of the state"):
        monitor(healthy, HOUR, state)
