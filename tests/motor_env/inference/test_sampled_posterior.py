"""The sampled posterior against the exact one, against sums over severities, and against itself."""

from dataclasses import replace

import numpy as np
import pytest
from sampled_posterior import (
    Linear,
    TruncatedNormal,
    _regressed,
    _tempered,
    best_fit,
    log_joint,
    sampled_evidence,
    sampled_probabilities,
)
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

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


def test_joint_density_value_by_value() -> None:
    """Normal without a converter; with one, the share of the normal distribution within the code's step."""
    values = np.array([[0.3, -1.0, 0.5, 2.0, 0.1], [0.0, 0.0, 0.0, 0.0, 0.0]])
    prior = norm.logpdf(values).sum(axis=1)
    plain, field = ClassModel(BENCH, BENCH.classes[0]), ClassModel(FIELD, FIELD.classes[0])
    rng = np.random.default_rng(1)
    for model, sigma, step in ((plain, 0.02, 0.0), (field, 0.004, 2.0 * 8.2 / 4096.0)):
        count = len(model.noise)
        read, measured = rng.random((2, count)), rng.random(count)
        measured = np.where(np.arange(count) % 7 == 0, np.nan, read[0] + 1.5 * sigma * (measured - 0.5))
        seen = ~np.isnan(measured)
        read[1] = read[0] + sigma
        off = measured[seen] - read[:, seen]
        density = norm.logpdf(off, scale=sigma)
        if step:
            density = np.log(norm.cdf((off + step / 2.0) / sigma) - norm.cdf((off - step / 2.0) / sigma))
        at = np.hstack([values, np.full((2, model.n_uniform), 0.4)])
        np.testing.assert_allclose(
            log_joint(model, measured, read, at), density.sum(axis=1) + prior, rtol=1e-9
        )


def test_a_motor_that_is_linear_has_a_normal_posterior() -> None:
    """Of draws around any point: completing the square, for the coordinates of a class with and without ranges."""
    rng = np.random.default_rng(6)
    for model in (ClassModel(BENCH, BENCH.classes[0]), ClassModel(FIELD, FIELD.classes[0])):
        size, count = len(model.names), len(model.noise)
        at, slopes, left = (
            0.3 * rng.standard_normal(size),
            rng.standard_normal((count, size)),
            rng.standard_normal(count),
        )
        linear, mean = Linear(at, left, slopes), model.prior[0]
        posterior = linear.posterior(model)
        precision = slopes.T @ slopes + np.eye(size)
        centre = np.linalg.solve(precision, slopes.T @ (left + slopes @ at) + mean)
        covariance = posterior.root @ posterior.root.T
        np.testing.assert_allclose(posterior.mean, centre[posterior.order], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(
            covariance,
            np.linalg.inv(precision)[np.ix_(posterior.order, posterior.order)],
            rtol=1e-9,
            atol=1e-12,
        )
        expected = 0.5 * (left @ left + np.square(at - mean).sum()) + np.log(model.noise).sum()
        assert linear.objective(model) == pytest.approx(expected)


def test_of_a_linear_motor_fit_and_evidence_are_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then draws are from the posterior itself, all weights are alike, and what was measured is one normal vector."""
    model, rng = ClassModel(BENCH, BENCH.classes[0]), np.random.default_rng(7)
    slopes = 0.02 * rng.standard_normal((5, 100))
    monkeypatch.setattr(ClassModel, "readings", lambda _, values: values @ slopes)
    start = rng.standard_normal(5) @ slopes + 0.02 * rng.standard_normal(100)
    start[30:40] = np.nan
    seen = ~np.isnan(start)
    found = best_fit(model, start, np.full(5, 0.5))
    information = slopes[:, seen] @ slopes[:, seen].T / 4e-4 + np.eye(5)
    np.testing.assert_allclose(
        found.at, np.linalg.solve(information, slopes[:, seen] @ start[seen] / 4e-4), rtol=1e-5
    )
    np.testing.assert_allclose(found.slopes[seen], slopes[:, seen].T / 0.02, rtol=1e-6, atol=1e-9)
    got = sampled_evidence(model, start, found, rng)
    dense = 4e-4 * np.eye(seen.sum()) + slopes[:, seen].T @ slopes[:, seen]
    assert got.log_value == pytest.approx(multivariate_normal(cov=dense).logpdf(start[seen]), abs=1e-4)
    assert got.effective == pytest.approx(128.0, abs=1e-3)


def test_draws_teach_the_linear_motor_and_uneven_weights_are_flattened() -> None:
    """Implementation: a wrong step of either would cost draws, which no result shows."""
    rng = np.random.default_rng(9)
    true, wrong, weights = rng.standard_normal((30, 3)), rng.standard_normal((30, 3)), rng.random(40)
    values, weights = rng.standard_normal((40, 3)), weights / weights.sum()
    left = 2.0 - values @ true.T
    got = _regressed(Linear(np.zeros(3), np.zeros(30), wrong), values, left, weights)
    centre = weights @ values
    np.testing.assert_allclose(got.at, centre, rtol=1e-12)
    np.testing.assert_allclose(got.left, 2.0 - true @ centre, rtol=1e-9)
    scatter = np.cov(values.T, aweights=weights, bias=True)
    damped = scatter + 0.02 * np.diag(np.diag(scatter))
    expected = wrong + (true - wrong) @ np.linalg.solve(damped, scatter).T
    np.testing.assert_allclose(got.slopes, expected, rtol=1e-9, atol=1e-12)
    logs = 3.0 * rng.standard_normal(128)
    flat = _tempered(logs, 64.0)
    assert flat.sum() == pytest.approx(1.0)
    assert 1.0 / np.square(flat).sum() == pytest.approx(64.0, rel=0.02)  # Kish's effective number
    assert np.corrcoef(np.log(flat), logs)[0, 1] == pytest.approx(1.0)
    even = np.exp(0.1 * logs) / np.exp(0.1 * logs).sum()
    np.testing.assert_allclose(_tempered(0.1 * logs, 64.0), even, rtol=1e-9)


def test_a_best_fit_comes_with_the_slopes_there() -> None:
    """Of a start whose later half was lost: differences of its readings, over noise and converter."""
    (start,) = starts(FIELD, 1).reshape(1, -1)
    start[60:] = np.nan
    model = ClassModel(FIELD, FIELD.classes[0])
    found = best_fit(model, start, model.prior[0])
    noise = np.hypot(0.004, 2.0 * 8.2 / 4096.0 / np.sqrt(12.0))
    seen = ~np.isnan(start)
    np.testing.assert_allclose(
        found.left[seen], (start - model.readings(found.at[None])[0])[seen] / noise, rtol=1e-6, atol=1e-6
    )
    assert not found.left[~seen].any()
    assert not found.slopes[~seen].any()
    for k in range(len(found.at)):
        step = 0.01 * (model.box[1, k] - model.box[0, k]) * np.eye(len(found.at))[k]
        step = -step if found.at[k] + step[k] > model.box[1, k] else step
        there, here = model.readings(np.stack([found.at + step, found.at]))
        np.testing.assert_allclose(
            found.slopes[seen, k], (there - here)[seen] / (noise * step[k]), rtol=1e-4, atol=0.05
        )


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
        log_joint(model, lowest[0] + np.where(np.arange(read.size) == 0, code, np.nan), read, values)
        for code in codes
    ]
    prior = log_joint(model, np.full(read.size, np.nan), read, values)
    assert np.exp(np.concatenate(logs) - prior).sum() == pytest.approx(1.0, abs=1e-6)


def test_a_class_whose_first_fit_is_far_away_is_not_given_up() -> None:
    """Begun at the nominal motor, the fit of its true class, winding_contact_10, ends 16 below the best."""
    recipe = replace(load_recipe("field"), starts_per_motor=1, healthy_starts=0)
    (start,) = measure_draw(draw(recipe, 41, [1828]), recipe, 41)
    probabilities, effective = sampled_probabilities(recipe, start, np.random.default_rng([41, 0, 1828]))
    assert probabilities[3] == pytest.approx(0.5, abs=0.1)
    assert effective[3] > 50.0
