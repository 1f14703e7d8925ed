"""Where the fit of a start begins: bounded least squares and recorded truth are the oracles."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from first_guess import StartGrid, begun_fit, bounded, start_grid
from scipy.optimize import lsq_linear

from motor_datasets import generate_arrays
from motor_env import load_recipe
from motor_env.inference.work_features import work_feature_names


def test_bounded_mostly_finds_the_best_point_of_the_box_and_never_leaves_it() -> None:
    rng = np.random.default_rng(3)
    low, high, at = np.full(4, -0.3), np.array([0.3, 0.3, 0.1, 2.0]), np.zeros((50, 4))
    roots = rng.normal(size=(50, 6, 4)) + 0.5
    wanted = 0.4 * rng.normal(size=(50, 6))
    precision, force = roots.swapaxes(1, 2) @ roots, np.einsum("nij,ni->nj", roots, wanted)
    got = bounded(at, precision, force, low, high)
    best = [lsq_linear(root, want, (low, high)).x for root, want in zip(roots, wanted, strict=True)]
    assert (np.abs(got - best).max(axis=1) < 1e-6).mean() > 0.7
    cut = np.clip(np.linalg.solve(precision, force[..., None])[..., 0], low, high)
    misfit = [np.square((roots @ x[..., None])[..., 0] - wanted).sum(axis=1) for x in (got, cut)]
    assert misfit[0].sum() < 0.9 * misfit[1].sum()
    assert ((got >= low) & (got <= high)).all()


def test_a_coordinate_whose_ends_are_one_stays_there() -> None:
    precision = np.array([[[2.0, 1.0], [1.0, 2.0]]])
    ends = np.array([-9.0, 0.5]), np.array([9.0, 0.5])
    got = bounded(np.zeros((1, 2)), precision, np.array([[1.0, 0.0]]), *ends)
    np.testing.assert_allclose(got, [[0.25, 0.5]])


def test_the_guess_of_a_linear_motor_is_the_posterior_mean() -> None:
    rng = np.random.default_rng(8)
    slopes, offset, noise = rng.normal(size=(7, 3)), rng.normal(size=7), rng.uniform(0.5, 2.0, 7)
    centre, precision = np.array([0.4, -1.0, 0.2]), np.array([3.0, 0.5, 2.0])
    linear: Any = SimpleNamespace(
        names=("gain", "offset", "bearing"),
        whole_noise=noise,
        box=(np.full(3, -99.0), np.full(3, 99.0)),
        readings=lambda at: at @ slopes.T + offset,
    )
    grid = StartGrid(linear, centre=centre, precision=precision, severities=np.array([[0.0], [1.5]]))
    measured = rng.normal(size=(4, 7))
    white = slopes / noise[:, None]
    force = ((measured - offset) / noise) @ white + precision * centre
    expected = np.linalg.solve(white.T @ white + np.diag(precision), force.T).T
    np.testing.assert_allclose(grid.guess(measured), expected, rtol=1e-6)


def test_a_fit_begins_near_the_ramp_of_a_start_and_explains_it_nearly() -> None:
    recipe = replace(load_recipe("field"), starts_per_motor=1, healthy_starts=0, shifts=())
    starts = generate_arrays(recipe, 5, 40)
    fit = begun_fit(recipe, starts.X.astype(np.float64), start_grid(recipe))
    _, longest = recipe.priors["ramp_s"]
    column = work_feature_names(recipe).index("ramp_s")
    error = fit.simulated[:, column] - starts.parameters["ramp_s"] / longest
    assert np.median(np.abs(error)) < 0.03
    assert np.median(fit.chi2) < 1.4  # 300 in the middle of the box, 2 without a point for each class
    assert fit.chi2.max() < 20.0
    assert (fit.log_probability[np.arange(40), starts.class_index] > np.log(0.1)).mean() > 0.8
