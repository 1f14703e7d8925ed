"""Fits of starts: residuals, priors and bounds written out, covariances from dense matrices, and what is told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import circulant
from scipy.stats import norm
from started_motor import Beyond, step_start, values_of

from motor_env import PAPER_MOTOR
from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.model_selection import STRONG_EVIDENCE
from motor_env.diagnosis.estimation.problem import Problem, Solution
from motor_env.diagnosis.estimation.record import rectified_mean
from motor_env.diagnosis.estimation.starts.start_fit import (
    NOT_TURNING,
    StartFit,
    back_emf_v,
    constants_at,
    find_ripple,
    implausible,
    is_blocked,
    record_of,
    ripple_quantities,
    shows_turning,
)
from motor_env.diagnosis.estimation.starts.start_identification import (
    _is_applicable,
    _outliers_of_fit,
    evidence,
    identify,
    identify_best,
)

# Reaches in: what is believed of a start before it is fitted, and which samples are wild, are told by no result alone.
from motor_env.diagnosis.estimation.starts.start_prior import FIT_SAMPLES, absolute_parameters, start_prior
from motor_env.diagnosis.estimation.uncertainty import (
    capped,
    free_run_states,
    model_error,
    normalised,
    sandwich,
    score_tests,
    supply_effects,
)

# Reaches in: starts are aligned by hand, their onset known; dense matrices need the floor of a residual's noise.
from motor_env.diagnosis.readers.alignment import Alignment
from motor_env.diagnosis.readers.noise import difference_noise, floor_noise
from motor_env.diagnosis.readers.start import Circuit, Start
from motor_env.motor.parameters import FloatArray

MOTOR = PAPER_MOTOR.scaled(torque_constant_n_m_per_a=0.02352 / 0.0235)
DT_S, QUIET = 2e-4, 40
TIME_S: FloatArray = (np.arange(500.0) - QUIET) * DT_S
ONSET_S = 0.4 * DT_S
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
    *,
    noise_a: float = 0.01,
    seed: int = 1,
    speed: bool = False,
    quiet: bool = True,
    level_known: bool = True,
    offset_a: float = 0.02,
    onset_s: float = ONSET_S,
    **beyond: Beyond,
) -> Start:
    """A start of the paper's motor at 12 V, its onset between two samples, white noise, an offset of the sensor.

    What it has beyond the textbook is named as in `motor_env.diagnosis.estimation.parameter_index`.
    """
    first = 0 if quiet else QUIET
    time_s = TIME_S[first:]
    states = step_start(MOTOR, time_s, onset_s, 12.0, **beyond)
    rng = np.random.default_rng(seed)
    current = states[:, 0] + offset_a + noise_a * rng.standard_normal(len(time_s))
    turned = states[:, 1] + 2.0 * rng.standard_normal(len(time_s)) if speed else None
    begin = QUIET - first + 1
    alignment = Alignment(begin, float(time_s[begin]), begin - 2 if quiet else 0, 1.0, offset_a, noise_a)
    level = 12.0 if level_known else 1.0
    return Start(time_s, current, turned, None, level, level_known, alignment)


def problem_of(
    measured: Start,
    model: tuple[str, ...] = (),
    constant: float | None = 0.02352,
    typical: dict[str, float] | None = None,
) -> Problem:
    return start_prior(measured, constant, typical).problem(model)


def truth(problem: Problem, measured: Start, **extras: float) -> FloatArray:
    """The unknowns of the motor that was simulated; what it has beyond the textbook by the names of the terms."""
    values = QUANTITIES | extras | {"onset": ONSET_S - measured.alignment.onset_s, "offset_current": 0.0}
    ratios = [(values[term.name] / term.unit, term.is_log) for term in problem.free]
    return np.array([np.log(ratio) if is_log else ratio for ratio, is_log in ratios])


def place(problem: Problem, name: str) -> int:
    return problem.names.index(name)


def left_of(problem: Problem, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals of the samples, shape (n_samples, n_channels), and of the beliefs, shape (n_unknowns,)."""
    residuals = problem.residuals(theta)
    n = len(problem.free)
    return residuals[:-n].reshape(-1, int(problem.record.recorded.sum())), residuals[-n:]


@pytest.mark.parametrize("speed", [False, True])
def test_residuals_at_the_truth_are_the_noise(speed: bool) -> None:
    """Over the noises believed, times their geometric mean; what is not believed beforehand has none."""
    measured = start(speed=speed)
    problem = problem_of(measured)
    assert problem.names == ("R", "L", *(("K",) if speed else ()), "J", "B", "onset", "offset_current")
    states = step_start(MOTOR, TIME_S, ONSET_S, 12.0)
    noise_i, noise_w = problem.known[[index.NOISE_I, index.NOISE_W]]
    assert noise_i == pytest.approx(0.02 * np.ptp(measured.current_a))
    got, beliefs = left_of(problem, truth(problem, measured))
    scale = np.sqrt(noise_i * noise_w) if speed else noise_i
    np.testing.assert_allclose(
        got[:, 0] * noise_i / scale, measured.current_a - states[:, 0] - 0.02, atol=1e-9
    )
    if measured.speed_rad_s is not None:
        assert noise_w == pytest.approx(0.02 * np.ptp(measured.speed_rad_s))
        np.testing.assert_allclose(
            got[:, 1] * noise_w / scale, measured.speed_rad_s - states[:, 1], atol=1e-6
        )
    assert got.shape == (500, 2 if speed else 1)
    assert not beliefs.any()
    # Weighed by what is left, they have the scatter 1.
    weighed = Solution(problem, truth(problem, measured), 0.0).reweighted()
    noises = weighed.known[[index.NOISE_I, index.NOISE_W]] if speed else weighed.known[[index.NOISE_I]]
    again = left_of(weighed, truth(problem, measured))[0] / np.exp(np.mean(np.log(noises)))
    assert again.std(axis=0) == pytest.approx(np.ones(2 if speed else 1))


@pytest.mark.parametrize("speed", [False, True])
def test_by_eye_a_motor_is_known_to_a_factor_of_three(speed: bool) -> None:
    """Where a fit begins, and without a constant that is believed: the current alone then tells K^2/J and B/J."""
    known = problem_of(start(speed=speed), constant=None).known
    base = dict(zip("RLKJB", known[[index.R, index.L, index.K, index.J, index.B]], strict=True))
    assert base["K"] == pytest.approx(0.02352 if speed else 0.12, rel=0.05)
    told = {"R": base["R"], "L": base["L"], "K^2/J": base["K"] ** 2 / base["J"], "B/J": base["B"] / base["J"]}
    for name, value in told.items():
        assert 1.0 / 3.0 < value / QUANTITIES[name] < 3.0, name


@pytest.mark.parametrize(("quiet", "share"), [(True, 0.05), (False, 0.0002)])
def test_the_offset_is_held_near_that_of_the_quiet_part(quiet: bool, share: float) -> None:
    measured = start(quiet=quiet)
    problem = problem_of(measured)
    unknowns, span = truth(problem, measured), np.ptp(measured.current_a)
    offset, onset_term = problem.free[-1], problem.free[-2]
    unknowns[-1] += 0.01 / offset.unit
    belief = left_of(problem, unknowns)[1][-1] / problem.known[index.NOISE_I]
    assert belief == pytest.approx(0.01 / (share * span))
    assert (offset.unit * offset.low, offset.unit * offset.high) == pytest.approx((-0.5 * span, 0.5 * span))
    assert (problem.free[0].low, problem.free[0].high) == (-12.0, 12.0)
    # A fiftieth of what follows the onset, no earlier than two samples before the first; one sample for a voltage.
    onset, end = measured.alignment.onset_s, measured.time_s[-1]
    assert onset_term.value(onset_term.high) == pytest.approx(0.02 * (end - onset))
    earliest = max(-0.02 * (end - onset), measured.time_s[0] - 2.0 * DT_S - onset)
    assert onset_term.value(onset_term.low) == pytest.approx(earliest)
    driven = replace(measured, voltage_v=np.full(len(measured.time_s), 12.0))
    delay = problem_of(driven).free[-2]
    assert (delay.name, delay.low, delay.high) == ("delay", -1.5, 1.5)
    hidden = problem_of(measured, ("dead_zone",))
    zone = hidden.free[place(hidden, "dead_zone")]
    assert zone.value(zone.high) == pytest.approx(0.35 * span)
    rectified = replace(measured, alignment=replace(measured.alignment, rectified=True))
    assert "offset_current" not in problem_of(rectified).names


def test_a_short_start_leaves_its_onset_five_samples() -> None:
    first = replace(start(), time_s=TIME_S[:100], current_a=start().current_a[:100])
    onset = problem_of(first).free[-2]
    assert (onset.low, onset.high) == pytest.approx((-5.0, 5.0))


def test_a_typical_inductance_is_believed_to_thirty_per_cent() -> None:
    """Where a lag of supply or sensor takes its place; the current alone tells J and B as multiples of K^2."""
    typical = {"R": 2.0, "L": 3e-4, "K^2/J": 500.0, "B/J": 1.2}
    measured = start()
    belief = start_prior(measured, 0.02352, typical)
    plain, ramp = belief.problem(()), belief.problem(("supply_ramp",))
    off = np.log(0.238e-3 / 3e-4) / 0.3
    assert plain.free[1].prior_sd == np.inf
    assert ramp.free[1].prior_sd == 0.3
    for name in ("supply_curve", "sensor_lag"):
        assert belief.problem((name,)).free[1].prior_sd == 0.3
    assert belief.problem(("coulomb",)).free[1].prior_sd == np.inf
    unknowns = truth(ramp, measured, supply_ramp=1e-3)
    assert belief.inductance_deviation(unknowns) == pytest.approx(off)
    assert left_of(ramp, unknowns)[1][1] / ramp.known[index.NOISE_I] == pytest.approx(off)
    assert belief.typical["J"] == pytest.approx(np.log(0.02352**2 / 500.0 / ramp.known[index.J]))
    assert belief.typical["B"] == pytest.approx(np.log(1.2 * 0.02352**2 / 500.0 / ramp.known[index.B]))
    assert belief.is_typical(truth(plain, measured))
    far = truth(plain, measured)
    far[0] = belief.typical["R"] + 1.01
    assert not belief.is_typical(far)
    unknown = start_prior(measured, 0.02352, None)
    assert unknown.problem(("supply_ramp",)).free[1].prior_sd == np.inf
    assert unknown.inductance_deviation(unknowns) == 0.0
    driven = replace(measured, voltage_v=np.full(500, 12.0))  # the two lags change places there, too
    assert start_prior(driven, 0.02352, typical).problem(("sensor_lag",)).free[1].prior_sd == 0.3


def test_quantities_become_parameters() -> None:
    """With the constant that is believed, or that of the quantities; ratios per volt stay ratios."""
    alone = {name: QUANTITIES[name] for name in ("R", "L", "K^2/J", "B/J")}
    got = absolute_parameters(alone, 0.02352)
    assert {name: got[name] for name in "RLKJB"} == pytest.approx(
        {name: QUANTITIES[name] for name in "RLKJB"}
    )
    per_volt = absolute_parameters({"R/V": 1.0, "K/V": 2.0, "J/V": 3.0, "B/V": 4.0}, 0.5)
    assert per_volt == {"K": 2.0, "R": 1.0, "J": 3.0, "B": 4.0}
    assert absolute_parameters({"K^2/(J V)": 5.0, "B/J": 2.0}, 0.5)["J"] == pytest.approx(0.05)


def test_a_curve_of_the_supply_is_shares_of_its_rise() -> None:
    measured = start()
    problem = problem_of(measured, ("supply_ramp", "supply_curve"))
    curve = {f"curve_{n + 1}": share for n, share in enumerate((2.0, 0.5, 1.0, 3.0))}
    assert problem.names[4:-2] == ("supply_ramp", *curve)
    unknowns = truth(problem, measured, supply_ramp=1e-3, **curve)
    values = problem.values(unknowns)
    assert values[index.RISE] == pytest.approx(1e-3)
    assert values[index.CURVE] == pytest.approx([2.0, 0.5, 1.0, 3.0])
    beliefs = left_of(problem, unknowns)[1][5:-2] / problem.known[index.NOISE_I]
    np.testing.assert_allclose(beliefs, np.log([2.0, 0.5, 1.0, 3.0]) / 1.5)


def test_a_rise_without_a_curve_is_a_straight_line() -> None:
    """Five equal parts: before the fit, in it and after it; its current is that of the means of a straight line."""
    fit = identify(start(RISE=2e-3), ("supply_ramp",), constant=0.02352)
    for values in (fit.solution.problem.known, fit.physical, identify(start(), constant=0.02352).physical):
        assert values[index.CURVE].tolist() == [1.0] * 4
    rise_s, since = float(fit.physical[index.RISE]), TIME_S - fit.onset_s
    area = np.where(since < rise_s, 0.5 * np.maximum(since, 0.0) ** 2 / rise_s, since - 0.5 * rise_s)
    pair = fit.solution.problem.record.supply(fit.physical)[0]
    np.testing.assert_array_equal(pair[:, 0], pair[:, 1])
    np.testing.assert_allclose(pair[QUIET + 2 :, 0], 12.0 * np.diff(area)[QUIET + 1 :] / DT_S, rtol=1e-8)


def test_a_shunt_is_in_the_circuit_and_not_in_the_motor() -> None:
    measured = replace(start(), circuit=Circuit(shunt_ohm=0.3, sensor_lag_s=2e-4))
    problem = problem_of(measured)
    values = problem.values(truth(problem, measured))
    assert values[index.R] == pytest.approx(2.18)
    states = problem.record.predict(values, learn=False)[0][:, 2:4]
    whole = MOTOR.scaled(resistance_ohm=2.48 / 2.18)
    expected = step_start(whole, TIME_S, ONSET_S, 12.0, LAG_I=2e-4)
    np.testing.assert_allclose(states, expected, rtol=1e-9, atol=1e-12)


def test_what_a_start_shows_of_another_motor() -> None:
    """Its own supply, circuit and samples, and what its sensor hides; the offset of its quiet part is not in it."""
    measured = replace(start(speed=True), circuit=Circuit(shunt_ohm=0.3))
    fit = identify(measured)
    motor, volts = MOTOR.scaled(resistance_ohm=1.2), np.full(500, 12.0)
    whole = motor.scaled(resistance_ohm=1.0 + 0.3 / float(motor.resistance_ohm))
    late = ONSET_S - measured.alignment.onset_s
    got = fit.run(values_of(motor, ONSET=late, OFFSET_I=0.1))
    np.testing.assert_allclose(
        got, step_start(whole, TIME_S, ONSET_S, 12.0) + np.array([0.1, 0.0]), atol=1e-9
    )
    record = record_of(replace(measured, voltage_v=volts, from_rest=False))
    assert (record.onset_s, record.shunt_ohm, record.rectified_a) == (None, 0.3, None)
    np.testing.assert_array_equal(record.voltage_v, volts)


def test_the_record_of_a_start_is_what_counts_of_it() -> None:
    """Without the ripple and the quiet part's offset; wild samples are none; a speed where there is one."""
    measured = start(speed=True)
    wild = replace(measured, alignment=replace(measured.alignment, wild=(3, 60)))
    record = record_of(wild)
    assert np.flatnonzero(np.isnan(record.readings[:, 0])).tolist() == [3, 60]
    expected = np.delete(measured.current_a - 0.02, [3, 60])
    np.testing.assert_allclose(np.delete(record.readings[:, 0], [3, 60]), expected)
    np.testing.assert_array_equal(record.readings[:, 1], measured.speed_rad_s)
    missing = np.zeros((500, 2), dtype=np.bool_)
    missing[70, 0] = missing[[80, 90], 1] = True
    holed = record_of(replace(wild, missing=missing)).readings
    assert [np.flatnonzero(np.isnan(one)).tolist() for one in holed.T] == [[3, 60, 70], [80, 90]]
    assert record.is_start
    assert record.recorded.tolist() == [1.0, 1.0]
    assert record_of(replace(measured, speed_rad_s=None)).recorded.tolist() == [1.0, 0.0]
    assert record.onset_s == pytest.approx((QUIET + 1) * DT_S)  # from the first sample to where it was found
    problem = problem_of(wild)
    assert problem.count == 998
    assert not left_of(problem, truth(problem, wild))[0][[3, 60], 0].any()
    rectified = record_of(replace(measured, alignment=replace(measured.alignment, rectified=True)))
    assert rectified.rectified_a == 0.01


@pytest.mark.parametrize("current", [-0.03, 0.0, 0.01, 0.5])
def test_the_mean_of_a_rectified_reading(current: float) -> None:
    expected = quad(lambda x: x * norm.pdf(x, current, 0.02), 0.0, max(current, 0.0) + 0.3)[0]
    assert rectified_mean(np.array([current]), 0.02)[0] == pytest.approx(expected, rel=1e-6)
    assert rectified_mean(np.array([current]), 0.0)[0] == max(current, 0.0)


def test_a_fit_is_given_finite_numbers() -> None:
    """A missing sample counts nothing, an infinite one much, and so does every sample under values that are none."""
    measured = start()
    problem = problem_of(measured)
    unknowns = truth(problem, measured)
    for wild in (np.inf, -np.inf):
        problem.record.readings[:3, 0] = [wild, wild, np.nan]
        got, scale = left_of(problem, unknowns)[0][:, 0], problem.known[index.NOISE_I]
        # Two of 500 count otherwise.
        assert got[:3] == pytest.approx([1e6 * scale, 1e6 * scale, 0.0], rel=0.01)
    assert problem.count == 497
    unknowns[place(problem, "R")] = np.nan
    np.testing.assert_allclose(left_of(problem, unknowns)[0][QUIET + 1 :, 0], 1e6 * scale, rtol=0.01)


@pytest.mark.parametrize(("lag_s", "least", "most"), [(0.0, 0.0, 5.0), (1e-4, 25.0, 50.0)])
def test_a_score_foretells_what_an_extension_gains(lag_s: float, least: float, most: float) -> None:
    """Of a sensor's lag: near the fall of twice the log-likelihood by its fit (Rao 1948), and small without one."""
    measured = start(LAG_I=lag_s)
    simple = identify(measured, constant=0.02352)
    rich = identify(measured, ("sensor_lag",), simpler=simple, constant=0.02352)
    gain = 500.0 * np.log(simple.misfit[0] / rich.misfit[0])
    every = start_prior(measured, 0.02352, None).available_terms
    tests = score_tests(simple.solution, every, ("sensor_lag",), np.exp([-2.0, 0.0, 2.0, 4.0]).tolist())
    score = tests["sensor_lag"].chi_square
    assert least <= score < most
    assert score == pytest.approx(gain, rel=0.1, abs=3.0)


def central_jacobian(problem: Problem, unknowns: FloatArray) -> FloatArray:
    steps = 1e-5 * np.eye(len(unknowns))
    columns = [(problem.residuals(unknowns + s) - problem.residuals(unknowns - s)) / 2e-5 for s in steps]
    return np.stack(columns, axis=1)


def dense_covariance(problem: Problem, theta: FloatArray, measured: Start) -> tuple[FloatArray, list[float]]:
    """The sandwich of dense matrices: residuals correlated over many samples (Newey & West 1987)."""
    n, p, begin = len(measured.time_s), len(theta), measured.alignment.onset_index
    channels, values = int(problem.record.recorded.sum()), problem.values(theta)
    noises = values[[index.NOISE_I, index.NOISE_W][:channels]]
    left = problem.residuals(theta)
    scale = np.sqrt(left @ left / problem.count)
    jacobian, left = central_jacobian(problem, theta) / scale, left / scale
    # Logarithms are known to 3 beforehand, and so are sizes in theirs; the onset to half an interval and half the
    # rise of the current; the offset as far as its quiet part tells.
    rise = values[index.L] / values[index.R] + values[index.RISE] + values[index.LAG_I]
    sd = np.array(
        [
            3.0 * (1.0 if term.is_log else max(abs(one), term.usual))
            for term, one in zip(problem.free, theta, strict=True)
        ]
    )
    sd[-2] = 0.5 * (1.0 + rise / DT_S)
    sd[[term.prior_sd < np.inf for term in problem.free]] = np.inf
    weak = np.diag(1.0 / sd**2)
    beliefs = jacobian[-p:].T @ jacobian[-p:] + weak
    meat, counts = beliefs.copy(), []
    for channel in range(channels):
        rows, series = jacobian[channel : n * channels : channels], left[channel : n * channels : channels]
        series = series - series.mean()
        lags = n // 10
        full = np.array([series[lag:] @ series[: n - lag] / n for lag in range(lags)])
        taper = full * (1.0 - np.arange(lags) / lags)
        wrapped = np.concatenate([taper, np.zeros(n + 1), taper[:0:-1]])
        spectrum = np.maximum(np.fft.fft(wrapped).real, difference_noise(series[begin:]) ** 2)
        meat += rows.T @ circulant(np.fft.ifft(spectrum).real)[:n, :n] @ rows
        counts.append(n / max((2.0 * taper.sum() - taper[0]) / taper[0], 1.0))
    current = jacobian[begin * channels : n * channels : channels]
    level = measured.alignment.unseen_level_a / noises[0] * current.sum(axis=0)
    meat += np.outer(level, level)
    bread = np.linalg.inv(jacobian.T @ jacobian + weak)
    return bread @ meat @ bread, counts


@pytest.mark.parametrize("unseen_a", [0.0, 0.004])
def test_the_covariance_is_the_sandwich_of_dense_matrices(unseen_a: float) -> None:
    """Residuals of a wrong model, of both channels."""
    measured = start(speed=True, COULOMB=1e-4)
    measured = replace(measured, alignment=replace(measured.alignment, unseen_level_a=unseen_a))
    problem = problem_of(measured, ("supply_ramp",), None, QUANTITIES)
    theta = truth(problem, measured, supply_ramp=2e-4)
    problem = Solution(problem, theta, 0.0).reweighted()
    jacobian = problem.jacobian(theta, problem.residuals(theta))
    level, begin = unseen_a / problem.known[index.NOISE_I], measured.alignment.onset_index
    white, rows = normalised(problem, theta, jacobian, range(len(theta)))
    got, independent = sandwich(white, rows, begin=begin, level=level)
    expected, counts = dense_covariance(problem, theta, measured)
    assert independent == pytest.approx(counts, rel=1e-9)
    std = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(got / np.outer(std, std), expected / np.outer(std, std), atol=2e-3)


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


def moved_by_an_inductance(best: Solution, share: float) -> FloatArray:
    """Unknowns of the fit with more L, by that share of the mechanical time constant, less the best; to first order."""
    values, at, small = best.values, best.names.index("L"), 1e-2
    more = share * values[index.R] ** 2 * values[index.J] / values[index.K] ** 2 / values[index.L]
    begun = best.theta.copy()
    begun[at] += np.log1p(small * more)
    free = tuple(term for term in best.problem.free if term.name != "L")
    fixed = replace(best.problem, free=free, known=best.problem.values(begun))
    moved = (fixed.solve(np.delete(begun, at)).theta - np.delete(best.theta, at)) / small
    return np.insert(moved, at, min(np.log1p(more), 3.0))


def test_what_a_fit_says_of_itself() -> None:
    """Sizes of the fit, each from its curves; the errors of extensions from the covariance of the unknowns."""
    measured = start(speed=True, RISE=2e-3, CURVE=[1.0, 2.0, 2.0, 4.0])
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
    assert fit.noise_a == pytest.approx(floor_noise(left[QUIET + 1 :]))
    np.testing.assert_allclose(fit.states, fit.expected - np.array([fit.offset_a, 0.0]))
    np.testing.assert_allclose(fit.run(fit.physical)[:, 0] + 0.02, fit.expected[:, 0])
    errors = np.sqrt(np.diag(fit.log_covariance))
    np.testing.assert_allclose(fit.standard_errors, np.exp(fit.log_values) * errors)
    np.testing.assert_allclose(fit.correlation * np.outer(errors, errors), fit.log_covariance)

    problem, theta = fit.solution.problem, fit.solution.theta
    assert problem.free == problem_of(measured, model, None).free
    covariance, counts = dense_covariance(problem, theta, measured)
    assert fit.independent == pytest.approx(counts, rel=1e-6)
    series = np.sqrt(np.diag(fit.series_covariance))
    np.testing.assert_allclose(series, np.sqrt(np.diag(covariance))[:5], rtol=0.02)
    jacobian = problem.jacobian(theta, problem.residuals(theta))
    states = free_run_states(fit.solution)
    np.testing.assert_allclose(states[:, :2], fit.run(fit.physical), atol=0.03)
    np.testing.assert_allclose(states[1:-1, 2:], 0.5 * (states[2:, :2] - states[:-2, :2]))
    told = normalised(problem, theta, jacobian, range(len(theta)))
    more = model_error(*told, covariance, states=states)
    rounded = states * (1.0 + 1e-9 * np.random.default_rng(1).standard_normal(states.shape))
    rounded += 1e-12 * np.random.default_rng(2).standard_normal(states.shape)
    again = model_error(*told, covariance, states=rounded)
    np.testing.assert_allclose(np.diag(again), np.diag(more), rtol=1e-3)  # another machine's rounding
    covariance += more
    usual = moved_by_an_inductance(fit.solution, 0.03)
    covariance += np.outer(usual, usual)
    np.testing.assert_allclose(errors, np.sqrt(np.diag(covariance))[:5], rtol=0.02)
    assert (errors > series).any()
    first = place(problem, "supply_ramp")
    unit = problem.free[first].unit
    assert fit.fitted_extension["supply_ramp"] == pytest.approx(
        (unit * theta[first], unit * np.sqrt(covariance[first, first])), rel=0.03
    )

    def middle(curve: FloatArray) -> float:
        parts = np.array([1.0, *np.exp(curve)])
        return float(parts / parts.sum() @ [0.1, 0.3, 0.5, 0.7, 0.9])

    curve, some = theta[first + 1 : first + 5], slice(first + 1, first + 5)
    slopes = np.array([(middle(curve + s) - middle(curve - s)) / 2e-5 for s in 1e-5 * np.eye(4)])
    error = np.sqrt(slopes @ covariance[some, some] @ slopes)
    assert fit.fitted_extension["supply_curve"] == pytest.approx((middle(curve), error), rel=0.02)
    assert abs(middle(curve) - 0.64) < 4.0 * error


def sagging(measured: Start, share: float) -> Start:
    """The same start at a supply that loses so much of its voltage at the largest current, with its square."""
    healthy = identify(measured)
    record, current = record_of(measured), healthy.states[:, 0]
    for _ in range(40):
        left = record.voltage_v * (1.0 - share * (current / current.max()) ** 2)
        sagged = replace(record, voltage_v=left).predict(healthy.physical, learn=False)[0][:, 2]
        current = 0.7 * current + 0.3 * sagged
    return replace(measured, current_a=current + measured.current_a - healthy.states[:, 0])


def test_a_supply_that_may_sag_widens_what_is_told_in_ohms() -> None:
    """A voltage that was told and not recorded; per volt of one that nobody knows, nothing is claimed."""
    sd = []
    for share, known in ((0.0, True), (0.05, True), (0.05, False)):
        fit = identify(sagging(start(noise_a=1e-3, level_known=known), share))
        sd.append(float(np.sqrt(fit.log_covariance[0, 0])))
        if known:
            off = float(fit.log_values[0]) - np.log(QUANTITIES["R"])
            sag = supply_effects(fit.solution)[1]
            assert sag.value == pytest.approx(20.0 * share, abs=0.2)
            assert off == pytest.approx(share, abs=0.02)
            assert abs(off) < 2.0 * sd[-1]
    rising = identify(sagging(start(noise_a=1e-3), -0.05))
    assert supply_effects(rising.solution)[1].chi_square == 0.0  # no supply rises under its load
    assert sd[1] > 5.0 * sd[0]
    assert sd[2] < 0.5 * sd[1]


def test_what_looks_like_an_inductance_is_told_to_a_factor_of_e() -> None:
    """A ramp where the inductance is typical: its logarithm has the variance 1 beside that of the fit."""
    measured = start(RISE=2e-3)
    plain, typical = (
        identify(measured, ("supply_ramp",), constant=0.02352, typical=known) for known in (None, QUANTITIES)
    )
    row = typical.quantity_names.index("L")
    assert 1.0 < typical.log_covariance[row, row] < 1.1
    assert plain.log_covariance[row, row] < 0.7
    assert abs(typical.inductance_deviation) < 2.0
    assert plain.inductance_deviation == 0.0


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
        assert _outliers_of_fit(residual, current) == ([20] if wild else [])
        current[21:] = 2.0 * current[20] - 3.0  # a slope and no spike
        assert _outliers_of_fit(residual, current) == []


def test_evidence_counts_independent_samples() -> None:
    """The Bayesian information criterion (Schwarz 1978), and the prior of an inductance that is known."""
    plain = identify(start(speed=True))

    def with_unknowns(count: int) -> StartFit:
        return replace(plain, solution=replace(plain.solution, theta=np.zeros(count)))

    simple = replace(with_unknowns(7), inductance_deviation=3.0)
    rich = replace(with_unknowns(9), inductance_deviation=1.0, independent=(120.0, 80.0))
    assert evidence(simple, rich) == pytest.approx(9.0 - 1.0 - 2.0 * np.log(200.0))
    worse = replace(simple, expected=simple.expected + np.array([0.01, 5.0]))
    gain = 120.0 * np.log(worse.misfit[0] / rich.misfit[0]) + 80.0 * np.log(worse.misfit[1] / rich.misfit[1])
    assert gain > 50.0
    assert (STRONG_EVIDENCE, FIT_SAMPLES) == (6.0, 40_000)  # Raftery (1995); what takes about a second
    assert evidence(worse, rich) == pytest.approx(gain + 8.0 - 2.0 * np.log(200.0))


@pytest.mark.parametrize(("rise_s", "model"), [(0.0, ()), (2e-3, ("supply_ramp",))])
def test_the_extensions_that_are_there_are_found(rise_s: float, model: tuple[str, ...]) -> None:
    fit = identify_best(start(speed=True, RISE=rise_s))
    assert fit.model == model
    for value, error in fit.fitted_extension.values():
        assert abs(value - 2e-3) < 4.0 * error < 2e-4


def test_terms_are_tried_only_where_a_start_can_tell_them() -> None:
    """A sensor that shows currents below 0 hides no small ones; a lag that is known is not fitted again."""
    above = start(noise_a=0.0, offset_a=0.0)
    below = replace(above, current_a=above.current_a - 0.05)
    for measured, hides in ((above, True), (below, False), (replace(above, from_rest=False), False)):
        assert _is_applicable("dead_zone", measured, (), knows_inductance=False) is hides
    for lag_s, knows_inductance, is_tried in ((0.0, True, True), (0.0, False, False), (1e-4, True, False)):
        known = replace(above, circuit=Circuit(sensor_lag_s=lag_s))
        assert _is_applicable("sensor_lag", known, (), knows_inductance=knows_inductance) is is_tried


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
    for factor, inside in ((0.999, True), (1.001, False)):
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


def test_a_start_that_tells_no_pull_shows_no_turning_motor() -> None:
    """K^2/J, or with the speed K, just inside and just outside a factor of e; other quantities do not count."""
    for has_speed, name in ((True, "K"), (False, "K^2/J")):
        fit = identify(start(speed=has_speed))
        at = fit.quantity_names.index(name)
        for log_sd, turns in ((0.99, True), (1.01, False)):
            spread = 9.0 * np.eye(len(fit.quantity_names))
            spread[at, at] = log_sd**2
            odd = replace(fit, log_covariance=spread)
            assert shows_turning(odd) == turns
            assert implausible(odd) == ([] if turns else [NOT_TURNING])


def test_a_current_that_hardly_falls_is_of_a_blocked_rotor() -> None:
    """Two time constants of a healthy motor after it is switched on: in the last tenth, by less than a fifth."""
    fit = identify(start(speed=False))
    untold = replace(fit, log_covariance=1.01 * np.eye(len(fit.quantity_names)))
    lasts, after = float(fit.start.time_s[-1]) - fit.onset_s, fit.start.time_s >= fit.onset_s

    def held(share: float, *, of: StartFit = untold) -> StartFit:
        current = np.where(after, 3.0, 0.0)
        current[-len(current) // 10 :] *= share
        shown = fit.expected.copy()
        shown[:, 0] = current + fit.offset_a
        seen = replace(of.start, current_a=shown[:, 0])
        return replace(of, start=seen, expected=shown)

    for share, stands in ((0.81, True), (0.79, False)):
        assert is_blocked(held(share), 0.1 * lasts) is stands
    for constant_s, stands in ((lasts / 2.01, True), (lasts / 1.99, False), (np.inf, False)):
        assert is_blocked(held(1.0), constant_s) is stands
    assert not is_blocked(held(1.0, of=fit), 0.1 * lasts)  # which tells K^2/J
    clipped = replace(fit.start.alignment, saturation="at 3 A")
    whole = held(1.0)
    assert not is_blocked(replace(whole, start=replace(whole.start, alignment=clipped)), 0.1 * lasts)
    noise = 1.5 * np.random.default_rng(1).standard_normal(len(after))  # R2 far below 0.75
    noisy = replace(whole.start, current_a=whole.start.current_a + noise)
    assert not is_blocked(replace(whole, start=noisy), 0.1 * lasts)


def rippled(per_turn: float, amplitude_a: float) -> Start:
    """A start of 3,000 samples whose current carries a line over the angle."""
    time_s: FloatArray = (np.arange(3000.0) - QUIET) * DT_S
    states = step_start(MOTOR, time_s, ONSET_S, 12.0)
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
    for constant in (0.01, 0.02352):
        fit = identify(start(noise_a=1e-4), constant=constant)
        speed = float(step_start(MOTOR, TIME_S, ONSET_S, 12.0)[-25:, 1].mean())
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


@pytest.mark.parametrize("n", [50, 400, 5000])
def test_the_floor_of_a_spectrum_is_the_white_noise(n: int) -> None:
    """On average over many series; below 40 samples second differences tell it."""
    drawn = 0.3 * np.random.default_rng(n).standard_normal((100, n))
    assert np.mean([floor_noise(one) ** 2 for one in drawn]) == pytest.approx(0.09, rel=0.06)
    assert floor_noise(drawn[0, :39]) == difference_noise(drawn[0, :39])


@pytest.mark.parametrize("share", [0.7, 1.5, 4.0])
def test_a_line_is_no_noise_whether_it_is_taken_off_or_not(share: float) -> None:
    """Of 882 Hz, beside noise: where it is small against it, it stays in the residual."""
    rng, time_s = np.random.default_rng(2), DT_S * np.arange(500.0)
    noises, subtracted = [], []
    for seed in range(5):
        plain = start(seed=seed)
        size = 0.01 * share * rng.uniform(0.8, 1.2)
        line = size * np.sin(2.0 * np.pi * 882.0 * time_s + seed)
        rippled = replace(plain, current_a=plain.current_a + np.where(plain.time_s > ONSET_S, line, 0.0))
        fit = identify(rippled, constant=0.02352)
        noises.append(fit.noise_a / identify(plain, constant=0.02352).noise_a)
        subtracted.append(bool(fit.start.lines))
    assert np.all(np.abs(np.array(noises) - 1.0) < 0.12)
    assert subtracted == [share > 1.0] * 5


def test_what_a_start_counts_in_is_as_large_as_the_note_says() -> None:
    for found, larger in (
        (identify(start(noise_a=1e-3, speed=True, DROP=0.6)), {"R": 0.95, "L": 0.95, "K": 0.95, "J": 0.95}),
        (identify(start(noise_a=1e-3, speed=True, GEAR=0.1)), {"J": 0.9}),
    ):
        for name, value in zip(found.quantity_names, np.exp(found.log_values), strict=True):
            if name in "RLKJ":
                assert value / QUANTITIES[name] == pytest.approx(1.0 / larger.get(name, 1.0), rel=0.01), name
