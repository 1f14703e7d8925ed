"""What a wrong model adds to the errors of a fit: scores of parts of a record, what no term says; notches."""

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from recorded_motor import LOGS, Line, least_squares, plain, solution, values, worked
from scipy.linalg import sqrtm

from motor_env.diagnosis.estimation import parameter_index as index, uncertainty
from motor_env.diagnosis.estimation.model_selection import fit
from motor_env.diagnosis.estimation.problem import Problem, Solution, motor_unknowns
from motor_env.diagnosis.estimation.record import Record
from motor_env.diagnosis.estimation.uncertainty import (
    covariance,
    excess_covariance,
    model_error,
    normalised,
    sandwich,
    unmodelled_effects,
)
from motor_env.motor.parameters import FloatArray


def line(seed: int = 0, n: int = 400) -> Line:
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((n, 2)) * [0.05, 1.0]
    design[: n // 20, 0] = 1.0
    return Line(design, rng.standard_normal(n), ("R", "K"))


def told(of: Line) -> tuple[FloatArray, FloatArray]:
    return normalised(cast("Any", of), least_squares(of), of.design, range(of.design.shape[1]))


def both(of: Line) -> tuple[FloatArray, FloatArray]:
    """Covariance of a stationary series, and what the model's error adds."""
    series, _ = sandwich(*told(of))
    return series, model_error(*told(of), series, states=np.empty((len(of.design), 0)))


def test_scores_of_parts_are_scaled_as_bell_and_mccaffrey_have_it() -> None:
    of = line()
    of.target[:10] += 6.0
    series, found = both(of)
    design, left = of.design, of.residuals(least_squares(of))
    size = np.sqrt(left @ left / len(left))
    design, left = design / size, left / size
    weak = np.eye(2) / 9.0  # logarithms are known to 3 beforehand
    bread = np.linalg.inv(design.T @ design + weak)
    hat = design @ bread @ design.T
    told = np.cumsum(np.diag(hat))
    part = np.minimum((20.0 * told / told[-1]).astype(int), 19)
    expected = np.zeros((2, 2))
    for number in range(20):
        some = part == number
        scale = np.linalg.inv(np.real(sqrtm(np.eye(some.sum()) - hat[np.ix_(some, some)])))
        moved = bread @ design[some].T @ scale @ left[some]
        expected += np.outer(moved, moved)
    np.testing.assert_allclose(found, excess_covariance(series, expected), rtol=1e-3, atol=1e-9)
    assert found[0, 0] > 1.5 * series[0, 0]  # what no stationary series shows


def test_states_that_have_no_part_in_it_add_next_to_nothing() -> None:
    """Six unknowns, cut in time and by four states: chance alone would add a third and more."""
    added = []
    for rng in map(np.random.default_rng, range(8)):
        of = Line(rng.standard_normal((400, 6)), rng.standard_normal(400), tuple("RLKJBT"))
        series, in_time = both(of)
        by_state = model_error(*told(of), series, states=rng.standard_normal((400, 4)))
        added.append([np.trace(in_time) / np.trace(series), np.trace(by_state - in_time) / np.trace(series)])
    assert (np.mean(added, axis=0) < [0.5, 0.1]).all()


def test_an_error_that_follows_a_state_shows_under_a_periodic_command() -> None:
    """Every period errs alike: parts in time agree, and those of small to large current do not."""
    phase = 2.0 * np.pi * np.arange(1600) / 32.0
    current = np.cos(phase)
    design, noise = np.stack([current, np.sin(phase)], axis=1), np.random.default_rng(4).standard_normal(1600)
    for bent, seen in ((0.0, False), (2.0, True)):
        of = Line(design, noise + bent * np.cos(3.0 * phase), ("R", "K"))
        series, in_time = both(of)
        by_state = model_error(*told(of), series, states=current[:, None])
        assert np.trace(in_time) < np.trace(series)
        assert (np.trace(by_state) > 5.0 * np.trace(series)) == seen
        assert np.linalg.eigvalsh(by_state - in_time).min() > -1e-12


def lossy(gear: float = 0.0, brushes: float = 0.0, noise: float = 1.0, knee: float = 0.1) -> Record:
    """A record of the motor whose gear takes a share of its torque, and whose brushes resist small currents more."""
    p, record = values(), worked(values(), noise=0.0)
    shown = record.readings
    rng = np.random.default_rng(3)
    for _ in range(30):
        amps, current = np.quantile(np.abs(shown[:, 0]), 0.999), shown[:, 0]
        drop = (
            brushes * np.quantile(np.abs(record.voltage_v), 0.999) * current / (np.abs(current) + knee * amps)
        )
        one = plain(len(shown), record.voltage_v - drop, record.hold)
        free = one.predict(values(GEAR=gear), learn=False)[0][:, 2:4]
        shown = 0.7 * shown + 0.3 * free
    shown = shown + noise * rng.standard_normal(shown.shape) * p[[index.NOISE_I, index.NOISE_W]]
    return replace(record, readings=shown)


@pytest.mark.parametrize(("gear", "brushes"), [(0.0, 0.0), (0.035, 0.0), (0.0, 0.04)])
def test_what_real_motors_have_is_found_at_its_size(gear: float, brushes: float) -> None:
    found = unmodelled_effects(solution(lossy(gear, brushes), LOGS, values()))
    assert (
        unmodelled_effects(solution(worked(values()).only(current=False, speed=True), ["K"], values())) == []
    )
    for test, true in ((found[0], brushes / 0.04), (found[2], gear / 0.07)):
        assert test.sd < 0.2
        assert test.value == pytest.approx(true, abs=0.25)


def test_a_share_of_what_no_term_says_never_averages_away() -> None:
    """Of a record twice as long the same, 0.15 of the error; where the model is right next to nothing."""
    once = lossy(brushes=0.16, noise=0.01).only(current=True, speed=False)
    columns = {name: np.concatenate(2 * [getattr(once, name)]) for name in ("voltage_v", "readings", "marks")}
    best, long, right = (
        solution(each, ["R"], values()) for each in (once, replace(once, **cast("Any", columns)), lossy())
    )
    one, two, none = (uncertainty._systematic_covariance(each, [0])[0, 0] for each in (best, long, right))
    shown = best.free[1][:, 2]
    moved = once.predict(best.problem.values(best.theta + 1e-4), learn=False)[0][:, 2]
    expected = (
        0.15 * np.std(once.readings[:, 0] - shown) / np.sqrt(np.mean(np.square((moved - shown) / 1e-4)))
    )
    assert np.sqrt([one, two]) == pytest.approx([expected] * 2, rel=0.1)
    assert none < 0.01 * one


@pytest.mark.parametrize("chosen_on", [4000, 300])
def test_a_voltage_without_steps_may_be_timed_otherwise(
    chosen_on: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample late or early looks like a lag of L/R, here 0.5 ms with samples 2 ms apart; in long records, too."""
    monkeypatch.setattr("motor_env.diagnosis.estimation.model_selection.SELECTION_SAMPLES", chosen_on)
    p, at, rng = values(), np.arange(800.0), np.random.default_rng(2)
    waves = 6.0 * np.sin(2.0 * np.pi * at / 150.0) + 3.0 * np.sin(2.0 * np.pi * at / 67.0)
    for volts, is_open in ((waves, True), (np.repeat(rng.uniform(-9.0, 9.0, 40), 20), False)):
        record = plain(800, volts)
        clean = record.predict(p, learn=False)[0][:, 2:4]
        shown = clean + 10.0 * rng.standard_normal((800, 2)) * p[[index.NOISE_I, index.NOISE_W]]
        found = fit(replace(record, readings=shown))
        spread = covariance(found)
        row = motor_unknowns(found.problem).index(found.names.index("L"))
        told = found.problem.free[found.names.index("L")].unit * np.sqrt(spread[row, row])
        others = [found.problem.values(theta)[index.L] for theta, _ in found.alternative_optima]
        assert (max(others, default=0.0) > 3.0 * p[index.L]) == is_open
        assert (told > p[index.L]) == is_open


@pytest.mark.parametrize(("channel", "told"), [(0, "J"), (1, "K")])
def test_errors_allow_for_what_the_steps_of_a_reading_hide(
    channel: int, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = lossy()
    step = 0.1 * record.peaks[1 + channel]
    cut = record.readings.copy()
    cut[:, channel] = step * np.trunc(cut[:, channel] / step)
    coarse = replace(record, readings=cut)
    assert coarse.steps[channel] == pytest.approx(step)
    wrong = solution(coarse, LOGS, values())
    at = wrong.names.index(told)
    allowed = abs(wrong.theta[at]) / math.sqrt(covariance(wrong)[at, at])
    monkeypatch.setattr(uncertainty, "quantisation_effects", lambda _: [])
    monkeypatch.setattr(uncertainty, "_FOLLOWS", 1e-6)
    assert 1.0 < allowed < 1.5
    assert abs(wrong.theta[at]) > 3.0 * math.sqrt(covariance(wrong)[at, at])


BEST = np.array([0.02, 0.03, 0.01, 0.04])
DEPTH = 0.02
"""By how much the squares are larger outside of the notch of each unknown, as a share."""


@pytest.fixture
def caught(monkeypatch: pytest.MonkeyPatch) -> Solution:
    """R, K, J and a load; the smallest squares are far off, but the fit is in a notch at 0."""
    one = solution(worked(values()), [*LOGS, "load_constant"], values())
    free = tuple(replace(term, low=-1e-3) for term in one.problem.free)
    one = replace(one, problem=replace(one.problem, free=free))
    readings = one.problem.count
    rng = np.random.default_rng(3)
    axes, _ = np.linalg.qr(rng.normal(size=(readings, 2 * len(BEST))))
    slopes, rest = axes[:, : len(BEST)] / 0.004, axes[:, len(BEST) :] * np.sqrt(readings / len(BEST))

    def residuals_each(problem: Problem, thetas: FloatArray) -> FloatArray:
        low, high = problem.bounds
        assert np.all((low <= thetas) & (thetas <= high))
        outside = np.sqrt(1.0 + DEPTH * (np.abs(thetas) > 5e-5))
        found: FloatArray = outside @ rest.T + (thetas - BEST) @ slopes.T
        return 2.0 * found

    monkeypatch.setattr(Problem, "residuals_each", residuals_each)
    at = np.zeros(len(BEST))
    squares = float(np.sum(one.problem.residuals(at) ** 2))
    return replace(one, theta=at, misfit=one.problem.misfit(squares), alternative_optima=((at, 1.0),))


def test_a_fit_leaves_a_notch(caught: Solution) -> None:
    stuck = caught.problem.solve(caught.theta)
    assert np.abs(stuck.theta).max() < 5e-5
    found = caught.escape_local_minimum()
    np.testing.assert_allclose(found.theta, BEST, atol=1e-4)
    assert found.misfit < caught.misfit - 50.0
    ((theta, misfit),) = found.alternative_optima
    assert theta is caught.theta
    assert misfit - found.misfit == pytest.approx(1.0 - caught.misfit)  # as far behind as before
    assert found.escape_local_minimum() is found
