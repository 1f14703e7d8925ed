"""The tests of a judgement, each alone on hand-made differences: shares of a rate, explanations, probabilities."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from judged_by_hand import EXPONENTS, RATE, difference, fitted, spread
from scipy import integrate, stats

from motor_env import (
    FaultKind,
)
from motor_env.diagnosis.verdict.decision import alarm_limits
from motor_env.diagnosis.verdict.hypotheses import (
    alarm_share,
    compare,
    explain,
    form_hypotheses,
    is_separable,
    joint_share,
    probabilities,
    severity_of,
    smallest_changes,
)

# Reaches in: faults move a fit in directions that no public name gives.
from motor_env.motor.identifiable import matrix, nameable_kinds, visible_direction
from motor_env.motor.parameters import FloatArray

PARAMETERS_MOVED = (EXPONENTS[:, :5] * np.square([0.025, 0.02, 0.02, 0.1, 0.1])) @ EXPONENTS[:, :5].T
"""Covariance of the quantities where R, L, K, J and B move beside a fault of the size e."""


def beside_a_fault(kind: str, step: float) -> FloatArray:
    """Covariance of what a fault moves beside it.

    R by 0.025 of the step, L and K by 0.02, J and B by 0.1; L by 0.3 of what R moves, which contact and shorted turns
    do by 1.
    """
    lag = np.zeros((4, 4))
    lag[1, 1] = 0.0 if kind == "bearing" else (0.3 * step) ** 2
    return np.asarray(step**2 * PARAMETERS_MOVED + lag)


def test_tests_share_the_rate_of_false_alarms() -> None:
    """Three faults of the current alone, four of R, K, J and the drag; the noise and the whole."""
    assert alarm_share(0.01, EXPONENTS) == pytest.approx(0.01 / 5.0)
    assert alarm_share(0.01, matrix(("R", "K", "J", "B"))) == pytest.approx(0.01 / 6.0)


@pytest.mark.parametrize("tests_noise", [False, True])
def test_the_noise_has_its_share_and_the_motor_the_rest(tests_noise: bool) -> None:
    """The noise is told apart from the motor: its share is taken off the rate first."""
    _, fit, reference = fitted()
    views = form_hypotheses(fit, replace(reference, degrees_of_freedom=7.0), RATE)
    found = alarm_limits(views, RATE, tests_noise=tests_noise)
    left = 0.8 * RATE if tests_noise else RATE
    assert found.share == joint_share(left, views[0].difference.covariance, EXPONENTS, 7.0)
    expected = [float(stats.t.isf(share, 7.0)) for share in (found.share, RATE / 5.0)]
    assert (found.z, found.noise_z) == pytest.approx(tuple(expected))
    # Four tests of the motor share what is left: at least equally, and none has more than all of it.
    assert left / 4.0 <= found.share <= left


@pytest.mark.parametrize(("rate", "freedom"), [(0.05, 12.0), (0.001, 40.0)])
def test_the_joint_share_of_the_tests_by_integration(rate: float, freedom: float) -> None:
    """Two quantities, one fault each: the region without an alarm is a square cut off in a circle, in polar form."""
    exponents = matrix(("R/B", "K/B"))  # a bearing fault looks like a load there
    share = joint_share(rate, np.diag([0.01, 0.04]), exponents, freedom)
    limit, radius = stats.t.isf(share, freedom), math.sqrt(2.0 * stats.f.isf(share, 2, freedom))
    assert [str(kind) for kind in nameable_kinds(exponents)] == ["winding_contact", "magnet"]
    axes = [visible_direction(kind, exponents) for kind in nameable_kinds(exponents)]
    whitened = [axis / [0.1, 0.2] for axis in axes]
    units = np.array([axis / np.linalg.norm(axis) for axis in whitened])
    angle = np.linspace(0.0, 2.0 * math.pi, 20_001)[:-1]
    along = np.maximum((units @ [np.cos(angle), np.sin(angle)]).max(axis=0), 1e-9)
    least = np.minimum(limit / along, radius)
    assert np.mean(stats.f.sf(least**2 / 2.0, 2, freedom)) == pytest.approx(rate, rel=0.02)


def test_explanations_of_a_difference_by_hand() -> None:
    covariance, off = spread(4), np.array([0.3, -0.05, 0.02, 0.4])
    inverse = np.linalg.inv(covariance)
    for response in (None, EXPONENTS * 1.5):
        given = replace(difference(off, covariance), response=response)
        found = {str(one.kind): one for one in explain(given)}
        assert set(found) == {"bearing", "winding_contact", "winding_short"}
        for name, one in found.items():
            g = visible_direction(FaultKind(name), EXPONENTS if response is None else response)
            information = g @ inverse @ g
            assert one.step == pytest.approx(g @ inverse @ off / information)
            assert one.step_sd == pytest.approx(information**-0.5)
            assert one.z == pytest.approx(one.step / one.step_sd)
            beside = covariance + beside_a_fault(name, one.step)
            np.testing.assert_allclose(one.covariance, beside, rtol=1e-12)
            rest = off - one.step * g
            p_value = stats.f.sf(rest @ np.linalg.solve(beside, rest) / 3.0, 3, 9.0)
            assert one.p_left_over == pytest.approx(p_value, rel=1e-9)
            assert one.severity == pytest.approx(FaultKind(name).severity(one.step))
    whole = difference(off, covariance)
    assert whole.squared_distance == pytest.approx(off @ inverse @ off)
    assert whole.p_value(9.0, 4) == pytest.approx(stats.f.sf(9.0 / 4.0, 4, 9.0))
    assert (whole.p_value(9.0, 0), whole.p_value(-1.0, 3)) == (1.0, 1.0)
    assert severity_of(FaultKind.BEARING, 99.0) == pytest.approx(math.expm1(30.0))
    invisible = replace(whole, response=0.5e-3 * EXPONENTS)
    assert [str(one.kind) for one in explain(invisible)] == [
        "winding_short"
    ]  # of length 1.5; the others of 0.5, times 1e-3


@pytest.mark.parametrize(("step", "beyond"), [(2.2, 2.2), (2.31, math.log(10.0)), (12.0, math.log(10.0))])
def test_a_fault_may_move_no_more_beside_it_than_a_tenfold_one(step: float, beyond: float) -> None:
    """A friction that healthy starts did not tell has any size, and would excuse a resistance twice as large."""
    direction = visible_direction(FaultKind.BEARING, EXPONENTS)
    (found,) = explain(difference(step * direction, spread(4)), (FaultKind.BEARING,))
    expected = spread(4) + beyond**2 * PARAMETERS_MOVED
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-12)


def test_the_smallest_change_is_found_in_95_of_100_cases() -> None:
    """A step as far beyond the limit as 0.95 of the normal distribution."""
    given = difference(np.zeros(4), spread(4))
    sizes = {str(one.kind): one.step_sd for one in explain(given)}
    for kind, severity in smallest_changes(given, 3.0).items():
        step = (3.0 + stats.norm.isf(0.05)) * sizes[kind]
        assert severity == pytest.approx(float(FaultKind(kind).severity(step)), rel=2e-4)


def test_a_fault_is_its_own_where_the_winding_alone_shows_it() -> None:
    """Shorted turns move R by one and L by two: along both they lie 1.645 standard deviations out."""
    covariance = np.diag([0.01, 0.04, 0.01, 0.01])
    part = np.array([-1.0, -2.0])
    sd = (part @ np.linalg.inv(covariance[:2, :2]) @ part) ** -0.5
    for z, expected in ((1.64, False), (1.65, True)):
        off = np.array([*(z * sd * part), -0.3, 0.0])
        assert is_separable(difference(off, covariance), FaultKind.WINDING_SHORT) is expected
        assert is_separable(difference(off, covariance), FaultKind.BEARING)


def test_intervals_of_changes_hold_95_of_100() -> None:
    off, covariance = np.array([0.1, -0.2]), np.diag([0.0025, 0.01])
    one, other = compare(("R", "B"), off, covariance, 7.0, 2.0 * (1.0 + 1e-9), is_alarm=True)
    half = stats.t.isf(0.025, 7.0)
    assert (one.ratio, one.low, one.high) == pytest.approx(
        np.exp([0.1, 0.1 - 0.05 * half, 0.1 + 0.05 * half])
    )
    assert (other.low, other.high) == pytest.approx(np.exp([-0.2 - 0.1 * half, -0.2 + 0.1 * half]))
    assert (one.significant, other.significant) == (False, False)
    assert all(c.significant for c in compare(("R", "B"), off, covariance, 7.0, 1.999, is_alarm=True))
    (far,) = compare(("R",), np.array([99.0]), np.eye(1), 7.0, 3.0, is_alarm=False)
    assert (far.ratio, far.verdict) == (math.exp(30.0), "undecided")


def test_a_quantity_is_undecided_where_its_doubling_might_not_show() -> None:
    """A doubling is found in 95 of 100 cases where the limit and 1.645 deviations lie below log 2."""
    widest = math.log(2.0) / (3.0 + 1.645)
    names_, covariance = ("R", "L", "K", "B"), np.diag(np.array([0.999, 1.001, 1.001, 0.999]) * widest) ** 2
    off = np.array([0.0, 0.0, -3.01 * widest, 3.01 * widest])
    for is_alarm, expected in (
        (True, ["healthy", "undecided", "moved", "moved"]),
        (False, ["healthy", "undecided", "undecided", "healthy"]),
    ):
        found = compare(names_, off, covariance, 7.0, 3.0, is_alarm=is_alarm)
        assert [one.verdict for one in found] == expected
        assert [one.significant for one in found] == [word == "moved" for word in expected]


@pytest.mark.parametrize(
    ("off", "told"),
    [
        ((0.25, 0.02, 0.03, 0.25), ("bearing", "winding_contact")),
        ((-0.2, -0.42, -0.4, 0.02), ("winding_short",)),
    ],
)
def test_probabilities_by_integration(off: tuple[float, ...], told: tuple[str, ...]) -> None:
    """Healthy 0.8 beforehand; each fault and something else share the rest; a severity is half-Cauchy of 0.3.

    Beside a fault the parameters may move, see `beside_a_fault`, by its best step. Faults that do not show at all
    are summed coarsely, and left out here.
    """
    covariance, at = 4.0 * spread(4), np.array(off)
    given = replace(difference(at, covariance), degrees_of_freedom=9.7)
    healthy = stats.multivariate_t(np.zeros(4), covariance, df=9)
    weights: dict[str, Any] = {"healthy": 0.8 * healthy.pdf(at)}
    steps = {str(one.kind): one.step for one in explain(given)}
    for kind in told:
        g = visible_direction(FaultKind(kind), EXPONENTS)
        beside = covariance + beside_a_fault(kind, steps[kind])
        faulty = stats.multivariate_t(np.zeros(4), beside, df=9)

        def density(step: float, g: FloatArray = g, faulty: Any = faulty) -> float:
            return float(faulty.pdf(at - step * g) * stats.halfcauchy.pdf(step, scale=0.3))

        weights[kind] = 0.05 * integrate.quad(density, 0.0, 3.0, limit=200)[0]
    weights["other"] = 0.05 * stats.multivariate_t(np.zeros(4), covariance + 0.09 * np.eye(4), df=9).pdf(at)
    found = probabilities(given, explain(given))
    for name, weight in weights.items():
        assert found[name] / found["healthy"] == pytest.approx(weight / weights["healthy"], rel=3e-3), name
    assert sum(found.values()) == pytest.approx(1.0)
