"""A likelihood with jumps: fits that are caught in a notch go on from it, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from recorded_motor import LOGS, solution, values, worked

from motor_env.diagnosis.estimation import model_selection as fitting
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.uncertainty import secants
from motor_env.motor.parameters import FloatArray

BEST = np.array([0.02, 0.03, 0.01, 0.04])
DEPTH = 0.02
"""By how much the squares are larger outside of the notch of each unknown, as a share."""


@pytest.fixture
def caught(monkeypatch: pytest.MonkeyPatch) -> Solution:
    """R, K, J and a load, each known to 0.004 beside noise of 2.

    The smallest squares are far off, but the fit is in a notch at 0.
    """
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


def test_a_fit_stays_where_hardly_anything_is_promised(
    caught: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One standard error off costs 1; and what lies beyond the bounds is no promise."""
    tried: list[bool] = []

    def solve(_: Problem, theta: FloatArray, most: int, steps: FloatArray) -> Solution:
        np.testing.assert_allclose(steps, 0.004, rtol=0.02)  # a standard error
        tried.append(True)
        return caught

    monkeypatch.setattr(Problem, "solve", solve)
    for off, goes_on in ((0.0036, []), (0.0072, [True])):
        one = replace(caught, theta=BEST - np.array([0.0, 0.0, off, 0.0]), misfit=-1e9)
        assert one.escape_local_minimum() is one
        assert tried == goes_on
    bounded = tuple(replace(term, high=1e-3) for term in caught.problem.free)
    one = replace(caught, problem=replace(caught.problem, free=bounded), theta=np.full(len(BEST), 1e-3))
    assert one.escape_local_minimum() is one
    assert tried == [True]


def test_a_fit_that_gains_little_stays(caught: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    for gain, stays in ((0.9, True), (1.1, False)):
        other = replace(caught, theta=BEST, misfit=caught.misfit - gain)
        monkeypatch.setattr(Problem, "solve", lambda *_, found=other: found)
        assert (caught.escape_local_minimum() is caught) is stays


def test_a_fit_goes_on_until_nothing_is_promised(caught: Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was found may be in another notch."""
    halfway = replace(caught, theta=0.5 * BEST, misfit=caught.misfit - 2.0)
    found = [replace(caught, theta=BEST, misfit=caught.misfit - 4.0), halfway]
    monkeypatch.setattr(Problem, "solve", lambda *_: found.pop())
    assert caught.escape_local_minimum().theta is BEST
    assert not found


@pytest.mark.parametrize(("size", "step"), [(1e-9, 0.1), (1e9, 0.001)])
def test_wide_steps_stay_between_a_thousandth_and_a_tenth(
    size: float, step: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unknowns of which nothing is known, or all."""
    problem, taken = solution(worked(values()), LOGS, values()).problem, []
    slopes = size * np.random.default_rng(5).normal(size=(len(problem.residuals(np.zeros(3))), 3))

    def over(_: Problem, __: FloatArray, ___: list[int], steps: FloatArray) -> FloatArray:
        taken.append(steps)
        return slopes

    monkeypatch.setattr(Problem, "jacobian", lambda *_: slopes)
    monkeypatch.setattr(Problem, "secants", over)
    secants(problem, np.zeros(3))
    np.testing.assert_allclose(taken, step, rtol=1e-9)


def test_the_smallest_model_escapes_local_minima(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Solution, "escape_local_minimum", lambda one: replace(one, misfit=-1234.5))
    assert fitting._smallest_model(worked(values())).misfit == -1234.5
