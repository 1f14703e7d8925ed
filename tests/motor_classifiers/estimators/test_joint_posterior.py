"""The joint posterior of class, severity and parameters: against the exact one, and by the ranks of the truth."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from motor_classifiers import JointPosterior, PosteriorNetwork

# Reaches in: a density is compared with scipy's, and the posterior with that of the linear motor.
from motor_classifiers.estimators.networks.parameter_density import (
    N_OUT,
    PARAMETERS,
    Scales,
    drawn,
    given_fault,
    parameter_loss,
)
from motor_datasets import generate_arrays
from motor_env import FaultKind, Timing, load_recipe
from motor_env.inference.class_model import ClassModel
from motor_env.simulation.recipes import FaultClass

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "benchmarks"))
from ranks import rank_check

BENCH = replace(
    load_recipe("bench", timing=Timing(1_000.0, 0.1)),
    classes=(
        FaultClass(),
        FaultClass(FaultKind.BEARING, 0.25),
        FaultClass(FaultKind.WINDING_CONTACT, 0.10, severity_to=0.25),
    ),
)
N_CASES = 1_000


@pytest.fixture(scope="module")
def joint() -> JointPosterior:
    return JointPosterior.around(PosteriorNetwork.from_recipe(BENCH, steps=400, random_state=0))


def test_the_density_is_a_normal_one() -> None:
    rng = np.random.default_rng(3)
    outputs, targets = rng.normal(scale=0.5, size=(2, N_OUT)), rng.normal(size=(2, len(PARAMETERS)))
    size = len(PARAMETERS)
    logs = []
    for row, target in zip(outputs, targets, strict=True):
        whitening = np.diag(np.exp(row[size : 2 * size]))
        whitening[np.tril_indices(size, -1)] = row[2 * size :]
        covariance = np.linalg.inv(whitening.T @ whitening)
        logs.append(multivariate_normal(row[:size], covariance).logpdf(target))
    loss = float(parameter_loss(torch.from_numpy(outputs), torch.from_numpy(targets)))
    assert loss == pytest.approx(-np.mean(logs) - 0.5 * size * np.log(2.0 * np.pi))
    scales = Scales(np.full(size, 2.0), np.arange(1.0, size + 1.0))
    many = drawn(torch.from_numpy(np.tile(outputs[:1], (40_000, 1))), scales, rng)
    standard = (np.log(many) - scales.center) / scales.width
    whitening = np.diag(np.exp(outputs[0, size : 2 * size]))
    whitening[np.tril_indices(size, -1)] = outputs[0, 2 * size :]
    white = (standard - outputs[0, :size]) @ whitening.T
    np.testing.assert_allclose(np.cov(white.T), np.eye(size), atol=0.04)
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=0.03)
    told = given_fault(torch.tensor([1, 0]), torch.tensor([0.5, 0.25]), 3)
    assert told.tolist() == [[0.0, 0.5, 0.0], [0.25, 0.0, 0.0]]


def test_given_the_class_it_is_the_posterior_of_the_linear_motor(joint: JointPosterior) -> None:
    healthy = generate_arrays(replace(BENCH, classes=(FaultClass(),)), 21, 60)
    draws = joint.sample(healthy.X, 800, np.random.default_rng(1))
    model = ClassModel(BENCH, BENCH.classes[0])
    read = model.readings(np.concatenate([np.zeros((1, 5)), 0.1 * np.eye(5)]))
    slopes = (read[1:] - read[:1]) / (0.1 * model.noise)
    covariance = np.linalg.inv(slopes @ slopes.T + np.eye(5))
    left = (healthy.X.reshape(len(healthy.X), -1) - read[0]) / model.noise
    mean, std = left @ slopes.T @ covariance, np.sqrt(np.diag(covariance))
    nominal = generate_arrays(replace(BENCH, classes=(FaultClass(),), spread=type(BENCH.spread)()), 21, 1)
    here = draws.label == "healthy"
    for n, name in enumerate(PARAMETERS):
        factor = (draws.parameters[name] / nominal.parameters[name][0] - 1.0) / BENCH.spread.std[n]
        enough = here.sum(axis=0) > 200
        assert enough.sum() > 20
        own = np.where(here, factor, np.nan)[:, enough]
        away = np.nanmean(own, axis=0) - mean[enough, n]
        assert np.sqrt(np.square(away).mean()) < 0.25 * std[n], name
        np.testing.assert_allclose(np.median(np.nanstd(own, axis=0)), std[n], rtol=0.15)


def test_the_truth_is_as_likely_anywhere_among_the_draws(joint: JointPosterior) -> None:
    cases = generate_arrays(BENCH, 22, N_CASES)
    draws = joint.sample(cases.X, 199, np.random.default_rng(2))
    shares = np.stack([(draws.label == name).mean(axis=0) for name in joint.network.classes_], axis=1)
    assert np.abs(shares - joint.network.predict_proba(cases.X)).max() < 5.0 * 0.5 / np.sqrt(199.0)
    ranks = {name: (drawn < cases.parameters[name]).mean(axis=0) for name, drawn in draws.parameters.items()}
    # Equal severities are ordered by chance.
    below, equal = ((draws.severity < cases.severity), (draws.severity == cases.severity))
    uniform = np.random.default_rng(3).uniform(size=N_CASES)
    ranks["severity"] = below.mean(axis=0) + uniform * equal.mean(axis=0)
    for name, rank in ranks.items():
        assert rank_check(rank, 0.001 / len(ranks)).inside, name
    assert (draws.severity[draws.label == "healthy"] == 0.0).all()
    assert (draws.severity[draws.label == "bearing_25"] == 0.25).all()
    contact = draws.severity[np.char.startswith(draws.label, "winding")]
    assert 0.10 <= contact.min() < 0.12
    assert 0.23 < contact.max() <= 0.25
    # What lies outside the range is left out, not heaped at its ends.
    assert np.isin(contact, [0.10, 0.25]).mean() < 0.05


def test_the_same_draws_again_and_what_it_refuses(joint: JointPosterior) -> None:
    X = generate_arrays(BENCH, 23, 3).X
    first, again, other = (joint.sample(X, 4, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first.label.shape == first.severity.shape == first.parameters["inertia_kg_m2"].shape == (4, 3)
    for name in PARAMETERS:
        np.testing.assert_array_equal(first.parameters[name], again.parameters[name])
        assert not np.array_equal(first.parameters[name], other.parameters[name])
    with pytest.raises(ValueError, match="n_draws must be >= 1, got 0"):
        joint.sample(X, 0, np.random.default_rng(0))
    blind = PosteriorNetwork(BENCH, steps=2, with_severity=False, random_state=0).fit_stream()
    with pytest.raises(ValueError, match="network must be trained on a recipe's stream and with_severity"):
        JointPosterior.around(blind)
    both = FaultClass(FaultKind.BEARING, 0.2, also=(FaultClass(FaultKind.WINDING_CONTACT, 0.1),))
    double = PosteriorNetwork.from_recipe(
        replace(BENCH, classes=(FaultClass(), both)), steps=2, random_state=0
    )
    with pytest.raises(ValueError, match="must have one fault a class for a joint posterior"):
        JointPosterior.around(double)
