"""Posteriors of classes and severities against importance sampling, integrals, and accuracies that are known."""

from dataclasses import replace

import numpy as np
import pytest
from limits import bayes_limit
from scipy.integrate import cumulative_simpson, simpson
from scipy.optimize import least_squares
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_t, norm

from motor_env import (
    Fault,
    FaultKind,
    Recipe,
    SensorParameters,
    SeverityPrior,
    Timing,
    class_probabilities,
    draw,
    excess_over_limit,
    load_recipe,
    severity_posterior,
    simulate,
    simulate_states,
)
from motor_env.inference.class_model import ClassModel
from motor_env.inference.fit import Prior, fit
from motor_env.inference.posterior import (
    SeverityPosterior,
    class_coordinates,
    class_log_evidence,
    prior_from_starts,
    recipe_observed,
    variance_factor,
)
from motor_env.inference.sensitivities import fitted_residuals
from motor_env.motor.faults import BUILT_IN_KINDS, apply_fault, apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.recipes import FACTORS, FaultClass

# Reaches in: the numbers of each stream behind a draw, and what it measures, show in no public name.
from motor_env.simulation.sampling import Draw, measure_draw

BENCH_1KHZ = load_recipe("bench", timing=Timing(1_000.0, 0.1))
ALL_KINDS = (
    FaultClass(),
    FaultClass(FaultKind.BEARING, 0.25),
    FaultClass(FaultKind.WINDING_CONTACT, 0.10),
    FaultClass(FaultKind.WINDING_SHORT, 0.05, weight=2.0),
    FaultClass(FaultKind.NOISE, 1.0),
)


FIELD = replace(
    load_recipe("field"), starts_per_motor=1, healthy_starts=0, timing=Timing(2_000.0, 0.05, 0.01)
)


def drawn_measurements(recipe: Recipe, n: int, seed: int = 7) -> tuple[Draw, FloatArray]:
    drawn = draw(recipe, seed, np.arange(n))
    return drawn, simulate(drawn.scenario, seed, drawn.cases).measurements


def importance_evidence(recipe: Recipe, measurements: FloatArray, n_draws: int) -> FloatArray:
    """Log evidence by importance sampling from the Laplace approximation with heavier tails (multivariate t)."""
    rng, observed, freedom = np.random.default_rng(2), recipe_observed(recipe, measurements), 8
    evidence = np.empty((observed.n_cases, len(recipe.classes)))
    for column, fault_class in enumerate(recipe.classes):
        noisy = observed.with_variance(variance_factor(fault_class))
        coordinates = class_coordinates(recipe, fault_class)
        fitted = fit(noisy, coordinates, Prior.from_std(np.ones(coordinates.size)))
        for n in range(observed.n_cases):
            proposal = multivariate_t(fitted.values[n], fitted.covariance[n], freedom, seed=rng)
            values = np.reshape(proposal.rvs(n_draws), (n_draws, coordinates.size))
            whitened = np.repeat(noisy.whitened[n : n + 1], n_draws, 0)
            row = replace(noisy.rows(slice(n, n + 1)), whitened=whitened)
            chi2 = np.square(fitted_residuals(row, coordinates, values)).sum(axis=(1, 2))
            log_joint = noisy.log_normaliser - 0.5 * chi2 + norm.logpdf(values).sum(axis=1)
            evidence[n, column] = logsumexp(log_joint - proposal.logpdf(values)) - np.log(n_draws)
    return evidence


@pytest.mark.parametrize("classes", [BENCH_1KHZ.classes, ALL_KINDS])
def test_laplace_agrees_with_importance_sampling(classes: tuple[FaultClass, ...]) -> None:
    recipe = replace(BENCH_1KHZ, classes=classes)
    _, measured = drawn_measurements(recipe, 24)
    prior = np.log(recipe.class_probabilities)
    sampled = importance_evidence(recipe, measured, 2000) + prior
    off = class_log_evidence(recipe, measured) + prior - sampled
    assert np.abs(off).max() < 0.15
    assert abs(off.mean()) < 0.01
    wrong = np.abs(class_probabilities(recipe, measured) - softmax(sampled, axis=1))
    assert wrong.max() < 0.012
    assert wrong.max(axis=1).mean() < 0.005


@pytest.mark.parametrize(
    ("rate_hz", "noise_a", "expected"),
    [(10_000.0, 0.02, 0.951), (1_000.0, 0.005, 0.965), (1_000.0, 0.1, 0.632)],
)
def test_limit_of_the_bench_recipe(rate_hz: float, noise_a: float, expected: float) -> None:
    sensor = SensorParameters(current_noise_a=noise_a)
    recipe = load_recipe("bench", sensor=sensor, timing=Timing(rate_hz, 0.1))
    drawn, measured = drawn_measurements(recipe, 400)
    probabilities = class_probabilities(recipe, measured)
    limit = bayes_limit(probabilities)
    assert abs(limit.expected_accuracy - expected) < 4.0 * limit.standard_error
    hits = (probabilities.argmax(axis=1) == drawn.class_index).mean()
    assert abs(hits - limit.expected_accuracy) < 4.0 * np.sqrt(expected * (1.0 - expected) / 400)


def test_without_spread_the_evidence_is_the_likelihood() -> None:
    recipe = load_recipe("paper", classes=ALL_KINDS, timing=Timing(1_000.0, 0.05, quiet_s=0.01))
    _, measured = drawn_measurements(recipe, 20)
    expected = np.empty((20, len(ALL_KINDS)))
    voltage = np.where(recipe.timing.interval_start_s >= -1e-12, 12.0, 0.0)
    for column, fault_class in enumerate(ALL_KINDS):
        motor = apply_faults(recipe.motor, fault_class.faults)
        current = simulate_states(motor, voltage, recipe.timing.dt_s)[:, 0]
        std = 0.02 * np.sqrt(2.0 if fault_class.kind is FaultKind.NOISE else 1.0)
        density = np.asarray(norm.logpdf(measured[:, 0], current, std))
        expected[:, column] = density.sum(axis=1)
    np.testing.assert_allclose(class_log_evidence(recipe, measured), expected, rtol=1e-10)


def test_starts_of_one_motor_tell_of_its_next_one() -> None:
    """Against one fit of all starts together: factors of the motor in common, a supply of its own in each."""
    recipe = replace(BENCH_1KHZ, classes=(FaultClass(),), starts_per_motor=3)
    _, measured = drawn_measurements(recipe, 6)
    got, coordinates = (
        prior_from_starts(recipe, measured.reshape(2, 3, 1, -1)),
        class_coordinates(recipe, FaultClass()),
    )
    assert coordinates.names[0] == "supply"

    def residuals(x: FloatArray, motor: int) -> FloatArray:
        motors, supply = coordinates.motors(np.column_stack([x[:3], np.tile(x[3:], (3, 1))]))
        states = simulate_states(motors, supply[:, None] * recipe.nominal_voltage_v, 1e-3)
        left = (measured[3 * motor : 3 * motor + 3, 0] - states[..., 0]) / 0.02
        return np.concatenate([left.ravel(), x])

    for motor in range(2):
        best = least_squares(residuals, np.zeros(7), args=(motor,), xtol=1e-12)
        slopes = np.asarray(best.jac, dtype=np.float64)
        covariance = np.linalg.inv(slopes.T @ slopes)[3:, 3:]
        std, found = np.sqrt(np.diag(covariance)), np.linalg.inv(got.precision[motor])
        np.testing.assert_allclose(got.mean[motor, 1:] / std, best.x[3:] / std, atol=0.05)
        np.testing.assert_allclose((found[1:, 1:] - covariance) / np.outer(std, std), 0.0, atol=0.02)
        np.testing.assert_allclose(found[0], [1.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)
        assert got.mean[motor, 0] == 0.0
    nothing = prior_from_starts(recipe, np.empty((2, 0, 1, 100)))
    np.testing.assert_array_equal(nothing.precision, np.tile(np.eye(5), (2, 1, 1)))
    assert not nothing.mean.any()


def test_an_excess_counts_the_cases_on_which_the_two_differ() -> None:
    """Of 100 cases the classifier alone is right on 9, the limit alone on 4."""
    truth, best = np.zeros(100, dtype=int), np.zeros(100, dtype=int)
    predicted = truth.copy()
    best[:9] = 1
    predicted[9:13] = 1
    found = excess_over_limit(np.eye(2)[best], truth, predicted)
    error = np.sqrt((13.0 / 100.0 - 0.05**2) / 99.0)
    assert found == pytest.approx((0.05, error))


def test_coordinates_of_a_class_give_back_a_drawn_case() -> None:
    """Readings at the coordinates of a case are those of the simulation without noise and converter."""
    bearing, cases = FaultClass(FaultKind.BEARING, 0.1, severity_to=0.4), np.arange(5)
    assert FIELD.field is not None
    clean = replace(FIELD.field, adc_bits=0, sensor_range_a=0.0)
    recipe = replace(FIELD, classes=(bearing,), field=clean, shifts=(), sensor=FIELD.sensor.with_noise(0.0))
    drawn, model = draw(recipe, 3, cases), ClassModel(replace(FIELD, classes=(bearing,)), bearing)
    factors = len(FACTORS)
    assert model.names == (*FACTORS, *FIELD.priors, "bearing")
    assert model.n_uniform == 14
    values = np.empty((5, factors + 14))
    values[:, 0] = normals(3, Stream.SUPPLY, cases, 1)[:, 0]
    values[:, 1:factors] = normals(3, Stream.MOTOR, cases, factors)[:, 1:]
    values[:, factors : factors + 6] = uniforms(3, Stream.FIELD_MOTOR, cases, 13)[:, :6]
    values[:, factors + 6 : -1] = uniforms(3, Stream.FIELD_START, cases, 13)[:, 6:]
    values[:, -1] = (drawn.severity - 0.1) / 0.3
    expected = measure_draw(drawn, recipe, 3).reshape(5, -1)
    np.testing.assert_allclose(model.readings(values), expected, atol=1e-5)
    np.testing.assert_allclose(model.box, [[-6.77] * 5 + [0.0] * 14, [6.77] * 5 + [1.0] * 14])
    np.testing.assert_array_equal(model.prior, [[0.0] * 5 + [0.5] * 14, [1.0] * 19])
    assert model.steps == pytest.approx(np.full(120, 2.0 * 8.2 / 4096.0))
    assert ClassModel(FIELD, FaultClass(FaultKind.NOISE, 3.0)).noise == pytest.approx(np.full(120, 0.008))


BENCH = load_recipe("bench", classes=(FaultClass(),))


def graded(recipe: Recipe, kind: FaultKind, n: int, seed: int = 9) -> tuple[FloatArray, FloatArray]:
    severity = np.random.default_rng(seed).uniform(0.0, 0.3, n)
    drawn = draw(recipe, seed, np.arange(n))
    scenario = replace(drawn.scenario, faults=(Fault(kind, severity),))
    return simulate(scenario, seed, drawn.cases).measurements, severity


@pytest.mark.parametrize("kind", BUILT_IN_KINDS)
@pytest.mark.parametrize("noise_a", [0.002, 0.05])
def test_known_motor_posterior_is_the_integral(kind: FaultKind, noise_a: float) -> None:
    sensor, timing = SensorParameters(current_noise_a=noise_a), Timing(1_000.0, 0.03)
    recipe = load_recipe("paper", classes=(FaultClass(),), sensor=sensor, timing=timing)
    measured, _ = graded(recipe, kind, 3)
    got = severity_posterior(recipe, SeverityPrior(kind), measured)
    for case in range(3):
        reach = 9.0 * got.std[case]
        grid = np.linspace(max(0.0, got.mean[case] - reach), min(0.3, got.mean[case] + reach), 2001)
        motors = apply_fault(recipe.motor, Fault(kind, grid))
        current = simulate_states(motors, np.full((2001, 30), 12.0), 1e-3)[..., 0]
        std = noise_a * np.sqrt(1.0 + grid[:, None] if kind is FaultKind.NOISE else 1.0)
        log_likelihood = np.asarray(norm.logpdf(measured[case, 0], current, std)).sum(axis=1)
        density = np.exp(log_likelihood - log_likelihood.max())
        total, first, second = (simpson(grid**k * density, x=grid) for k in (0, 1, 2))
        mean = first / total
        assert got.mean[case] == pytest.approx(mean, abs=1e-3 * got.std[case])
        assert got.std[case] == pytest.approx(np.sqrt(second / total - mean**2), rel=1e-3)
        evidence = log_likelihood.max() + np.log(total / 0.3)
        assert got.log_evidence[case] == pytest.approx(evidence, abs=1e-3)
        cumulated = cumulative_simpson(density, x=grid, initial=0.0) / total
        for share in (0.05, 0.5, 0.95):
            exact = np.interp(share, cumulated, grid)
            assert got.quantile(share)[case] == pytest.approx(exact, abs=5e-3 * got.std[case])


def test_quantiles_of_weights_that_are_known() -> None:
    grid, even = np.linspace(0.1, 0.3, 41), np.full(41, 1.0 / 40.0)
    even[[0, 40]] *= 0.5
    posterior = SeverityPosterior(grid[None], even[None], np.zeros(1))
    for share in (0.05, 0.25, 0.5, 0.9):
        assert posterior.quantile(share) == pytest.approx([0.1 + 0.2 * share], abs=2e-4)
    np.testing.assert_allclose(posterior.interval(), [[0.11, 0.29]], atol=1e-12)
    np.testing.assert_allclose(posterior.interval(0.5), [[0.15, 0.25]], atol=1e-12)
    with pytest.raises(ValueError, match="probability must be > 0 and < 1, got 1"):
        posterior.quantile(1.0)
    assert SeverityPrior(FaultKind.BEARING) == SeverityPrior(FaultKind.BEARING, 0.0, 0.3)


def test_severities_are_graded_under_tolerances() -> None:
    recipe = replace(BENCH, timing=Timing(1_000.0, 0.1))
    measured, severity = graded(recipe, FaultKind.WINDING_CONTACT, 300)
    got = severity_posterior(recipe, SeverityPrior(FaultKind.WINDING_CONTACT), measured)
    score = (got.mean - severity) / np.sqrt(np.square(got.std).mean())
    assert np.square(score).mean() == pytest.approx(1.0, abs=0.25)
    low, high = got.interval(0.90).T
    assert ((low <= severity) & (severity <= high)).mean() == pytest.approx(0.90, abs=0.05)


@pytest.mark.parametrize(
    ("kind", "bounds", "sentence"),
    [
        ("winding_short", (0.2, 0.1), "must range from >= 0 to more, got 0.2 to 0.1"),
        ("winding_short", (0.0, 1.0), "must be < 1, got 1"),
        ("speed_dead", (0.0, 0.3), "must be a fault of the motor or noise, got speed_dead"),
    ],
)
def test_bad_ranges_are_named(kind: str, bounds: tuple[float, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SeverityPrior(FaultKind(kind), *bounds)
