"""The severity's posterior against direct numerical integration, its own calibration and the known errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson, simpson
from scipy.stats import norm

from motor_env import (
    Fault,
    FaultKind,
    Recipe,
    SensorParameters,
    SeverityPrior,
    Timing,
    draw,
    load_recipe,
    severity_posterior,
    simulate,
    simulate_states,
)
from motor_env.inference.posterior import SeverityPosterior, class_log_evidence
from motor_env.motor.faults import BUILT_IN_KINDS, apply_fault
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import FaultClass

BENCH = load_recipe("bench", classes=(FaultClass(),))


def graded(recipe: Recipe, kind: FaultKind, n: int, seed: int = 9) -> tuple[FloatArray, FloatArray]:
    """Measurements of motors with severities uniform from 0 to 30 %, and the severities."""
    severity = np.random.default_rng(seed).uniform(0.0, 0.3, n)
    drawn = draw(recipe, seed, np.arange(n))
    scenario = replace(drawn.scenario, faults=(Fault(kind, severity),))
    return simulate(scenario, seed, drawn.cases).measurements, severity


@pytest.mark.parametrize("kind", BUILT_IN_KINDS)
@pytest.mark.parametrize("noise_a", [0.002, 0.05])
def test_known_motor_posterior_is_the_integral(kind: FaultKind, noise_a: float) -> None:
    recipe = load_recipe(
        "paper",
        classes=(FaultClass(),),
        sensor=SensorParameters(current_noise_a=noise_a),
        timing=Timing(1_000.0, 0.03),
    )
    measured, _ = graded(recipe, kind, 3)
    got = severity_posterior(recipe, SeverityPrior(kind), measured)
    for case in range(3):
        reach = 9.0 * got.std[case]
        grid = np.linspace(max(0.0, got.mean[case] - reach), min(0.3, got.mean[case] + reach), 2001)
        motors = apply_fault(recipe.motor, Fault(kind, grid))
        current = simulate_states(motors, np.full((2001, 30), 12.0), 1e-3)[..., 0]
        std = noise_a * np.sqrt(1.0 + grid[:, None] if kind is FaultKind.NOISE else 1.0)
        log_likelihood = np.asarray(norm.logpdf(measured[case, 0], current, std)).sum(axis=1)
        top = log_likelihood.max()
        total, first, second = (simpson(grid**k * np.exp(log_likelihood - top), x=grid) for k in (0, 1, 2))
        mean = first / total
        assert got.mean[case] == pytest.approx(mean, abs=1e-3 * got.std[case])
        assert got.std[case] == pytest.approx(np.sqrt(second / total - mean**2), rel=1e-3)
        assert got.log_evidence[case] == pytest.approx(top + np.log(total / 0.3), abs=1e-3)
        cumulated = cumulative_simpson(np.exp(log_likelihood - top), x=grid, initial=0.0) / total
        for share in (0.05, 0.5, 0.95):
            exact = np.interp(share, cumulated, grid)
            assert got.quantile(share)[case] == pytest.approx(exact, abs=5e-3 * got.std[case])


def test_quantiles_of_weights_that_are_known() -> None:
    """Trapezoid's weights of a uniform density, of which every quantile is known, and of a triangle."""
    grid = np.linspace(0.1, 0.3, 41)
    even = np.where(np.isin(np.arange(41), [0, 40]), 0.5, 1.0)
    weights = np.stack([even / 40.0, even * (grid - 0.1)])
    posterior = SeverityPosterior(
        np.stack([grid, grid]), weights / weights.sum(axis=1, keepdims=True), np.zeros(2)
    )
    for share in (0.05, 0.25, 0.5, 0.9):
        expected = [0.1 + 0.2 * share, 0.1 + 0.2 * np.sqrt(share)]
        np.testing.assert_allclose(posterior.quantile(share), expected, atol=2e-4)
    np.testing.assert_allclose(posterior.interval()[0], [0.11, 0.29], atol=1e-12)
    np.testing.assert_allclose(posterior.interval(0.5)[0], [0.15, 0.25], atol=1e-12)
    np.testing.assert_allclose(posterior.mean, [0.2, 0.1 + 0.4 / 3.0], rtol=1e-3)
    np.testing.assert_allclose(posterior.std, [0.2 / np.sqrt(12.0), 0.2 / np.sqrt(18.0)], rtol=2e-3)
    with pytest.raises(ValueError, match="probability must be > 0 and < 1, got 1"):
        posterior.quantile(1.0)
    assert SeverityPrior(FaultKind.BEARING) == SeverityPrior(FaultKind.BEARING, 0.0, 0.3)


@pytest.mark.parametrize("kind", BUILT_IN_KINDS)
def test_every_kind_is_graded_under_tolerances(kind: FaultKind) -> None:
    recipe = replace(BENCH, timing=Timing(1_000.0, 0.1))
    measured, severity = graded(recipe, kind, 300)
    got = severity_posterior(recipe, SeverityPrior(kind), measured)
    score = (got.mean - severity) / np.sqrt(np.square(got.std).mean())
    assert np.square(score).mean() == pytest.approx(1.0, abs=0.25)
    low, high = got.interval(0.90).T
    assert ((low <= severity) & (severity <= high)).mean() == pytest.approx(0.90, abs=0.05)
    assert (got.quantile(0.5) > low).all()


def test_evidence_of_a_narrow_range_is_that_of_the_class() -> None:
    recipe = replace(BENCH, classes=(FaultClass(FaultKind.BEARING, 0.1),), timing=Timing(1_000.0, 0.1))
    measured, _ = graded(recipe, FaultKind.BEARING, 5)
    narrow = SeverityPrior(FaultKind.BEARING, 0.0999, 0.1001)
    got = severity_posterior(recipe, narrow, measured)
    np.testing.assert_allclose(got.log_evidence, class_log_evidence(recipe, measured)[:, 0], atol=1e-3)


def test_a_sensor_has_no_severity_of_a_fault() -> None:
    with pytest.raises(ValueError, match="must be a fault of the motor or noise, got speed_dead"):
        SeverityPrior(FaultKind("speed_dead"))


@pytest.mark.parametrize(
    ("bounds", "sentence"),
    [((0.2, 0.1), "must range from >= 0 to more, got 0.2 to 0.1"), ((0.0, 1.0), "must be < 1, got 1")],
)
def test_bad_ranges_are_named(bounds: tuple[float, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SeverityPrior(FaultKind.WINDING_SHORT, *bounds)
