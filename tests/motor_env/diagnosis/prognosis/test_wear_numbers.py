"""Wear and its laws number by number: against brute force, closed forms, and borders on hand-made fits."""

import json
import math
import os
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import invgauss, norm

from motor_env import InputError
from motor_env.cli import main
from motor_env.diagnosis.prognosis import trend_report
from motor_env.diagnosis.prognosis.degradation import Degradation, fit_degradation, time_scale
from motor_env.diagnosis.prognosis.trend import (
    Series,
    at_one_temperature,
    judge,
    last_jump,
    reason_withheld,
)
from motor_env.diagnosis.prognosis.trend_report import Trends, build_series, read_estimates
from motor_env.diagnosis.readers.start import Start
from motor_env.motor.parameters import FloatArray


def array(*values: float) -> FloatArray:
    return np.array(values)


def wear(*, limit: float = 1.5, sign: float = 1.0, **given: Any) -> Degradation:
    """What estimates might tell, made by hand; one hypothesis unless more are given. All began 20 days ago."""
    n = len(given.get("weights", [1.0]))
    usual = {"weights": 1.0, "span": 20.0, "exponent": 1.0, "growth": 0.0, "diffusion": 0.1, "scatter": 0.0}
    usual |= {"level": 1.0, "drift": 0.01, "limit_variance": 0.0}
    arrays = {name: np.zeros(n) + value for name, value in (usual | given).items() if name != "covariance"}
    covariance = np.zeros((n, 2, 2)) + given.get("covariance", 1e-12 * np.eye(2))
    return Degradation(**arrays, covariance=covariance, limit=limit, sign=sign, probability_trend=1.0)


def series(values: FloatArray, error: float = 0.01, name: str = "x", step: float = 1.0) -> Series:
    return Series(name, step * np.arange(float(len(values))), values, np.full(len(values), error))


def test_the_fit_is_the_posterior_of_its_grid_by_brute_force() -> None:
    """Every hypothesis as one joint Gaussian; grid and priors as the model states them."""
    rng, limit, n = np.random.default_rng(2), 0.8, 9
    time = np.cumsum(rng.uniform(0.5, 2.0, n)) + 3.0
    value, error = (
        1.0 - 0.012 * (time - time[0]) + 0.01 * rng.standard_normal(n),
        rng.uniform(0.004, 0.012, n),
    )
    found = fit_degradation(time, value, error, limit)

    distance = abs(limit - value[:3].mean())
    typical = max(np.median(error), 0.3 * np.median(np.abs(np.diff(value))) / 0.954)
    sizes, scatters = np.geomspace(0.01, 2.0, 9), np.append(0.0, np.geomspace(0.35, 8.0, 6))
    prior_d, prior_s = 1.0 / (1.0 + (sizes / 0.25) ** 2), 1.0 / (1.0 + scatters**2)
    prior_d, prior_s = prior_d / prior_d.sum(), prior_s / prior_s.sum()
    powers, growths = {0.5: 0.25, 1.0: 1.0, 1.5: 0.25, 2.0: 0.25, 3.0: 0.25}, (1.5, 2.5, 4.0, 6.0)
    laws = [(lambda u, p=p: u**p, share / 4.0) for p, share in powers.items()]
    laws += [(lambda u, g=g: np.expm1(g * u) / math.expm1(g), 1.0 / 16.0) for g in growths]
    drifting = [(law, k, d, s) for law in laws for k in range(n - 1) for d in range(9) for s in range(7)]
    chance = [(None, 0, d, s) for d in range(9) for s in range(7)]
    sd0, y, rows = 10.0 * (distance + np.ptp(value)), -value, []
    for law, onset, d, s in [*drifting, *chance, *((None, n, -1, s) for s in range(7))]:
        prior, elapsed, slope_sd, diffusion = prior_s[s] / 2.0, np.zeros(n), 0.0, 0.0
        if onset < n:
            prior *= prior_d[d] * (
                1.0 / 4.0 if law is None else law[1] * (0.5 if onset == 0 else 0.5 / (n - 2))
            )
            diffusion, elapsed = sizes[d] * distance / math.sqrt(time[-1] - time[0]), time - time[0]
        if law is not None:
            span = time[-1] - time[onset]
            elapsed = span * law[0](np.maximum(time - time[onset], 0.0) / span)
            slope_sd = 0.7 * distance / span
        signal = sd0**2 + slope_sd**2 * np.outer(elapsed, elapsed)
        signal += diffusion**2 * np.minimum.outer(elapsed, elapsed)
        joint = signal + np.diag(error**2 + (scatters[s] * typical) ** 2)
        both, off = np.stack([signal[-1], slope_sd**2 * elapsed]), y - y[0]
        gain = both @ np.linalg.inv(joint)
        ahead = np.array([[signal[-1, -1], both[1, -1]], [both[1, -1], slope_sd**2]]) - gain @ both.T
        log = -0.5 * (off @ np.linalg.solve(joint, off) + np.linalg.slogdet(2.0 * math.pi * joint)[1])
        rows.append((prior, log, law is not None, *(array(y[0], 0.0) + gain @ off), ahead[0, 0], ahead[1, 1]))
    prior, log, moves, level, drift, p00, p11 = np.array(rows).T
    every = prior * np.exp(log - log.max())
    weight = np.where(moves > 0.0, every, 0.0) / every.sum()
    # Grid points that hold together less than 0.01 of the weight are left out.
    order = np.argsort(weight)[::-1]
    kept = order[: int(np.searchsorted(np.cumsum(weight[order]) / weight.sum(), 1.0 - 0.01)) + 1]
    w = weight[kept] / weight[kept].sum()
    np.testing.assert_allclose(np.sort(found.weights), np.sort(w), rtol=1e-5)
    towards = w @ norm.cdf(drift[kept] / np.sqrt(p11[kept]))
    assert found.probability_trend == pytest.approx(weight.sum() * towards, rel=1e-6)
    mean, sd = found.forecast(0.0)
    assert mean == pytest.approx(-(w @ level[kept]), rel=1e-8)
    assert sd == pytest.approx(math.sqrt(w @ (p00[kept] + (level[kept] - w @ level[kept]) ** 2)), rel=1e-4)


@pytest.mark.parametrize(("exponent", "growth"), [(2.0, 0.0), (0.5, 0.0), (1.0, 3.0)])
def test_a_clock_that_bends_takes_the_life_with_it(exponent: float, growth: float) -> None:
    elapsed = array(0.0, 0.5, 1.0, 1.7)
    shown = time_scale(elapsed, np.full(4, exponent), np.full(4, growth))
    curve = elapsed**exponent if growth == 0.0 else np.expm1(growth * elapsed) / math.expm1(growth)
    np.testing.assert_allclose(shown, curve, rtol=2e-6)
    reach = 0.01 * 20.0 * (curve[-1] - 1.0)
    one = wear(exponent=exponent, growth=growth, limit=1.0 + reach, diffusion=1e-5)
    np.testing.assert_allclose(one.passage(array(13.9, 14.1)), [0.0, 1.0], atol=1e-3)
    assert one.forecast(14.0)[0] == pytest.approx(1.0 + reach, rel=1e-5)
    pace = (one.forecast(1e-3)[0] - one.forecast(0.0)[0]) / 1e-3
    assert one.mean_drift == pytest.approx(pace, rel=1e-3)


def test_the_life_of_a_known_drift_is_inverse_gaussian() -> None:
    """Distance 0.5, drift 0.01, diffusion 0.03; the quantiles are interpolated between times 17 % apart."""
    one, law = wear(diffusion=0.03), invgauss(0.03**2 / (0.01 * 0.5), scale=0.5**2 / 0.03**2)
    for level in (0.5, 0.9):
        life = one.remaining_life(level)
        expected = law.ppf([0.5 - level / 2.0, 0.5, 0.5 + level / 2.0])
        np.testing.assert_allclose([life.low, life.median, life.high], expected, rtol=0.01)
    assert one.remaining_life() == life
    assert (life.probability_reached, life.probability_ever) == pytest.approx((0.0, 1.0))
    away = wear(drift=array(-0.01), diffusion=0.03).remaining_life()
    assert away.probability_ever == pytest.approx(math.exp(-2.0 * 0.01 * 0.5 / 0.03**2), rel=1e-6)
    assert (away.median, away.high) == (math.inf, math.inf)
    down = replace(one, level=array(-1.0), limit=0.5, sign=-1.0)
    np.testing.assert_allclose(down.remaining_life(), one.remaining_life())


def test_the_limit_is_as_uncertain_as_the_estimates_that_it_is_relative_to() -> None:
    """It widens the passage as an uncertain level does; of a part of the way, its error is that part."""
    unsure = replace(wear(), limit_variance=array(0.04))
    blurred = wear(covariance=np.diag([0.04, 1e-12])[None])
    times = array(5.0, 30.0, 80.0)
    np.testing.assert_allclose(unsure.passage(times), blurred.passage(times), rtol=1e-6)
    assert unsure.passage(times)[0] > 2.0 * wear().passage(times)[0]
    for share in (0.8, 1.0):
        expected = norm.cdf((1.0 - (1.0 + 0.5 * share)) / (0.2 * share))
        assert unsure.probability_beyond(share) == pytest.approx(expected, rel=1e-6)


def test_a_forecast_is_the_mixture_of_its_hypotheses() -> None:
    """Three hypotheses that disagree in level and drift: mean, and spread within and between them."""
    w, level, drift = array(0.5, 0.3, 0.2), array(1.0, 1.3, 0.6), array(0.02, -0.05, 0.1)
    covariance = np.array([[[0.01, c], [c, 0.0004]] for c in (0.001, -0.0015, 0.0)])
    one = wear(weights=w, level=level, drift=drift, covariance=covariance, diffusion=0.05)
    for ahead in (0.0, 3.0):
        at = level + ahead * drift
        within = 0.01 + 2.0 * ahead * covariance[:, 0, 1] + ahead**2 * 0.0004 + 0.05**2 * ahead
        mean, sd = one.forecast(ahead)
        assert (mean, sd) == pytest.approx((w @ at, math.sqrt(w @ (within + at**2) - (w @ at) ** 2)))
        assert replace(one, sign=-1.0).forecast(ahead)[0] == pytest.approx(-mean)
    assert one.mean_drift == pytest.approx(w @ drift)


@pytest.mark.parametrize(
    ("error", "size", "is_one"), [(0.01, 0.1, True), (0.01, 0.02, False), (0.2, 0.1, False)]
)
def test_a_jump_stands_out_of_the_scatter_and_of_the_errors(error: float, size: float, is_one: bool) -> None:
    values = 1.0 + 0.002 * np.arange(60.0) + 0.01 * np.random.default_rng(7).standard_normal(60)
    given = series(values + size * (np.arange(60) >= 30), error)
    found = last_jump(given)
    assert (found is not None) is is_one
    if found is not None:  # by a fit of line and step
        near = np.arange(22, 38)
        design = np.stack([np.ones(16), near, near >= 30], axis=1)
        height = np.linalg.lstsq(design, given.estimate[near], rcond=None)[0][2]
        assert found == pytest.approx((30, height), rel=1e-9)


def test_of_two_jumps_the_last_counts_and_few_estimates_have_none() -> None:
    at, noise = np.arange(90), 0.001 * np.random.default_rng(7).standard_normal(90)
    twice = 1.0 + 0.012 * (at >= 22) - 0.012 * (at >= 68) + noise
    assert last_jump(series(twice, 1e-3)) == pytest.approx((68, -0.012), abs=0.003)
    assert last_jump(series(twice[19:26], 1e-3)) is None


def test_estimates_are_taken_to_the_first_temperature() -> None:
    given = series(np.ones(5), 0.1, "R")
    kelvin = Series("temperature_c", array(0.0, 4.0), array(20.0, 40.0), np.zeros(2))
    for name, slope in (("R", 0.00393), ("B/J", -0.003), ("K^2/J", -0.002), ("K/V", -0.001), ("else", 0.0)):
        found = at_one_temperature(replace(given, name=name), kelvin)
        expected = np.exp(-slope * 5.0 * np.arange(5.0))
        np.testing.assert_allclose(found.estimate, expected, rtol=1e-12)
        np.testing.assert_allclose(found.standard_error, 0.1 * expected, rtol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("share", "is_withheld"), [(0.995, True), (1.005, False)])
def test_a_change_that_30_kelvin_explain_is_withheld(sign: float, share: float, is_withheld: bool) -> None:
    values = 1.0 + sign * share * 30.0 * 0.00393 * np.linspace(0.0, 1.0, 21)
    one = wear(level=array(sign * (values[-1] + values[:3].mean() - 1.0)), sign=sign)
    given = series(values, 1e-3, "R")
    assert ("temperature by 30 K" in reason_withheld(given, one, knows_temperature=False)) is is_withheld
    assert "temperature" not in reason_withheld(given, one, knows_temperature=True)


def test_a_trend_is_judged_from_five_estimates_on_relative_to_the_first() -> None:
    values = 2.0 * (1.0 + 0.01 * np.arange(30.0))
    found = judge(series(values, 1e-4), (1.5,))
    assert found.reference == pytest.approx(2.02)
    (forecast,) = found.forecasts
    assert (forecast.factor, forecast.trends, forecast.wear.probability_trend > 0.95) == (1.5, True, True)
    assert forecast.wear.mean_drift == pytest.approx(0.02 / 2.02, rel=0.01)
    assert judge(series(values, 1e-4), (1.5,), level=0.5).forecasts[0].life.level == 0.5
    assert "trends to the limit at +50 %, by +0.99 % of the reference a day: reached in" in found.sentence
    assert judge(series(values[:5], 1e-4)).forecasts
    assert judge(series(values[:4], 1e-4)).sentence.startswith("too few estimates for a trend: 4")
    assert [f.factor for f in judge(series(values[:9], 1e-4)).forecasts] == [0.75, 1.25]
    reached = judge(series(values, 1e-4), (1.2,))
    assert reached.sentence == "the limit at +20 % is reached, with a probability of 100 %"
    with pytest.raises(InputError, match="the first estimates are 0"):
        judge(series(np.zeros(9)))


@pytest.mark.parametrize(("count", "mean_of", "change"), [(1, 1, "-4 %"), (2, 2, "-2 %"), (10, 6, "-2 %")])
def test_what_is_said_is_relative_to_the_mean_of_some_estimates(
    count: int, mean_of: int, change: str
) -> None:
    """Of six none is the mean of ten; the limit has the error of that mean, times its factor."""
    found = judge(series(1.0 + 0.02 * (-1.0) ** np.arange(6.0), 1e-3), (1.5,), reference_count=count)
    of_one = (1e-3 / found.reference) ** 2 + found.forecasts[0].wear.scatter ** 2
    np.testing.assert_allclose(found.forecasts[0].wear.limit_variance, 1.5**2 / mean_of * of_one)
    assert f"last change {change};" in found.sentence


def test_estimates_of_one_time_weigh_by_their_precision() -> None:
    entries = {"B": [(1.0, 2.0, 0.1), (1.0, 4.0, 0.2), (3.0, 5.0, 0.0)]}
    (found,) = build_series(entries, "hours")
    np.testing.assert_allclose(found.estimate, [(2.0 / 0.01 + 4.0 / 0.04) / 125.0, 5.0])
    np.testing.assert_allclose(found.standard_error, [1.0 / math.sqrt(125.0), 0.0])
    assert (found.unit, found.start, found.time.tolist()) == ("hours", None, [1.0, 3.0])


def test_dates_become_days_since_the_first(tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    table.write_text("date,B\n2026-03-01T12:00,1\n2026-02-27,2\nMar-02-2026_06-00-00,3\n")
    (found,) = read_estimates(table)
    assert found.time.tolist() == [0.0, 2.5, 3.25]
    assert found.estimate.tolist() == pytest.approx([2.0, 1.0, 3.0])
    assert (found.unit, found.start) == ("days", datetime(2026, 2, 27, tzinfo=UTC))


def test_json_says_what_was_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "e.csv"
    lines = [f"{day},{3.0 + 0.03 * day:.9g},{0.001}" for day in range(30)]
    table.write_text("\n".join(["time_days,B,B_se", *lines]) + "\n")
    (given,) = read_estimates(table)

    def told(limits: str) -> dict[str, Any]:
        page = str(tmp_path / "t.html")
        options = ["--limit", f"B={limits}", "--level", "0.8", "--out", page, "--json"]
        assert main(["trend", str(table), *options]) == 1
        (found,) = json.loads(capsys.readouterr().out)
        return dict(found)

    found, expected = told("1.2,1.6,0.5"), judge(given, (1.2, 1.6, 0.5), 0.8)
    assert (found["quantity"], found["state"], found["time_unit"]) == ("B", "reached", "days")
    assert (found["estimates"], found["last_estimate"]) == (30, pytest.approx(3.87))
    assert (found["sentence"], found["reference"]) == (expected.sentence, pytest.approx(3.03))
    assert [limit["reached"] for limit in found["limits"]] == [True, False, False]
    for limit, forecast in zip(found["limits"], expected.forecasts, strict=True):
        assert limit["limit"] == pytest.approx(3.03 * forecast.factor)
        assert limit["drift_per_time_unit"] == pytest.approx(forecast.wear.mean_drift * 3.03)
        assert limit["probability_of_trend"] == forecast.wear.probability_trend
        assert limit["remaining_life"] is None
    found, life = told("1.6,2.0,0.5"), judge(given, (1.6,), 0.8).forecasts[0].life
    names = ("low", "median", "high", "level")
    lives = [limit["remaining_life"] for limit in found["limits"]]
    assert found["state"] == "trending"
    assert lives[0] == pytest.approx({name: getattr(life, name) for name in names})
    assert lives[1] is None  # the nearer one is told
    for count, reference in ((1, 3.0), (5, 3.06)):
        (one,) = trend_report.trend(table, reference_count=count).trends
        assert one.reference == pytest.approx(reference)
    assert 0.5 < life.median / ((1.6 * 3.03 - 3.87) / 0.03) < 1.02


@pytest.mark.parametrize(
    ("apart_s", "date", "note", "unit"),
    [(13e4, "modified", "", "days"), (30.0, "modified", "of copying", "days"), (30.0, "order", "", "starts")],
)
def test_recordings_may_be_dated_by_their_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], apart_s: float, date: str, note: str, unit: str
) -> None:
    for n, file in enumerate((tmp_path / "0.csv", tmp_path / "1.csv")):
        shutil.copy(Path(__file__).parents[4] / "examples" / "startup_capture.csv", file)
        os.utime(file, 2 * (1_767_225_600.0 + n * apart_s,))
    assert main(["trend", str(tmp_path), "--date", date, "--out", str(tmp_path / "t.html"), "--json"]) == 0
    told = capsys.readouterr()
    found = {each["quantity"]: each for each in json.loads(told.out)}["R"]
    assert note in told.err
    assert (found["estimates"], found["state"], found["time_unit"]) == (2, "unknown", unit)
    assert found["first_date"] == ("2026-01-01T00:00:00+00:00" if date == "modified" else None)


def test_all_recordings_are_fitted_with_one_model_under_the_supply_that_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model that the first three that can be used prefer: another one would be a jump."""
    shown = np.append(np.zeros(50), np.exp(-np.arange(150.0) / 40.0))
    for day in range(1, 7):
        rows = (f"{1e-4 * k:.4f},{day * amps:.6f}" for k, amps in enumerate(shown * (day > 1)))
        (tmp_path / f"2026-03-{day:02d}.csv").write_text("time_s,current_a\n" + "\n".join(rows) + "\n")
    fitted: list[tuple[tuple[str, ...], float, bool]] = []

    def choose(starts: list[Start]) -> list[SimpleNamespace]:
        assert [round(float(one.current_a.max()), 3) for one in starts] == [2.0, 3.0, 4.0]
        return [SimpleNamespace(model=("sensor_lag",))] * 3

    def fit(start: Start, model: tuple[str, ...]) -> SimpleNamespace:
        fitted.append((model, start.level_v, start.voltage_known))
        # The model's error, which all starts have alike, is in the covariance, and in that of white noise it is not.
        errors = {"log_covariance": np.array([[1.0]]), "white_covariance": np.array([[0.01]])}
        return SimpleNamespace(quantity_names=("R",), values=np.array([2.0]), **errors)

    monkeypatch.setattr(trend_report, "fit_healthy", choose)
    monkeypatch.setattr(trend_report, "identify", fit)
    found = trend_report.trend(sorted(tmp_path.iterdir(), reverse=True), voltage_v=24.0)
    assert fitted == [(("sensor_lag",), 24.0, True)] * 5
    assert found.trends[0].series.time.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert found.trends[0].series.standard_error == pytest.approx([0.2] * 5)
    assert found.notes == ("2026-03-01.csv: the current is constant at 0 A",)


def test_a_trend_is_said_from_95_percent_on_and_a_limit_is_reached_from_one_half_on() -> None:
    noise = 0.01 * np.random.default_rng(3).standard_normal(12)
    found = [
        judge(series(1.0 + slope * np.arange(12.0) + noise), (1.15,)) for slope in np.linspace(0.0, 0.02, 60)
    ]
    for (one,) in (trend.forecasts for trend in found):
        assert one.trends is bool(one.wear.probability_trend >= 0.95)
        assert one.reached is bool(one.life.probability_reached >= 0.5)
        assert one.close is bool(one.wear.probability_beyond(0.8) >= 0.25)
    assert any(0.9 < trend.forecasts[0].wear.probability_trend < 0.95 for trend in found)


def test_the_page_draws_errors_at_90_percent_on_the_scale_of_the_limits() -> None:
    html = Trends((judge(series(2.0 + 0.002 * (-1.0) ** np.arange(9.0), 0.1)),)).page()
    y = {name: float(at) for at, name in re.findall(r'y="([\d.]+)"[^>]*>limit ([-+]\d+ %)<', html)}
    ranges = re.findall(r'class="range"[^>]*y1="([\d.]+)"[^>]*y2="([\d.]+)"', html)
    lengths = [float(low) - float(high) for low, high in ranges]
    assert lengths == pytest.approx([4.0 * 1.6449 * 0.05 * (y["-25 %"] - y["+25 %"])] * 9, abs=0.3)
