"""What is decided on a fit, and from which border on: faults, noise, warmth, what is undecided, what is unusable."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from judged_by_hand import CURRENT, EXPONENTS, RATE, difference, fitted, judged, moved, of_one, spread
from present import present
from scipy import integrate, stats

from motor_env import FaultKind, Verdict
from motor_env.diagnosis.diagnose import explain_unusable
from motor_env.diagnosis.verdict import report_text
from motor_env.diagnosis.verdict.decision import alarm_limits, decide
from motor_env.diagnosis.verdict.hypotheses import (
    compare,
    covariance_at_one_temperature,
    explain,
    form_hypotheses,
    joint_share,
    probabilities,
    severity_of,
    smallest_changes,
)
from motor_env.diagnosis.verdict.judgement import NOTHING_ELSE, Judgement
from motor_env.filters.consistency import check_consistency

# Reaches in: fits are moved by hand in directions that no public name gives.
from motor_env.motor.identifiable import matrix, nameable_kinds, visible_direction
from motor_env.motor.parameters import FloatArray


def border(kind: str, freedom: float) -> tuple[FloatArray, float]:
    """A step along a fault at the limit of its test, and the standard deviation of the step."""
    _, fit, reference = fitted()
    covariance = covariance_at_one_temperature(fit, replace(reference, includes_fit_error=True))
    g = visible_direction(FaultKind(kind), EXPONENTS)
    sd = (g @ np.linalg.inv(covariance) @ g) ** -0.5
    share = joint_share(0.8 * RATE, covariance, EXPONENTS, freedom)  # the noise has a fifth
    return stats.t.isf(share, freedom) * sd * g, float(sd)


@pytest.mark.parametrize(
    ("kind", "verdict"), [("bearing", Verdict.BEARING), ("winding_contact", Verdict.WINDING)]
)
def test_a_fault_is_called_from_the_limit_of_its_test_on(kind: str, verdict: Verdict) -> None:
    freedom = 7.0
    at, sd = border(kind, freedom)
    for size, expected in ((0.995, Verdict.HEALTHY), (1.005, verdict)):
        found = moved(*(size * at), degrees_of_freedom=freedom, own_friction=0.8)
        assert found.verdict is expected
    step, half = float(1.005 * at.sum()), stats.t.isf(0.025, freedom) * sd
    own = 0.8 if kind == "bearing" else 1.0
    expected_size = [math.expm1(one) / own for one in (step, step - half, step + half)]
    assert [found.severity, *(found.severity_interval or ())] == pytest.approx(expected_size)
    assert str(found.fault_kind) == kind
    assert found.reference is not None
    view = form_hypotheses(fitted()[1], found.reference, RATE)[0]
    told = probabilities(view.difference, view.faults)
    kinds = [name for name in told if name == kind or (verdict is Verdict.WINDING and "winding" in name)]
    assert found.confidence == pytest.approx(sum(told[name] for name in kinds))
    assert found.kind_probability == pytest.approx(told[kind])
    assert moved(*(0.995 * at), degrees_of_freedom=freedom).confidence is not None
    for probability, sure_kind in ((0.949, None), (0.951, kind)):
        one = replace(judged(), pieces=(replace(found, kind_probability=probability),))
        assert (one.kind, report_text.as_json(one)["kind"]) == (sure_kind, sure_kind)


@pytest.mark.parametrize(
    ("off", "named"),
    [
        ((0.25, 0.0, 0.0, 0.5), ["bearing", "winding"]),
        ((-0.15, -0.3, -0.3, 0.5), ["bearing", "winding"]),  # shorted turns
        ((0.25, 0.0, 0.0, 0.0), ["winding"]),
        ((0.0, 0.0, 0.0, 0.5), ["bearing"]),
        ((0.25, 0.0, -0.3, 0.5), ["other"]),
        ((0.25, 0.0, 0.0, 2.5), ["other"]),  # friction of no wear
    ],
)
def test_two_faults_at_once_are_named_both(off: tuple[float, ...], named: list[str]) -> None:
    """Each where it is significant beside the other, and both together explain what one does not."""
    found = moved(*off)
    assert [str(fault.verdict) for fault in (found, *found.also)] == named
    if len(named) == 2:
        sizes = {str(fault.fault_kind): fault for fault in (found, *found.also)}
        assert sizes["bearing"].severity == pytest.approx(math.expm1(off[3]), rel=0.02)
        for fault in (found, *found.also):
            low, high = fault.severity_interval or (1.0, 0.0)
            assert low < (fault.severity or 0.0) < high
            assert 0.5 < (fault.confidence or 0.0) <= 1.0
        assert not any(NOTHING_ELSE in reason for reason in found.reasons)
        told, text = report_text.as_json(of_one(also=found.also)), report_text.headline(found)
        assert [each["verdict"] for each in told["also"]] == named[1:]
        assert "; also " in text


def test_no_two_faults_are_named_that_no_interval_shows() -> None:
    """Errors that R, K^2/J and B/J share hide both in the table; only together they would show."""
    shared = np.array([1.0, 0.0, 1.0, 1.0])
    given = 0.02**2 * np.eye(4) + 0.3**2 * np.outer(shared, shared)
    found = moved(0.25, 0.0, 0.0, 0.4, log_covariance=given)
    assert not any(change.excludes_healthy for change in found.changes)
    assert found.verdict.is_fault
    assert found.also == ()


def test_drag_far_above_a_data_sheet_is_first_a_coupled_machine() -> None:
    """Believed beforehand: a machine brakes as often, five times the motor's own friction, give or take e."""
    for size, is_first in ((0.3, False), (2.0, True)):
        found = moved(0.0, 0.0, 0.0, math.log1p(size), is_bare=True)
        taught = moved(0.0, 0.0, 0.0, math.log1p(size))
        assert found.verdict is taught.verdict is Verdict.BEARING
        machine = stats.norm.pdf(math.log(size / 5.0)) * (1.0 + size) / size
        bearing = 2.0 / (math.pi * 0.3) / (1.0 + (math.log1p(size) / 0.3) ** 2)
        share = present(found.confidence) / present(taught.confidence)
        assert share == pytest.approx(bearing / (machine + bearing), rel=1e-3)
        assert ("motor-env commission start1.csv" in found.reasons[0]) is is_first
        assert not any("coupled machine" in reason for reason in taught.reasons)
    for off, is_loaded in (((0, 0, -0.4, 0.8), True), ((0, 0, 0, -0.6), False), ((0.3, 0, -0.4, 0.8), False)):
        loaded = moved(*off, is_bare=True)
        assert loaded.verdict is Verdict.OTHER
        assert ("coupled machine" in loaded.reasons[0]) is is_loaded


def test_a_noise_is_called_from_its_limit_on() -> None:
    freedom, sd = 7.0, 0.12
    limit = stats.t.isf(RATE / 5.0, freedom) * sd
    for size, expected in ((0.999, Verdict.HEALTHY), (1.001, Verdict.NOISE)):
        found = moved(0, 0, 0, 0, noise=size * limit, degrees_of_freedom=freedom, log_noise_sd=sd)
        assert found.verdict is expected
    ratio = math.exp(1.001 * limit)
    assert found.severity == pytest.approx(ratio**2 - 1.0)
    assert found.confidence == pytest.approx(stats.t.cdf(1.001 * limit / sd, freedom))
    assert found.reasons == (
        f"the parameters are as expected, but the current's noise is {ratio:.2f} times the reference's",
    )
    assert moved(0, 0, 0, 0, noise=9.0, log_noise=None).verdict is Verdict.HEALTHY


def test_a_noise_is_not_compared_with_a_sheet_where_the_sensor_changes_what_it_shows() -> None:
    """Steps as large as the noise and a zone without current do; healthy starts had the same sensor."""
    _, fit, reference = fitted()
    quiet: dict[str, Any] = {"log_values": fit.log_values, "log_noise": math.log(fit.noise_a) - 1.0}
    coarse = replace(fit.start, alignment=replace(fit.start.alignment, quantum_a=fit.noise_a))
    for seen in (replace(fit, model=("dead_zone",)), replace(fit, start=coarse)):
        for is_taught, expected in ((False, Verdict.HEALTHY), (True, Verdict.NOISE)):
            given = replace(reference, **quiet, includes_fit_error=is_taught)
            assert decide(seen, given, RATE).verdict is expected
            assert decide(fit, given, RATE).verdict is Verdict.NOISE


def doubled(friction: float, resistance: float) -> Judgement:
    """A healthy start whose noise hides a doubling along these in 95 of 100 cases, times these factors.

    The error of its model is larger, but healthy starts have the same.
    """
    _, fit, reference = fitted()
    share = joint_share(0.8 * RATE, np.eye(4), EXPONENTS, 1e6)
    unit = math.log(2.0) / (stats.norm.isf(share) + 1.645)
    white = np.diag([resistance, 1e-3, 1e-3, friction]) ** 2 * unit**2
    white_share = fit.white_covariance[0, 0] / fit.series_covariance[0, 0]
    wide = replace(fit, log_covariance=100.0 * np.eye(4), series_covariance=white / white_share)
    given = replace(
        reference, log_values=fit.log_values, log_covariance=1e-3 * np.eye(4), includes_fit_error=True,
        own_friction=1.0,
    )  # fmt: skip
    return decide(wide, given, RATE)


@pytest.mark.parametrize(
    ("friction", "resistance", "unseen"),
    [
        (0.99, 0.99, []),
        (1.01, 0.99, ["friction"]),
        (0.99, 1.01, ["resistance"]),
        (1.01, 1.01, ["friction", "resistance"]),
    ],
)
def test_a_start_that_hides_a_doubled_friction_says_so_and_one_that_hides_all_is_not_called_healthy(
    friction: float, resistance: float, unseen: list[str]
) -> None:
    """A friction twice as large is found in 95 of 100 cases where (limit + 1.645) deviations are log 2."""
    found = doubled(friction, resistance)
    said = [one for one in found.reasons if "is undecided" in one]
    assert [one.split()[1] for one in said] == unseen
    assert all(one.endswith("or too short to decide it, only a rise of 101% would show") for one in said)
    verdict, severity = (Verdict.UNUSABLE, None) if len(unseen) == 2 else (Verdict.HEALTHY, 0.0)
    assert (found.verdict, found.severity, found.confidence is None) == (verdict, severity, len(unseen) == 2)


@pytest.mark.parametrize(
    ("rows", "unseen"), [([0, 1], ["friction"]), ([3], ["resistance"]), ([1], ["friction", "resistance"])]
)
def test_what_cannot_be_compared_is_undecided(rows: list[int], unseen: list[str]) -> None:
    """The reference speaks of fewer quantities than the fit tells; of L alone it is none."""
    _, fit, reference = fitted()
    known = replace(
        reference,
        names=tuple(CURRENT[row] for row in rows),
        log_values=fit.log_values[rows],
        log_covariance=reference.log_covariance[np.ix_(rows, rows)],
    )
    found = decide(fit, known, RATE)
    said = [f"the {word} is undecided: it cannot be compared with {reference.source}" for word in unseen]
    assert list(found.reasons[-len(unseen) :]) == said
    assert found.verdict == ("unusable" if len(unseen) == 2 else "healthy")
    assert [change.name for change in found.changes] == list(known.names)


@pytest.mark.parametrize(("noise", "least"), [(1e-3, 0.75), (1.0, 0.375), (9.0, 0.3)])
@pytest.mark.parametrize("channel", ["r2_current", "r2_speed"])
def test_a_fit_that_explains_too_little_is_unusable(channel: str, noise: float, least: float) -> None:
    """Three quarters of what is no noise: half of a channel's variance may be, and more than 60 % never count so."""
    _, fit, _ = fitted()
    moves, count = np.repeat([1.0, -1.0], 20_000), np.arange(40_000) < 30_000
    shown = moves + noise * np.random.default_rng(2).standard_normal(40_000)
    current = 0.5 * moves + np.where(count, shown, 1e6)
    known = {"alignment": fit.start.alignment, "counted": count, "is_coupled": False, "speed_rad_s": shown}
    start = SimpleNamespace(**known, ripple_a=0.5 * moves, current_a=current)
    for off, is_refused in ((-0.04, True), (0.04, False)):
        given = {"r2_current": 1.0, "r2_speed": None, "coupling_per_s": None, channel: least + off}
        fake: Any = SimpleNamespace(start=start, log_covariance=fit.log_covariance, **given)
        assert (explain_unusable(fake) is not None) is is_refused
    untold = replace(fit, log_covariance=1.02 * np.eye(4))  # no quantity to a factor of e
    assert "too short or too noisy" in present(explain_unusable(untold))


def test_innovations_are_what_the_fit_leaves_over_the_noise() -> None:
    """Of white noise they are white and of size 1; whatever the piece, the same tests judge them."""
    found, fit, _ = fitted()
    driven = int(np.sum(fit.start.time_s <= fit.onset_s)) + 1
    np.testing.assert_allclose(fit.whitened[:, 0], fit.residual_a[driven:] / fit.noise_a)
    assert found.consistency == check_consistency(fit.whitened)
    assert found.consistency is not None
    assert found.consistency.holds
    assert found.consistency.mean_square == pytest.approx(1.0, abs=0.1)
    early = replace(fit, start=replace(fit.start, time_s=fit.start.time_s - 1.0))  # all lies before the onset
    assert [replace(found, fit=few).consistency for few in (None, early)] == [None, None]


PARAMETERS_MOVED = (EXPONENTS[:, :5] * np.square([0.025, 0.02, 0.02, 0.1, 0.1])) @ EXPONENTS[:, :5].T
"""Covariance of the quantities where R, L, K, J and B move beside a fault of the size e."""


def beside_a_fault(kind: str, step: float) -> FloatArray:
    """Covariance of what a fault moves beside it.

    R by 0.025 of the step, L and K by 0.02, J and B by 0.1; L by 0.3 of what R moves, as contact and shorted turns do.
    """
    lag = np.zeros((4, 4))
    lag[1, 1] = 0.0 if kind == "bearing" else (0.3 * step) ** 2
    return np.asarray(step**2 * PARAMETERS_MOVED + lag)


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


def test_the_smallest_change_is_found_in_95_of_100_cases() -> None:
    """A step as far beyond the limit as 0.95 of the normal distribution."""
    given = difference(np.zeros(4), spread(4))
    sizes = {str(one.kind): one.step_sd for one in explain(given)}
    for kind, severity in smallest_changes(given, 3.0).items():
        step = (3.0 + stats.norm.isf(0.05)) * sizes[kind]
        assert severity == pytest.approx(float(FaultKind(kind).severity(step)), rel=2e-4)
