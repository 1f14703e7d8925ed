"""Fits of starts: residuals, priors and bounds written out, covariances from dense matrices, and what is told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import circulant
from scipy.stats import norm

from motor_env import PAPER_MOTOR
from motor_env.fitting.commutation import (
    back_emf_v,
    constants_at,
    find_ripple,
    ripple_quantities,
)
from motor_env.fitting.plausibility import implausible
from motor_env.fitting.starts import (
    FIT_SAMPLES,
    STRONG_EVIDENCE,
    Extension,
    Problem,
    _rectified_mean,
    _wild_against,
    absolute,
    evidence,
    identify,
    identify_best,
    step_start,
)
from motor_env.fitting.uncertainty import capped, unknowns_covariance
from motor_env.motor.parameters import FloatArray

# Reaches in: starts are aligned by hand, their onset known; dense matrices need the floor of a residual's noise.
from motor_env.recordings.alignment import Alignment
from motor_env.recordings.noise import difference_noise
from motor_env.recordings.start import Circuit, Start

MOTOR = PAPER_MOTOR.scaled(torque_constant_n_m_per_a=0.02352 / 0.0235)
DT_S, QUIET = 2e-4, 40
TIME_S: FloatArray = (np.arange(500.0) - QUIET) * DT_S
TEXTBOOK = Extension()
QUANTITIES = {
    "R": 2.18,
    "L": 0.238e-3,
    "K": 0.02352,
    "J": 1.07e-6,
    "B": 12e-7,
    "K^2/J": 0.02352**2 / 1.07e-6,
    "B/J": 12e-7 / 1.07e-6,
}


def start(
    extension: Extension = TEXTBOOK,
    *,
    noise_a: float = 0.01,
    seed: int = 1,
    speed: bool = False,
    quiet: bool = True,
    level_known: bool = True,
    offset_a: float = 0.02,
    onset_s: float = 0.4 * DT_S,
) -> Start:
    """A start of the paper's motor at 12 V, its onset between two samples, white noise, an offset of the sensor."""
    first = 0 if quiet else QUIET
    time_s = TIME_S[first:]
    states = step_start(MOTOR, extension, time_s, onset_s, 12.0)
    rng = np.random.default_rng(seed)
    current = states[:, 0] + offset_a + noise_a * rng.standard_normal(len(time_s))
    turned = states[:, 1] + 2.0 * rng.standard_normal(len(time_s)) if speed else None
    begin = QUIET - first + 1
    alignment = Alignment(begin, float(time_s[begin]), begin - 2 if quiet else 0, 1.0, offset_a, noise_a)
    level = 12.0 if level_known else 1.0
    return Start(time_s, current, turned, None, level, level_known, alignment)


def truth(problem: Problem, *extras: float) -> FloatArray:
    """The unknowns of the motor that was simulated."""
    logs = [np.log(QUANTITIES[name] / problem.base[name]) for name in problem.free]
    extra = [
        np.log(value / problem.base_extra[name]) for name, value in zip(problem.extras, extras, strict=True)
    ]
    return np.array([*logs, *extra, 0.4 * DT_S, 0.02])


@pytest.mark.parametrize("speed", [False, True])
def test_residuals_at_the_truth_are_the_noise(speed: bool) -> None:
    problem = Problem(start(speed=speed), (), constant=0.02352)
    assert problem.free == (("R", "L", "K", "J", "B") if speed else ("R", "L", "J", "B"))
    states = step_start(MOTOR, TEXTBOOK, TIME_S, 0.4 * DT_S, 12.0)
    noise = problem.start.current_a - states[:, 0] - 0.02
    got = problem.residuals(truth(problem))
    np.testing.assert_allclose(got[:500] * 0.02 * np.ptp(problem.start.current_a), noise, atol=1e-9)
    if problem.start.speed_rad_s is not None:
        left = problem.start.speed_rad_s - states[:, 1]
        np.testing.assert_allclose(got[500:-1] * 0.02 * np.ptp(problem.start.speed_rad_s), left, atol=1e-6)
    assert len(got) == (1001 if speed else 501)
    assert got[-1] == 0.0
    # Weighed by what is left, they have the scatter 1.
    problem.reweight(truth(problem))
    again = problem.residuals(truth(problem))
    assert again[:500].std() == pytest.approx(1.0)
    assert not speed or again[500:1000].std() == pytest.approx(1.0)


@pytest.mark.parametrize("speed", [False, True])
def test_by_eye_a_motor_is_known_to_a_factor_of_three(speed: bool) -> None:
    """Where a fit begins, and without a constant that is believed: the current alone then tells K^2/J and B/J."""
    base = Problem(start(speed=speed), ()).base
    assert base["K"] == pytest.approx(0.02352 if speed else 0.12, rel=0.05)
    told = {"R": base["R"], "L": base["L"], "K^2/J": base["K"] ** 2 / base["J"], "B/J": base["B"] / base["J"]}
    for name, value in told.items():
        assert 1.0 / 3.0 < value / QUANTITIES[name] < 3.0, name


@pytest.mark.parametrize(("quiet", "share"), [(True, 0.05), (False, 0.0002)])
def test_the_offset_is_held_near_that_of_the_quiet_part(quiet: bool, share: float) -> None:
    problem = Problem(start(quiet=quiet), (), constant=0.02352)
    unknowns = truth(problem)
    unknowns[-1] += 0.01
    expected = 0.01 / (share * np.ptp(problem.start.current_a))
    assert problem.residuals(unknowns)[-1] == pytest.approx(expected)
    low, high = problem.bounds
    span = np.ptp(problem.start.current_a)
    assert (low[-1], high[-1]) == pytest.approx((0.02 - 0.5 * span, 0.02 + 0.5 * span))
    assert (low[0], high[0]) == (-12.0, 12.0)
    # A fiftieth of what follows the onset, no earlier than two samples before the first; one sample for a voltage.
    onset, end = problem.start.alignment.onset_s, problem.start.time_s[-1]
    assert high[-2] == pytest.approx(onset + 0.02 * (end - onset))
    assert low[-2] == pytest.approx(max(onset - 0.02 * (end - onset), problem.start.time_s[0] - 2.0 * DT_S))
    measured = replace(problem.start, voltage_v=np.full(len(problem.start.time_s), 12.0))
    low, high = Problem(measured, (), constant=0.02352).bounds
    assert (low[-2], high[-2]) == pytest.approx((onset - 1.5 * DT_S, onset + 1.5 * DT_S))
    hidden = Problem(problem.start, ("dead_zone",), constant=0.02352)
    at_most = np.exp(hidden.bounds[1][4]) * hidden.base_extra["dead_zone"]
    assert at_most == pytest.approx(0.35 * span)


def test_a_typical_inductance_is_believed_to_thirty_per_cent() -> None:
    """Where a lag of supply or sensor takes its place; the current alone tells J and B as multiples of K^2."""
    typical = {"R": 2.0, "L": 3e-4, "K^2/J": 500.0, "B/J": 1.2}
    plain = Problem(start(), (), constant=0.02352, typical=typical)
    ramp = Problem(start(), ("supply_ramp",), constant=0.02352, typical=typical)
    assert not plain.has_inductance_prior
    assert ramp.has_inductance_prior
    unknowns = truth(ramp, 1e-3)
    off = np.log(0.238e-3 / 3e-4) / 0.3
    assert ramp.inductance_off(unknowns) == pytest.approx(off)
    assert ramp.residuals(unknowns)[-2] == pytest.approx(off)
    assert ramp.typical["J"] == pytest.approx(np.log(0.02352**2 / 500.0 / ramp.base["J"]))
    assert ramp.typical["B"] == pytest.approx(np.log(1.2 * 0.02352**2 / 500.0 / ramp.base["B"]))
    assert plain.is_typical(truth(plain))
    far = truth(plain)
    far[0] = plain.typical["R"] + 1.01
    assert not plain.is_typical(far)
    unknown = Problem(start(), ("supply_ramp",), constant=0.02352)
    assert not unknown.has_inductance_prior
    assert unknown.inductance_off(unknowns) == 0.0


def test_quantities_become_parameters() -> None:
    """With the constant that is believed, or that of the quantities; ratios per volt stay ratios."""
    alone = {name: QUANTITIES[name] for name in ("R", "L", "K^2/J", "B/J")}
    got = absolute(alone, 0.02352)
    assert {name: got[name] for name in "RLKJB"} == pytest.approx(
        {name: QUANTITIES[name] for name in "RLKJB"}
    )
    per_volt = absolute({"R/V": 1.0, "K/V": 2.0, "J/V": 3.0, "B/V": 4.0}, 0.5)
    assert per_volt == {"K": 2.0, "R": 1.0, "J": 3.0, "B": 4.0}
    assert absolute({"K^2/(J V)": 5.0, "B/J": 2.0}, 0.5)["J"] == pytest.approx(0.05)


def test_a_curve_of_the_supply_is_shares_of_its_rise() -> None:
    problem = Problem(start(), ("supply_ramp", "supply_curve"), constant=0.02352)
    assert problem.extras == ("supply_ramp", "curve_1", "curve_2", "curve_3", "curve_4")
    unknowns = truth(problem, 1e-3, 2.0, 0.5, 1.0, 3.0)
    _, extension, onset, offset = problem.split(unknowns)
    assert (onset, offset) == (0.4 * DT_S, 0.02)
    assert extension.supply_rise_s == pytest.approx(1e-3)
    assert extension.supply_shares == pytest.approx(np.array([1.0, 2.0, 0.5, 1.0, 3.0]) / 7.5)
    priors = problem.residuals(unknowns)[500:-1]
    np.testing.assert_allclose(priors, np.log([2.0, 0.5, 1.0, 3.0]) / 1.5)


def test_a_shunt_is_in_the_circuit_and_not_in_the_motor() -> None:
    circuit = Circuit(shunt_ohm=0.3, sensor_lag_s=2e-4)
    problem = Problem(replace(start(), circuit=circuit), (), constant=0.02352)
    states = problem.expected(truth(problem), problem.start)
    whole = MOTOR.scaled(resistance_ohm=2.48 / 2.18)
    expected = step_start(whole, Extension(sensor_lag_s=2e-4), TIME_S, 0.4 * DT_S, 12.0)
    np.testing.assert_allclose(states, expected + np.array([0.02, 0.0]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("current", [-0.03, 0.0, 0.01, 0.5])
def test_the_mean_of_a_rectified_reading(current: float) -> None:
    expected = quad(lambda x: x * norm.pdf(x, current, 0.02), 0.0, max(current, 0.0) + 0.3)[0]
    assert _rectified_mean(np.array([current]), 0.02)[0] == pytest.approx(expected, rel=1e-6)
    assert _rectified_mean(np.array([current]), 0.0)[0] == max(current, 0.0)


def test_a_fit_is_given_finite_numbers() -> None:
    problem = Problem(start(), (), constant=0.02352)
    problem.measured[:3] = [np.inf, -np.inf, np.nan]
    assert problem.residuals(truth(problem))[:3].tolist() == [1e6, -1e6, 1e6]


@pytest.mark.parametrize(("lag_s", "least", "most"), [(0.0, 0.0, 5.0), (1e-4, 25.0, 50.0)])
def test_a_score_foretells_what_an_extension_gains(lag_s: float, least: float, most: float) -> None:
    """Of a sensor's lag: near the fall of twice the log-likelihood by its fit (Rao 1948), and small without one."""
    measured = start(Extension(sensor_lag_s=lag_s))
    simple = identify(measured, constant=0.02352)
    rich = identify(measured, ("sensor_lag",), simpler=simple, constant=0.02352)
    gain = 500.0 * np.log(simple.misfit[0] / rich.misfit[0])
    score = Problem(measured, ("sensor_lag",), constant=0.02352).score(simple.unknowns)
    assert least <= score < most
    assert score == pytest.approx(gain, rel=0.1, abs=3.0)


def central_jacobian(problem: Problem, unknowns: FloatArray) -> FloatArray:
    steps = np.diag([*[1e-5] * (len(unknowns) - 2), 1e-3 * DT_S, 1e-5])
    columns = [
        (problem.residuals(unknowns + s) - problem.residuals(unknowns - s)) / (2.0 * s.sum()) for s in steps
    ]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("unseen_a", [0.0, 0.004])
def test_the_covariance_is_the_sandwich_of_dense_matrices(unseen_a: float) -> None:
    """Residuals of a wrong model, correlated over many samples (Newey & West 1987), of both channels."""
    measured = start(Extension(coulomb_friction_n_m=1e-4), speed=True)
    measured = replace(measured, alignment=replace(measured.alignment, unseen_level_a=unseen_a))
    problem = Problem(measured, ("supply_ramp",), typical=QUANTITIES)
    unknowns = truth(problem, 2e-4)
    problem.reweight(unknowns)
    jacobian, left = central_jacobian(problem, unknowns), problem.residuals(unknowns)
    got, independent = unknowns_covariance(problem, unknowns, jacobian)
    # Logarithms are known to 3 beforehand, the onset to half an interval and half the rise of the current.
    rise = 0.238e-3 / 2.18 + 2e-4
    weak = np.diag([1.0 / 9.0] * 6 + [1.0 / (0.5 * (DT_S + rise)) ** 2, 0.0])
    priors = jacobian[1000:].T @ jacobian[1000:] + weak
    meat = priors.copy()
    for begin, count in zip((0, 500), independent, strict=True):
        series = left[begin : begin + 500] - left[begin : begin + 500].mean()
        full = np.array([series[lag:] @ series[: 500 - lag] / 500.0 for lag in range(50)])
        taper = full * (1.0 - np.arange(50) / 50.0)
        wrapped = np.concatenate([taper, np.zeros(501), taper[:0:-1]])
        floor = difference_noise(series[measured.alignment.onset_index :]) ** 2
        spectrum = np.maximum(np.fft.fft(wrapped).real, floor)
        coloured = circulant(np.fft.ifft(spectrum).real)[:500, :500]
        rows = jacobian[begin : begin + 500]
        meat += rows.T @ coloured @ rows
        inflation = max((2.0 * taper.sum() - taper[0]) / taper[0], 1.0)
        assert count == pytest.approx(500.0 / inflation, rel=1e-9)
    level = unseen_a / problem.scale[0] * jacobian[measured.alignment.onset_index : 500].sum(axis=0)
    meat += np.outer(level, level)
    bread = np.linalg.inv(jacobian.T @ jacobian + weak)
    expected = bread @ meat @ bread
    std = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(got / np.outer(std, std), expected / np.outer(std, std), atol=1e-5)


def test_a_covariance_is_capped_at_a_factor_of_e_to_the_ten() -> None:
    turned, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((4, 4)))
    got = capped((turned * [1e-15, 1e-4, 4.0, 1e6]) @ turned.T)
    np.testing.assert_allclose(got, (turned * [1e-12, 1e-4, 4.0, 100.0]) @ turned.T, atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "level_known"), [(False, True), (True, True), (False, False), (True, False)]
)
def test_a_fit_finds_what_its_recording_tells(speed: bool, level_known: bool) -> None:
    fit = identify(start(speed=speed, level_known=level_known), constant=0.02352)
    known = {f"{name}/V": QUANTITIES[name] / 12.0 for name in "RLKJB"} | QUANTITIES
    known["K^2/(J V)"] = QUANTITIES["K^2/J"] / 12.0
    if not level_known:  # per volt of a supply that counts as 1 V
        assert all("V" in name or name == "B/J" for name in fit.quantity_names)
    errors = (fit.log_values - np.log([known[name] for name in fit.quantity_names])) / np.sqrt(
        np.diag(fit.log_covariance)
    )
    assert np.abs(errors).max() < 4.0
    assert np.sqrt(np.diag(fit.log_covariance)).max() < 0.1
    assert fit.onset_s == pytest.approx(0.4 * DT_S, abs=0.05 * DT_S)
    assert fit.offset_a == pytest.approx(0.02, abs=0.003)
    assert fit.noise_a == pytest.approx(0.01, rel=0.1)
    assert fit.fitted_extension == {}


def test_standard_errors_are_the_scatter_of_repeated_starts() -> None:
    fits = [identify(start(seed=seed), constant=0.02352, typical=QUANTITIES) for seed in range(2, 32)]
    logs = np.array([fit.log_values for fit in fits])
    told = np.sqrt(np.mean([np.diag(fit.log_covariance) for fit in fits], axis=0))
    np.testing.assert_allclose(logs.std(axis=0, ddof=1), told, rtol=0.45)
    known = np.log([QUANTITIES[name] for name in fits[0].quantity_names])
    assert (np.abs(logs.mean(axis=0) - known) / told * np.sqrt(30.0)).max() < 4.0


def test_what_a_fit_says_of_itself() -> None:
    """Sizes of the fit, each from its curves; the errors of extensions from the covariance of the unknowns."""
    measured = start(Extension(supply_rise_s=2e-3, supply_shares=(0.1, 0.1, 0.2, 0.2, 0.4)), speed=True)
    model = ("supply_ramp", "supply_curve")
    ramp = identify(measured, model[:1])
    fit = identify(measured, model, simpler=ramp)
    left = measured.current_a - fit.expected[:, 0]
    turned = measured.speed_rad_s
    assert turned is not None
    r2 = [
        1.0 - np.square(each - shown).sum() / np.square(each - each.mean()).sum()
        for each, shown in ((measured.current_a, fit.expected[:, 0]), (turned, fit.expected[:, 1]))
    ]
    assert (fit.r2_current, fit.r2_speed) == pytest.approx(r2, rel=1e-12)
    assert fit.misfit == pytest.approx([1.0 - value for value in r2], rel=1e-9)
    centred = left - left.mean()
    assert fit.lag_one == pytest.approx(centred[1:] @ centred[:-1] / (centred @ centred))
    assert fit.noise_a == pytest.approx(difference_noise(left[QUIET + 1 :]))
    np.testing.assert_allclose(fit.states, fit.expected - np.array([fit.offset_a, 0.0]))
    errors = np.sqrt(np.diag(fit.log_covariance))
    np.testing.assert_allclose(fit.standard_errors, np.exp(fit.log_values) * errors)
    np.testing.assert_allclose(fit.correlation * np.outer(errors, errors), fit.log_covariance)

    problem = Problem(measured, model)
    problem.reweight(fit.unknowns)
    covariance, _ = unknowns_covariance(problem, fit.unknowns, central_jacobian(problem, fit.unknowns))
    place = problem.n_core
    rise_s = problem.base_extra["supply_ramp"] * np.exp(fit.unknowns[place])
    assert fit.fitted_extension["supply_ramp"] == pytest.approx(
        (rise_s, rise_s * np.sqrt(covariance[place, place])), rel=0.02
    )

    def middle(curve: FloatArray) -> float:
        parts = np.array([1.0, *np.exp(curve)])
        return float(parts / parts.sum() @ [0.1, 0.3, 0.5, 0.7, 0.9])

    curve, some = fit.unknowns[place + 1 : place + 5], slice(place + 1, place + 5)
    slopes = np.array([(middle(curve + s) - middle(curve - s)) / 2e-5 for s in 1e-5 * np.eye(4)])
    error = np.sqrt(slopes @ covariance[some, some] @ slopes)
    assert fit.fitted_extension["supply_curve"] == pytest.approx((middle(curve), error), rel=0.02)
    assert abs(middle(curve) - 0.64) < 4.0 * error


def test_what_looks_like_an_inductance_is_told_to_a_factor_of_e() -> None:
    """A ramp where the inductance is typical: its logarithm has the variance 1 beside that of the fit."""
    measured = start(Extension(supply_rise_s=2e-3))
    plain, typical = (
        identify(measured, ("supply_ramp",), constant=0.02352, typical=known) for known in (None, QUANTITIES)
    )
    place = typical.quantity_names.index("L")
    assert 1.0 < typical.log_covariance[place, place] < 1.1
    assert plain.log_covariance[place, place] < 0.5
    assert abs(typical.inductance_off) < 2.0
    assert plain.inductance_off == 0.0


def test_wild_samples_stand_out_of_a_fit_that_goes_through_their_neighbours() -> None:
    """Implementation: more than ten spreads off, three times as far as both neighbours, half of it a jump to each."""
    even = np.where(np.arange(41) % 2 == 0, 1.0, -1.0)  # a spread of 1.4826
    for off, beside, jump, wild in (
        (14.9, 1.0, 14.0, True),
        (14.8, 1.0, 14.0, False),
        (14.9, 4.4, 14.0, True),
        (14.9, 4.5, 14.0, False),
        (-14.9, 1.0, 7.5, True),
        (14.9, 1.0, 7.5, True),
        (14.9, 1.0, 7.4, False),
    ):
        residual, current = even.copy(), np.full(41, 3.0)
        residual[20], residual[21] = off, -beside
        current[20] += np.copysign(jump, off)
        assert _wild_against(residual, current) == ([20] if wild else [])
        current[21:] = 2.0 * current[20] - 3.0  # a slope and no spike
        assert _wild_against(residual, current) == []


def test_evidence_counts_independent_samples() -> None:
    """The Bayesian information criterion (Schwarz 1978), and the prior of an inductance that is known."""
    plain = identify(start(speed=True))
    simple = replace(plain, unknowns=np.zeros(7), inductance_off=3.0)
    rich = replace(plain, unknowns=np.zeros(9), inductance_off=1.0, independent=(120.0, 80.0))
    assert evidence(simple, rich) == pytest.approx(9.0 - 1.0 - 2.0 * np.log(200.0))
    worse = replace(simple, expected=simple.expected + np.array([0.01, 5.0]))
    gain = 120.0 * np.log(worse.misfit[0] / rich.misfit[0]) + 80.0 * np.log(worse.misfit[1] / rich.misfit[1])
    assert gain > 50.0
    assert (STRONG_EVIDENCE, FIT_SAMPLES) == (6.0, 40_000)  # Raftery (1995); what takes about a second
    assert evidence(worse, rich) == pytest.approx(gain + 8.0 - 2.0 * np.log(200.0))


@pytest.mark.parametrize(
    ("extension", "model"), [(TEXTBOOK, ()), (Extension(supply_rise_s=2e-3), ("supply_ramp",))]
)
def test_the_extensions_that_are_there_are_found(extension: Extension, model: tuple[str, ...]) -> None:
    fit = identify_best(start(extension, speed=True))
    assert fit.model == model
    for value, error in fit.fitted_extension.values():
        assert abs(value - 2e-3) < 4.0 * error < 1e-4


def test_values_that_no_motor_has_are_named() -> None:
    """Each just inside and just outside; and nothing of what the start hardly tells."""
    fit = identify(start(speed=True))
    names = list(fit.quantity_names)
    assert implausible(fit) == []

    def moved(**logs: float) -> list[str]:
        values = fit.log_values.copy()
        for name, log in logs.items():
            values[names.index(name)] = log
        return [sentence.partition(" of ")[0] for sentence in implausible(replace(fit, log_values=values))]

    r, el, k, j = (fit.log_values[names.index(name)] for name in "RLKJ")
    for factor, inside in ((0.99, True), (1.01, False)):
        log = np.log(factor)
        assert ("R" not in moved(R=np.log(1e3) + log, L=el + 6.0)) == inside
        assert ("R" not in moved(R=np.log(5e-3) - log)) == inside
        assert ("L" not in moved(L=log)) == inside
        assert ("L" not in moved(L=np.log(1e-7) - log)) == inside
        assert ("K" not in moved(K=np.log(20.0) + log)) == inside
        assert ("K" not in moved(K=np.log(1e-4) - log)) == inside
        assert ("L/R" not in moved(L=r + np.log(0.2) + log)) == inside
        assert ("L/R" not in moved(L=r + np.log(2e-6) - log)) == inside
        assert ("R J/K^2" not in moved(J=2.0 * k - r + np.log(30.0) + log)) == inside
        assert ("R J/K^2" not in moved(J=2.0 * k - r + np.log(5e-4) - log)) == inside
    untold = fit.log_covariance.copy()
    untold[names.index("L"), names.index("L")] = 0.3003**2
    odd = replace(fit, log_values=np.where(np.array(names) == "L", 3.0, fit.log_values))
    assert len(implausible(odd)) == 2
    assert implausible(replace(odd, log_covariance=untold)) == []
    untold[names.index("L"), names.index("L")] = 0.2997**2
    assert len(implausible(replace(odd, log_covariance=untold))) == 2
    far = replace(fit.start, time_s=fit.start.time_s * 300.0)
    assert implausible(replace(fit, start=far))[0].startswith("sampling rate of 16.7 Hz")
    assert j < 0.0


def rippled(per_turn: float, amplitude_a: float) -> Start:
    """A start of 3,000 samples whose current carries a line over the angle."""
    time_s: FloatArray = (np.arange(3000.0) - QUIET) * DT_S
    states = step_start(MOTOR, TEXTBOOK, time_s, 0.4 * DT_S, 12.0)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (states[1:, 1] + states[:-1, 1]) * DT_S)])
    line = amplitude_a * np.sin(per_turn * angle) * (time_s > 0.0)
    current = states[:, 0] + line + 0.01 * np.random.default_rng(2).standard_normal(3000)
    alignment = Alignment(QUIET + 1, float(time_s[QUIET + 1]), QUIET - 1, 1.0, 0.0, 0.01)
    return Start(time_s, current, None, None, 12.0, True, alignment)


def test_the_ripple_of_the_commutator_tells_the_last_speed() -> None:
    fit = identify(rippled(14.003, 0.02), constant=0.02352)
    ripple = find_ripple(fit)
    assert ripple is not None
    speed = (12.0 - 2.18 * fit.states[-1, 0]) / 0.02352
    assert ripple.frequency_hz == pytest.approx(
        14.003 * speed / (2.0 * np.pi), abs=4.0 * ripple.standard_error_hz
    )
    assert ripple.amplitude_a == pytest.approx(0.02, rel=0.2)  # over the angle it is not quite a line
    # Of a sine in white noise, windowed: the power over that of the noise is n a^2 / (4 * 1.5 sigma^2).
    assert ripple.strength == pytest.approx(2959.0 * 0.02**2 / (6.0 * 0.01**2), rel=0.4)
    turned_s = np.trapezoid(fit.states[:, 1], dx=DT_S) / fit.states[-1, 1]  # at the last speed
    expected = np.sqrt(6.0 / ripple.strength) / (np.pi * turned_s)
    assert ripple.standard_error_hz == pytest.approx(expected, rel=2e-3)
    assert find_ripple(identify(rippled(14.0, 0.003), constant=0.02352)) is None
    induced = 12.0 - fit.parameters.resistance_ohm * fit.states[-148:, 0].mean()
    assert back_emf_v(fit) == pytest.approx(induced, rel=1e-3)
    got = ripple_quantities(fit)
    assert got == pytest.approx(
        (ripple.frequency_hz, induced / (2.0 * np.pi * ripple.frequency_hz)), rel=1e-3
    )


def test_a_last_speed_gives_the_constants() -> None:
    """K from V = R i + K w; J and B from K^2/J and B/J, whatever K the fit believed."""
    for believed in (0.01, 0.02352):
        fit = identify(start(noise_a=1e-4), constant=believed)
        speed = float(step_start(MOTOR, TEXTBOOK, TIME_S, 0.4 * DT_S, 12.0)[-25:, 1].mean())
        got = constants_at(fit, speed)
        assert got == pytest.approx({name: QUANTITIES[name] for name in "KJB"}, rel=2e-3)
    shunted = replace(start(noise_a=1e-4), circuit=Circuit(shunt_ohm=0.1))
    fit = identify(shunted, constant=0.02352)
    assert fit.parameters.resistance_ohm == pytest.approx(2.08, rel=1e-3)
    assert back_emf_v(fit) == pytest.approx(
        back_emf_v(identify(start(noise_a=1e-4), constant=0.02352)), rel=1e-5
    )
    unknown = constants_at(identify(start(level_known=False), constant=0.002), 500.0)
    assert list(unknown) == ["K/V", "J/V", "B/V"]
