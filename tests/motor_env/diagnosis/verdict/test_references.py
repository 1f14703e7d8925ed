"""What healthy starts or a data sheet teach: the reference of a start, and the motor file it comes from."""

import math
from dataclasses import replace

import numpy as np
import pytest
from judged_by_hand import CURRENT, EXPONENTS, RATE, SCATTER, SHEET, fits, fitted, spread
from present import present
from scipy import stats

from motor_env import InputError
from motor_env.diagnosis import commission
from motor_env.diagnosis.estimation.uncertainty import excess_covariance
from motor_env.diagnosis.readers.noise import difference_noise
from motor_env.diagnosis.verdict import healthy_motor, healthy_spread
from motor_env.diagnosis.verdict.decision import alarm_limits
from motor_env.diagnosis.verdict.healthy_motor import (
    ReferenceShift,
    add_normal_spread,
    reference_of,
    reference_of_pieces,
)
from motor_env.diagnosis.verdict.healthy_spread import (
    explain_disagreement,
    explain_outlier,
    learn_starts,
    predictive_t,
)
from motor_env.diagnosis.verdict.hypotheses import (
    covariance_at_one_temperature,
    form_hypotheses,
    joint_share,
    severity_unit,
    smallest_changes,
    smallest_detectable,
)

# Reaches in: what a reference must hold follows from a motor's equations and from the noise of its starts.
from motor_env.motor.healthy import Fleet
from motor_env.motor.identifiable import names
from motor_env.motor.model import steady_state


def test_the_next_of_several_healthy_ones() -> None:
    """The prior is worth four of them; the next one is off by its own spread and the mean's."""
    logs = np.array([[0.0, 1.0], [0.3, 1.2], [0.6, 0.5]])
    prior = np.array([[0.04, 0.01], [0.01, 0.09]])
    centre, covariance, freedom = predictive_t(logs, prior)
    assert centre == pytest.approx([0.3, 0.9])
    scatter = sum(np.outer(row - centre, row - centre) for row in logs)
    np.testing.assert_allclose(covariance, (scatter + 4.0 * prior) / 6.0 * 4.0 / 3.0)
    assert freedom == 6.0
    one = predictive_t(logs[:1], prior)
    np.testing.assert_allclose(one[1], prior * 2.0)
    assert one[2] == 4.0


def test_the_data_sheet_as_a_reference() -> None:
    """Tolerances of R, L, K, J and B through the powers of each quantity; the supply acts like all per volt."""
    names_of = ("resistance", "inductance", "constants", "inertia", "friction", "supply")
    sizes = {name: (n + 1) / 100.0 for n, name in enumerate(names_of)}
    tolerance = replace(SHEET.tolerance, **sizes, temperature_k=10.0)
    found = present(reference_of(replace(SHEET, tolerance=tolerance), CURRENT))
    heat = 10.0 * np.array([0.00393, 0.0, -0.001, 0.0, 0.0, 0.0])
    motor = np.diag((np.arange(1, 7) / 100.0) ** 2) + np.outer(heat, heat)
    per_volt = np.array([-1.0, -1.0, -1.0, 0.0])  # of R/V, L/V, K^2/(J V) and B/J
    expected = EXPONENTS @ motor @ EXPONENTS.T + 0.06**2 * np.outer(per_volt, per_volt)
    np.testing.assert_allclose(found.log_covariance, expected, rtol=1e-9)
    p = SHEET.parameters
    k2 = p.back_emf_constant_v_s_per_rad * p.torque_constant_n_m_per_a
    drag = p.viscous_friction_n_m_s_per_rad / p.inertia_kg_m2
    values = [p.resistance_ohm, p.inductance_h, k2 / p.inertia_kg_m2, drag]
    assert list(found.values.values()) == pytest.approx(values)
    constant_s = p.resistance_ohm * p.inertia_kg_m2 / k2
    assert found.time_constant_s == pytest.approx(constant_s)
    assert replace(found, names=found.names[:2]).time_constant_s == math.inf  # R and L
    assert (found.temperature_k, found.warmer_k, found.own_friction) == (0.0, 0.0, 1.0)
    noisy = present(
        reference_of(replace(SHEET, current_noise_a=0.05), names(has_voltage=True, has_speed=True))
    )
    assert noisy.log_noise == pytest.approx(math.log(0.05))
    assert noisy.log_noise_sd == 0.10
    assert reference_of(SHEET, names(has_voltage=False, has_speed=False)) is None
    # Brushes that leave 0.8 of the voltage; a drag that is half as much again over the speed, to within 20 %.
    moved = present(
        reference_of(replace(SHEET, tolerance=tolerance), CURRENT, shift=ReferenceShift(0.8, 1.5, 0.2))
    )
    np.testing.assert_allclose(np.exp(moved.log_values - found.log_values), [1.25, 1.25, 1.25, 1.5])
    more = moved.log_covariance - found.log_covariance
    np.testing.assert_allclose(more, np.diag([0.0, 0.0, 0.0, 0.2**2]), atol=1e-12)
    np.testing.assert_allclose(
        np.exp(ReferenceShift(0.5, 3.0).logs), [2.0, 2.0, 2.0, 2.0, 6.0, 1.0]
    )  # the voltage stays
    # Of a drag that is half over the speed, only B is half.
    other = present(reference_of(SHEET, ("R", "B"), shift=ReferenceShift(friction=0.5)))
    assert other.values == pytest.approx({"R": p.resistance_ohm, "B": 0.5 * p.viscous_friction_n_m_s_per_rad})


def test_healthy_starts_teach_the_next_one() -> None:
    given = fits(*SCATTER)
    learned = learn_starts(given)
    logs, error = np.array([fit.log_values for fit in given]), given[0].white_covariance
    centre, covariance, freedom = predictive_t(logs, np.eye(4) * 0.02**2 + error)
    assert learned.values == pytest.approx(np.exp(centre))
    np.testing.assert_allclose(learned.log_covariance, covariance)
    assert (learned.pieces, learned.degrees_of_freedom, learned.quantities) == (3, freedom, CURRENT)
    starts = present(learned.starts)
    # Equal noises: only the prior of 10 % is left, worth four starts.
    assert starts.log_noise == pytest.approx(math.log(given[0].noise_a))
    assert starts.log_noise_sd == pytest.approx(math.sqrt(4.0 * 0.1**2 / 6.0 * 4.0 / 3.0))
    start = given[0].start
    assert starts.sampling_rate_hz == pytest.approx(1.0 / start.dt_s)
    assert starts.duration_s == pytest.approx(0.2, abs=1e-3)
    assert starts.quiet_s == pytest.approx(0.03, abs=1e-3)
    onset_s = start.alignment.onset_s + 0.05 - given[2].onset_s
    later = replace(start, alignment=replace(start.alignment, onset_s=onset_s))
    late = present(learn_starts([*given[:2], replace(given[2], start=later)]).starts)
    assert late.duration_s == pytest.approx((starts.duration_s or 0.0) - 0.05, abs=1e-3)
    assert late.quiet_s == starts.quiet_s
    assert (starts.ripple_hz, starts.ripple_log_sd, learned.temperature_k) == (None, None, 15.0)
    running = given[0].residual_a[start.alignment.onset_index :]
    left, white = float(np.var(running)), difference_noise(running)
    np.testing.assert_allclose(error, given[0].series_covariance * min(white**2 / left, 1.0))
    extended = [replace(fit, model=("coulomb",), fitted_extension={"coulomb": (size, 0.1)}) for fit, size in
                zip(given, (2.0, 1.0, 3.0), strict=True)]  # fmt: skip
    kept = present(learn_starts(extended).starts)
    assert (kept.model, kept.model_low, kept.model_high) == (("coulomb",), (1.0,), (3.0,))


def test_a_reference_speaks_of_what_follows_from_its_quantities() -> None:
    learned = replace(learn_starts(fits(*SCATTER)), temperature_c=20.0)
    same = present(reference_of_pieces(learned, CURRENT, "m", temperature_c=45.0))
    assert (same.temperature_k, same.warmer_k) == (4.0, 25.0)
    assert same.source == "3 healthy starts of m"
    for measured, known in ((None, 20.0), (45.0, None)):
        other = reference_of_pieces(
            replace(learned, temperature_c=known), CURRENT, "m", temperature_c=measured
        )
        assert other is not None
        assert (other.temperature_k, other.warmer_k) == (15.0, 0.0)
    narrow = present(
        reference_of_pieces(replace(learned, temperature_k=2.0), CURRENT, "m", temperature_c=45.0)
    )
    assert narrow.temperature_k == 2.0
    ratio = present(reference_of_pieces(learned, ("R/L", "L"), "m"))
    powers = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    np.testing.assert_allclose(ratio.log_values, powers @ np.log(learned.values))
    np.testing.assert_allclose(ratio.log_covariance, powers @ learned.log_covariance @ powers.T, atol=1e-12)
    assert reference_of_pieces(learned, ("K",), "m") is None
    # Between its own starts only the fits' white errors differ; between sisters all of a fit's error does.
    sisters = present(reference_of_pieces(replace(learned, fleet=Fleet(7, np.eye(4))), CURRENT, "m"))
    assert sisters.source == "7 sisters of m"
    assert (same.includes_fit_error, sisters.includes_fit_error) == (True, False)


def test_healthy_starts_must_agree() -> None:
    """R, K and J to half a logarithm (1 sd); one is odd that lies five of its deviations off the others' median."""
    apart = 0.5 * math.sqrt(2.0)
    for size, is_far in ((0.999, False), (1.001, True)):
        two = fits(*([side * size * apart / math.sqrt(2.0), 0.0, 0.0, 0.0] for side in (-1.0, 1.0)))
        said = explain_disagreement(two)
        assert (said is not None and "their R lies between" in said) is is_far
    assert explain_disagreement(fits([0.0, 0.0, 0.0, -2.0], [0.0, 0.0, 0.0, 2.0])) is None
    others = [[0.0] * 4, [0.02, 0.0, 0.0, 0.0], [-0.02, 0.0, 0.0, 0.0]]
    _, fit, _ = fitted()
    sd = math.sqrt(fit.log_covariance[0, 0] + 0.02**2 + 0.1**2)
    for size, is_odd in ((4.99, False), (5.01, True)):
        given = fits(*others, [size * sd, 0.0, 0.0, 0.0])
        said = explain_outlier(given, 3)
        assert (said is not None) is is_odd
        if said:
            assert said == f"its R is {math.exp(size * sd):.3g} times that of the others"
    assert explain_outlier(fits([0.0] * 4, [9.0] * 4), 1) is None  # of two none is odd


def test_a_start_is_compared_with_what_is_as_warm() -> None:
    """Errors of the fit join those of a sheet; beside healthy starts only what is beyond their own."""
    _, fit, sheet = fitted()
    np.testing.assert_allclose(
        covariance_at_one_temperature(fit, sheet), sheet.log_covariance + fit.log_covariance
    )
    starts = replace(sheet, includes_fit_error=True)
    expected = sheet.log_covariance + excess_covariance(sheet.log_covariance, fit.white_covariance)
    np.testing.assert_allclose(covariance_at_one_temperature(fit, starts), expected)
    warm = replace(starts, temperature_k=15.0, warmer_k=5.0, own_friction=1.0, degrees_of_freedom=8.0)
    view = form_hypotheses(fit, warm, RATE)[0]
    warmth = np.array([0.00393, 0.0, -0.002, -0.003])
    np.testing.assert_allclose(view.load.warmth, warmth)
    # The factors move in proportion to the temperature: by its posterior mean, 15 K believed, the logarithms do too.
    raw = fit.log_values - sheet.log_values - 5.0 * warmth
    slope = np.linalg.inv(expected) @ warmth
    factors = slope @ raw / (slope @ warmth + 15.0**-2) * warmth
    np.testing.assert_allclose(view.difference.log_ratios, raw + factors - np.log1p(factors))
    np.testing.assert_allclose(
        view.difference.covariance,
        add_normal_spread(expected, 225.0 * np.outer(warmth, warmth), RATE / 5.0, 8.0),
    )
    limit = view.faults[0].z
    assert not view.is_alarm(max(one.z for one in view.faults) + 1e-9, 0.0)
    assert view.is_alarm(max(one.z for one in view.faults) - 1e-9, 0.0)
    assert view.is_alarm(math.inf, 1.0) or limit
    views = form_hypotheses(fit, replace(warm, own_friction=None), RATE)
    assert [(one.load.name, one.load.own_friction) for one in views] == [
        (None, 1.0),
        ("constant", 1.0),
        ("constant", 0.0),
        ("fan", 0.0),
    ]
    each = [smallest_changes(one.difference, 3.0) for one in views]
    largest = {kind: max(one[kind] for one in each) for kind in each[0]}
    assert smallest_detectable(views, None, 3.0) == largest
    assert smallest_detectable(views, 0.25, 3.0) == largest | {"bearing": 4.0 * largest["bearing"]}
    assert (
        severity_unit("bearing", 0.3),
        severity_unit("bearing", None),
        severity_unit("winding_contact", 0.3),
    ) == (0.3, 1.0, 1.0)


def test_an_identified_motor_is_the_geometric_mean_of_its_fits() -> None:
    _, fit, _ = fitted()
    theta = fit.solution.theta.copy()
    theta[[fit.solution.names.index(name) for name in "RJ"]] += np.log([4.0, 0.25])
    other = replace(fit, solution=replace(fit.solution, theta=theta))
    motor = healthy_motor.to_motor([fit, other], "two")
    assert motor.parameters.resistance_ohm == pytest.approx(2.0 * float(fit.parameters.resistance_ohm))
    assert motor.parameters.inertia_kg_m2 == pytest.approx(0.5 * float(fit.parameters.inertia_kg_m2))
    assert motor.nominal_voltage_v == pytest.approx(12.0)
    assert motor.current_noise_a == pytest.approx(fit.noise_a)
    for error, told in ((0.0495, 0.1), (0.0505, 0.0)):
        # Twice their mean's standard error: that of one over the root of two.
        pair = [replace(fit, fitted_extension={"coulomb": (0.1, error * math.sqrt(2.0))})] * 2
        assert healthy_motor.to_motor(pair, "two").coulomb_friction_n_m == pytest.approx(told)
    wide = replace(fit, log_covariance=np.diag([0.49, 0.51, 0.1, 0.1]) ** 2)
    assert [one for one in healthy_motor.describe_undetermined(wide) if "is not determined" in one] == [
        "L is not determined by this recording (its standard error is 51 %)"
    ]
    for model, alike in (((), False), (("speed_lag", "coulomb"), False), (("coulomb", "sensor_lag"), True)):
        said = healthy_motor.describe_undetermined(replace(fit, model=model))
        assert any("a lag of the sensor and L look alike" in one for one in said) is alike


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
        _, covariance, freedom = predictive_t(np.delete(logs, n, axis=0), prior)
        same = covariance + excess_covariance(covariance, white)
        whole = add_normal_spread(same, 225.0 * np.outer(warmth, warmth), RATE / 5.0, freedom)
        limit = stats.t.isf(joint_share(0.8 * RATE, whole, EXPONENTS, freedom), freedom)
        expected += bool((limit + 1.645) * math.sqrt(same[3, 3]) > math.log(2.0))
    assert expected == (4 if odd else 0)
    motor = healthy_motor.to_motor(given, "m", healthy=learn_starts(given))
    smallest, undecided = healthy_spread.detectable_changes(motor, given, None, RATE)
    assert undecided == ({"B/J": expected} if odd else {})
    reference = present(reference_of(motor, CURRENT))
    views = form_hypotheses(given[0], reference, RATE)
    assert smallest == smallest_detectable(views, None, alarm_limits(views, RATE, tests_noise=True).z)
    assert (
        healthy_spread.detectable_changes(motor, given[:1], None, RATE)[1] == {}
    )  # nothing is left to judge one by


def test_a_known_temperature_spread_counts_in_the_ratio_of_the_quantiles() -> None:
    covariance, warmth = spread(3), np.array([0.06, 0.0, -0.015])
    ratio = stats.norm.isf(0.002) / stats.t.isf(0.002, 6.0)
    expected = covariance + ratio**2 * np.outer(warmth, warmth)
    np.testing.assert_allclose(
        add_normal_spread(covariance, np.outer(warmth, warmth), 0.002, 6.0), expected, rtol=1e-9
    )
