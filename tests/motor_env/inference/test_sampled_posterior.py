"""The sampled posterior against the exact one, against sums over severities, and against itself."""

from dataclasses import replace

import numpy as np
import pytest
from sampled_posterior import (
    TruncatedNormal,
    best_fit,
    sampled_evidence,
    sampled_probabilities,
)
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from motor_env import FaultKind, Recipe, Timing, class_probabilities, draw, load_recipe
from motor_env.inference.class_model import ClassModel
from motor_env.inference.posterior import class_log_evidence
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.random_streams import Stream, normals, uniforms
from motor_env.simulation.recipes import FACTORS, FaultClass

# Reaches in: what a draw measures, and the numbers of each stream behind it, show in no public name.
from motor_env.simulation.sampling import measure_draw

BENCH = load_recipe("bench", timing=Timing(1_000.0, 0.1))
FIELD = replace(
    load_recipe("field"), starts_per_motor=1, healthy_starts=0, timing=Timing(2_000.0, 0.05, 0.01)
)


def starts(recipe: Recipe, n: int) -> FloatArray:
    return measure_draw(draw(recipe, 3, np.arange(n)), recipe, 3).astype(np.float64)


@pytest.mark.parametrize("away", [0.3, 1.5])
def test_mass_of_a_normal_distribution_in_a_box(away: float) -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, 6))
    precision, mean = root @ root.T + np.eye(6), away * rng.standard_normal(6)
    low, high = (
        np.array([-np.inf, -np.inf, 0.0, 0.0, 0.0, 0.0]),
        np.array([np.inf, np.inf, 1.0, 1.0, 1.0, 1.0]),
    )
    cut = TruncatedNormal.cut(mean, precision, low, high)
    draws = cut.draw(rng, 20_000)
    assert ((draws >= low) & (draws <= high)).all()
    normal = multivariate_normal(mean, np.linalg.inv(precision))
    mass = logsumexp(normal.logpdf(draws) - cut.log_density(draws)) - np.log(len(draws))
    assert mass == pytest.approx(np.log(normal.cdf(high, lower_limit=low)), abs=0.02)


def test_a_box_far_from_the_mean_keeps_its_digits() -> None:
    cut = TruncatedNormal.cut(np.array([40.0]), np.eye(1), np.zeros(1), np.ones(1))
    draws = cut.draw(np.random.default_rng(2), 1000)
    # Beyond 39 standard deviations the density falls by e within 1 / 39.
    assert (1.0 - draws).mean() == pytest.approx(1.0 / 39.0, rel=0.15)
    assert np.isfinite(cut.log_density(draws)).all()


def test_coordinates_of_a_class_give_back_a_drawn_case() -> None:
    """Readings at the coordinates of a case are those of the simulation without noise and converter."""
    bearing = FaultClass(FaultKind.BEARING, 0.1, severity_to=0.4)
    assert FIELD.field is not None
    clean = replace(FIELD.field, adc_bits=0, sensor_range_a=0.0)
    recipe = replace(FIELD, classes=(bearing,), field=clean, shifts=(), sensor=FIELD.sensor.with_noise(0.0))
    cases = np.arange(5)
    drawn = draw(recipe, 3, cases)
    model = ClassModel(replace(FIELD, classes=(bearing,)), bearing)
    factors, priors = len(FACTORS), FIELD.priors
    assert model.names == (*FACTORS, *priors, "bearing")
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
    noisy = ClassModel(FIELD, FaultClass(FaultKind.NOISE, 3.0))
    assert noisy.noise == pytest.approx(np.full(120, 2.0 * 0.004))


def test_on_textbook_motors_it_is_the_exact_posterior() -> None:
    measured = starts(BENCH, 8)
    rng = np.random.default_rng(4)
    sampled = np.array([sampled_probabilities(BENCH, start, rng)[0] for start in measured])
    assert np.abs(sampled - class_probabilities(BENCH, measured)).max() < 0.02


def test_a_severity_with_a_range_is_integrated_out() -> None:
    (measured,) = starts(replace(BENCH, classes=BENCH.classes[:1]), 1)
    model = ClassModel(BENCH, FaultClass(FaultKind.BEARING, 0.0, severity_to=0.3))
    linear = best_fit(model, measured.ravel(), model.prior[0])
    got = sampled_evidence(model, measured.ravel(), linear, np.random.default_rng(5))
    levels = 0.3 * (np.arange(30) + 0.5) / 30
    at_levels = replace(BENCH, classes=tuple(FaultClass(FaultKind.BEARING, level) for level in levels))
    exact = logsumexp(class_log_evidence(at_levels, measured[None])) - np.log(len(levels))
    assert got.log_value == pytest.approx(exact, abs=0.15)
    assert got.effective > 100.0


def test_in_the_field_two_runs_agree_and_lost_samples_do_not_matter() -> None:
    (start,) = starts(FIELD, 1)
    first, second = (sampled_probabilities(FIELD, start, np.random.default_rng(seed)) for seed in (6, 7))
    assert np.abs(first[0] - second[0]).max() < 0.1
    assert (first[1][first[0] > 0.01] > 50.0).all()
    start[0, ::40] = np.nan
    assert np.abs(sampled_probabilities(FIELD, start, np.random.default_rng(8))[0] - first[0]).max() < 0.3
