"""Wear and its laws number by number: against brute force, closed forms, and borders on hand-made fits."""

import json
import math
import os
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import invgauss, norm

from motor_env import InputError
from motor_env.cli import main
from motor_env.diagnosis.prognosis import trend_report
from motor_env.diagnosis.prognosis.degradation import Degradation, RemainingLife, fit_degradation, time_scale
from motor_env.diagnosis.prognosis.trend import (
    Forecast,
    Series,
    at_one_temperature,
    describe,
    judge,
    last_jump,
    reason_withheld,
)
from motor_env.diagnosis.prognosis.trend_report import Trends, build_series, read_estimates
from motor_env.diagnosis.readers.start import Start
from motor_env.motor.parameters import FloatArray


def array(*values: float) -> FloatArray:
    return np.array(values)


def wear(
    *,
    weights: FloatArray | None = None,
    level: FloatArray | None = None,
    drift: FloatArray | None = None,
    covariance: FloatArray | None = None,
    diffusion: float = 0.1,
    exponent: float = 1.0,
    growth: float = 0.0,
    limit: float = 1.5,
    sign: float = 1.0,
) -> Degradation:
    """What estimates might tell, made by hand; one hypothesis unless more are given. All began 20 days ago."""
    weights = array(1.0) if weights is None else weights
    n = len(weights)
    return Degradation(
        weights=weights,
        span=np.full(n, 20.0),
        exponent=np.full(n, exponent),
        growth=np.full(n, growth),
        diffusion=np.full(n, diffusion),
        scatter=np.zeros(n),
        level=np.ones(n) if level is None else level,
        drift=np.full(n, 0.01) if drift is None else drift,
        covariance=np.full((n, 2, 2), 1e-12 * np.eye(2)) if covariance is None else covariance,
        limit=limit,
        sign=sign,
        probability_trend=1.0,
        limit_variance=np.zeros(n),
    )


def series(values: FloatArray, error: float = 0.01, name: str = "x", step: float = 1.0) -> Series:
    return Series(name, step * np.arange(float(len(values))), values, np.full(len(values), error))


def test_the_fit_is_the_posterior_of_its_grid_by_brute_force() -> None:
    """Every hypothesis as one joint Gaussian; grid and priors as the model states them."""
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.5, 2.0, 9)) + 3.0
    value = 1.0 - 0.012 * (time - time[0]) + 0.01 * rng.standard_normal(9)
    error, limit, n = rng.uniform(0.004, 0.012, 9), 0.8, 9
    found = fit_degradation(time, value, error, limit)

    distance = abs(limit - value[:3].mean())
    typical = max(np.median(error), 0.3 * np.median(np.abs(np.diff(value))) / 0.954)
    sizes = np.geomspace(0.01, 2.0, 9)
    scatters = np.concatenate([[0.0], np.geomspace(0.35, 8.0, 6)])
    sd0, y = 10.0 * (distance + np.ptp(value)), -value
    rows = []
    prior_d = 1.0 / (1.0 + (sizes / 0.25) ** 2)
    prior_s = 1.0 / (1.0 + scatters**2)
    powers, growths = {0.5: 0.25, 1.0: 1.0, 1.5: 0.25, 2.0: 0.25, 3.0: 0.25}, (1.5, 2.5, 4.0, 6.0)
    laws = [(lambda u, p=p: u**p, share / 4.0) for p, share in powers.items()]
    laws += [(lambda u, g=g: np.expm1(g * u) / math.expm1(g), 1.0 / 16.0) for g in growths]
    drifting = [(law, k, d, s) for law in laws for k in range(n - 1) for d in range(9) for s in range(7)]
    chance = [(None, 0, d, s) for d in range(9) for s in range(7)]
    for law, onset, d, s in [*drifting, *chance, *((None, n, -1, s) for s in range(7))]:
        prior = prior_s[s] / prior_s.sum() / 2.0
        elapsed, slope_sd, diffusion = np.zeros(n), 0.0, 0.0
        if law is not None:
            span = time[-1] - time[onset]
            prior *= law[1] * prior_d[d] / prior_d.sum() * (0.5 if onset == 0 else 0.5 / (n - 2))
            elapsed = span * law[0](np.maximum(time - time[onset], 0.0) / span)
            slope_sd = 0.7 * distance / span
            diffusion = sizes[d] * distance / math.sqrt(time[-1] - time[0])
        elif onset == 0:  # diffusion without a drift
            prior *= prior_d[d] / prior_d.sum() / 4.0
            elapsed, diffusion = time - time[0], sizes[d] * distance / math.sqrt(time[-1] - time[0])
        signal = sd0**2 + slope_sd**2 * np.outer(elapsed, elapsed)
        signal += diffusion**2 * np.minimum.outer(elapsed, elapsed)
        joint = signal + np.diag(error**2 + (scatters[s] * typical) ** 2)
        gain = np.stack([signal[-1], slope_sd**2 * elapsed]) @ np.linalg.inv(joint)
        mean = array(y[0], 0.0) + gain @ (y - y[0])
        ahead = array(slope_sd**2 * elapsed[-1], slope_sd**2)
        both = np.array([[signal[-1, -1], ahead[0]], [ahead[0], ahead[1]]])
        both = both - gain @ np.stack([signal[-1], slope_sd**2 * elapsed], axis=1)
        off = y - y[0]
        log = -0.5 * (off @ np.linalg.solve(joint, off) + np.linalg.slogdet(2.0 * math.pi * joint)[1])
        rows.append((prior, log, law is not None, *mean, both[0, 0], both[0, 1], both[1, 1]))
    prior, log, moves, level, drift, p00, _, p11 = np.array(rows).T
    every = prior * np.exp(log - log.max())
    weight = np.where(moves > 0.0, every, 0.0) / every.sum()
    wears = weight.sum()
    # Grid points that hold together less than 0.01 of the weight are left out.
    order = np.argsort(weight)[::-1]
    kept = order[: int(np.searchsorted(np.cumsum(weight[order]) / wears, 1.0 - 0.01)) + 1]
    assert len(found.weights) == len(kept)
    w = weight[kept] / weight[kept].sum()
    np.testing.assert_allclose(np.sort(found.weights), np.sort(w), rtol=1e-5)
    towards = w @ norm.cdf(drift[kept] / np.sqrt(p11[kept]))
    assert found.probability_trend == pytest.approx(wears * towards, rel=1e-6)
    mean, sd = found.forecast(0.0)
    assert mean == pytest.approx(-(w @ level[kept]), rel=1e-8)
    assert sd == pytest.approx(math.sqrt(w @ (p00[kept] + (level[kept] - w @ level[kept]) ** 2)), rel=1e-4)


@pytest.mark.parametrize(("exponent", "growth"), [(2.0, 0.0), (0.5, 0.0), (1.0, 3.0)])
def test_a_clock_that_bends_takes_the_life_with_it(exponent: float, growth: float) -> None:
    """A drift without chance reaches the limit where its curve does."""
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


def test_many_estimates_have_twenty_onsets_and_the_first_tenth_sets_the_distance() -> None:
    value = np.concatenate([np.full(3, 1.2), np.ones(57)]) + 1e-3 * np.random.default_rng(1).standard_normal(
        60
    )
    found = fit_degradation(np.arange(60.0), value, np.full(60, 1e-3), 1.05)
    assert set(59.0 - found.span) <= set(np.linspace(0.0, 58.0, 20).round())
    assert found.sign == -1.0  # the first six lie at 1.1 in the mean


def test_wear_downwards_is_wear_upwards_in_a_mirror() -> None:
    rng = np.random.default_rng(4)
    time, error = np.arange(30.0), np.full(30, 0.02)
    value = 0.4 + np.cumsum(0.15 * (rng.random(30) < 0.15)) + error * rng.standard_normal(30)
    up, down = fit_degradation(time, value, error, 2.0), fit_degradation(time, -value, error, -2.0)
    assert (up.sign, down.sign) == (1.0, -1.0)
    np.testing.assert_allclose(down.level, up.level)
    np.testing.assert_allclose(down.drift, up.drift)
    assert down.probability_trend == pytest.approx(up.probability_trend)


def test_the_typical_error_is_the_larger_of_what_is_said_and_what_neighbours_show() -> None:
    """Scatters are multiples of it; the least that is not none is 0.35 of it."""
    value = 1.0 + 0.1 * (-1.0) ** np.arange(8.0) * np.linspace(1.0, 1.01, 8)
    for said, typical in ((0.5, 0.5), (1e-4, 0.3 * np.median(np.abs(np.diff(value))) / 0.954)):
        found = fit_degradation(np.arange(8.0), value, np.full(8, said), 1.5).scatter
        steps = np.concatenate([[0.0], np.geomspace(0.35, 8.0, 6)]) * typical
        assert np.abs(found[:, None] - steps).min(axis=1).max() < 1e-12


def test_the_life_of_a_known_drift_is_inverse_gaussian() -> None:
    """Distance 0.5, drift 0.01, diffusion 0.03; the quantiles are interpolated between times 17 % apart."""
    one = wear(diffusion=0.03)
    law = invgauss(0.03**2 / (0.01 * 0.5), scale=0.5**2 / 0.03**2)
    for level in (0.5, 0.9):
        life = one.remaining_life(level)
        expected = law.ppf([0.5 - level / 2.0, 0.5, 0.5 + level / 2.0])
        np.testing.assert_allclose([life.low, life.median, life.high], expected, rtol=0.01)
        assert life.level == level
    assert one.remaining_life() == one.remaining_life(0.9)
    assert (life.probability_reached, life.probability_ever) == pytest.approx((0.0, 1.0))
    away = wear(drift=array(-0.01), diffusion=0.03).remaining_life()
    assert away.probability_ever == pytest.approx(math.exp(-2.0 * 0.01 * 0.5 / 0.03**2), rel=1e-6)
    assert (away.median, away.high) == (math.inf, math.inf)
    down = replace(one, level=array(-1.0), limit=0.5, sign=-1.0)
    np.testing.assert_allclose(down.remaining_life(), one.remaining_life())


def test_an_uncertain_level_is_integrated_by_seven_points() -> None:
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    sd, correlation, drift_sd = 0.2, -0.8, 0.06
    covariance = np.array([[sd**2, correlation * sd * drift_sd], [correlation * sd * drift_sd, drift_sd**2]])
    one = wear(level=array(1.4), drift=array(0.05), covariance=covariance[None])
    assert one.remaining_life().probability_reached == pytest.approx(norm.cdf(-0.5))
    # At each point the drift is still uncertain; the first passage of each drift is known.
    life, grid = 4.0, np.linspace(-8.0, 8.0, 4001)
    share, root = np.exp(-0.5 * grid**2) / np.exp(-0.5 * grid**2).sum(), 0.1 * math.sqrt(life)
    expected = 0.0
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        distance = 1.5 - (1.4 + sd * node)
        drifts = 0.05 + correlation * drift_sd * node + math.sqrt(1.0 - correlation**2) * drift_sd * grid
        passed = np.ones(len(grid))
        if distance > 0.0:
            passed = norm.cdf((drifts * life - distance) / root)
            passed += np.exp(2.0 * drifts * distance / 0.01) * norm.cdf((-drifts * life - distance) / root)
        expected += weight * float(share @ passed)
    assert one.passage(array(life))[0] == pytest.approx(expected, rel=1e-6)


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
    """Three hypotheses that disagree in level and drift: by drawing from each."""
    weights, level, drift = array(0.5, 0.3, 0.2), array(1.0, 1.3, 0.6), array(0.02, -0.05, 0.1)
    covariance = np.array([[[0.01, c], [c, 0.0004]] for c in (0.001, -0.0015, 0.0)])
    one = wear(weights=weights, level=level, drift=drift, covariance=covariance, diffusion=0.05)
    ahead = array(0.0, 3.0)
    mean, sd = one.forecast(ahead)
    rng, drawn = np.random.default_rng(4), []
    for w, at, slope, spread in zip(weights, level, drift, covariance, strict=True):
        both = rng.multivariate_normal([at, slope], spread, int(400_000 * w))
        walk = 0.05 * np.sqrt(ahead) * rng.standard_normal((len(both), 2))
        drawn.append(both[:, :1] + both[:, 1:] * ahead + walk)
    every = np.concatenate(drawn)
    np.testing.assert_allclose(mean, every.mean(axis=0), atol=0.003)
    np.testing.assert_allclose(sd, every.std(axis=0), rtol=0.005)
    np.testing.assert_allclose(replace(one, sign=-1.0).forecast(ahead)[0], -mean)
    assert one.mean_drift == pytest.approx(weights @ drift)


def stepped(values: FloatArray, size: float, at: int, error: float) -> Series:
    return series(values + size * (np.arange(len(values)) >= at), error)


def largest_step(given: Series) -> tuple[float, int, float]:
    """Size in robust standard deviations, place and height of the largest step, by fits of line and step."""
    n, found = len(given.time), []
    for k in range(3, n - 2):
        some = slice(max(k - 8, 0), k + 8)
        time = given.time[some]
        design = np.stack([np.ones(len(time)), time, time >= given.time[k]], axis=1)
        height = np.linalg.lstsq(design, given.estimate[some], rcond=None)[0][2]
        found.append((k, height, height / math.sqrt(np.linalg.inv(design.T @ design)[2, 2])))
    z = array(*(each[2] for each in found))
    spread = max(1.4826 * np.median(np.abs(z)), 0.5 * np.median(given.standard_error))
    best = int(np.argmax(np.abs(z)))
    return float(abs(z[best]) / spread), found[best][0], found[best][1]


@pytest.mark.parametrize("error", [0.01, 0.2])
def test_a_jump_is_a_step_of_six_robust_deviations(error: float) -> None:
    values = 1.0 + 0.002 * np.arange(60.0) + 0.01 * np.random.default_rng(7).standard_normal(60)
    size = 0.05
    for _ in range(12):  # to the border
        size *= 6.0 / largest_step(stepped(values, size, 30, error))[0]
    below, above = (stepped(values, factor * size, 30, error) for factor in (0.995, 1.005))
    assert largest_step(below)[0] == pytest.approx(6.0, rel=0.006)
    assert last_jump(below) is None
    found = last_jump(above)
    assert found is not None
    _, place, height = largest_step(above)
    assert found == pytest.approx((place, height), rel=1e-9)


def test_of_two_jumps_the_last_counts_and_few_estimates_have_none() -> None:
    values = 0.001 * np.random.default_rng(7).standard_normal(90) + 1.0
    twice = values + 0.012 * (np.arange(90) >= 22) - 0.012 * (np.arange(90) >= 68)
    found = last_jump(series(twice, 1e-3))
    assert found is not None
    assert found[0] == 68
    assert found[1] == pytest.approx(-0.012, abs=0.003)
    assert last_jump(series(twice[19:26], 1e-3)) is None


def test_estimates_are_taken_to_the_first_temperature() -> None:
    given = series(np.ones(5), 0.1, "R")
    kelvin = Series("temperature_c", array(0.0, 4.0), array(20.0, 40.0), np.zeros(2))
    for name, slope in (("R", 0.00393), ("B/J", -0.003), ("K^2/J", -0.002), ("K/V", -0.001), ("else", 0.0)):
        found = at_one_temperature(replace(given, name=name), kelvin)
        expected = np.exp(-slope * 5.0 * np.arange(5.0))
        np.testing.assert_allclose(found.estimate, expected, rtol=1e-12)
        np.testing.assert_allclose(found.standard_error, 0.1 * expected, rtol=1e-12)


def test_a_change_that_30_kelvin_explain_is_withheld() -> None:
    limit = 30.0 * 0.00393
    for change, is_withheld in ((0.995 * limit, True), (1.005 * limit, False)):
        for sign in (1.0, -1.0):
            given = series(1.0 + sign * change * np.linspace(0.0, 1.0, 21), 1e-3, "R")
            one = wear(
                level=array(sign * given.estimate[-1] + given.estimate[:3].mean() * sign - sign), sign=sign
            )
            said = reason_withheld(given, one, knows_temperature=False)
            assert ("temperature by 30 K" in said) is is_withheld
            assert "temperature" not in reason_withheld(given, one, knows_temperature=True)


def test_a_trend_is_said_from_95_percent_on() -> None:
    """Two slopes so close that their probabilities lie on either side of the border."""
    noise = 0.01 * np.random.default_rng(3).standard_normal(12)
    low, high = 0.0, 0.02
    for _ in range(14):
        middle = 0.5 * (low + high)
        found = judge(series(1.0 + middle * np.arange(12.0) + noise), (1.25,)).forecasts[0]
        low, high = (middle, high) if found.wear.probability_trend < 0.95 else (low, middle)
    for slope, trends in ((low, False), (high, True)):
        (found,) = judge(series(1.0 + slope * np.arange(12.0) + noise), (1.25,)).forecasts
        assert found.wear.probability_trend == pytest.approx(0.95, abs=2e-4)
        assert found.trends is trends


def test_a_trend_is_judged_from_five_estimates_on_relative_to_the_first() -> None:
    values = 2.0 * (1.0 + 0.01 * np.arange(30.0))
    found = judge(series(values, 1e-4), (1.5,))
    assert found.reference == pytest.approx(2.02)
    (forecast,) = found.forecasts
    assert forecast.factor == 1.5
    assert forecast.wear.mean_drift == pytest.approx(0.02 / 2.02, rel=0.01)
    # The limit has the error of the mean of three estimates, times its factor.
    of_one = (1e-4 / 2.02) ** 2 + forecast.wear.scatter**2
    np.testing.assert_allclose(forecast.wear.limit_variance, 1.5**2 / 3.0 * of_one)
    assert judge(series(values, 1e-4), (1.5,), reference_count=1).reference == 2.0
    assert judge(series(values, 1e-4), (1.5,), level=0.5).forecasts[0].life.level == 0.5
    assert "trends to the limit at +50 %, by +0.99 % of the reference a day: reached in" in found.sentence
    assert judge(series(values[:5], 1e-4)).forecasts
    assert (
        judge(series(values[:4], 1e-4)).sentence == "too few estimates for a trend: 4, at least 5 are needed"
    )
    assert [f.factor for f in judge(series(values[:9], 1e-4)).forecasts] == [0.75, 1.25]
    reached = judge(series(values, 1e-4), (1.2,))
    assert reached.sentence == "the limit at +20 % is reached, with a probability of 100 %"
    steady = judge(series(1.0 + 1e-3 * (-1.0) ** np.arange(9.0), 1e-3))
    assert re.match(r"no trend: last change \+0 %; .* \d+ %, below 95 %;", steady.sentence)
    with pytest.raises(InputError, match="the first estimates are 0"):
        judge(series(np.zeros(9)))


def test_what_is_said_is_relative_to_the_reference_however_many_estimates_it_is_the_mean_of() -> None:
    """Of six estimates none is the mean of ten; and the last change is from it, not from the first three."""
    values = 1.0 + 0.02 * (-1.0) ** np.arange(6.0)
    assert judge(series(values, 1e-3), reference_count=10).reference == pytest.approx(1.0)
    for count, mean_of, change in ((1, 1, "-4 %"), (2, 2, "-2 %"), (10, 6, "-2 %")):
        found = judge(series(values, 1e-3), (1.5,), reference_count=count)
        of_one = (1e-3 / found.reference) ** 2 + found.forecasts[0].wear.scatter ** 2
        np.testing.assert_allclose(found.forecasts[0].wear.limit_variance, 1.5**2 / mean_of * of_one)
        assert f"last change {change};" in found.sentence


def test_a_limit_counts_as_reached_with_a_probability_of_one_half() -> None:
    low, high = 1.0, 1.4
    values = 1.0 + 0.01 * np.arange(30.0) + 0.02 * np.random.default_rng(3).standard_normal(30)
    for _ in range(12):
        middle = 0.5 * (low + high)
        (found,) = judge(series(values, 0.02), (middle,)).forecasts
        assert found.reached is (found.life.probability_reached >= 0.5)
        low, high = (middle, high) if found.reached else (low, middle)
    shares = [judge(series(values, 0.02), (f,)).forecasts[0].life.probability_reached for f in (low, high)]
    near = [judge(series(values, 0.02), (f,)).forecasts[0] for f in (1.37, 1.38)]
    beyond = [one.wear.probability_beyond(0.8) for one in near]
    assert 0.5 > beyond[0] > 0.25 > beyond[1]
    assert [one.close for one in near] == [True, False]
    assert shares[0] >= 0.5 > shares[1]
    assert shares[0] - shares[1] < 0.06


def test_a_life_in_words() -> None:
    life = RemainingLife(4.0, 12.0, 31.0, 0.8, 0.0, 1.0)
    one = Forecast(1.5, reached=False, close=False, trends=True, wear=wear(), life=life)
    assert describe(one, "days") == "reached in 12 days from the last estimate (80 % interval 4 to 31)"
    said = describe(replace(one, life=life._replace(high=math.inf, probability_ever=0.45)), "days")
    assert "not before 4 days (lower end of the 80 % interval; no upper end" in said
    assert "with 45 %)" in said


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


def test_the_page_draws_errors_at_90_percent_on_the_scale_of_the_limits() -> None:
    values, error = 1.0 + 0.001 * (-1.0) ** np.arange(9.0), 0.05
    html = Trends((judge(series(2.0 * values, 2.0 * error)),)).page()
    y = {name: float(at) for at, name in re.findall(r'y="([\d.]+)"[^>]*>limit ([-+]\d+ %)<', html)}
    scale = (y["-25 %"] - y["+25 %"]) / 0.5
    ranges = re.findall(r'class="range"[^>]*y1="([\d.]+)"[^>]*y2="([\d.]+)"', html)
    assert len(ranges) == 9
    for low, high in ranges:
        assert float(low) - float(high) == pytest.approx(2.0 * 1.6449 * error * scale, abs=0.3)
    # Errors that reach beyond the limits are drawn whole.
    html = Trends((judge(series(2.0 * values, 0.8)),)).page()
    ends = re.findall(r'class="range"[^>]*y1="(-?[\d.]+)"[^>]*y2="(-?[\d.]+)"', html)
    assert len(ends) == 9
    for low, high in ends:
        assert 16.0 < float(high) < float(low) < 262.0


def test_json_says_what_was_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [f"{day},{3.0 + 0.03 * day:.9g},{0.001}" for day in range(30)]
    table = tmp_path / "e.csv"
    table.write_text("time_days,B,B_se\n" + "\n".join(lines) + "\n")
    options = ["--limit", "B=1.2,1.6,0.5", "--level", "0.8", "--out", str(tmp_path / "t.html"), "--json"]
    assert main(["trend", str(table), *options]) == 1
    (found,) = json.loads(capsys.readouterr().out)
    (given,) = read_estimates(table)
    expected = judge(given, (1.2, 1.6, 0.5), 0.8)
    assert (found["quantity"], found["state"], found["time_unit"]) == ("B", "reached", "days")
    assert (found["estimates"], found["last_estimate"]) == (30, pytest.approx(3.87))
    assert found["reference"] == pytest.approx(3.03)
    assert found["sentence"] == expected.sentence
    assert [limit["reached"] for limit in found["limits"]] == [True, False, False]
    for limit, forecast in zip(found["limits"], expected.forecasts, strict=True):
        assert limit["factor"] == forecast.factor
        assert limit["limit"] == pytest.approx(3.03 * forecast.factor)
        assert limit["drift_per_time_unit"] == pytest.approx(forecast.wear.mean_drift * 3.03)
        assert limit["probability_of_trend"] == forecast.wear.probability_trend
        assert limit["remaining_life"] is None
    assert main(["trend", str(table), "--limit", "B=1.6,2.0,0.5", *options[2:]]) == 1
    (found,) = json.loads(capsys.readouterr().out)
    life = judge(given, (1.6,), 0.8).forecasts[0].life
    names = ("low", "median", "high", "level")
    assert found["state"] == "trending"
    assert found["limits"][0]["remaining_life"] == pytest.approx(
        {name: getattr(life, name) for name in names}
    )
    assert found["limits"][1]["remaining_life"] is None  # the nearer one is told
    leading = judge(given, (2.0, 1.6), 0.8).leading
    assert leading is not None
    assert leading.factor == 1.6
    for count, reference in ((1, 3.0), (5, 3.06)):
        (one,) = trend_report.trend(table, reference_count=count).trends
        assert one.reference == pytest.approx(reference)
    assert 0.5 < life.median / ((1.6 * 3.03 - 3.87) / 0.03) < 1.02


def test_recordings_may_be_dated_by_their_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two copies of a start, a day and a half apart."""
    start = (Path(__file__).parents[4] / "examples" / "startup_capture.csv").read_bytes()
    for n, stamp in enumerate((1_767_225_600.0, 1_767_225_600.0 + 129_600.0)):
        (tmp_path / f"{n}.csv").write_bytes(start)
        os.utime(tmp_path / f"{n}.csv", (stamp, stamp))
    out = ["--out", str(tmp_path / "out" / "t.html"), "--json"]
    assert main(["trend", str(tmp_path), "--date", "modified", *out]) == 0
    found = {each["quantity"]: each for each in json.loads(capsys.readouterr().out)}
    assert found["R"]["estimates"] == 2
    assert found["R"]["state"] == "unknown"
    assert found["R"]["first_date"] == "2026-01-01T00:00:00+00:00"
    os.utime(tmp_path / "1.csv", (1_767_225_630.0, 1_767_225_630.0))
    for date, note, unit in (("modified", "those of copying", "days"), ("order", "", "starts")):
        assert main(["trend", str(tmp_path), "--date", date, *out]) == 0
        told = capsys.readouterr()
        assert note in told.err
        assert {each["time_unit"] for each in json.loads(told.out)} == {unit}


def test_all_recordings_are_fitted_with_one_model_under_the_supply_that_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model that the first three that can be used prefer: another one would be a jump."""
    shown = np.append(np.zeros(50), np.exp(-np.arange(150.0) / 40.0))
    for day in range(1, 7):
        rows = (f"{1e-4 * k:.4f},{day * amps:.6f}" for k, amps in enumerate(shown * (day > 1)))
        (tmp_path / f"2026-03-{day:02d}.csv").write_text("time_s,current_a\n" + "\n".join(rows) + "\n")
    chosen: list[list[tuple[float, float]]] = []
    fitted: list[tuple[tuple[str, ...], float, bool]] = []

    def choose(starts: list[Start]) -> list[SimpleNamespace]:
        chosen.append([(float(one.current_a.max()), one.level_v) for one in starts])
        return [SimpleNamespace(model=("sensor_lag",))] * 3

    def fit(start: Start, model: tuple[str, ...]) -> SimpleNamespace:
        fitted.append((model, start.level_v, start.voltage_known))
        # The model's error, which all starts have alike, is in the covariance, and in that of white noise it is not.
        errors = {"log_covariance": np.array([[1.0]]), "white_covariance": np.array([[0.01]])}
        return SimpleNamespace(quantity_names=("R",), values=np.array([2.0]), **errors)

    monkeypatch.setattr(trend_report, "fit_healthy", choose)
    monkeypatch.setattr(trend_report, "identify", fit)
    found = trend_report.trend(sorted(tmp_path.iterdir(), reverse=True), voltage_v=24.0)
    np.testing.assert_allclose(chosen, [[(2.0, 24.0), (3.0, 24.0), (4.0, 24.0)]])
    assert fitted == [(("sensor_lag",), 24.0, True)] * 5
    assert found.trends[0].series.time.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert found.trends[0].series.standard_error == pytest.approx([0.2] * 5)
    assert found.notes == ("2026-03-01.csv: the current is constant at 0 A",)
