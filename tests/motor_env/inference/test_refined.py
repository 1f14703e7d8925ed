"""A few exact draws put the fit of a motor at work right; the sampler of the limit is the oracle."""

from dataclasses import replace

import numpy as np

from motor_datasets import generate_arrays
from motor_env import load_recipe
from motor_env.inference.field_posterior import Effort, sampled_probabilities
from motor_env.inference.refined import refined_probabilities
from motor_env.inference.work_features import work_fit, work_probabilities

RECIPE = replace(load_recipe("operation"), shifts=())


def test_refined_probabilities_are_nearer_to_the_sampled_ones() -> None:
    cases = generate_arrays(RECIPE, 7, 20).X.astype(np.float64)
    logs = np.sort(work_fit(RECIPE, cases).log_probability, axis=1)
    unsure = np.argsort(logs[:, -1] - logs[:, -2])[:4]
    few = cases[unsure]
    effort = Effort(draws=64, most_rounds=8, enough=60.0)
    got, effective = refined_probabilities(RECIPE, few, np.random.default_rng(1), effort)
    exact = np.array([sampled_probabilities(RECIPE, case, np.random.default_rng(2))[0] for case in few])
    fit = work_probabilities(RECIPE, few)
    assert np.square(got - exact).sum() < 0.5 * np.square(fit - exact).sum()
    np.testing.assert_allclose(got.sum(axis=1), 1.0)
    assert ((effective > 0.0).sum(axis=1) >= 2).all()
    again, _ = refined_probabilities(RECIPE, few, np.random.default_rng(1), effort)
    np.testing.assert_array_equal(again, got)


def test_a_sure_case_is_left_to_the_fit() -> None:
    cases = generate_arrays(RECIPE, 7, 20).X.astype(np.float64)
    logs = np.sort(work_fit(RECIPE, cases).log_probability, axis=1)
    sure = cases[logs[:, -1] - logs[:, -2] > 6.0][:2]
    got, effective = refined_probabilities(RECIPE, sure, np.random.default_rng(1))
    assert effective.sum() == 0.0
    np.testing.assert_allclose(got, work_probabilities(RECIPE, sure), atol=1e-4)
