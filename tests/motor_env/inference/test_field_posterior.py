"""The sampled posterior against the exact one, against sums over severities, and against itself."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from motor_env.inference.class_model import ClassModel
from motor_env.inference.field_posterior import best_fit, sampled_evidence, sampled_probabilities
from motor_env.inference.posterior import class_log_evidence, class_probabilities
from motor_env.inference.truncated_normal import TruncatedNormal
from motor_env.motor.faults import FaultKind
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.drawing import draw, measure_draw
from motor_env.simulation.named_recipes import named_recipe
from motor_env.simulation.recipes import FaultClass, Recipe
from motor_env.simulation.simulate import Timing

BENCH = named_recipe("bench", timing=Timing(1_000.0, 0.1))
FIELD = replace(
    named_recipe("field"), starts_per_motor=1, healthy_starts=0, timing=Timing(2_000.0, 0.05, 0.01)
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


def test_shares_of_the_converter_sum_to_one() -> None:
    model = ClassModel(FIELD, FIELD.classes[0])
    step, values = model.steps[0], model.prior[:1]
    read = model.readings(values)
    codes = step * np.arange(-12, 13)[:, None]
    lowest = np.round(read / step) * step
    # Every reading moves by so many codes at once; the sum over one reading's codes is 1.
    logs = [
        model.log_joint(lowest[0] + np.where(np.arange(read.size) == 0, code, np.nan), read, values)
        for code in codes
    ]
    prior = model.log_joint(np.full(read.size, np.nan), read, values)
    assert np.exp(np.concatenate(logs) - prior).sum() == pytest.approx(1.0, abs=1e-6)


def test_a_class_whose_first_fit_is_far_away_is_not_given_up() -> None:
    """Begun at the nominal motor, the fit of its true class, winding_contact_10, ends 16 below the best."""
    recipe = replace(named_recipe("field"), starts_per_motor=1, healthy_starts=0)
    (start,) = measure_draw(draw(recipe, 41, [1828]), recipe, 41)
    probabilities, effective = sampled_probabilities(recipe, start, np.random.default_rng([41, 0, 1828]))
    assert probabilities[3] == pytest.approx(0.5, abs=0.1)
    assert effective[3] > 50.0
