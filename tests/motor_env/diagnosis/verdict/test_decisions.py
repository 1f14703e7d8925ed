"""What is decided on a fit, and from which border on: faults, noise, warmth, what is undecided, what is unusable."""

import math
import re
from collections import Counter
from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from judged_by_hand import CURRENT, EXPONENTS, RATE, SHEET, fitted, judged, moved, of_one, start
from scipy import stats

from motor_env import (
    Fault,
    FaultKind,
    Verdict,
    diagnose,
)
from motor_env.diagnosis import diagnose as judging
from motor_env.diagnosis.diagnose import explain_unusable

# Reaches in: fits are moved by hand in directions that no public name gives.
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.uncertainty import excess_covariance
from motor_env.diagnosis.identification import Identification
from motor_env.diagnosis.verdict import report_text
from motor_env.diagnosis.verdict.decision import alarm_limits, decide
from motor_env.diagnosis.verdict.hypotheses import (
    covariance_at_one_temperature,
    form_hypotheses,
    joint_share,
    probabilities,
)
from motor_env.diagnosis.verdict.judgement import NOTHING_ELSE, Judgement
from motor_env.filters.consistency import check_consistency
from motor_env.motor.healthy import Starts
from motor_env.motor.identifiable import visible_direction
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


@pytest.mark.parametrize(
    ("off", "named"),
    [
        ((0.25, 0.0, 0.0, 0.5), ["bearing", "winding"]),
        ((0.6, 0.0, 0.0, 0.3), ["winding", "bearing"]),
        ((-0.15, -0.3, -0.3, 0.5), ["bearing", "winding"]),  # shorted turns
        ((0.25, 0.0, 0.0, 0.0), ["winding"]),
        ((0.0, 0.0, 0.0, 0.5), ["bearing"]),
        ((0.02, 0.0, 0.0, 0.5), ["bearing"]),
        ((0.25, 0.0, -0.3, 0.5), ["other"]),
        ((0.25, 0.0, 0.0, -0.5), ["other"]),
        ((0.3, 0.0, 0.0, 0.5), ["bearing", "winding"]),
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


def test_a_noise_is_named_beside_a_fault() -> None:
    found = moved(0.0, 0.0, 0.0, 0.5, noise=0.8)
    assert [str(fault.verdict) for fault in (found, *found.also)] == ["bearing", "noise"]
    assert found.also[0].severity == pytest.approx(math.exp(1.6) - 1.0)
    assert not any(NOTHING_ELSE in reason for reason in found.reasons)


def test_no_sentence_says_that_nothing_else_moved_where_the_table_says_that_it_did() -> None:
    """For steps of all quantities through the limits of the intervals and of the tests."""
    said = Counter[bool]()
    steps = (-0.2, 0.0, 0.04, 0.07, 0.1)
    for r, pull, drag in product(steps, steps, (0.0, 0.3, 0.6, 1.1)):
        for found in (moved(r, 0.0, pull, drag), moved(r, 0.0, pull, drag, is_bare=True, own_friction=1.0)):
            beside = {"bearing": "RLK", "winding": "LKB", "magnet": "RLJB"}.get(str(found.verdict), "")
            others = [
                change for change in found.changes if change.name[0] in beside and change.excludes_healthy
            ]
            alone = any(NOTHING_ELSE in reason for reason in found.reasons)
            if found.fault_kind == FaultKind.WINDING_SHORT:
                continue
            assert not (alone and others)
            assert not (alone and found.also)
            said[alone] += 1
    assert min(said.values()) > 20


def test_drag_far_above_a_data_sheet_is_first_a_coupled_machine() -> None:
    """Believed beforehand: a machine brakes as often, five times the motor's own friction, give or take e."""
    for size, is_first in ((0.3, False), (2.0, True)):
        found = moved(0.0, 0.0, 0.0, math.log1p(size), is_bare=True)
        taught = moved(0.0, 0.0, 0.0, math.log1p(size))
        assert found.verdict is taught.verdict is Verdict.BEARING
        machine = stats.norm.pdf(math.log(size / 5.0)) * (1.0 + size) / size
        bearing = 2.0 / (math.pi * 0.3) / (1.0 + (math.log1p(size) / 0.3) ** 2)
        assert (found.confidence or 0.0) / (taught.confidence or 1.0) == pytest.approx(
            bearing / (machine + bearing), rel=1e-3
        )
        assert ("motor-env commission start1.csv" in found.reasons[0]) is is_first
        assert not any("coupled machine" in reason for reason in taught.reasons)
    for off, is_loaded in (
        ((0, 0, -0.4, 0.8), True),
        ((0, 0, -0.4, 0), True),
        ((0, 0, 0, -0.6), False),
        ((0.3, 0, -0.4, 0.8), False),
    ):
        loaded = moved(*off, is_bare=True)
        assert loaded.verdict is Verdict.OTHER
        assert ("coupled machine" in loaded.reasons[0]) is is_loaded


def test_a_verdict_says_what_its_sheet_assumes() -> None:
    usual = {"resistance": "usual", "friction": "from a no-load current", "temperature_k": "usual"}
    for faults, verdict in (
        ((), Verdict.HEALTHY),
        ((Fault(FaultKind.WINDING_CONTACT, 0.4),), Verdict.WINDING),
    ):
        found = diagnose(start(*faults), replace(SHEET, usual_tolerances=usual, notes=("odd",)))
        assert found.verdict is verdict
        (said,) = (reason for reason in found.reasons if "are assumed" in reason)
        assert "resistance 2%, temperature 10 K (usual); friction 3% (from a no-load current)" in said
        assert "odd" in found.to_json()["warnings"]
    assert not any("assumed" in reason for reason in judged().reasons)


def test_what_a_tolerance_hides_is_not_the_recordings_fault() -> None:
    wide = replace(SHEET, tolerance=replace(SHEET.tolerance, friction=0.3))
    (said,) = (reason for reason in diagnose(start(), wide).reasons if "undecided" in reason)
    assert said.startswith("the friction is undecided: data sheet RE 25, 12 V allows too much to decide it")


@pytest.mark.parametrize(
    ("faults", "verdict"),
    [
        ((), "healthy"),
        ((Fault(FaultKind.WINDING_CONTACT, 0.3),), "winding"),
        ((Fault(FaultKind.BEARING, 1.0),), "bearing"),
    ],
)
def test_a_sheet_without_inertia_and_inductance_still_judges_the_rest(
    faults: tuple[Fault, ...], verdict: str
) -> None:
    """The guesses are 10 and 50 times too large here."""
    far = replace(SHEET.parameters, inductance_h=50.0 * 0.238e-3, inertia_kg_m2=10.0 * 1.07e-6)
    lacking = replace(
        SHEET,
        parameters=far,
        tolerance=replace(SHEET.tolerance, inductance=1.5, inertia=1.5),
        assumed={"inductance_h": "a guess", "rotor_inertia_kg_m2": "a guess"},
    )
    assert diagnose(start(*faults), lacking).verdict == verdict


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
        assert (one.kind, report_text.as_json(one)["kind"]) == (kind, kind)
    assert judged().kind is None


@pytest.mark.parametrize(
    ("factor", "said"), [(99.0, "B/J is up by 9800% ("), (102.0, "B/J is up by over 10,000% (")]
)
def test_how_far_a_friction_moved_that_nothing_told_before(factor: float, said: str) -> None:
    """Its percents would be of a friction that healthy starts had not told."""
    found = moved(1.0, 0.0, 1.0, math.log(factor))
    assert (found.verdict, found.severity) == (Verdict.OTHER, None)
    (reason,) = (one for one in found.reasons if "B/J" in one)
    assert said in reason
    assert reason.endswith("; K down looks the same as J and B up in the current alone")


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


def test_no_load_excuses_a_motor_whose_sheet_knows_of_none() -> None:
    """What would be healthy with a constant load is told; healthy starts may have had that load."""
    _, fit, reference = fitted()
    off = np.array([-0.068, -0.11, -0.05, 0.078])
    sheet = replace(reference, log_values=fit.log_values - off)
    views = form_hypotheses(fit, sheet, RATE)
    limits = alarm_limits(views, RATE, tests_noise=sheet.log_noise is not None)
    assert [view.is_alarm(limits.z, limits.share) for view in views] == [True, False, True]
    assert decide(fit, sheet, RATE).verdict.is_fault


def test_the_ripple_is_compared_beside_the_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    """Speed and K by hand, per volt where it is unknown; another of the ripple's orders tells nothing."""
    found, fit, _ = fitted()
    starts = Starts(-3.0, 0.1, ripple_hz=1000.0, ripple_constant_v_s=0.02, ripple_log_sd=0.01)
    half = stats.norm.isf(0.025) * 0.01
    for is_known, name in ((True, "K"), (False, "K/V")):
        one = replace(fit, start=replace(fit.start, voltage_known=is_known))
        for hz, is_determined in ((1.49e3, True), (1.51e3, False), (0.66e3, False)):
            monkeypatch.setattr(judging, "ripple_quantities", lambda _, hz=hz: (hz, 0.018))
            told = judging._add_ripple(found, one, starts, RATE)
            assert (told.verdict, told.reasons) == (found.verdict, found.reasons)
            added = told.changes[len(found.changes) :]
            alone = judging._add_ripple(
                replace(found, reasons=(f"B is up{NOTHING_ELSE}",)), one, starts, RATE
            )
            assert alone.reasons == (("B is up" if is_determined else f"B is up{NOTHING_ELSE}"),)
            assert [each.name for each in added] == (["speed", name] if is_determined else [])
            for each, log in zip(added, np.log([1e-3 * hz, 0.9]), strict=is_determined):
                expected = np.exp([log, log - half, log + half])
                assert (each.ratio, each.low, each.high) == pytest.approx(tuple(expected), rel=1e-5)
                assert each.significant


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
    text = repr(found)
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
        assert all(one.endswith("or too short to decide it, only a rise of 101% would show") for one in said)
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
    for deviations, shown in (
        (3.31, "only a rise of 893%"),
        (3.33, "not even a tenfold one"),
    ):  # log 10 over log 2: 3.32
        (told,) = (one for one in doubled(deviations, 0.99).reasons if "is undecided" in one)
        assert told.endswith(f"too short to decide it, {shown} would show")


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
    same = covariance + excess_covariance(covariance, fit.white_covariance)
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
        pull = warmth @ np.linalg.inv(covariance + excess_covariance(covariance, error)) @ warmth
        low, high = (middle, high) if (pull + 15.0**-2) ** -0.5 < 6.0 else (low, middle)
    for kelvin, is_determined in ((11.9, False), (12.1, True)):
        shrunk = pull / (pull + 15.0**-2)
        off = kelvin / shrunk * warmth - bent(kelvin * warmth)
        found = moved(*off, log_covariance=covariance, temperature_k=15.0)
        assert ("12 K warmer" in " ".join(found.reasons)) is is_determined


def test_units_of_the_extensions() -> None:
    _, fit, _ = fitted()
    units = {
        "supply_ramp": "s", "supply_curve": "of the rise (its middle)", "sensor_lag": "s", "speed_lag": "s",
        "dead_zone": "A", "coulomb": "N m", "brush_drop": "V",
    }  # fmt: skip
    extended = replace(fit, fitted_extension=dict.fromkeys(units, (0.5, 0.1)))
    told = report_text.extensions_json(extended)
    assert {name: row["unit"] for name, row in told.items()} == units
    interval = pytest.approx([0.5 - 0.196, 0.5 + 0.196])
    assert told["coulomb"] == {"value": 0.5, "standard_error": 0.1, "interval": interval, "unit": "N m"}
    unknown = replace(extended, start=replace(fit.start, voltage_known=False))
    per_volt = units | {"coulomb": "N m/V", "brush_drop": "of the supply"}
    assert {name: row["unit"] for name, row in report_text.extensions_json(unknown).items()} == per_volt


def test_a_fit_that_explains_too_little_is_unusable() -> None:
    """Three quarters of what is no noise: half of a channel's variance may be, and more than 60 % never count so."""
    _, fit, _ = fitted()
    rng, moves = np.random.default_rng(2), np.repeat([1.0, -1.0], 2000)
    count = np.arange(4000) < 3000
    for noise, least in ((1e-3, 0.75), (1.0, 0.375), (9.0, 0.3)):
        shown = moves + noise * rng.standard_normal(4000)
        start = SimpleNamespace(
            alignment=fit.start.alignment,
            counted=count,
            ripple_a=0.5 * moves,
            speed_rad_s=shown,
            is_coupled=False,
        )
        start.current_a = start.ripple_a + np.where(count, shown, 1e6)
        for off, is_refused in ((-0.02, True), (0.02, False)):
            for channel in ("r2_current", "r2_speed"):
                given = {"r2_current": 1.0, "r2_speed": None, channel: least + off}
                fake = SimpleNamespace(start=start, log_covariance=fit.log_covariance, **given)
                assert (explain_unusable(cast("Any", fake)) is not None) is is_refused
    # Whatever else it tells, what does not tell R is no start.
    for sds, is_refused in (([1.01] * 4, True), ([0.99] * 4, False), ([1.01] + [0.1] * 3, True)):
        wide = replace(fit, log_covariance=np.diag(np.square(sds)))
        assert (explain_unusable(wide) is not None) is is_refused


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
    left_out = replace(fit, start=wild)
    assert np.flatnonzero(np.isnan(left_out.whitened[:, 0])).tolist() == [7, 90]
    assert (left_out.residual_a[[begin + 7, begin + 90]] == 0.0).all()
    assert np.count_nonzero(fit.residual_a[[begin + 7, begin + 90]]) == 2
    problem, zone = fit.solution.problem, float(fit.states[begin + 300, 0])
    hiding = problem.known.copy()
    hiding[index.ZONE] = 2.0 * zone
    blind = replace(fit, solution=replace(fit.solution, problem=replace(problem, known=hiding)))
    np.testing.assert_array_equal(np.isnan(blind.whitened[:, 0]), fit.states[begin:, 0] < zone)
    assert not fit.is_hidden
    assert replace(fit, model=("dead_zone",)).is_hidden


def test_a_warning_is_allowed_for_where_there_is_a_verdict() -> None:
    _, fit, _ = fitted()
    odd = replace(fit, expected=fit.expected + [[0.0, 0.0], [0.05, 0.0]] * (len(fit.expected) // 2))
    warned = of_one(fit=odd)
    said = warned.decisive.warning
    assert "their mean is not 0" in said
    assert f"  {said}; the verdict allows for it" in report_text.expert_lines(warned.decisive)
    assert f"  {said}" in report_text.expert_lines(replace(warned.decisive, reference=None))
    assert report_text.as_json(warned)["warning"] == said
    assert report_text.as_json(warned)["consistent"] is False
