"""Parts of the fit of a motor at work, each against a closed form or brute force on a small case."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from recorded_motor import DT_S, LOGS, Line, least_squares, plain, solution, values, worked

from motor_env.diagnosis.estimation import model_selection as fitting, parameter_index as index, uncertainty
from motor_env.diagnosis.estimation.model_selection import initial_values
from motor_env.diagnosis.estimation.problem import Solution, motor_unknowns
from motor_env.diagnosis.estimation.terms import Term, terms
from motor_env.diagnosis.estimation.uncertainty import (
    ScoreTest,
    candidates,
    information_covariance,
    score_tests,
    secants,
)
from motor_env.motor.parameters import FloatArray

PEAKS = (12.0, 3.0, 200.0)


@pytest.fixture(scope="module")
def small() -> Solution:
    """R, K, J and a load, fitted; the rest is known. There is a fan that the model lacks."""
    return solution(worked(values(SQUARE=5e-10)), [*LOGS, "load_constant"], values())


def test_units_of_the_unknowns() -> None:
    """By the largest voltage, current and speed; of a channel that is not recorded, or hardly moves, V over R or K."""
    every, torque = terms(plain(2000), values(), PEAKS), 0.03 * 3.0
    units = {
        "R": 2.0,
        "L": 2.0 * DT_S,
        "B": torque / 200.0,
        "coulomb": torque,
        "load_square": torque / 200.0**2,
    }
    assert {name: every[name].unit for name in units} == pytest.approx(units)
    assert every["load_walk"].unit == pytest.approx(0.05 * torque / math.sqrt(2000 * DT_S))
    assert [every[name].high * DT_S for name in ("sensor_lag", "speed_lag")] == pytest.approx([0.01, 0.1])
    assert every["R"].value(0.3) == pytest.approx(2.0 * math.exp(0.3))
    assert every["L"].value(0.3) == pytest.approx(0.3 * 2.0 * DT_S)
    alone = terms(plain(500).only(current=False, speed=True), values(), PEAKS)
    assert alone["coulomb"].unit == pytest.approx(0.03 * 12.0 / 2.0)
    blind = terms(plain(500).only(current=True, speed=False), values(), PEAKS)
    assert blind["coulomb_knee"].unit == 400.0
    weak = terms(plain(500), values(), (12.0, 1e-9, 1e-9))
    assert (weak["offset_current"].unit, weak["coulomb_knee"].unit) == pytest.approx((0.006, 0.4))


@pytest.mark.parametrize(("volts", "most_v"), [(2.0, 0.8), (12.0, 1.5), (60.0, 1.5), (61.0, 2.5)])
def test_brushes_take_no_more_than_physics_allows(volts: float, most_v: float) -> None:
    term = terms(plain(500), values(), (volts, 3.0, 200.0))["brush_drop"]
    assert term.value(term.high) == pytest.approx(most_v)
    assert (None if term.bound is None else term.bound.most) == (None if volts == 2.0 else most_v)
    stated = terms(replace(plain(500), brush_drop_v=3.0), values(), (volts, 3.0, 200.0))["brush_drop"]
    assert stated.value(stated.high) == pytest.approx(min(3.0, 0.4 * volts))


@pytest.mark.parametrize(
    ("step", "low"), [(0.02, 0.02 / math.sqrt(12.0) / 0.2), (1e-4, math.exp(-5.0)), (9.0, 1.0)]
)
def test_no_noise_is_finer_than_the_steps_of_its_readings(step: float, low: float) -> None:
    shown = step * np.round(np.random.default_rng(2).uniform(-30.0, 30.0, (500, 2)))
    shown[7, 1] += 1e-12  # a rounding error is no step
    every = terms(replace(plain(500), readings=shown), values(NOISE_W=0.2), PEAKS)
    assert every["noise_speed"].low == pytest.approx(math.log(low))


def test_values_of_the_unknowns() -> None:
    known = values(DRAG=1.5)
    one = solution(worked(values()), ["R", "L"], known, np.array([math.log(1.1), 0.4]))
    found = one.problem.values(one.theta)
    assert found[index.R] == pytest.approx(2.2)
    assert found[[index.B, index.COULOMB]] == pytest.approx([3e-6, 0.003])
    assert found[index.L] == pytest.approx(math.hypot(0.4 * 2.0 * DT_S, 0.01 * 2.2 * DT_S))
    assert known[index.B] == 2e-6


def test_the_misfit_is_the_likelihood_at_the_best_noise_level() -> None:
    """-2 log likelihood of the innovations, the noises times a common factor, without its constant."""
    record = worked(values(), n=120)
    one = solution(record, LOGS, values(NOISE_V=0.01), np.array([0.02, -0.01, 0.03]))
    out, sums = record.predict(one.problem.values(one.theta))
    white, count = out[1:, :2], 2 * 119
    assert one.problem.count == count
    levels = np.geomspace(0.1, 1e3, 20_001)
    likelihoods = sums + count * np.log(levels**2) + np.sum(white**2) / levels**2 - count
    assert one.misfit == pytest.approx(likelihoods.min(), abs=1e-3)
    assert one.bic() == pytest.approx(one.misfit + 3.0 * math.log(count))
    level = math.sqrt(np.mean(out[:, :2] ** 2))
    assert one.values[[index.NOISE_I, index.NOISE_V]] == pytest.approx([level * 2e-3, level * 0.01])


def test_slopes_of_the_fit_are_central_differences(small: Solution) -> None:
    problem = small.problem
    for theta, chosen in ((small.theta, range(4)), (np.array([0.0, 0.0, 0.0, 2.0]), [3])):
        slopes = problem.jacobian(theta, problem.residuals(theta), chosen)
        wide = problem.secants(theta, list(chosen), np.full(len(chosen), 1e-5))
        for n, slope, secant in zip(chosen, slopes.T, wide.T, strict=True):
            side = 1e-5 * np.eye(4)[n]
            exact = (problem.residuals(theta + side) - problem.residuals(theta - side)) / 2e-5
            size = np.abs(exact).max()
            np.testing.assert_allclose(slope, exact, atol=0.02 * size)
            np.testing.assert_allclose(secant, exact, atol=(1e-6 if n in range(3) else 0.02) * size)


TESTED = ("gear_loss", "load_square", "sensor_lag", "speed_lag", "supply_resistance")


@pytest.mark.parametrize(
    ("change", "lacking"),
    [
        ({}, set()),
        ({"hold": "late"}, {"supply_resistance"}),
        ({"recorded": np.array([1.0, 0.0])}, {"gear_loss", "speed_lag"}),
        ({"recorded": np.array([0.0, 1.0])}, {"gear_loss", "load_square", "sensor_lag", "supply_resistance"}),
    ],
)
def test_terms_that_a_record_may_tell(small: Solution, change: dict[str, Any], lacking: set[str]) -> None:
    problem = replace(small.problem, record=replace(small.problem.record, **change))
    assert set(candidates(replace(small, problem=problem))) == set(TESTED) - lacking
    without = replace(small, problem=replace(problem, without=("sensor_lag",)))
    assert "sensor_lag" not in candidates(without)


def one_step(of: Solution, term: Term, size: float) -> ScoreTest:
    """The step of the fit with a further term, by least squares on all columns at once."""
    base = of.problem.residuals(of.theta)
    moved = of.problem.with_terms([term]).residuals(np.append(of.theta, size))
    both = np.column_stack([of.problem.jacobian(of.theta, base), (np.delete(moved, len(base)) - base) / size])
    step = -np.linalg.lstsq(both, base, rcond=None)[0]
    spread = np.linalg.inv(both.T @ both) * float(base @ base) / of.problem.count
    value, sd = float(step[-1]), math.sqrt(spread[-1, -1])
    gain = 0.0 if term.low >= 0.0 and value < 0.0 else (value / sd) ** 2
    return ScoreTest(gain, value, sd, spread[:-1, -1] / spread[-1, -1])


def test_a_score_test_is_one_step_of_the_richer_fit(small: Solution) -> None:
    """Of several sizes, over the usual one and within the bounds, the most telling counts."""
    every, sizes = terms(small.problem.record, small.problem.known), (0.1, 1.0, 100.0)
    assert score_tests(small, every, ()) == {}
    found, sized = (score_tests(small, every, TESTED, given) for given in ((), sizes))
    for name in TESTED:
        term, test = every[name], found[name]
        expected = one_step(small, term, term.slope_at)
        assert (test.value, test.sd) == pytest.approx((expected.value, expected.sd), rel=1e-6)
        assert test.chi_square == pytest.approx(expected.chi_square, rel=1e-6)
        np.testing.assert_allclose(test.moves, expected.moves, rtol=1e-4, atol=1e-7)
        each = [one_step(small, term, min(size * term.usual, term.high)) for size in sizes]
        assert sized[name].chi_square == pytest.approx(max(one.chi_square for one in each), rel=1e-5)
    richer = solution(small.problem.record, [*small.names, "load_square"], small.problem.known)
    square = found["load_square"]
    assert square.chi_square > 10.0
    assert small.misfit - richer.misfit == pytest.approx(square.chi_square, rel=0.3)
    assert richer.theta[-1] == pytest.approx(square.value, rel=0.1)


def test_a_lag_is_tested_where_it_shows() -> None:
    """Where the current settles within an interval, a lag far below it hides: its slope at 0 would tell nothing."""
    quick = values(L=1e-4)  # twenty time constants of the winding an interval
    best = solution(worked(quick), LOGS, quick)
    test = score_tests(best, terms(best.problem.record, best.problem.known), ["sensor_lag"])["sensor_lag"]
    assert test.sd < 0.01
    assert abs(test.value) < 4.0 * test.sd


@pytest.mark.parametrize(
    ("beyond", "gain", "is_taken"), [(0.01, 6.01, True), (0.01, 5.99, False), (-0.01, 9.0, False)]
)
def test_a_term_is_taken_where_the_evidence_is_strong(
    beyond: float, gain: float, is_taken: bool, monkeypatch: pytest.MonkeyPatch, small: Solution
) -> None:
    """Its score lies beyond log(n) + 6, and its fit is better by 6 than the criterion asks."""
    by_count = math.log(small.problem.count)
    tests = {"sensor_lag": ScoreTest(by_count + 6.0 + beyond, 1.0, 0.1, np.zeros(4))}

    def solved(best: Solution, added: list[Term]) -> Solution:
        problem = best.problem.with_terms(added)
        return Solution(problem, np.append(best.theta, 0.0), best.misfit - by_count - gain)

    monkeypatch.setattr(fitting, "_refit", solved)
    monkeypatch.setattr(fitting, "score_tests", lambda best, *_: {} if "sensor_lag" in best.names else tests)
    assert ("sensor_lag" in fitting._grown(small).names) is is_taken


def straight() -> tuple[Line, FloatArray]:
    drawn = np.random.default_rng(4).standard_normal((600, 4))
    line = Line(drawn[:, :3] * [1.0, 3.0, 1.0], drawn[:, 3], ("R", "K", "noise_current"))
    return line, least_squares(line)


def test_errors_of_white_residuals_are_those_of_least_squares() -> None:
    """In any units; a direction of which nothing is known has a hopeless variance."""
    line, theta = straight()
    left = line.residuals(theta)
    expected = np.linalg.inv(line.design[:, :2].T @ line.design[:, :2]) * (left @ left) / 600
    assert motor_unknowns(cast("Any", line)) == [0, 1]
    for factors in ([1.0, 1.0], [1e6, 1e-3]):
        line.design[:, :2] *= factors
        scaled = theta / [*factors, 1.0]
        found = information_covariance(cast("Any", line), scaled, secants(cast("Any", line), scaled))
        np.testing.assert_allclose(found, expected / np.outer(factors, factors), rtol=1e-7)
    line.design[:, 1] *= 1e-3
    found = information_covariance(cast("Any", line), np.zeros(3), secants(cast("Any", line), np.zeros(3)))
    assert found[1, 1] == pytest.approx(1e6 * float(line.target @ line.target) / 600)


LEFT_OUT = ScoreTest(4.0, 0.5, 0.2, np.array([0.1, -0.3, 9.0]))
ODDS = 0.2 / math.hypot(0.2, 0.6) * math.exp(2.0)
SETTLED = 1.0 / (1.0 + 0.2**2)


@pytest.mark.parametrize(
    ("source", "tests", "size"),
    [
        # A term that was left out counts with its posterior probability, under its usual size of 0.6.
        ("score_tests", {"sensor_lag": LEFT_OUT}, ODDS / (1.0 + ODDS) * (0.5**2 + 0.2**2)),
        # What no term says is believed to be of size 1; the record settles a share of it. Rounding counts in full.
        ("unmodelled_effects", [LEFT_OUT], (SETTLED * 0.5) ** 2 + SETTLED * 0.2**2),
        ("quantisation_effects", [LEFT_OUT], 1.0),
    ],
)
def test_what_was_left_out_widens_the_errors(
    source: str, tests: Any, size: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, theta = straight()
    line.available_terms["sensor_lag"] = cast("Any", SimpleNamespace(usual=0.6))
    best = SimpleNamespace(
        problem=line, theta=theta, alternative_optima=(), misfit=10.0, free=(None, np.zeros((600, 4)))
    )
    monkeypatch.setattr(uncertainty, "_systematic_covariance", lambda *_: np.zeros((2, 2)))
    for name, nothing in (("score_tests", {}), ("unmodelled_effects", []), ("quantisation_effects", [])):
        monkeypatch.setattr(uncertainty, name, lambda *_, nothing=nothing: nothing)
    without = uncertainty.covariance(cast("Any", best))
    off = [np.array([0.2, 0.0, 5.0]), np.array([0.0, 0.1, 5.0])]
    best.alternative_optima = ((theta + off[0], 12.0), (theta - off[1], 11.0))
    shares = np.exp([-1.0, -0.5]) / (1.0 + np.exp([-1.0, -0.5]).sum())
    others = uncertainty.covariance(cast("Any", best)) - without
    np.testing.assert_allclose(others, np.diag(shares * [0.04, 0.01]), rtol=1e-7, atol=1e-12)
    best.alternative_optima = ()
    monkeypatch.setattr(uncertainty, source, lambda *_: tests)
    monkeypatch.setattr(uncertainty, "_systematic_covariance", lambda *_: np.diag([0.02, 0.03]))
    added = uncertainty.covariance(cast("Any", best)) - without
    expected = size * np.outer([0.1, -0.3], [0.1, -0.3]) + np.diag([0.02, 0.03])
    np.testing.assert_allclose(added, expected, rtol=1e-7, atol=1e-12)


def test_regressions_begin_near_the_motor() -> None:
    """Without noise, at fine steps: each of the three kinds finds what its channels tell."""
    p = values(L=4e-3, B=4e-5, COULOMB=0.001, NOISE_I=1e-9, NOISE_W=1e-9)
    record = worked(p, n=16_000, hold="straight", noise=0.0, dt_s=1e-4)
    told = [index.R, index.L, index.K, index.J]
    best = min(initial_values(record), key=lambda one: float(np.abs(np.log(one[told] / p[told])).sum()))
    np.testing.assert_allclose(best[told], p[told], rtol=0.02)
    assert best[[index.B, index.COULOMB]] == pytest.approx(p[[index.B, index.COULOMB]], rel=0.1)
    ratio, gain = 4e-6 / 0.03**2, 0.03 + 2.0 * 4e-5 / 0.03  # of the current alone, and of the speed
    near = min(
        initial_values(record.only(current=True, speed=False)),
        key=lambda one: abs(math.log(one[index.R] / 2.0)) + abs(math.log(one[index.J] / ratio)),
    )
    assert near[[index.R, index.K, index.J]] == pytest.approx([2.0, 1.0, ratio], rel=0.5)
    speeds = initial_values(record.only(current=False, speed=True))
    near = min(speeds, key=lambda one: abs(math.log(one[index.K] / gain)))
    expected = [gain, gain * 2.0 * 4e-6 / 0.03, gain * 2.0 * 0.001 / 0.03]
    assert near[[index.K, index.J, index.COULOMB]] == pytest.approx(expected, rel=0.3)
