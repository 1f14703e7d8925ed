"""The posterior against importance sampling, the exact likelihood, and the accuracies known for the bench recipe."""

from dataclasses import replace

import numpy as np
import pytest
from limits import bayes_limit
from scipy.optimize import least_squares
from scipy.special import gammaln, logsumexp
from scipy.stats import norm

from motor_env import (
    FaultKind,
    Recipe,
    SensorParameters,
    Timing,
    class_probabilities,
    draw,
    excess_over_limit,
    load_recipe,
    simulate,
    simulate_states,
)
from motor_env.inference.fit import Prior, fit
from motor_env.inference.posterior import (
    class_coordinates,
    class_log_evidence,
    prior_from_starts,
    recipe_observed,
    variance_factor,
)
from motor_env.inference.sensitivities import fitted_residuals
from motor_env.motor.faults import apply_faults
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

# Reaches in: `Draw` is the type of what the public `draw` returns.
from motor_env.simulation.sampling import Draw

BENCH_1KHZ = load_recipe("bench", timing=Timing(1_000.0, 0.1))
ALL_KINDS = (
    FaultClass(),
    FaultClass(FaultKind.BEARING, 0.25),
    FaultClass(FaultKind.WINDING_CONTACT, 0.10),
    FaultClass(FaultKind.WINDING_SHORT, 0.05, weight=2.0),
    FaultClass(FaultKind.NOISE, 1.0),
)


def drawn_measurements(recipe: Recipe, n: int, seed: int = 7) -> tuple[Draw, FloatArray]:
    drawn = draw(recipe, seed, np.arange(n))
    return drawn, simulate(drawn.scenario, seed, drawn.cases).measurements


def importance_evidence(
    recipe: Recipe, measurements: FloatArray, rng: np.random.Generator, n_draws: int
) -> FloatArray:
    """Log evidence by importance sampling from the Laplace approximation with heavier tails (multivariate t)."""
    observed = recipe_observed(recipe, measurements)
    evidence = np.empty((observed.n_cases, len(recipe.classes)))
    freedom = 8.0
    for column, fault_class in enumerate(recipe.classes):
        noisy = observed.with_variance(variance_factor(fault_class))
        coordinates = class_coordinates(recipe, fault_class)
        size = coordinates.size
        fitted = fit(noisy, coordinates, Prior.from_std(np.ones(size)))
        factor = np.linalg.cholesky(fitted.covariance)
        for n in range(observed.n_cases):
            normal = rng.standard_normal((n_draws, size))
            heavy = normal * np.sqrt(freedom / rng.chisquare(freedom, n_draws))[:, None]
            values = fitted.values[n] + heavy @ factor[n].T
            squares = np.square(heavy).sum(axis=1)
            # log density of the t distribution, up to the constant that follows
            log_proposal = -0.5 * (freedom + size) * np.log1p(squares / freedom)
            log_proposal += _log_t_constant(freedom, size) - np.log(np.diagonal(factor[n])).sum()
            row = replace(
                noisy.rows(slice(n, n + 1)), whitened=np.repeat(noisy.whitened[n : n + 1], n_draws, 0)
            )
            chi2 = np.square(fitted_residuals(row, coordinates, values)).sum(axis=(1, 2))
            log_joint = noisy.log_normaliser - 0.5 * chi2 + norm.logpdf(values).sum(axis=1)
            evidence[n, column] = logsumexp(log_joint - log_proposal) - np.log(n_draws)
    return evidence


def _log_t_constant(freedom: float, size: int) -> float:
    ends = gammaln(0.5 * (freedom + size)) - gammaln(0.5 * freedom)
    return float(ends - 0.5 * size * np.log(freedom * np.pi))


@pytest.mark.parametrize("classes", [BENCH_1KHZ.classes, ALL_KINDS])
def test_laplace_agrees_with_importance_sampling(classes: tuple[FaultClass, ...]) -> None:
    recipe = replace(BENCH_1KHZ, classes=classes)
    _, measured = drawn_measurements(recipe, 24)
    prior = np.log(recipe.class_probabilities)
    sampled = importance_evidence(recipe, measured, np.random.default_rng(2), 2000) + prior
    expected = np.exp(sampled - logsumexp(sampled, axis=1, keepdims=True))
    assert np.abs(class_log_evidence(recipe, measured) + prior - sampled).max() < 0.15
    assert abs((class_log_evidence(recipe, measured) + prior - sampled).mean()) < 0.01
    got = class_probabilities(recipe, measured)
    assert np.abs(got - expected).max() < 0.012
    assert np.abs(got - expected).max(axis=1).mean() < 0.005


@pytest.mark.parametrize(
    ("rate_hz", "noise_a", "expected"),
    [
        (10_000.0, 0.02, 0.951),
        (1_000.0, 0.005, 0.965),
        (1_000.0, 0.1, 0.632),
    ],
)
def test_limit_of_the_bench_recipe(rate_hz: float, noise_a: float, expected: float) -> None:
    recipe = load_recipe(
        "bench", sensor=SensorParameters(current_noise_a=noise_a), timing=Timing(rate_hz, 0.1)
    )
    drawn, measured = drawn_measurements(recipe, 400)
    probabilities = class_probabilities(recipe, measured)
    limit = bayes_limit(probabilities)
    assert abs(limit.expected_accuracy - expected) < 4.0 * limit.standard_error
    # A posterior is calibrated: it expects as many hits as it gets.
    hits = (probabilities.argmax(axis=1) == drawn.class_index).mean()
    assert abs(hits - limit.expected_accuracy) < 4.0 * np.sqrt(expected * (1.0 - expected) / len(measured))


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


def test_probabilities_do_not_depend_on_the_batch() -> None:
    _, measured = drawn_measurements(BENCH_1KHZ, 6)
    together = class_probabilities(BENCH_1KHZ, measured)
    np.testing.assert_allclose(class_probabilities(BENCH_1KHZ, measured[4:5])[0], together[4], atol=1e-9)
    np.testing.assert_allclose(together.sum(axis=1), 1.0)


def test_starts_of_one_motor_tell_of_its_next_one() -> None:
    """Against one fit of all starts together: factors of the motor in common, a supply of its own in each."""
    recipe = replace(BENCH_1KHZ, classes=(FaultClass(),), starts_per_motor=3)
    _, measured = drawn_measurements(recipe, 6)
    got = prior_from_starts(recipe, measured.reshape(2, 3, 1, -1))
    coordinates = class_coordinates(recipe, FaultClass())
    assert coordinates.names[0] == "supply"

    def residuals(x: FloatArray, motor: int) -> FloatArray:
        values = np.column_stack([x[:3], np.tile(x[3:], (3, 1))])
        motors, supply = coordinates.motors(values)
        states = simulate_states(motors, supply[:, None] * recipe.nominal_voltage_v, 1e-3)
        left = (measured[3 * motor : 3 * motor + 3, 0] - states[..., 0]) / 0.02
        return np.concatenate([left.ravel(), x])

    for motor in range(2):
        best = least_squares(residuals, np.zeros(7), args=(motor,), xtol=1e-12)
        slopes = np.asarray(best.jac, dtype=np.float64)
        covariance = np.linalg.inv(slopes.T @ slopes)[3:, 3:]
        std = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(got.mean[motor, 1:] / std, best.x[3:] / std, atol=0.05)
        found = np.linalg.inv(got.precision[motor])
        np.testing.assert_allclose(
            found[1:, 1:] / np.outer(std, std), covariance / np.outer(std, std), atol=0.02
        )
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
