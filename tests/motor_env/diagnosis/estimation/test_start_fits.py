"""Fits of starts: covariances from dense matrices, evidence, and what is told."""

from dataclasses import replace

import numpy as np
import pytest
from measured_starts import DT_S, MOTOR, ONSET_S, QUANTITIES, QUIET, start
from scipy.linalg import circulant
from started_motor import step_start

from motor_env.diagnosis.estimation import parameter_index as index
from motor_env.diagnosis.estimation.problem import Problem
from motor_env.diagnosis.estimation.starts.start_fit import (
    StartFit,
    constants_at,
    find_ripple,
    implausible,
    is_blocked,
    record_of,
    ripple_quantities,
)
from motor_env.diagnosis.estimation.starts.start_identification import (
    _is_applicable,
    _outliers_of_fit,
    evidence,
    identify,
    identify_best,
)

# Reaches in: starts are aligned by hand, their onset known; dense matrices need the floor of a residual's noise.
from motor_env.diagnosis.estimation.uncertainty import free_run_states, supply_effects
from motor_env.diagnosis.readers.alignment import Alignment
from motor_env.diagnosis.readers.noise import difference_noise, floor_noise
from motor_env.diagnosis.readers.start import Circuit, Start
from motor_env.motor.parameters import FloatArray


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


def test_what_a_fit_says_of_itself() -> None:
    measured = start(speed=True, RISE=2e-3, CURVE=[1.0, 2.0, 2.0, 4.0])
    measured = replace(measured, alignment=replace(measured.alignment, unseen_level_a=0.002))
    model = ("supply_ramp", "supply_curve")
    fit = identify(measured, model, simpler=identify(measured, model[:1]))
    shown = np.stack([measured.current_a, measured.speed_rad_s], axis=1)  # type: ignore[list-item]
    left = shown - fit.expected
    r2 = 1.0 - np.square(left).sum(axis=0) / np.square(shown - shown.mean(axis=0)).sum(axis=0)
    assert (fit.r2_current, fit.r2_speed) == pytest.approx(r2, rel=1e-12)
    assert fit.misfit == pytest.approx(1.0 - r2, rel=1e-9)
    centred = left[:, 0] - left[:, 0].mean()
    assert fit.lag_one == pytest.approx(centred[1:] @ centred[:-1] / (centred @ centred))
    assert fit.noise_a == pytest.approx(floor_noise(left[QUIET + 1 :, 0]))
    np.testing.assert_allclose(fit.states, fit.expected - np.array([fit.offset_a, 0.0]))
    np.testing.assert_allclose(fit.run(fit.physical)[:, 0] + 0.02, fit.expected[:, 0])
    errors = np.sqrt(np.diag(fit.log_covariance))
    np.testing.assert_allclose(fit.standard_errors, np.exp(fit.log_values) * errors)
    np.testing.assert_allclose(fit.correlation * np.outer(errors, errors), fit.log_covariance)
    covariance, counts = dense_covariance(fit.solution.problem, fit.solution.theta, measured)
    assert fit.independent == pytest.approx(counts, rel=1e-6)
    series = np.sqrt(np.diag(fit.series_covariance))
    np.testing.assert_allclose(series, np.sqrt(np.diag(covariance))[:5], rtol=0.02)
    assert (errors > series).any()
    states = free_run_states(fit.solution)
    np.testing.assert_allclose(states[1:-1, 2:], 0.5 * (states[2:, :2] - states[:-2, :2]))
    for name, true, most in (("supply_ramp", 2e-3, 1e-3), ("supply_curve", 0.64, 0.2)):
        value, error = fit.fitted_extension[name]
        assert abs(value - true) < 4.0 * error < most


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
    fits = [
        identify(sagging(start(noise_a=1e-3, level_known=known), share))
        for share, known in ((0.0, True), (0.05, True), (0.05, False), (-0.05, True))
    ]
    sd = [float(np.sqrt(fit.log_covariance[0, 0])) for fit in fits]
    off = float(fits[1].log_values[0]) - np.log(QUANTITIES["R"])
    assert off == pytest.approx(0.05, abs=0.02)
    assert abs(off) < 2.0 * sd[1]
    assert [supply_effects(fit.solution)[1].value for fit in fits[:2]] == pytest.approx([0.0, 1.0], abs=0.2)
    assert supply_effects(fits[3].solution)[1].chi_square == 0.0  # no supply rises under its load
    assert sd[1] > 5.0 * sd[0]
    assert sd[2] < 0.5 * sd[1]


@pytest.mark.parametrize(
    ("off", "beside", "jump", "wild"),
    [
        (16.0, 1.0, 14.0, [20]),
        (-16.0, 1.0, 14.0, [20]),
        (14.0, 1.0, 13.0, []),
        (16.0, 6.0, 14.0, []),
        (16.0, 1.0, 6.0, []),
    ],
)
def test_wild_samples_stand_out_of_a_fit_that_goes_through_their_neighbours(
    off: float, beside: float, jump: float, wild: list[int]
) -> None:
    """More than ten spreads off, three times as far as both neighbours, half of it a jump to each."""
    residual, current = np.where(np.arange(41) % 2 == 0, 1.0, -1.0), np.full(41, 3.0)
    residual[20], residual[21] = off, -beside
    current[20] += np.copysign(jump, off)
    assert _outliers_of_fit(residual, current) == wild
    current[21:] = 2.0 * current[20] - 3.0  # a slope and no spike
    assert _outliers_of_fit(residual, current) == []


def test_evidence_counts_independent_samples() -> None:
    """The Bayesian information criterion (Schwarz 1978), and the prior of an inductance that is known."""
    plain = identify(start(speed=True))
    simple, rich = (replace(plain, solution=replace(plain.solution, theta=np.zeros(n))) for n in (7, 9))
    simple = replace(simple, inductance_deviation=3.0)
    rich = replace(rich, inductance_deviation=1.0, independent=(120.0, 80.0))
    assert evidence(simple, rich) == pytest.approx(9.0 - 1.0 - 2.0 * np.log(200.0))
    worse = replace(simple, expected=simple.expected + np.array([0.01, 5.0]))
    gain = np.array([120.0, 80.0]) @ np.log(np.divide(worse.misfit, rich.misfit))
    assert gain > 50.0
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


@pytest.mark.parametrize(
    ("name", "low", "high", "moves"),
    [
        ("R", 5e-3, 1e3, ("R", "L")),
        ("L", 1e-7, 1.0, ("L",)),
        ("K", 1e-4, 20.0, ("K",)),
        ("L/R", 2e-6, 0.2, ("L",)),
        ("R J/K^2", 5e-4, 30.0, ("J",)),
    ],
)
def test_values_that_no_motor_has_are_named(
    name: str, low: float, high: float, moves: tuple[str, ...]
) -> None:
    fit = identify(start(speed=True))
    p = dict(zip(fit.quantity_names, fit.values, strict=True))
    own = {**p, "L/R": p["L"] / p["R"], "R J/K^2": p["R"] * p["J"] / p["K"] ** 2}[name]
    direction = np.array([float(each in moves) for each in fit.quantity_names])
    untold = fit.log_covariance + 0.4**2 * np.diag(direction)
    for value, is_named in ((low / 1.5, True), (1.5 * low, False), (high / 1.5, False), (1.5 * high, True)):
        odd = replace(fit, log_values=fit.log_values + np.log(value / own) * direction)
        said, hidden = implausible(odd), implausible(replace(odd, log_covariance=untold))
        assert any(sentence.startswith(f"{name} of") for sentence in said) is is_named
        assert not any(sentence.startswith(f"{name} of") for sentence in hidden)
    slow = replace(fit, start=replace(fit.start, time_s=fit.start.time_s * 300.0))
    assert implausible(slow)[0].startswith("sampling rate of 16.7 Hz")


@pytest.mark.parametrize("n", [50, 400, 5000])
def test_the_floor_of_a_spectrum_is_the_white_noise(n: int) -> None:
    drawn = 0.3 * np.random.default_rng(n).standard_normal((100, n))
    assert np.mean([floor_noise(one) ** 2 for one in drawn]) == pytest.approx(0.09, rel=0.06)
    assert floor_noise(drawn[0, :39]) == difference_noise(drawn[0, :39])


@pytest.mark.parametrize(("share", "is_taken_off"), [(0.7, False), (1.5, True), (4.0, True)])
def test_a_line_is_no_noise_whether_it_is_taken_off_or_not(share: float, is_taken_off: bool) -> None:
    plain = start(seed=1)
    line = np.where(plain.time_s > ONSET_S, 0.01 * share * np.sin(2.0 * np.pi * 882.0 * plain.time_s), 0.0)
    fit = identify(replace(plain, current_a=plain.current_a + line), constant=0.02352)
    assert fit.noise_a == pytest.approx(identify(plain, constant=0.02352).noise_a, rel=0.12)
    assert bool(fit.start.lines) is is_taken_off


def test_the_ripple_of_the_commutator_tells_the_last_speed() -> None:
    """A line over the angle, on a start of 3,000 samples; a weak one tells nothing."""
    time_s: FloatArray = (np.arange(3000.0) - QUIET) * DT_S
    states = step_start(MOTOR, time_s, ONSET_S, 12.0)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (states[1:, 1] + states[:-1, 1]) * DT_S)])
    noise = 0.01 * np.random.default_rng(2).standard_normal(3000)
    alignment = Alignment(QUIET + 1, float(time_s[QUIET + 1]), QUIET - 1, 1.0, 0.0, 0.01)

    def rippled(amplitude_a: float) -> StartFit:
        current = states[:, 0] + amplitude_a * np.sin(14.003 * angle) * (time_s > 0.0) + noise
        return identify(Start(time_s, current, None, None, 12.0, True, alignment), constant=0.02352)

    fit = rippled(0.02)
    ripple = find_ripple(fit)
    assert ripple is not None
    hertz = 14.003 * (12.0 - 2.18 * fit.states[-1, 0]) / 0.02352 / (2.0 * np.pi)
    assert ripple.frequency_hz == pytest.approx(hertz, abs=4.0 * ripple.standard_error_hz)
    assert ripple.amplitude_a == pytest.approx(0.02, rel=0.2)  # over the angle it is not quite a line
    turned_s = np.trapezoid(fit.states[:, 1], dx=DT_S) / fit.states[-1, 1]  # at the last speed
    expected = np.sqrt(6.0 / ripple.strength) / (np.pi * turned_s)
    assert ripple.standard_error_hz == pytest.approx(expected, rel=2e-3)
    induced = 12.0 - fit.parameters.resistance_ohm * fit.states[-148:, 0].mean()
    told = (ripple.frequency_hz, induced / (2.0 * np.pi * ripple.frequency_hz))
    assert ripple_quantities(fit) == pytest.approx(told, rel=1e-3)
    assert constants_at(fit, 500.0)["K"] == pytest.approx(induced / 500.0, rel=1e-3)
    assert find_ripple(rippled(0.003)) is None


def test_what_looks_like_an_inductance_is_told_to_a_factor_of_e() -> None:
    """A ramp where the inductance is typical; else a usual one may hide in it."""
    measured, model = start(RISE=2e-3), ("supply_ramp",)
    plain, typical = (identify(measured, model, constant=0.02352, typical=t) for t in (None, QUANTITIES))
    row = typical.quantity_names.index("L")
    assert 1.0 < typical.log_covariance[row, row] < 1.1
    assert plain.series_covariance[row, row] + 0.05 < plain.log_covariance[row, row] < 0.7


@pytest.mark.parametrize(
    ("share", "lasts", "is_told", "stands"),
    [
        (0.85, 2.1, False, True),
        (0.75, 2.1, False, False),
        (0.85, 1.9, False, False),
        (0.85, 2.1, True, False),
    ],
)
def test_a_current_that_hardly_falls_is_of_a_blocked_rotor(
    share: float, lasts: float, is_told: bool, stands: bool
) -> None:
    """Two time constants after it is switched on, by less than a fifth; where no motor is seen to turn."""
    fit = identify(start())
    current = np.where(fit.start.time_s >= fit.onset_s, 3.0, 0.0)
    current[-len(current) // 10 :] *= share
    shown = np.stack([current + fit.offset_a, fit.expected[:, 1]], axis=1)
    held = replace(fit, start=replace(fit.start, current_a=shown[:, 0]), expected=shown)
    odd = held if is_told else replace(held, log_covariance=1.01 * np.eye(len(fit.quantity_names)))
    assert is_blocked(odd, (float(fit.start.time_s[-1]) - fit.onset_s) / lasts) is stands
