"""A fit of each class that comes into question; the sampler of the limit is the oracle."""

from dataclasses import replace

import numpy as np
import pytest
from class_by_class import refined_probabilities
from first_guess import begun_fit, start_grid
from sampled_posterior import sampled_probabilities

from motor_datasets import generate_arrays
from motor_env import load_recipe
from motor_env.inference.work_features import work_probabilities
from motor_env.motor.parameters import FloatArray
from motor_env.simulation.recipes import Recipe

OPERATION = replace(load_recipe("operation"), shifts=())
FIELD = replace(load_recipe("field"), starts_per_motor=1, healthy_starts=0, shifts=())


def by_doubt(recipe: Recipe) -> tuple[FloatArray, FloatArray]:
    """Cases, those first of which the fit is least sure, and by how much it is."""
    cases = generate_arrays(recipe, 7, 30).X.astype(np.float64)
    logs = np.sort(begun_fit(recipe, cases, start_grid(recipe)).log_probability, axis=1)
    lead = logs[:, -1] - logs[:, -2]
    return cases[np.argsort(lead)], np.sort(lead)


@pytest.mark.parametrize("recipe", [OPERATION, FIELD], ids=lambda recipe: str(recipe.name))
def test_refined_probabilities_are_near_the_sampled_ones(recipe: Recipe) -> None:
    cases = by_doubt(recipe)[0][:4]
    got, effective = refined_probabilities(recipe, cases, np.random.default_rng(1))
    exact = np.array([sampled_probabilities(recipe, case, np.random.default_rng(2))[0] for case in cases])
    fit = work_probabilities(recipe, cases)
    assert np.square(got - exact).mean() < 0.05**2
    assert np.square(got - exact).sum() < 0.3 * np.square(fit - exact).sum()
    np.testing.assert_allclose(got.sum(axis=1), 1.0)
    assert ((effective > 0.0).sum(axis=1) >= 2).all()
    assert effective.max() <= 128.0
    again, _ = refined_probabilities(recipe, cases[2:], np.random.default_rng(1))
    np.testing.assert_allclose(again, got[2:], atol=1e-9)  # whatever stands beside it


def test_a_sure_case_is_left_to_the_fit() -> None:
    cases, lead = by_doubt(OPERATION)
    sure = cases[lead > 6.0][:2]
    got, effective = refined_probabilities(OPERATION, sure, np.random.default_rng(1))
    assert effective.sum() == 0.0
    np.testing.assert_allclose(got, work_probabilities(OPERATION, sure), atol=1e-4)


def test_a_class_out_of_the_question_keeps_what_the_fit_says_of_it() -> None:
    cases = by_doubt(FIELD)[0][:6]
    got, effective = refined_probabilities(FIELD, cases, np.random.default_rng(1))
    logs = begun_fit(FIELD, cases, start_grid(FIELD)).log_probability
    assert ((effective > 0.0) == (logs > logs.max(axis=1, keepdims=True) - 3.5)).all()
    far = np.where(effective > 0.0, 0.0, got).sum(axis=1)
    of_fit = np.where(effective > 0.0, 0.0, np.exp(logs)).sum(axis=1)
    np.testing.assert_allclose(far, of_fit, rtol=1e-9)


def test_the_odds_of_two_classes_go_by_their_weights() -> None:
    classes = tuple(replace(each, weight=2.0 if n == 0 else 1.0) for n, each in enumerate(OPERATION.classes))
    weighted = replace(OPERATION, classes=classes)
    case, told = by_doubt(OPERATION)[0][:1], []
    for recipe in (OPERATION, weighted):
        (got,), (effective,) = refined_probabilities(recipe, case, np.random.default_rng(1))
        told.append(np.where(effective > 0.0, np.log(got), np.nan))
    more = told[1] - told[0]
    others = more[1:][~np.isnan(more[1:])]
    assert others.size > 0
    np.testing.assert_allclose(more[0] - others, np.log(2.0), atol=1e-6)
