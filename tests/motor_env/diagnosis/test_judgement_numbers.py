"""Parts of a judgement on starts, each alone on hand-made fits: spreads, quantiles, borders, probabilities, words."""

import json
import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import integrate, stats

from motor_env import (
    PAPER_MOTOR,
    Diagnosis,
    FaultKind,
    InputError,
    Motor,
    Recording,
    Scenario,
    SensorParameters,
    Timing,
    Verdict,
    diagnose,
    load_motor,
    read_recording,
    simulate,
)
from motor_env.cli import main
from motor_env.console import ExitStatus, worst
from motor_env.diagnosis import commission, motor_files
from motor_env.diagnosis.decision import decide, limits_of
from motor_env.diagnosis.diagnose import unusable_reason
from motor_env.diagnosis.explanations import (
    Change,
    Difference,
    alarm_share,
    compare,
    explain,
    is_its_own,
    joint_share,
    probabilities,
    severity_of,
    smallest_changes,
)
from motor_env.diagnosis.files import picture_of
from motor_env.diagnosis.healthy_motor import Reference, beyond, reference_of, reference_of_pieces, warmer
from motor_env.diagnosis.identify import Identification
from motor_env.diagnosis.learning import disagreement, learn_starts, odd_one_out, the_next
from motor_env.diagnosis.shown import page, report
from motor_env.diagnosis.verdict import Judgement
from motor_env.diagnosis.views import covariance_at_one_temperature, smallest_of, unit_of, views_of
from motor_env.filters.consistency import check_consistency

# Reaches in: fits are altered by hand, and faults move them in directions that no public name gives.
from motor_env.fitting import places
from motor_env.fitting.starts.identified import Identified
from motor_env.motor.identifiable import matrix, nameable_kinds, names, visible_direction
from motor_env.motor.model import steady_state
from motor_env.motor.parameters import FloatArray
from motor_env.recordings.noise import difference_noise
from motor_env.recordings.periodic_lines import PeriodicLine
from motor_env.recordings.start import Circuit

EXAMPLES = Path(__file__).parents[3] / "examples"
SHEET = load_motor(EXAMPLES / "motor.toml")
CURRENT = names(has_voltage=True, has_speed=False)
EXPONENTS = matrix(CURRENT)
RATE = 0.01


@cache
def judged() -> Diagnosis:
    """A healthy start against the data sheet."""
    sensor = SensorParameters(current_noise_a=0.02)
    made = simulate(Scenario(PAPER_MOTOR, sensor=sensor, timing=Timing(duration_s=0.2, quiet_s=0.03)), 3, [0])
    recording = Recording(
        Path("start.csv"), made.time_s, made.measurements[0, 0], made.voltage_v[0], columns=("read so",)
    )
    return diagnose(recording, SHEET)


def fitted() -> tuple[Judgement, Identified, Reference]:
    found = judged().telling
    assert found.identified is not None
    assert found.reference is not None
    return found, found.identified, found.reference


def of_one(**changed: Any) -> Diagnosis:
    """The diagnosis of this recording, if its judgement were another."""
    return replace(judged(), pieces=(replace(judged().telling, **changed),))


def moved(*off: float, noise: float = 0.0, **changed: Any) -> Judgement:
    """The decision on this fit, if the healthy motor lay so far from it, in logarithms."""
    _, fit, reference = fitted()
    given = {"log_values": fit.log_values - np.array(off), "includes_fit_error": True, "own_friction": 1.0}
    given |= {"log_noise": math.log(fit.noise_a) - noise}
    return decide(fit, replace(reference, **given | changed), RATE)


def spread(n: int, seed: int = 3) -> FloatArray:
    root = np.tril(np.random.default_rng(seed).normal(0.0, 0.02, (n, n))) + 0.05 * np.eye(n)
    return np.asarray(root @ root.T)


def difference(ratios: FloatArray, covariance: FloatArray, freedom: float = 9.0) -> Difference:
    return Difference(ratios, covariance, EXPONENTS, freedom)


def test_the_next_of_several_healthy_ones() -> None:
    """The prior is worth four of them; the next one is off by its own spread and the mean's."""
    logs = np.array([[0.0, 1.0], [0.3, 1.2], [0.6, 0.5]])
    prior = np.array([[0.04, 0.01], [0.01, 0.09]])
    centre, covariance, freedom = the_next(logs, prior)
    assert centre == pytest.approx([0.3, 0.9])
    scatter = sum(np.outer(row - centre, row - centre) for row in logs)
    np.testing.assert_allclose(covariance, (scatter + 4.0 * prior) / 6.0 * 4.0 / 3.0)
    assert freedom == 6.0
    one = the_next(logs[:1], prior)
    np.testing.assert_allclose(one[1], prior * 2.0)
    assert one[2] == 4.0


def test_an_error_counts_as_far_as_it_is_beyond_the_healthy_spread() -> None:
    healthy = np.diag([1.0, 4.0])
    np.testing.assert_allclose(beyond(healthy, np.diag([3.0, 2.0])), np.diag([2.0, 0.0]), atol=1e-12)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]]) @ np.array([[2.0, 0.3], [0.0, 0.7]])
    found = beyond(turn @ healthy @ turn.T, turn @ np.diag([3.0, 2.0]) @ turn.T)
    np.testing.assert_allclose(found, turn @ np.diag([2.0, 0.0]) @ turn.T, atol=1e-12)


def test_a_known_temperature_spread_counts_in_the_ratio_of_the_quantiles() -> None:
    covariance, warmth = spread(3), np.array([0.06, 0.0, -0.015])
    ratio = stats.norm.isf(0.002) / stats.t.isf(0.002, 6.0)
    expected = covariance + ratio**2 * np.outer(warmth, warmth)
    np.testing.assert_allclose(warmer(covariance, warmth, 0.002, 6.0), expected, rtol=1e-9)


def test_tests_share_the_rate_of_false_alarms() -> None:
    """Three faults of the current alone, four of R, K, J and the drag; the noise and the whole."""
    assert alarm_share(0.01, EXPONENTS) == pytest.approx(0.01 / 5.0)
    assert alarm_share(0.01, matrix(("R", "K", "J", "B"))) == pytest.approx(0.01 / 6.0)


@pytest.mark.parametrize("tests_noise", [False, True])
def test_the_noise_has_its_share_and_the_motor_the_rest(tests_noise: bool) -> None:
    """The noise is told apart from the motor: its share is taken off the rate first."""
    _, fit, reference = fitted()
    views = views_of(fit, replace(reference, degrees_of_freedom=7.0), RATE)
    found = limits_of(views, RATE, tests_noise=tests_noise)
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
            rest = off - one.step * g
            p_value = stats.f.sf(rest @ inverse @ rest / 3.0, 3, 9.0)
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
        assert is_its_own(difference(off, covariance), FaultKind.WINDING_SHORT) is expected
        assert is_its_own(difference(off, covariance), FaultKind.BEARING)


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

    Faults that do not show at all are summed coarsely, and left out here.
    """
    covariance, at = 4.0 * spread(4), np.array(off)
    given = replace(difference(at, covariance), degrees_of_freedom=9.7)
    healthy = stats.multivariate_t(np.zeros(4), covariance, df=9)
    weights: dict[str, Any] = {"healthy": 0.8 * healthy.pdf(at)}
    for kind in told:
        g = visible_direction(FaultKind(kind), EXPONENTS)

        def density(step: float, g: FloatArray = g) -> float:
            return float(healthy.pdf(at - step * g) * stats.halfcauchy.pdf(step, scale=0.3))

        weights[kind] = 0.05 * integrate.quad(density, 0.0, 3.0, limit=200)[0]
    weights["other"] = 0.05 * stats.multivariate_t(np.zeros(4), covariance + 0.09 * np.eye(4), df=9).pdf(at)
    found = probabilities(given, explain(given))
    for name, weight in weights.items():
        assert found[name] / found["healthy"] == pytest.approx(weight / weights["healthy"], rel=3e-3), name
    assert sum(found.values()) == pytest.approx(1.0)


def test_the_data_sheet_as_a_reference() -> None:
    """Tolerances of R, L, K, J and B through the powers of each quantity; the supply acts like all per volt."""
    tolerance = replace(
        SHEET.tolerance,
        **dict(
            zip(
                ("resistance", "inductance", "constants", "inertia", "friction", "supply"),
                (np.arange(1, 7) / 100).tolist(),
                strict=True,
            )
        ),
        temperature_k=10.0,
    )
    found = reference_of(replace(SHEET, tolerance=tolerance), CURRENT)
    assert found is not None
    heat = 10.0 * np.array([0.00393, 0.0, -0.001, 0.0, 0.0, 0.0])
    motor = np.diag((np.arange(1, 7) / 100.0) ** 2) + np.outer(heat, heat)
    per_volt = np.array([-1.0, -1.0, -1.0, 0.0])  # of R/V, L/V, K^2/(J V) and B/J
    expected = EXPONENTS @ motor @ EXPONENTS.T + 0.06**2 * np.outer(per_volt, per_volt)
    np.testing.assert_allclose(found.log_covariance, expected, rtol=1e-9)
    p = SHEET.parameters
    k2 = p.back_emf_constant_v_s_per_rad * p.torque_constant_n_m_per_a
    values = [
        p.resistance_ohm,
        p.inductance_h,
        k2 / p.inertia_kg_m2,
        p.viscous_friction_n_m_s_per_rad / p.inertia_kg_m2,
    ]
    assert list(found.values.values()) == pytest.approx(values)
    assert (found.temperature_k, found.warmer_k, found.own_friction) == (0.0, 0.0, 1.0)
    noisy = reference_of(replace(SHEET, current_noise_a=0.05), names(has_voltage=True, has_speed=True))
    assert noisy is not None
    assert noisy.log_noise == pytest.approx(math.log(0.05))
    assert noisy.log_noise_sd == 0.10
    assert reference_of(SHEET, names(has_voltage=False, has_speed=False)) is None
    # Of a drag that is half over the speed, only B is half.
    other = reference_of(SHEET, ("R", "B"), friction=0.5)
    assert other is not None
    assert other.values == pytest.approx({"R": p.resistance_ohm, "B": 0.5 * p.viscous_friction_n_m_s_per_rad})


def fits(*logs: list[float], **changed: Any) -> list[Identified]:
    _, fit, _ = fitted()
    return [replace(fit, log_values=fit.log_values + np.array(each), **changed) for each in logs]


SCATTER = ([0.0, 0.1, 0.02, 0.0], [0.03, 0.0, 0.0, 0.1], [0.0, -0.1, 0.01, 0.05])


def test_healthy_starts_teach_the_next_one() -> None:
    given = fits(*SCATTER)
    learned = learn_starts(given)
    logs, error = np.array([fit.log_values for fit in given]), given[0].white_covariance
    centre, covariance, freedom = the_next(logs, np.eye(4) * 0.02**2 + error)
    assert learned.values == pytest.approx(np.exp(centre))
    np.testing.assert_allclose(learned.log_covariance, covariance)
    assert (learned.pieces, learned.degrees_of_freedom, learned.quantities) == (3, freedom, CURRENT)
    starts = learned.starts
    assert starts is not None
    # Equal noises: only the prior of 10 % is left, worth four starts.
    assert starts.log_noise == pytest.approx(math.log(given[0].noise_a))
    assert starts.log_noise_sd == pytest.approx(math.sqrt(4.0 * 0.1**2 / 6.0 * 4.0 / 3.0))
    start = given[0].start
    assert starts.sampling_rate_hz == pytest.approx(1.0 / start.dt_s)
    assert starts.duration_s == pytest.approx(0.2, abs=1e-3)
    assert starts.quiet_s == pytest.approx(0.03, abs=1e-3)
    onset_s = start.alignment.onset_s + 0.05 - given[2].onset_s
    later = replace(start, alignment=replace(start.alignment, onset_s=onset_s))
    late = learn_starts([*given[:2], replace(given[2], start=later)]).starts
    assert late is not None
    assert late.duration_s == pytest.approx((starts.duration_s or 0.0) - 0.05, abs=1e-3)
    assert late.quiet_s == starts.quiet_s
    assert (starts.ripple_hz, starts.ripple_log_sd, learned.temperature_k) == (None, None, 15.0)
    running = given[0].residual_a[start.alignment.onset_index :]
    left, white = float(np.var(running)), difference_noise(running)
    np.testing.assert_allclose(error, given[0].log_covariance * min(white**2 / left, 1.0))
    extended = [replace(fit, model=("coulomb",), fitted_extension={"coulomb": (size, 0.1)}) for fit, size in
                zip(given, (2.0, 1.0, 3.0), strict=True)]  # fmt: skip
    kept = learn_starts(extended).starts
    assert kept is not None
    assert (kept.model, kept.model_low, kept.model_high) == (("coulomb",), (1.0,), (3.0,))


def test_a_reference_speaks_of_what_follows_from_its_quantities() -> None:
    learned = replace(learn_starts(fits(*SCATTER)), temperature_c=20.0)
    same = reference_of_pieces(learned, CURRENT, "m", temperature_c=45.0)
    assert same is not None
    assert (same.temperature_k, same.warmer_k) == (4.0, 25.0)
    assert same.source == "3 healthy starts of m"
    for measured, known in ((None, 20.0), (45.0, None)):
        other = reference_of_pieces(
            replace(learned, temperature_c=known), CURRENT, "m", temperature_c=measured
        )
        assert other is not None
        assert (other.temperature_k, other.warmer_k) == (15.0, 0.0)
    narrow = reference_of_pieces(replace(learned, temperature_k=2.0), CURRENT, "m", temperature_c=45.0)
    assert narrow is not None
    assert narrow.temperature_k == 2.0
    ratio = reference_of_pieces(learned, ("R/L", "L"), "m")
    assert ratio is not None
    powers = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    np.testing.assert_allclose(ratio.log_values, powers @ np.log(learned.values))
    np.testing.assert_allclose(ratio.log_covariance, powers @ learned.log_covariance @ powers.T, atol=1e-12)
    assert reference_of_pieces(learned, ("K",), "m") is None


def test_healthy_starts_must_agree() -> None:
    """R, K and J to half a logarithm (1 sd); one is odd that lies five of its deviations off the others' median."""
    apart = 0.5 * math.sqrt(2.0)
    for size, is_far in ((0.999, False), (1.001, True)):
        two = fits(*([side * size * apart / math.sqrt(2.0), 0.0, 0.0, 0.0] for side in (-1.0, 1.0)))
        said = disagreement(two)
        assert (said is not None and "their R lies between" in said) is is_far
    assert disagreement(fits([0.0, 0.0, 0.0, -2.0], [0.0, 0.0, 0.0, 2.0])) is None
    others = [[0.0] * 4, [0.02, 0.0, 0.0, 0.0], [-0.02, 0.0, 0.0, 0.0]]
    _, fit, _ = fitted()
    sd = math.sqrt(fit.log_covariance[0, 0] + 0.02**2 + 0.1**2)
    for size, is_odd in ((4.99, False), (5.01, True)):
        given = fits(*others, [size * sd, 0.0, 0.0, 0.0])
        said = odd_one_out(given, 3)
        assert (said is not None) is is_odd
        if said:
            assert said == f"its R is {math.exp(size * sd):.3g} times that of the others"
    assert odd_one_out(fits([0.0] * 4, [9.0] * 4), 1) is None  # of two none is odd


def test_a_start_is_compared_with_what_is_as_warm() -> None:
    """Errors of the fit join those of a sheet; beside healthy starts only what is beyond their own."""
    _, fit, sheet = fitted()
    np.testing.assert_allclose(
        covariance_at_one_temperature(fit, sheet), sheet.log_covariance + fit.log_covariance
    )
    starts = replace(sheet, includes_fit_error=True)
    expected = sheet.log_covariance + beyond(sheet.log_covariance, fit.white_covariance)
    np.testing.assert_allclose(covariance_at_one_temperature(fit, starts), expected)
    warm = replace(starts, temperature_k=15.0, warmer_k=5.0, own_friction=1.0, degrees_of_freedom=8.0)
    view = views_of(fit, warm, RATE)[0]
    warmth = np.array([0.00393, 0.0, -0.002, -0.003])
    np.testing.assert_allclose(view.drag.warmth, warmth)
    # The factors move in proportion to the temperature: by its posterior mean, 15 K believed, the logarithms do too.
    raw = fit.log_values - sheet.log_values - 5.0 * warmth
    slope = np.linalg.inv(expected) @ warmth
    factors = slope @ raw / (slope @ warmth + 15.0**-2) * warmth
    np.testing.assert_allclose(view.difference.log_ratios, raw + factors - np.log1p(factors))
    np.testing.assert_allclose(view.difference.covariance, warmer(expected, 15.0 * warmth, RATE / 5.0, 8.0))
    limit = view.faults[0].z
    assert not view.is_alarm(max(one.z for one in view.faults) + 1e-9, 0.0)
    assert view.is_alarm(max(one.z for one in view.faults) - 1e-9, 0.0)
    assert view.is_alarm(math.inf, 1.0) or limit
    views = views_of(fit, replace(warm, own_friction=None), RATE)
    assert [(one.drag.load, one.drag.own) for one in views] == [
        (None, 1.0),
        ("constant", 1.0),
        ("constant", 0.0),
        ("fan", 0.0),
    ]
    each = [smallest_changes(one.difference, 3.0) for one in views]
    largest = {kind: max(one[kind] for one in each) for kind in each[0]}
    assert smallest_of(views, None, 3.0) == largest
    assert smallest_of(views, 0.25, 3.0) == largest | {"bearing": 4.0 * largest["bearing"]}
    assert (unit_of("bearing", 0.3), unit_of("bearing", None), unit_of("winding_contact", 0.3)) == (
        0.3,
        1.0,
        1.0,
    )


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
    view = views_of(fitted()[1], found.reference, RATE)[0]
    told = probabilities(view.difference, view.faults)
    kinds = [name for name in told if name == kind or (verdict is Verdict.WINDING and "winding" in name)]
    assert found.confidence == pytest.approx(sum(told[name] for name in kinds))
    assert found.kind_probability == pytest.approx(told[kind])
    assert moved(*(0.995 * at), degrees_of_freedom=freedom).confidence is not None


def test_a_kind_is_told_from_a_probability_of_19_in_20_on() -> None:
    """The family is called at the limit of the test already; a larger step makes its kind surer."""
    at, _ = border("winding_contact", 7.0)
    low, high = 1.005, 3.0
    assert moved(*(low * at), degrees_of_freedom=7.0).kind_probability < 0.95
    for _ in range(20):
        middle = 0.5 * (low + high)
        found = moved(*(middle * at), degrees_of_freedom=7.0)
        low, high = (middle, high) if found.kind_probability < 0.95 else (low, middle)
        assert (found.verdict, found.fault_kind) == (Verdict.WINDING, FaultKind.WINDING_CONTACT)
    for size, kind in ((low, None), (high, FaultKind.WINDING_CONTACT)):
        found = moved(*(size * at), degrees_of_freedom=7.0)
        assert found.kind_probability == pytest.approx(0.95, abs=1e-4)
        one = replace(judged(), pieces=(found,))
        assert (one.kind, report.as_json(one)["kind"]) == (kind, kind)
    assert judged().kind is None


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


def doubled(friction: float, resistance: float) -> Judgement:
    """A healthy start whose errors show a doubling along these in 95 of 100 cases, times these factors."""
    _, fit, reference = fitted()
    share = joint_share(0.8 * RATE, np.eye(4), EXPONENTS, 1e6)
    unit = math.log(2.0) / (stats.norm.isf(share) + 1.645)
    wide = replace(fit, log_covariance=np.diag([resistance, 1e-3, 1e-3, friction]) ** 2 * unit**2)
    given = replace(
        reference, log_values=fit.log_values, log_covariance=1e-3 * np.eye(4), includes_fit_error=True,
        own_friction=1.0,
    )  # fmt: skip
    return decide(wide, given, RATE)


def test_what_is_identified_says_which_quantities_go_together() -> None:
    _, fit, _ = fitted()
    together = {("L", "R"): 0.5, ("K^2/J", "R"): -0.25, ("K^2/J", "L"): 0.1, ("B/J", "K^2/J"): 0.75}
    sd, correlation = np.array([0.01, 0.2, 0.03, 0.4]), np.eye(4)
    for pair, value in together.items():
        i, j = map(CURRENT.index, pair)
        correlation[i, j] = correlation[j, i] = value
    fit = replace(fit, log_covariance=correlation * np.outer(sd, sd))
    start = judged().recording
    found = Identification(((start, fit),), (), {start.path: judged().taken})
    text = found.text()
    pairs = [line.removeprefix("  correlations: ") for line in text.splitlines() if "correlations" in line]
    said = [dict(re.findall(r"(\S+ with \S+) ([-+]\S+?)(?:,|$)", line)) for line in pairs]
    zeros = {("B/J", "R"): 0.0, ("B/J", "L"): 0.0}
    assert said == [{f"{a} with {b}": f"{value:+.2f}" for (a, b), value in (together | zeros).items()}]
    (told,) = found.to_json()
    np.testing.assert_allclose(told["correlations"], correlation, rtol=1e-12)
    assert found.parameters["L"]["standard_error"] == pytest.approx(0.2 * fit.values[1])


def test_a_start_that_hides_a_doubled_friction_says_so_and_one_that_hides_all_is_not_called_healthy() -> None:
    """A friction twice as large is found in 95 of 100 cases where (limit + 1.645) deviations are log 2."""
    for friction, resistance, unseen in (
        (0.99, 0.99, []),
        (1.01, 0.99, ["friction"]),
        (0.99, 1.01, ["resistance"]),
        (1.01, 1.01, ["friction", "resistance"]),
    ):
        found = doubled(friction, resistance)
        said = [one for one in found.reasons if "is undecided" in one]
        assert [one.split()[1] for one in said] == unseen
        assert all(one.endswith("or too short to tell it, only a rise of 101% would show") for one in said)
        if len(unseen) == 2:
            assert (found.verdict, found.severity, found.confidence) == (Verdict.UNUSABLE, None, None)
            assert len(found.reasons) == 2
        else:
            assert (found.verdict, found.severity, len(found.reasons)) == (
                Verdict.HEALTHY,
                0.0,
                1 + len(unseen),
            )
            assert found.confidence is not None


@pytest.mark.parametrize(
    ("rows", "unseen"), [([0, 1], ["friction"]), ([3], ["resistance"]), ([1], ["friction", "resistance"])]
)
@pytest.mark.parametrize("includes_fit_error", [False, True])
def test_what_cannot_be_compared_is_undecided(
    rows: list[int], unseen: list[str], includes_fit_error: bool
) -> None:
    """The reference speaks of fewer quantities than the fit tells; of L alone it is none."""
    _, fit, reference = fitted()
    known = replace(
        reference,
        names=tuple(CURRENT[row] for row in rows),
        log_values=fit.log_values[rows],
        log_covariance=reference.log_covariance[np.ix_(rows, rows)],
        includes_fit_error=includes_fit_error,
    )
    found = decide(fit, known, RATE)
    said = [f"the {word} is undecided: it cannot be compared with {reference.source}" for word in unseen]
    assert list(found.reasons[-len(unseen) :]) == said
    assert found.verdict == ("unusable" if len(unseen) == 2 else "healthy")
    assert [change.name for change in found.changes] == list(known.names)


def bent(change: FloatArray) -> FloatArray:
    """By how much logarithms of factors are smaller than what they are changed by."""
    return change - np.log1p(change)


def test_another_temperature_is_told_from_eight_kelvin_on() -> None:
    """Its posterior mean: what the start shows, and 15 K believed beforehand."""
    warmth = np.array([0.00393, 0.0, -0.002, -0.003])
    covariance = np.diag([1e-3, 1.0, 1e-3, 1.0]) ** 2
    _, fit, _ = fitted()
    same = covariance + beyond(covariance, fit.white_covariance)
    pull = warmth @ np.linalg.inv(same) @ warmth
    shrunk = pull / (pull + 15.0**-2)
    assert 2.0 * (pull + 15.0**-2) ** -0.5 < 8.0
    for kelvin, word in ((7.9, ""), (8.1, "8 K warmer"), (-8.1, "8 K colder")):
        found = moved(
            *(kelvin / shrunk * warmth - bent(kelvin * warmth)), log_covariance=covariance, temperature_k=15.0
        )
        assert found.verdict is Verdict.HEALTHY
        said = " ".join(found.reasons[1:])
        assert (word in said) if word else said == ""


def test_another_temperature_is_told_beyond_two_of_its_deviations() -> None:
    """Where it is known to 6 K only."""
    _, fit, _ = fitted()
    warmth, error = np.array([0.00393, 0.0, -0.002, -0.003]), fit.white_covariance
    low, high = 1e-3, 1.0
    for _ in range(60):
        middle = math.sqrt(low * high)
        covariance = np.diag([middle, 1.0, middle, 1.0]) ** 2
        pull = warmth @ np.linalg.inv(covariance + beyond(covariance, error)) @ warmth
        low, high = (middle, high) if (pull + 15.0**-2) ** -0.5 < 6.0 else (low, middle)
    for kelvin, is_told in ((11.9, False), (12.1, True)):
        shrunk = pull / (pull + 15.0**-2)
        off = kelvin / shrunk * warmth - bent(kelvin * warmth)
        found = moved(*off, log_covariance=covariance, temperature_k=15.0)
        assert ("12 K warmer" in " ".join(found.reasons)) is is_told


def test_a_shunt_is_in_series_with_the_healthy_motor() -> None:
    """The current that it would have drawn is that of a motor with so much more resistance."""
    found, fit, reference = fitted()
    behind = replace(fit, start=replace(fit.start, circuit=Circuit(shunt_ohm=0.5)))
    logs = reference.log_values.copy()
    logs[0] = math.log(math.exp(logs[0]) + 0.5)
    larger = page.reference_current(replace(found, reference=replace(reference, log_values=logs)))
    assert larger is not None
    ours = page.reference_current(replace(found, fit=behind))
    np.testing.assert_allclose(np.asarray(ours), larger, rtol=1e-9, atol=1e-12)


def test_units_of_the_extensions() -> None:
    _, fit, _ = fitted()
    units = {
        "supply_ramp": "s", "supply_curve": "of the rise (its middle)", "sensor_lag": "s", "speed_lag": "s",
        "dead_zone": "A", "coulomb": "N m", "brush_drop": "V",
    }  # fmt: skip
    extended = replace(fit, fitted_extension=dict.fromkeys(units, (0.5, 0.1)))
    told = report.extensions_json(extended)
    assert {name: row["unit"] for name, row in told.items()} == units
    interval = pytest.approx([0.5 - 0.196, 0.5 + 0.196])
    assert told["coulomb"] == {"value": 0.5, "standard_error": 0.1, "interval": interval, "unit": "N m"}
    unknown = replace(extended, start=replace(fit.start, voltage_known=False))
    per_volt = units | {"coulomb": "N m/V", "brush_drop": "of the supply"}
    assert {name: row["unit"] for name, row in report.extensions_json(unknown).items()} == per_volt


def test_a_fit_that_explains_too_little_is_unusable() -> None:
    _, fit, _ = fitted()
    for r2, is_refused in ((0.749, True), (0.751, False)):
        for channel in ("r2_current", "r2_speed"):
            given = {"r2_current": 1.0, "r2_speed": None, channel: r2}
            fake = SimpleNamespace(start=fit.start, log_covariance=fit.log_covariance, **given)
            assert (unusable_reason(cast("Any", fake)) is not None) is is_refused
    for sd, is_refused in ((1.01, True), (0.99, False)):
        wide = replace(fit, log_covariance=sd**2 * np.eye(4))
        assert (unusable_reason(wide) is not None) is is_refused


def test_innovations_are_what_the_fit_leaves_over_the_noise() -> None:
    """Of white noise they are white and of size 1; whatever the piece, the same tests judge them."""
    found, fit, _ = fitted()
    driven = int(np.sum(fit.start.time_s <= fit.onset_s)) + 1
    np.testing.assert_allclose(fit.whitened[:, 0], fit.residual_a[driven:] / fit.noise_a)
    assert found.consistency == check_consistency(fit.whitened)
    assert found.consistency is not None
    assert found.consistency.holds
    assert found.consistency.mean_square == pytest.approx(1.0, abs=0.1)
    few = replace(
        fit, solution=replace(fit.solution), start=replace(fit.start, time_s=fit.start.time_s - 1.0)
    )
    assert replace(found, fit=None).consistency is None
    assert replace(found, fit=few).consistency is None  # all lies before the onset


def test_innovations_leave_out_what_is_not_shown() -> None:
    """Wild samples, and currents below half of a dead zone."""
    _, fit, _ = fitted()
    begin = int(np.sum(fit.start.time_s <= fit.onset_s)) + 1
    wild = replace(fit.start, alignment=replace(fit.start.alignment, wild=(begin + 7, begin + 90)))
    assert np.flatnonzero(np.isnan(replace(fit, start=wild).whitened[:, 0])).tolist() == [7, 90]
    problem, zone = fit.solution.problem, float(fit.states[begin + 300, 0])
    hiding = problem.known.copy()
    hiding[places.ZONE] = 2.0 * zone
    blind = replace(fit, solution=replace(fit.solution, problem=replace(problem, known=hiding)))
    np.testing.assert_array_equal(np.isnan(blind.whitened[:, 0]), fit.states[begin:, 0] < zone)
    assert not fit.is_hidden
    assert replace(fit, model=("dead_zone",)).is_hidden


def test_a_warning_is_allowed_for_where_there_is_a_verdict() -> None:
    _, fit, _ = fitted()
    odd = replace(fit, expected=fit.expected + [[0.0, 0.0], [0.05, 0.0]] * (len(fit.expected) // 2))
    warned = of_one(fit=odd)
    said = warned.telling.warning
    assert "their mean is not 0" in said
    assert f"  {said}; the verdict allows for it" in report.expert_lines(warned.telling)
    assert f"  {said}" in report.expert_lines(replace(warned.telling, reference=None))
    assert report.as_json(warned)["warning"] == said
    assert report.as_json(warned)["consistent"] is False


@pytest.mark.parametrize(
    ("verdicts", "unreadable", "status"),
    [
        (["healthy", "healthy"], False, 0),
        (["healthy", "bearing", "unusable"], False, 1),
        (["noise"], False, 1),
        (["other"], False, 1),
        (["bearing"], True, 2),
        (["healthy", "no_reference"], False, 3),
        (["healthy", "unusable"], False, 3),
    ],
)
def test_exit_status_of_verdicts(verdicts: list[str], unreadable: bool, status: int) -> None:
    statuses = [Verdict(verdict).status for verdict in verdicts]
    assert worst([*statuses, ExitStatus.BAD_INPUT] if unreadable else statuses) == status


def faulty() -> Diagnosis:
    changes = (Change("R", 1.2, 1.1, 1.31, "moved"), Change("B/J", 0.95, 0.9, 1.0, "undecided"))
    return of_one(
        verdict=Verdict.WINDING,
        fault_kind=FaultKind.WINDING_CONTACT,
        kind_probability=0.95,
        severity=0.2,
        severity_interval=(0.1, 0.31),
        confidence=0.876,
        changes=changes,
        smallest_changes={"bearing": 0.123, "winding_contact": 0.045},
    )


def test_text_and_json_say_the_same() -> None:
    found, fit, _ = fitted()
    check = found.consistency
    assert check is not None
    told, text = report.as_json(faulty(), 14.0), report.as_text(faulty(), verbose=True)
    said = "winding (winding_contact) +20% (95 %: +10% to +31%), confidence 0.88"
    assert text.splitlines()[0] == f"start.csv: {said}"
    unsure = replace(faulty().telling, kind_probability=0.94)
    assert report.headline(unsure) == said.replace(" (winding_contact)", "")
    bearing = replace(faulty().telling, verdict=Verdict.BEARING, fault_kind=FaultKind.BEARING)
    assert report.headline(bearing).startswith("bearing +20%")
    assert "R            " in text
    assert "+20.0% from the reference (95 %: +10.0% to +31.0%)\n" in text
    assert "-5.0% from the reference (95 %: -10.0% to +0.0%), undecided\n" in text
    assert "\n  taken for a start (the voltage goes on and stays)\n" in text
    assert "bearing 12%, winding_contact 4% (bearing: of the motor's own friction)" in text
    assert f"judged by the filter's innovations; sensor noise {fit.noise_a:.3g} A\n" in text
    assert f"(NIS) {check.mean_square:.2f}\n" in text
    expected = {
        "file": "start.csv", "verdict": "winding", "kind": "winding_contact", "severity": 0.2,
        "severity_interval": [0.1, 0.31], "confidence": 0.876, "r2_current": fit.r2_current, "r2_speed": None,
        "mean_nis": check.mean_square, "sensor_noise_a": fit.noise_a,
        "model": ["textbook", *fit.model], "reference": found.reference and found.reference.source,
        "smallest_changes": {"bearing": 0.123, "winding_contact": 0.045}, "residual_autocorrelation": fit.lag_one,
        "consistent": True, "columns": ["read so"], "pieces_of_recording": 1,
        "taken_for": {"regime": "start", "why": "the voltage goes on and stays"},
    }  # fmt: skip
    assert {name: told[name] for name in expected} == expected
    assert told["changes"] == {
        "R": {"verdict": "moved", "ratio": 1.2, "interval": [1.1, 1.31]},
        "B/J": {"verdict": "undecided", "ratio": 0.95, "interval": [0.9, 1.0]},
    }
    (piece,) = told["pieces"]
    begin, length = piece.pop("begin_s"), piece.pop("duration_s")
    time_s = judged().recording.time_s
    assert (begin, length) == pytest.approx((time_s[0], len(time_s) * judged().recording.dt_s))
    assert piece == {name: told[name] for name in piece}
    assert set(piece) == {
        "verdict", "kind", "severity", "severity_interval", "confidence", "reasons", "changes", "smallest_changes",
    }  # fmt: skip
    units = ("ohm", "H", "V/(A s)", "1/s")
    for name, value, error, unit in zip(CURRENT, fit.values, fit.standard_errors, units, strict=True):
        row = told["parameters"][name]
        assert (row["value"], row["standard_error"], row["unit"]) == (
            pytest.approx(value),
            pytest.approx(error),
            unit,
        )
        half = 1.96 * error / value  # the interval is even in the logarithm
        assert row["interval"] == pytest.approx([value * math.exp(-half), value * math.exp(half)])
        assert f"{value:.4g} +- {error:.2g} {unit}" in text
    assert told["parameters"]["onset_s"] == {"value": fit.onset_s, "unit": "s"}
    assert told["parameters"]["offset_a"] == {"value": fit.offset_a, "unit": "A"}
    assert report.of_the_drag(0.4).endswith("own friction, 40% of the drag")
    assert of_one(severity_interval=(0.1, 0.31)).severity_interval == (0.1, 0.31)
    assert of_one(severity_interval=None).severity_interval is None
    for number in (math.nan, math.inf):
        assert report.as_json(of_one(severity=number))["severity"] is None
    assert report.headline(of_one(confidence=None).telling) == "healthy"


def test_something_else_names_what_moved_most() -> None:
    found = moved(0.0, 0.0, -0.5, 0.0)
    assert found.verdict is Verdict.OTHER
    assert found.reasons[0].startswith("K^2/J is down by 39% (-")
    assert "K down looks the same as J and B up" in found.reasons[0]
    assert found.confidence is not None
    assert found.severity is None


def drawn(html: str, name: str) -> list[tuple[float, ...]]:
    """Numbers of the pieces of a class."""
    found = re.findall(rf'<(?:line|circle)[^>]*class="{name}"[^>]*>', html)
    return [tuple(map(float, re.findall(r'(?:x1|x2|cx|y1|y2|cy)="([-\d.]+)"', one))) for one in found]


@pytest.mark.parametrize(("high", "edge"), [(1.5, 1.65), (1.01, 1.1 * 1.01), (30.0, 8.0)])
def test_bars_stand_on_a_logarithmic_axis_a_tenth_wider_than_they_are(high: float, edge: float) -> None:
    changes = (Change("R", 1.005, 0.995, high, "healthy"), Change("B/J", 1.0, 0.999, 1.001, "moved"))
    html = page.page(of_one(changes=changes))
    edge = max(edge, 1.1)

    def x(ratio: float) -> float:
        return 150.0 + (480.0 - 150.0 - 64.0) * (math.log(ratio) / math.log(edge) + 1.0) / 2.0

    low, height, end, _ = drawn(html, "interval")[0]
    assert low == pytest.approx(x(0.995), abs=0.1)
    assert end == pytest.approx(x(high) if high < edge else end, abs=0.1)
    assert drawn(html, "dot")[0] == pytest.approx((x(1.005), height), abs=0.1)
    assert [dot[1] for dot in drawn(html, "dot")] == [17.0, 51.0]


def test_pieces_stand_at_their_middles_on_one_axis_of_time() -> None:
    """From the begin of the first to the end of the last; of quantities that the first and the last have."""
    ratios = [(0.0, 8.0, 1.5), (8.0, 10.0, 1.0), (30.0, 10.0, 0.8)]
    pieces = [
        replace(
            judged().telling,
            begin_s=begin,
            duration_s=length,
            changes=(
                Change("R", ratio, 0.9 * ratio, 1.1 * ratio, "healthy"),
                Change("L" if begin else "B/J", 1.0, 0.99, 1.01, "healthy"),
            ),
        )
        for begin, length, ratio in ratios
    ]
    silent = replace(pieces[1], changes=(), begin_s=99.0)
    html = page.pieces_chart([*pieces[:2], silent, pieces[2]])
    assert html.count("<svg") == 1
    edge = math.log(1.1 * 1.65)
    spots = [66.0 + 382.0 * (begin + 0.5 * length) / 40.0 for begin, length, _ in ratios]

    def y(ratio: float) -> float:
        return 102.0 - 78.0 * (math.log(ratio) / edge + 1.0) / 2.0

    for spot, (*_, ratio), dot, line in zip(
        spots, ratios, drawn(html, "dot"), drawn(html, "interval"), strict=True
    ):
        assert dot == pytest.approx((spot, y(ratio)), abs=0.1)
        assert line == pytest.approx((spot, y(0.9 * ratio), spot, y(1.1 * ratio)), abs=0.1)
    assert page.pieces_chart([silent]) == ""


def test_the_residuals_band_and_edge() -> None:
    """Averaged over a fiftieth; the axis reaches 1.2 times what 98 of 100 samples after the start lie within."""
    found, fit, _ = fitted()
    ripple = PeriodicLine(30.0, 0.05, 0.02)  # so slow that the mean over a fiftieth shows it
    fit = replace(fit, start=replace(fit.start, lines=(ripple,)))
    found = replace(found, fit=fit)
    expected = page.reference_current(found)
    assert expected is not None
    beyond_ = fit.start.current_a - fit.start.ripple_a - expected
    span = len(beyond_) // 50
    padded = np.pad(beyond_, (span // 2, span - 1 - span // 2), "reflect")
    smooth = np.convolve(padded, np.full(span, 1.0 / span), "valid")
    time_ms = 1e3 * (fit.start.time_s - fit.onset_s)
    begin = np.searchsorted(time_ms, -0.02 * time_ms[-1])
    shown = slice(begin, None, max((len(time_ms) - begin) // 700, 1))
    noise = 2.0 * fit.noise_a / math.sqrt(span)
    largest = max(np.quantile(np.abs(smooth[shown][time_ms[shown] > 0.0]), 0.98), 2.0 * noise)
    html = page.page(of_one(fit=fit)).split('aria-label="Measured less healthy current')[1].split("</svg>")[0]
    ticks = [(float(y), float(value)) for y, value in re.findall(r'y="([-\d.]+)"[^>]*>([-\d.]+) mA<', html)]
    (y0, v0), (y1, v1) = ticks[0], ticks[-1]
    per_pixel = (v1 - v0) / (y0 - y1)
    # 194 pixels between the margins show the edges and a tenth beyond.
    assert per_pixel * 194.0 == pytest.approx(2.0 * 1.1 * 1.2 * 1e3 * largest, rel=0.01)
    at = {float(t): float(x) for x, t in re.findall(r'x="([-\d.]+)"[^>]*>([-\d.]+) ms<', html)}
    first, last = min(at), max(at)
    begin_ms = first - (at[first] - 66.0) * (last - first) / (at[last] - at[first])
    assert begin_ms == pytest.approx(
        -0.02 * time_ms[-1], abs=0.2
    )  # a fiftieth of the recording before the start
    corners = re.findall(r'<polygon[^>]*points="([^"]+)"', html)[0].split()
    ys = [float(corner.split(",")[1]) for corner in corners]
    assert (max(ys) - min(ys)) * per_pixel == pytest.approx(2.0 * 1e3 * noise, rel=0.02)


@pytest.mark.parametrize(
    ("high", "ticks"),
    [
        (30.0, {-75, 0, 300}),
        (4.0, {-75, -50, 0, 100, 300}),
        (2.0, {-50, -25, 0, 50, 100}),
        (1.5, {-25, 0, 25, 50}),
        (1.23, {-25, 0, 25}),
        (1.12, {-10, 0, 10}),
        (1.03, {-10, -5, 0, 5, 10}),
    ],
)
def test_ticks_of_the_bars(high: float, ticks: set[int]) -> None:
    """The most welcome ones that lie more than 0.36 of the axis' half apart."""
    html = page.page(of_one(changes=(Change("R", 1.005, 0.995, high, "undecided"),)))
    bars = html.split('aria-label="Deviation of each quantity')[1].split("</svg>")[0]
    assert set(map(int, re.findall(r">([-+]\d+) %<", bars))) == ticks


def test_words_of_the_page() -> None:
    html = page.page(faulty())
    assert "Winding resistance up by 20%, between 10% and 31%" in html
    assert "88% sure" in html
    assert "over 99 % sure" in page.page(of_one(confidence=0.991))
    assert "99% sure" in page.page(of_one(confidence=0.99))
    assert "more friction" in html
    assert "12%" in html


def test_an_identified_motor_is_the_geometric_mean_of_its_fits() -> None:
    _, fit, _ = fitted()
    theta = fit.solution.theta.copy()
    theta[[fit.solution.names.index(name) for name in "RJ"]] += np.log([4.0, 0.25])
    other = replace(fit, solution=replace(fit.solution, theta=theta))
    motor = motor_files.to_motor([fit, other], "two")
    assert motor.parameters.resistance_ohm == pytest.approx(2.0 * float(fit.parameters.resistance_ohm))
    assert motor.parameters.inertia_kg_m2 == pytest.approx(0.5 * float(fit.parameters.inertia_kg_m2))
    assert motor.nominal_voltage_v == pytest.approx(12.0)
    assert motor.current_noise_a == pytest.approx(fit.noise_a)
    for error, told in ((0.0495, 0.1), (0.0505, 0.0)):
        # Twice their mean's standard error: that of one over the root of two.
        pair = [replace(fit, fitted_extension={"coulomb": (0.1, error * math.sqrt(2.0))})] * 2
        assert motor_files.to_motor(pair, "two").coulomb_friction_n_m == pytest.approx(told)
    wide = replace(fit, log_covariance=np.diag([0.49, 0.51, 0.1, 0.1]) ** 2)
    assert [one for one in motor_files.not_told(wide) if "is not told" in one] == [
        "L is not told by this recording (its standard error is 51 %)"
    ]


def test_the_friction_of_its_own_is_the_share_of_the_currents() -> None:
    _, fit, _ = fitted()
    running = float(steady_state(fit.parameters, fit.start.level_v)[0])
    for share, expected in ((0.25, 0.25), (1.1, 1.0), (1.19, 1.0)):
        assert commission._own_friction([fit, fit], share * running) == pytest.approx(expected)
    with pytest.raises(InputError, match="no-load-current must be at most the"):
        commission._own_friction([fit], 1.21 * running)


@pytest.mark.parametrize("odd", [0.0, 1.2])
def test_a_commissioning_counts_what_its_pieces_leave_undecided(odd: float) -> None:
    """Each is judged by the others: where one has another friction, only it is judged by such as agree."""
    given = fits([0.0] * 4, [0.0, 0.0, 0.0, 0.05], [0.0, 0.0, 0.0, -0.05], [0.0, 0.0, 0.0, odd], [0.0] * 4)
    logs, white = np.array([fit.log_values for fit in given]), given[0].white_covariance
    prior, warmth = np.eye(4) * 0.02**2 + white, np.array([0.00393, 0.0, -0.002, -0.003])
    expected = 0
    for n in range(5):
        _, covariance, freedom = the_next(np.delete(logs, n, axis=0), prior)
        same = covariance + beyond(covariance, white)
        whole = warmer(same, 15.0 * warmth, RATE / 5.0, freedom)
        limit = stats.t.isf(joint_share(0.8 * RATE, whole, EXPONENTS, freedom), freedom)
        expected += bool((limit + 1.645) * math.sqrt(same[3, 3]) > math.log(2.0))
    assert expected == (4 if odd else 0)
    motor = motor_files.to_motor(given, "m", kind="commissioned", healthy=learn_starts(given))
    smallest, undecided = commission._promise(motor, given, None, RATE)
    assert undecided == ({"B/J": expected} if odd else {})
    reference = reference_of(motor, CURRENT)
    assert reference is not None
    views = views_of(given[0], reference, RATE)
    assert smallest == smallest_of(views, None, limits_of(views, RATE, tests_noise=True).z)
    assert commission._promise(motor, given[:1], None, RATE)[1] == {}  # nothing is left to judge one by


@pytest.mark.parametrize(
    ("said", "telling"),
    [
        ([("healthy", 0.9), ("bearing", 0.8), ("winding", 0.99), ("bearing", 0.85)], 3),
        ([("winding", 0.7), ("bearing", 0.8)], 1),
        ([("unusable", None), ("healthy", 0.6), ("healthy", 0.9)], 1),
        ([("no_reference", None), ("unusable", None)], 0),
        ([("healthy", 0.9), ("other", None)], 1),
    ],
)
def test_the_piece_that_a_verdict_rests_on(said: list[tuple[str, float | None]], telling: int) -> None:
    """The surest of the most frequent fault; without a fault a healthy one, else the first."""
    pieces = tuple(
        replace(judged().telling, verdict=Verdict(word), confidence=sure, begin_s=float(n))
        for n, (word, sure) in enumerate(said)
    )
    found = replace(judged(), pieces=pieces, of=9)
    assert found.telling is pieces[telling]
    assert (found.verdict, found.confidence) == (Verdict(said[telling][0]), said[telling][1])
    told = report.as_json(found)
    assert (told["verdict"], told["pieces_of_recording"]) == (said[telling][0], 9)
    assert [(one["verdict"], one["confidence"]) for one in told["pieces"]] == said
    first, *lines = report.as_text(found).splitlines()
    same = sum(word == said[telling][0] for word, _ in said)
    assert first.endswith(f"; {same} of {len(said)} starts judged, of 9")
    marked = [line for line in lines if line.endswith(" <")]
    assert [line.startswith(f"  from {telling} s: {said[telling][0]}") for line in marked] == [True]


def test_words_of_a_commissioning() -> None:
    """The interval of the next healthy start, at the rate on both sides together."""
    given = fits(*SCATTER)
    learned = learn_starts(given)
    motor = motor_files.to_motor(given, "m", kind="commissioned", healthy=learned)
    known = commission.Commissioned(motor, tuple(given), {"bearing": 0.25}, {"B/J": 2})
    text = replace(known, false_alarm_rate=0.05).text()
    half = stats.t.isf(0.025, 6.0) * np.sqrt(np.diag(learned.log_covariance))
    assert "(95%, Student t, 6 degrees)" in text
    for name, value, h in zip(learned.quantities, learned.values, half, strict=True):
        words = f"{value:.4g} {report.UNITS[name]:<12} {math.expm1(-h):+.1%} to {math.expm1(h):+.1%}"
        assert " ".join(words.split()) in " ".join(text.split()), name
        told = replace(known, false_alarm_rate=0.05).parameters[name]
        assert (told["value"], told["unit"]) == (value, report.UNITS[name])
        assert told["interval"] == pytest.approx([value * math.exp(-h), value * math.exp(h)])
    assert "found in 95 of 100 cases: bearing 25.0%" in text
    assert "\n  B/J is left undecided by 2 of these 3 starts: a doubling would not show\n" in text
    assert "by 15 K (1 sd)" in text


def test_names_of_pages_are_numbered() -> None:
    assert picture_of(Path("a.b/c.d.csv"), Path("out"), 7) == Path("out/007-c-d-csv.png")
    assert len(picture_of(Path("x" * 99), Path("out"), 7).stem) == 4 + 50


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--false-alarm-rate", "0.5"], "false-alarm-rate must lie between 0 and 0.5, got 0.5"),
        (["--false-alarm-rate", "0"], "false-alarm-rate must lie between 0 and 0.5, got 0"),
        (["--ripple-periods-per-turn", "0"], "ripple-periods-per-turn must be > 0"),
    ],
)
def test_options_out_of_range_are_one_sentence(
    options: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["diagnose", str(EXAMPLES / "startup_capture.csv"), *options]) == 2
    assert sentence in capsys.readouterr().err


def test_a_false_alarm_rate_reaches_the_tests(capsys: pytest.CaptureFixture[str]) -> None:
    """A smaller rate asks for larger changes: in the ratio of their limits."""
    smallest = {}
    for rate in ("0.01", "0.2", ""):
        command = ["diagnose", str(EXAMPLES / "startup_capture.csv"), "--motor", str(EXAMPLES / "motor.toml")]
        main([*command, *(["--false-alarm-rate", rate] if rate else []), "--json"])
        (told,) = json.loads(capsys.readouterr().out)
        smallest[rate] = math.log1p(told["smallest_changes"]["bearing"])
    one = diagnose(read_recording(EXAMPLES / "startup_capture.csv"), SHEET)  # the library's own default
    assert smallest[""] == smallest["0.01"] == math.log1p(one.telling.smallest_changes["bearing"])
    (judgement,) = one.pieces
    assert isinstance(judgement.identified, Identified)
    assert judgement.reference is not None
    covariance = judgement.identified.log_covariance + judgement.reference.log_covariance
    shares = {rate: joint_share(0.8 * float(rate), covariance, EXPONENTS, 1e6) for rate in ("0.01", "0.2")}
    limits = {rate: stats.norm.isf(share) + 1.645 for rate, share in shares.items()}
    expected = limits["0.01"] / limits["0.2"]
    assert smallest["0.01"] / smallest["0.2"] == pytest.approx(expected, rel=1e-4)


def test_a_motor_file_of_another_kind_is_named() -> None:
    given = Motor("mine", "identified", SHEET.parameters)
    found = reference_of(given, names(has_voltage=True, has_speed=True))
    assert found is not None
    assert found.source == "identified motor mine"
    assert (found.log_noise, fitted()[2].source) == (None, f"data sheet {SHEET.name}")
